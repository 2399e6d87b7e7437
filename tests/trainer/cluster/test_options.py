"""Command lines of `submit` and `tune` are checked before anything starts."""

import argparse
import sys

import pytest

from trainer import configs
from trainer.cli import main
from trainer.cluster.board import reason
from trainer.cluster.checked import Training, check_training, strategy_options
from trainer.cluster.engine import Cluster, _check_room
from trainer.cluster.fitting import Group
from trainer.cluster.space import Range, check_space, find_space, options, read_space
from trainer.cluster.sweep import Search
from trainer.commands import tune
from trainer.configs import UsageError

SPACES = sorted(path.name for path in (configs.folder() / configs.SEARCH).glob("*.yaml"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["submit", "rendr"], "did you mean 'render'"),
        (["submit"], "give --config"),
        (["submit", "--config", "wskp_bmf.yaml"], "did you mean wskp_bmfr.yaml"),
        (["submit", "--config", "wskp_bmfr.yaml", "--trainr.max_epochs", "3"], "'trainer.max_epochs'"),
        (["submit", "--config", "wskp_bmfr.yaml", "--trainer.devices", "2"], "--workers"),
        (["submit", "--config", "wskp_bmfr.yaml", "--trainer.strategy", "fsdp"], "fsdp"),
        (["submit", "--config", "wskp_bmfr.yaml", "--workers", "0"], "--workers 0"),
        (["submit", "--config", "wskp_bmfr.yaml", "--address", "somewhere"], "ray://HOST:10001"),
        (["submit", "prepare", "sample:bmfr", "--output", "x", "--patch-size", "0"], "patch_size"),
        (["submit", "render", "stills", "--output", "x"], "nothing to render"),
        (["submit", "render", "stills", "--random", "1", "--output", "x", "--storage", "s"], "--storage"),
        (["tune", "--config", "wskp_bmfr.yaml"], "--space"),
        (["tune", "--config", "wskp_bmfr.yaml", "--space", "none"], "wskp_bmfr.yaml"),
        (["tune", "--config", "wskp_bmfr.yaml", "--space", "wskp_bmfr.yaml", "--grace", "99"], "--grace 99"),
    ],
)
def test_wrong_usage_ends_with_code_2_before_ray_is_imported(arguments, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["trainer", *arguments])
    monkeypatch.setitem(sys.modules, "ray", None)  # an import would fail
    monkeypatch.setattr("trainer.cluster.engine.need_ray", lambda: None)
    assert main() == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert said in error


def test_missing_extra_names_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["trainer", "submit", "--config", "wskp_bmfr.yaml"])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "optuna" else argparse)
    monkeypatch.setattr("trainer.cli._check_packages", lambda: None)
    assert main() == 1
    assert 'pip install "penumbra-denoise[ray]"' in capsys.readouterr().err


def test_nothing_at_an_address_is_said_at_once(monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["trainer", "submit", "--config", "wskp_bmfr.yaml", "--address", "ray://127.0.0.1:9"]
    )
    assert main() == 1
    assert "nothing can be reached" in capsys.readouterr().err


def test_configurations_travel_by_value(tmp_path):
    overlay = tmp_path / "mine.yaml"
    overlay.write_text("trainer: {max_epochs: 3, logger: {init_args: {experiment: other}}}\n")
    training = check_training(["--config", "wskp_bmfr.yaml", f"--config={overlay}", "--seed_everything", "5"])
    overlay.unlink()
    assert training.arguments == ("--config", "{0}", "--config={1}", "--seed_everything", "5")
    assert (training.root, training.experiment) == ("runs", "other")
    there = tmp_path / "there"
    there.mkdir()
    arguments = training.restored(there)
    assert (there / "config-1.yaml").read_text().startswith("trainer: {max_epochs: 3")
    assert check_training(arguments).experiment == "other"


def test_strategies_become_options_of_ddp():
    from lightning.pytorch.strategies import DDPStrategy

    assert strategy_options("ddp_find_unused_parameters_true") == {"find_unused_parameters": True}
    assert strategy_options(DDPStrategy(static_graph=True)) == {"static_graph": True}
    with pytest.raises(UsageError, match="fsdp"):
        strategy_options("fsdp")


@pytest.mark.parametrize("name", SPACES)
def test_every_key_of_a_shipped_space_is_one_of_its_configuration(name):
    path = find_space(name)
    assert path.read_text().startswith("# ")
    check_space(read_space(path), ["--config", name], path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model.net.layerz: {choice: [2, 4]}", "did you mean 'layers'"),
        ("model.net.layers: {choice: [2, many]}", "many"),
        ("model.net.layers: {chioce: [2]}", "did you mean 'choice'"),
        ("model.net.layers: [2, 4]", "expected one of"),
        ("model.net.layers: {int: [4, 2]}", "the smaller first"),
        ("model.net.layers: {int: [2.5, 4]}", "two integers"),
        ("model.optimizer.init_args.lr: {loguniform: [0, 1]}", "positive"),
        ("- 3", "expected lines"),
        ("a: [", "no YAML"),
    ],
)
def test_wrong_space_is_refused_with_the_key(tmp_path, text, said):
    path = tmp_path / "space.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=said):
        check_space(read_space(path), ["--config", "wskp_bmfr.yaml"], path)


def test_spaces_are_no_configurations():
    assert SPACES
    assert not [name for name in configs.names() if name.startswith(configs.SEARCH)]


def test_negative_values_with_an_exponent_are_values_and_no_options(tmp_path):
    assert options({"b": -1e-05, "a": "x"}) == ["--a=x", "--b=-1e-05"]
    path = tmp_path / "space.yaml"
    path.write_text("model.optimizer.init_args.lr: {uniform: [-0.00001, 0.1]}")
    check_space(read_space(path), ["--config", "wskp_bmfr.yaml"], path)


@pytest.fixture
def begun(tmp_path):
    """Folder of a search that was begun in another folder than this."""
    training = Training(("--config", "{0}"), ("",), "runs", "exp", "sqlite:///x.db")
    space = {"a": Range("choice", (1, 2))}
    search = Search(training, space, 5, Group(2), "val/psnr", "max", 4, 1, 3, 7, 0, str(tmp_path / "work"))
    search.save(tmp_path)
    assert Search.load(tmp_path) == search
    return tmp_path


def resumed(folder, *words):
    parser = argparse.ArgumentParser()
    tune.add_arguments(parser)
    args, args.rest = parser.parse_known_args(["--resume", str(folder), *words])
    return tune._resumed(args, folder)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "1"], "--workers 1: .* begun with 2"),
        (["--max-failures", "0"], "--max-failures 0: .* begun with 3"),
        (["--no-early-stop"], "--no-early-stop: .* begun without"),
        (["--search-seed", "8"], "--search-seed 8: .* begun with 7"),
        (["--space", "wskp_bmfr.yaml"], "--space"),
        (["--trainer.max_epochs", "9"], "--trainer.max_epochs"),
    ],
)
def test_search_that_is_resumed_refuses_what_it_was_not_begun_with(begun, words, said):
    with pytest.raises(UsageError, match=said):
        resumed(begun, *words)


def test_search_that_is_resumed_takes_what_it_was_begun_with(begun):
    search = resumed(begun, "--workers", "2", "--trials", "5", "--concurrent", "1")
    assert (search.concurrent, search.folder) == (1, str(begun / "work"))


class Nodes:
    """A cluster of two nodes with two processors and one GPU each."""

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": 2.0, "GPU": 1.0}}] * 2 + [{"Alive": False}]


def test_job_that_this_machine_has_no_room_for_is_refused_with_the_numbers():
    _check_room(Nodes(), Cluster(None, 2, 2, 1))
    _check_room(Nodes(), Cluster(None, 9, 2, 1, together=False))
    with pytest.raises(ValueError, match=r"needs 3 × 1 GPUs, and this machine has 2"):
        _check_room(Nodes(), Cluster(None, 3, 1, 1))


@pytest.mark.parametrize(("cluster", "said"), [
    (Cluster("auto", 2, 3), "needs 2 × 3 CPUs, and the cluster has 4, at most 2 on a node; it waits"),
    (Cluster("auto", 9, 1, together=False), ""),
])  # fmt: skip
def test_job_that_waits_for_nodes_of_a_cluster_says_so(cluster, said, capsys):
    _check_room(Nodes(), cluster)
    error = capsys.readouterr().err
    assert said in error
    assert bool(said) == bool(error)


def test_failure_in_the_cluster_is_told_by_what_was_raised():
    text = "ray::_Head.run() (pid=7)\n  File \"x.py\", line 3\nTypeError: 'int' object\n"
    assert reason(RuntimeError(text)) == "TypeError: 'int' object"
    assert reason("its process died") == "its process died"
