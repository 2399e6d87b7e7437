import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from jsonargparse import Namespace
from lightning.pytorch import Trainer
from lightning.pytorch.utilities import rank_zero_only

from models import WSKP
from tests.synthetic import Synthetic, patch
from trainer.callbacks import (
    AtomicCheckpointIO,
    ExportBest,
    FiniteGuard,
    LastCheckpoint,
    ValidationPictures,
    recorder,
)
from trainer.callbacks.progress import TrainingProgress, duration
from trainer.callbacks.recorder import RunRecorder, flatten, git_state, installed
from trainer.modules import Regression
from trainer.tracking import MLflowTracking, open_client

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
]


def small_trainer(folder, *callbacks, **options):
    return Trainer(
        default_root_dir=folder, max_epochs=1, logger=False, callbacks=list(callbacks), accelerator="cpu",
        enable_model_summary=False, num_sanity_val_steps=0, **options,
    )  # fmt: skip


def test_killed_writer_leaves_the_previous_checkpoint_whole(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({"step": 1}, path)

    def interrupted(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        writer.save_checkpoint({"step": 2}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert os.listdir(tmp_path) == ["last.ckpt"]


def test_full_disk_is_an_error_that_names_the_checkpoint(tmp_path, monkeypatch):
    real = torch.save
    monkeypatch.setattr(torch, "save", lambda data, path: real(data, "/dev/full"))
    with pytest.raises(OSError, match=r"cannot write checkpoint .*last\.ckpt"):
        AtomicCheckpointIO().save_checkpoint({"w": torch.zeros(1 << 16)}, tmp_path / "last.ckpt")
    assert os.listdir(tmp_path) == []


def second_rank(monkeypatch, first):
    """A trainer as the second of two processes sees it, with the folder of `first` arriving by broadcast."""
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    logger = MLflowTracking("exp", system_metrics=False)
    strategy = SimpleNamespace(broadcast=lambda own: own or str(first.folder.resolve()))
    return SimpleNamespace(
        logger=logger, loggers=[logger], strategy=strategy, is_global_zero=False, global_rank=1,
        global_step=5, default_root_dir=".",
    )  # fmt: skip


@pytest.fixture
def first_rank(workplace, monkeypatch):
    logger = MLflowTracking("exp", system_metrics=False)
    assert logger.folder.is_dir()
    yield logger
    monkeypatch.setattr(rank_zero_only, "rank", 0)
    logger.finalize("failed")


def test_other_ranks_save_into_the_first_ranks_folder_and_create_none(first_rank, monkeypatch):
    folder = first_rank.folder
    trainer = second_rank(monkeypatch, first_rank)
    assert trainer.logger.save_dir is None
    assert trainer.logger.version is None
    callback = LastCheckpoint()
    callback.setup(trainer, None, "fit")
    assert callback.dirpath == str(folder.resolve() / "checkpoints")
    assert trainer.logger.save_dir == str(folder.resolve())
    assert list(folder.parent.iterdir()) == [folder]


def test_batch_of_another_rank_is_saved_in_the_first_ranks_folder(first_rank, monkeypatch):
    folder = first_rank.folder
    trainer = second_rank(monkeypatch, first_rank)
    guard = FiniteGuard()
    guard.setup(trainer, None, "fit")
    module = SimpleNamespace(trainer=trainer, automatic_optimization=True)
    guard.on_train_batch_start(trainer, module, {"color": torch.ones(1)}, 0)
    with pytest.raises(ValueError, match="the loss became nan at step 6"):
        guard.on_before_backward(trainer, module, torch.tensor(float("nan")))
    assert [path.name for path in folder.iterdir()] == ["diverged-step6-rank1.pt"]
    assert list(folder.parent.iterdir()) == [folder]


class _Poisoned(Synthetic):
    def train_dataloader(self):
        bad = patch(0)
        bad["irradiance"] = bad["irradiance"].clone()
        bad["irradiance"][0, 3, 3] = float("nan")
        return torch.utils.data.DataLoader([patch(1), bad], 1)


def test_first_loss_that_is_not_finite_stops_with_the_batch_saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"loss became nan at step 2; not finite in the batch: irradiance"):
        small_trainer(tmp_path, FiniteGuard(), limit_val_batches=0).fit(
            Regression(WSKP(layers=3)), datamodule=_Poisoned()
        )
    saved = torch.load(next(tmp_path.glob("diverged-step2-*.pt")), weights_only=True)
    assert torch.isnan(saved["irradiance"]).any()
    assert saved["scene"] == ["step"]


def test_last_checkpoint_holds_the_end_of_training_whatever_the_interval(tmp_path):
    callback = LastCheckpoint(every_n_train_steps=3)
    callback.dirpath = str(tmp_path)
    small_trainer(tmp_path, callback).fit(Regression(WSKP(layers=3)), datamodule=Synthetic())
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == 4


def test_plain_lines_tell_rate_waiting_loss_and_time_left(tmp_path, capsys):
    progress = TrainingProgress(plain_interval_s=0.0)
    trainer = small_trainer(tmp_path, progress, log_every_n_steps=2)
    trainer.fit(Regression(WSKP(layers=3)), datamodule=Synthetic())
    lines = capsys.readouterr().err.splitlines()
    first = next(line for line in lines if "step 1/4" in line)
    assert "left" in first
    assert "patches/s" not in first, "it is not measured yet"
    step = next(line for line in lines if "step 4/4" in line)
    assert all(word in step for word in ("patches/s", "waiting", "loss", "left"))
    assert any("validation PSNR" in line for line in lines)
    assert 0 <= float(trainer.logged_metrics["throughput/waiting"]) <= 1


@pytest.mark.parametrize(
    ("options", "validated", "pictured"),
    [
        ({"max_epochs": 12}, range(12), [0, 5, 10, 11]),
        ({"max_epochs": 12, "check_val_every_n_epoch": 2}, range(1, 12, 2), [1, 7, 11]),
        ({"max_epochs": 13, "check_val_every_n_epoch": 4}, range(3, 13, 4), [3, 11]),
        ({"max_epochs": -1, "max_steps": 8}, range(8), [0, 5, 7]),
    ],
)
def test_first_and_last_validated_epochs_are_pictured_and_some_between(options, validated, pictured):
    defaults = {"max_steps": -1, "check_val_every_n_epoch": 1, "sanity_checking": False}
    state = SimpleNamespace(fn="fit")
    whole, kept, first = [], [], ValidationPictures(every_n_epochs=5)
    for epoch in validated:
        trainer = SimpleNamespace(
            current_epoch=epoch, global_step=epoch + 1, state=state, **defaults | options
        )
        first.on_validation_epoch_start(trainer, None)
        whole += [epoch] * first.due
        continued = ValidationPictures(every_n_epochs=5)  # as if killed and resumed after every epoch
        continued.load_state_dict(kept[-1] if kept else {})
        continued.on_validation_epoch_start(trainer, None)
        assert continued.due == first.due
        kept.append(continued.state_dict())
    assert whole == pictured


def test_format_that_cannot_be_exported_leaves_the_others(first_rank, monkeypatch, capsys):
    checkpoint = first_rank.folder / "checkpoints" / "best.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"x")
    exported = []

    def export(self, logger, checkpoint, format):
        if format == "onnx":
            raise ValueError("it differs")
        exported.append(format)

    monkeypatch.setattr(ExportBest, "_export", export)
    ExportBest().on_fit_end(SimpleNamespace(logger=first_rank, is_global_zero=True), None)
    assert exported == ["torchscript"]
    said = capsys.readouterr().err
    assert "The export failed: it differs" in said
    assert f"trainer export --model {checkpoint} --format onnx" in said


def test_best_weights_of_a_method_that_is_never_exported_stay_a_checkpoint(first_rank, monkeypatch, capsys):
    checkpoint = first_rank.folder / "checkpoints" / "best.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"x")
    exported = []
    monkeypatch.setattr(ExportBest, "_export", lambda *arguments: exported.append(arguments))
    module = SimpleNamespace(net=SimpleNamespace(no_export="it is a loop"))
    ExportBest().on_fit_end(SimpleNamespace(logger=first_rank, is_global_zero=True), module)
    assert exported == []
    assert capsys.readouterr().err == f"{checkpoint} is not exported: it is a loop\n"


def test_durations_read_as_people_say_them():
    assert [duration(s) for s in (7.4, 65, 3723)] == ["7 s", "1:05", "1:02:03"]


def test_flattened_configuration_has_dotted_names_and_no_empty_values():
    tree = {"a": {"b": 1, "c": None}, "list": [{"class_path": "x.Y"}, {"class_path": "z.W"}], "config": ["f"]}
    assert flatten(tree) == {"a.b": 1, "list": "x.Y, z.W"}


def test_resumed_configurations_lie_beside_the_first_in_folder_and_run(first_rank, monkeypatch, capsys):
    monkeypatch.setattr(recorder, "installed", lambda: ["penumbra==1"])
    module = Regression(WSKP(layers=3))
    for number in range(3):
        logger = first_rank if number == 0 else MLflowTracking("exp", resume_from=str(first_rank.folder))
        logger.system_metrics = False
        parser = SimpleNamespace(dump=lambda config, skip_none: f"seed: {config.seed}")
        config = Namespace(seed=number)
        trainer = SimpleNamespace(logger=logger, datamodule=Synthetic())
        RunRecorder(parser, config, save_to_log_dir=False).save_config(trainer, module, "fit")
        logger.finalize("success")
    names = ("config.yaml", "config-resumed-1.yaml", "config-resumed-2.yaml")
    texts = [f"seed: {number}" for number in range(3)]
    assert [(first_rank.folder / name).read_text() for name in names] == texts
    client = open_client(first_rank.uri)
    stored = [client.download_artifacts(first_rank.run_id, name) for name in names]
    assert [Path(path).read_text() for path in stored] == texts
    run = client.get_run(first_rank.run_id)
    assert run.data.params == {"seed": "0"}
    assert run.data.tags["changed.config-resumed-2"] == "seed: 0 → 2"
    assert "seed: 0 → 1" in capsys.readouterr().err


def test_run_that_continues_as_it_was_keeps_no_second_configuration(first_rank, monkeypatch, capsys):
    monkeypatch.setattr(recorder, "installed", lambda: ["penumbra==1"])
    for resume_from in (None, str(first_rank.folder)):
        parser = SimpleNamespace(dump=lambda config, skip_none: f"lr: 1\nckpt_path: {config.resume_from}")
        config = Namespace(lr=1, resume_from=resume_from)
        trainer = SimpleNamespace(logger=first_rank, datamodule=Synthetic())
        module = Regression(WSKP(layers=3))
        RunRecorder(parser, config, save_to_log_dir=False).save_config(trainer, module, "fit")
    assert [path.name for path in first_rank.folder.glob("*.yaml")] == ["config.yaml"]
    assert "other values" not in capsys.readouterr().err


def test_record_of_the_environment_lists_what_is_installed_and_the_commit(tmp_path):
    assert any(line.lower().startswith("torch==") for line in installed())
    state = git_state(tmp_path)
    assert state == {} or len(state["git.commit"]) == 40
