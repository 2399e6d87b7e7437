"""What variants train is checked before anything is trained."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from trainer import configs
from trainer.ablation.plan import Ablation, Variant, read_ablation
from trainer.ablation.variants import Training, trainings_of
from trainer.cluster.checked import parsed
from trainer.configs import UsageError

WSKP = ("wskp_bmfr.yaml",)
REST = ("--trainer.max_epochs", "2", "--model.net.width", "9")


def ablation(*variants: Variant) -> Ablation:
    return Ablation("sizes", "Sizes", variants)


@pytest.fixture(scope="module")
def pair() -> list[Training]:
    """Two variants, of which the second sets what the options of all set too."""
    narrow = Variant("narrow", WSKP, {"model.net.width": 4, "model.net.kernel_sizes": [3, 5]})
    return trainings_of(ablation(Variant("plain", WSKP), narrow), REST)


def config_of(training: Training, **tags: str) -> Any:
    return parsed(training.command(tags))


def test_a_variant_has_the_options_of_all_and_its_own_count_more(pair: list[Training]) -> None:
    plain, narrow = (config_of(training) for training in pair)
    assert (plain.trainer.max_epochs, narrow.trainer.max_epochs) == (2, 2)
    nets = [config.model.init_args.net.init_args for config in (plain, narrow)]
    assert [net.width for net in nets] == [9, 4]
    assert list(nets[1].kernel_sizes) == [3, 5]


def test_the_command_line_counts_more_than_common_options_and_less_than_own_ones() -> None:
    common = {"trainer.max_epochs": 7, "model.net.width": 5, "trainer.max_steps": 11}
    made = Variant("one", WSKP, {"model.net.width": 4}, common=common)
    config = config_of(trainings_of(ablation(made), REST)[0])
    assert (config.trainer.max_epochs, config.trainer.max_steps) == (2, 11)
    assert config.model.init_args.net.init_args.width == 4


def test_a_variant_registers_no_model_and_its_run_is_tagged(pair: list[Training]) -> None:
    callbacks = config_of(pair[0], **{"mlflow.parentRunId": "abc"}).trainer.callbacks
    names = [callback.class_path.rpartition(".")[2] for callback in callbacks]
    assert names[-1] == "RunTags"
    assert callbacks[-1].init_args.tags == {"mlflow.parentRunId": "abc"}
    assert "ExportBest" not in names
    assert {"BestCheckpoint", "LastCheckpoint", "FiniteGuard", "TrainingProgress"} <= set(names)
    assert (pair[0].experiment, pair[0].data, str(pair[0].root)) == ("sizes", "sample:bmfr", "runs")


def test_a_run_is_found_again_where_the_shipped_files_have_moved(
    pair: list[Training], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = tmp_path / "configs"
    shutil.copytree(configs.folder(), moved)
    monkeypatch.setattr(configs, "folder", lambda: moved)
    again = trainings_of(ablation(Variant("plain", WSKP)), REST)[0]
    assert str(moved) in " ".join(again.arguments)
    assert again.launch("a") == pair[0].launch("a")


def test_what_is_trained_and_nothing_else_decides_which_run_is_gone_on_with(pair: list[Training]) -> None:
    again = trainings_of(
        ablation(Variant("other name", WSKP)), [*REST, "--trainer.logger.init_args.root", "r"]
    )[0]
    assert again.launch("a") == pair[0].launch("a") != pair[0].launch("b")
    assert pair[0].launch("a") != pair[1].launch("a")
    longer = trainings_of(ablation(Variant("plain", WSKP)), [*REST, "--trainer.max_epochs", "3"])[0]
    assert longer.launch("a") != pair[0].launch("a")


def test_callbacks_are_part_of_what_is_trained_and_how_it_is_shown_is_not() -> None:
    def made(monitor: str, interval: float) -> Training:
        best = {"class_path": "trainer.callbacks.BestCheckpoint", "init_args": {"monitor": monitor}}
        shown = {
            "class_path": "trainer.callbacks.TrainingProgress",
            "init_args": {"plain_interval_s": interval},
        }
        given = {"trainer.callbacks": [shown, best]}
        return trainings_of(ablation(Variant("a", WSKP, given)), ())[0]

    first = made("val/psnr_wskp", 15.0)
    assert made("val/psnr_wskp", 3.0).digest == first.digest
    assert made("val/ssim_wskp", 15.0).digest != first.digest


@pytest.mark.parametrize(
    ("variants", "rest", "said"),
    [
        ([Variant("a", WSKP, {"model.net.widht": 4})], (), "variant 'a': unknown option 'widht'; did you"),
        ([Variant("a", WSKP, {"model.net.layers": "x"})], (), "variant 'a': "),
        ([Variant("a", ("wskp_bmf.yaml",))], (), "did you mean wskp_bmfr.yaml"),
        ([Variant("a", WSKP), Variant("b", WSKP)], (), "variants 'a' and 'b' are the same training"),
        (
            [Variant("a", WSKP), Variant("b", ("wskp_mr_stills.yaml",))], (),
            "trained on sample:bmfr (a), sample:stills (b); give --data.root",
        ),
        ([Variant("a", WSKP)], ("--trainer.logger", "false"), "--trainer.logger: runs of variants are found"),
        ([Variant("a", WSKP)], ("--ckpt_path", "last"), "--ckpt_path: variants are trained from their b"),
    ],
)  # fmt: skip
def test_what_cannot_be_trained_is_refused_by_name(
    variants: list[Variant], rest: tuple[str, ...], said: str
) -> None:
    with pytest.raises(UsageError) as stopped:
        trainings_of(ablation(*variants), rest)
    assert said in str(stopped.value)


def test_a_file_of_ones_own_lays_configurations_over_each_other(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("trainer:\n  max_epochs: 7\n")
    variant = {"name": "kp1", "config": ["kp_bmfr.yaml", "kp1_bmfr.yaml", str(tmp_path / "mine.yaml")]}
    (tmp_path / "a.yaml").write_text(json.dumps({"variants": [variant]}))
    made = trainings_of(read_ablation(tmp_path / "a.yaml"), ())[0]
    config = config_of(made)
    assert config.model.init_args.net.init_args.layers == 2
    assert config.trainer.max_epochs == 7
    assert made.experiment == "a"
