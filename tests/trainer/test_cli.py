import subprocess
import sys

import pytest

from trainer import cli, configs
from trainer.training import explain


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["trainer", *arguments])
    code = cli.main()
    return code, capsys.readouterr()


def test_help_lists_every_command_and_imports_nothing_heavy():
    script = (
        "import sys; sys.argv = ['trainer', '--help']; from trainer.cli import main; main();"
        "print(sorted({'torch', 'lightning', 'mlflow', 'numpy', 'OpenEXR'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert all(name in done.stdout for name in (*cli.TRAINING, *cli.COMMANDS))


def test_every_listed_command_has_a_module_with_the_three_names():
    import importlib

    for name in cli.COMMANDS:
        module = importlib.import_module(f"trainer.commands.{name}")
        assert isinstance(module.HELP, str)
        assert callable(module.add_arguments)
        assert callable(module.run)


def test_misspelt_command_names_the_nearest_and_exits_with_2(monkeypatch, capsys):
    code, printed = run(monkeypatch, capsys, "prepair")
    assert code == 2
    assert "did you mean 'prepare'?" in printed.err


def test_misspelt_configuration_names_the_nearest_and_exits_with_2(monkeypatch, capsys):
    code, printed = run(monkeypatch, capsys, "fit", "--config", "wksp_bmfr.yaml")
    assert code == 2
    assert "did you mean wskp_bmfr.yaml?" in printed.err


@pytest.mark.parametrize(
    ("option", "meant"),
    [
        ("--trainer.max_epoch=3", "max_epochs"),
        ("--model.init_args.net.init_args.layer=3", "layers"),
        ("--data.batchsize=3", "batch_size"),
        ("--modle=3", "model"),
    ],
)
def test_misspelt_option_is_an_error_that_names_the_nearest(monkeypatch, capsys, option, meant):
    code, printed = run(monkeypatch, capsys, "fit", "--config", "wskp_bmfr.yaml", option)
    assert code == 2
    assert f"{meant}'?" in printed.err
    assert "Traceback" not in printed.err


def test_misspelt_key_in_a_file_is_an_error_that_names_the_nearest(monkeypatch, capsys, tmp_path):
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text("model:\n  init_args:\n    net:\n      init_args:\n        widht: 14\n")
    code, printed = run(monkeypatch, capsys, "fit", "--config", "wskp_bmfr.yaml", "--config", str(overlay))
    assert code == 2
    assert "width'?" in printed.err


def test_bare_names_resolve_from_any_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert configs.resolve("wskp_bmfr.yaml").endswith("wskp_bmfr.yaml")
    assert configs.resolve_arguments(["--config=smoke"])[0].endswith("smoke.yaml")


def test_a_file_of_the_users_comes_before_a_shipped_one(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wskp_bmfr.yaml").write_text("{}")
    assert configs.resolve("wskp_bmfr.yaml") == "wskp_bmfr.yaml"


def test_print_config_shows_defaults_file_and_overrides(monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["trainer", "fit", "--config", "wskp_bmfr.yaml", "--data.batch_size=3", "--print_config"]
    )
    with pytest.raises(SystemExit) as stop:
        cli.main()
    text = capsys.readouterr().out
    assert stop.value.code in (0, None)
    for part in (
        "root: sample:bmfr",
        "batch_size: 3",
        "trainer.tracking.MLflowTracking",
        "layers: 6",
        "SMAPE",
    ):
        assert part in text, part


def test_accelerator_that_is_absent_is_one_line_and_exit_1(monkeypatch, capsys, tmp_path):
    import torch

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    code, printed = run(
        monkeypatch, capsys, "fit", "--config", "wskp_bmfr.yaml", "--trainer.accelerator", "cuda"
    )
    assert code == 1
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert "CUDAAccelerator" in printed.err


def test_unusable_tracking_uri_is_one_line_that_names_it_and_exit_1(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "foo://x")
    code, printed = run(monkeypatch, capsys, "models")
    assert code == 1
    assert printed.err.startswith("error: cannot read the model store foo://x: ")
    assert printed.err.count("\n") == 1


def failing(monkeypatch, error):
    def fail(verb, arguments):
        raise error

    monkeypatch.setattr(cli, "_run", fail)


def database_error():
    from mlflow.exceptions import MlflowException

    return MlflowException(
        "(raised as a result of Query-invoked autoflush; consider …)\n"
        "(sqlite3.OperationalError) attempt to write a readonly database\n[SQL: INSERT INTO runs …]"
    )


def device_error():
    return RuntimeError("CUDA error: invalid device ordinal\nCUDA kernel errors might be reported later")


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (database_error, "attempt to write a readonly database"),
        (device_error, "CUDA error: invalid device ordinal"),
        (lambda: AssertionError("Torch not compiled with CUDA enabled"), "not compiled with CUDA"),
        (lambda: RuntimeError("pair.cc:537] Read error [127.0.0.1]:1: Connection reset by peer. Check"),
         "another process of this training ended (Connection reset by peer)"),
        (lambda: RuntimeError("DataLoader worker (pid 26894) is killed by signal: Killed. "),
         "DataLoader worker (pid 26894) is killed by signal: Killed; if nobody ended it"),
        (lambda: RuntimeError("DataLoader worker (pid(s) 1, 2) exited unexpectedly"), "ran out of memory"),
    ],
)  # fmt: skip
def test_failures_of_the_surroundings_are_one_line_and_exit_1(monkeypatch, capsys, make, text):
    failing(monkeypatch, make())
    code, printed = run(monkeypatch, capsys, "fit")
    assert code == 1
    assert printed.err.startswith("error: ")
    assert text in printed.err
    assert printed.err.count("\n") == 1


def test_traceback_of_a_foreseen_failure_is_shown_on_demand(monkeypatch, capsys):
    monkeypatch.setenv("PENUMBRA_TRACEBACK", "1")
    failing(monkeypatch, device_error())
    with pytest.raises(RuntimeError, match="invalid device ordinal"):
        run(monkeypatch, capsys, "fit")


@pytest.mark.parametrize(
    "error", [RuntimeError("shapes differ"), AssertionError(), KeyError("x"), TypeError("x")]
)
def test_errors_that_are_bugs_keep_their_traceback(monkeypatch, capsys, error):
    failing(monkeypatch, error)
    with pytest.raises(type(error)):
        run(monkeypatch, capsys, "fit")


def test_messages_without_a_near_name_are_left_whole():
    assert explain("something else is wrong", {"model"}) == "something else is wrong"
