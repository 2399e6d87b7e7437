"""The data module with Lightning's own trainer: what is read, in which order, and after an interruption."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from data.module import Shards
from data.shards.index import Index
from data.shards.options import PrepareOptions
from data.shards.prepare import prepare
from tests.data.small_sets import CHANNELS, OPTIONS, write_set, write_shards, write_stills

INPUTS = ("irradiance", "albedo", "normal", "depth")
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval.*"),
    pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`, callbacks used to create"),
]


class Seen(LightningModule):
    """Notes what each training batch held; one parameter, so that an optimiser has something to do."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.batches: list[tuple[int, tuple[str, ...], float]] = []
        self.stop_at = stop_at

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> torch.Tensor:
        if self.stop_at is not None and self.trainer.global_step == self.stop_at:
            raise KeyError("stopped")
        summary = float(batch["irradiance"].double().sum() + batch["exposure"].double().sum())
        self.batches.append((self.trainer.current_epoch, tuple(batch["key"]), summary))
        return self.weight * 0

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        pass

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Index:
    return write_shards(tmp_path_factory.mktemp("shards"))


def module(index: Index, workers: int = 0, **options: Any) -> Shards:
    options = {"batch_size": 4, "buffers": INPUTS, "exposure_stops": 1.0, **options}
    return Shards(str(index.root), workers=workers, **options)


def fit(
    data: Shards,
    net: Seen,
    folder: Path,
    checkpoint: Path | None = None,
    callbacks: list[Callback] | None = None,
    **options: Any,
) -> Trainer:
    trainer = Trainer(
        **{"max_epochs": 3, "limit_val_batches": 0, **options},
        accelerator="cpu",
        devices=1,
        logger=False,
        enable_checkpointing=bool(callbacks),
        callbacks=callbacks,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        barebones=False,
    )
    trainer.fit(net, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    return trainer


@pytest.fixture(scope="module")
def uninterrupted(index: Index, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    net = Seen()
    fit(module(index), net, tmp_path_factory.mktemp("run"))
    return net.batches


def test_three_epochs_have_the_length_of_the_loader_and_differ(index: Index, uninterrupted: list[Any]):
    data = module(index)
    length = len(data.train_dataloader())
    assert length == index.count("train") // 4
    assert [epoch for epoch, _, _ in uninterrupted] == [0] * length + [1] * length + [2] * length
    epochs = [uninterrupted[i * length : (i + 1) * length] for i in range(3)]
    assert len({tuple(keys for _, keys, _ in epoch) for epoch in epochs}) == 3
    for epoch in epochs:
        keys = [key for _, names, _ in epoch for key in names]
        assert len(keys) == len(set(keys)) == 4 * length


@pytest.mark.parametrize("workers", [1, 2])
def test_order_and_values_do_not_depend_on_the_number_of_workers(index, uninterrupted, tmp_path, workers):
    net = Seen()
    fit(module(index, workers), net, tmp_path)
    assert net.batches == uninterrupted


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("after", ["first", "middle", "last of the epoch", "into the second epoch"])
def test_a_resumed_run_sees_exactly_the_batches_that_were_left(
    index, uninterrupted, tmp_path, workers, after
):
    length = len(uninterrupted) // 3
    steps = {
        "first": 1,
        "middle": length // 2,
        "last of the epoch": length,
        "into the second epoch": length + 3,
    }
    step = steps[after]
    saver = ModelCheckpoint(tmp_path, every_n_train_steps=step, save_top_k=-1, filename="{step}")
    with pytest.raises(KeyError):
        fit(module(index, workers), Seen(stop_at=step + 1), tmp_path, callbacks=[saver])
    resumed = Seen()
    fit(module(index, workers), resumed, tmp_path, tmp_path / f"step={step}.ckpt")
    assert resumed.batches == uninterrupted[step:]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_run_resumed_from_the_end_of_an_epoch_begins_the_next(index, uninterrupted, tmp_path, workers):
    length = len(uninterrupted) // 3
    saver = ModelCheckpoint(tmp_path, every_n_epochs=1, save_top_k=-1, filename="{epoch}")
    with pytest.raises(KeyError):
        fit(module(index, workers), Seen(stop_at=2 * length + 1), tmp_path, callbacks=[saver])
    resumed = Seen()
    fit(module(index, workers), resumed, tmp_path, tmp_path / "epoch=1.ckpt")
    assert resumed.batches == uninterrupted[2 * length :]


def test_a_checkpoint_of_an_exception_repeats_the_batch_that_was_not_finished(index, uninterrupted, tmp_path):
    saver = ModelCheckpoint(tmp_path, save_on_exception=True, filename="{step}", every_n_epochs=99)
    with pytest.raises(KeyError):
        fit(module(index), Seen(stop_at=5), tmp_path, callbacks=[saver])
    (checkpoint,) = tmp_path.glob("*.ckpt")
    resumed = Seen()
    fit(module(index), resumed, tmp_path, checkpoint)
    assert resumed.batches == uninterrupted[5:]


def test_a_run_resumed_after_validation_in_mid_epoch_goes_on(index, uninterrupted, tmp_path):
    saver = ModelCheckpoint(tmp_path, every_n_train_steps=4, save_top_k=-1, filename="{step}")
    options = {"limit_val_batches": 1.0, "val_check_interval": 4, "num_sanity_val_steps": 0}
    with pytest.raises(KeyError):
        fit(module(index), Seen(stop_at=6), tmp_path, callbacks=[saver], **options)
    resumed = Seen()
    fit(module(index), resumed, tmp_path, tmp_path / "step=4.ckpt", **options)
    assert resumed.batches == uninterrupted[4:]


def test_a_limited_epoch_reads_the_beginning_of_the_full_one(index, uninterrupted, tmp_path):
    length = len(uninterrupted) // 3
    net = Seen()
    fit(module(index, 1), net, tmp_path, limit_train_batches=3)
    assert net.batches == [batch for epoch in range(3) for batch in uninterrupted[epoch * length :][:3]]


def test_overfitting_sees_the_same_batches_in_every_epoch(index, tmp_path):
    net = Seen()
    fit(module(index, augment=False, exposure_stops=0.0), net, tmp_path, overfit_batches=2)
    keys = [names for _, names, _ in net.batches]
    assert keys[:2] == keys[2:4] == keys[4:]


def test_a_loader_without_trainer_continues_from_its_state(index: Index):
    loader = module(index).train_dataloader()
    loader.set_epoch(4)
    expected = [batch["key"] for batch in loader]
    first = iter(loader)
    for _ in range(3):
        next(first)
    state = loader.state_dict()
    again = module(index).train_dataloader()
    again.load_state_dict(state)
    assert [batch["key"] for batch in again] == expected[3:]
    loader.load_state_dict({**state, "batch": len(loader)})
    assert loader.epoch == 5


def test_resuming_in_mid_epoch_with_another_batch_size_warns(index: Index):
    loader = module(index).train_dataloader()
    state = {**loader.state_dict(), "batch": 2}
    with pytest.warns(UserWarning, match="batch_size 4 → 2.*not what it would have been"):
        module(index, batch_size=2).train_dataloader().load_state_dict(state)


def test_reading_does_not_advance_the_random_state_of_the_run(index: Index):
    before = torch.get_rng_state()
    for workers in (0, 1):
        data = module(index, workers)
        for _ in data.train_dataloader():
            pass
        data.teardown("fit")
    assert torch.equal(before, torch.get_rng_state())


def test_training_delivers_what_the_network_reads_and_the_reference(index: Index):
    batch = next(iter(module(index).train_dataloader()))
    assert set(batch) == {*INPUTS, "reference", "exposure", "depth_range", "scene", "frame", "key"}
    assert {batch[name].dtype for name in (*INPUTS, "reference", "exposure", "depth_range")} == {
        torch.float32
    }
    assert batch["depth_range"].shape == (4, 2)
    assert batch["frame"].dtype == torch.int64


def test_evaluation_delivers_color_and_history_too(index: Index):
    batch = next(iter(module(index).val_dataloader()))
    assert {"color", "history"} < set(batch)


def test_without_a_network_all_buffers_are_delivered(index: Index):
    batch = next(iter(module(index, buffers=None).train_dataloader()))
    assert {"color", "irradiance", "albedo", "normal", "depth", "history", "reference"} < set(batch)


def test_test_batches_are_whole_frames_in_order(index: Index):
    batches = list(module(index, 1).test_dataloader())
    assert [(b["scene"], int(b["frame"])) for b in batches] == [(["cave"], 0), (["cave"], 1), (["cave"], 2)]
    assert batches[0]["irradiance"].shape == (1, 3, 40, 48)


def test_validation_is_the_same_every_time_and_complete(index: Index):
    loader = module(index, 1).val_dataloader()
    first, second = list(loader), list(loader)
    keys = [key for batch in first for key in batch["key"]]
    assert len(keys) == len(set(keys)) == index.count("validation")
    assert all(torch.equal(a["irradiance"], b["irradiance"]) for a, b in zip(first, second, strict=True))


def test_scenes_counts_and_manifest_hash_are_told(index: Index):
    data = module(index)
    assert data.scenes("train") == data.scenes("validation") == ("hall", "roof")
    assert data.scenes("test") == ("cave",)
    assert data.counts() == {split: index.count(split) for split in ("train", "validation", "test")}
    assert data.manifest_hash == index.manifest_hash
    assert Shards(str(index.root.parent / "frames")).manifest_hash == index.manifest_hash


def test_an_ingested_root_is_prepared_into_the_cache(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    frames = write_set(tmp_path / "frames")
    data = Shards(str(frames), patch_size=16, train_patches=4000, validation_patches=1000, batch_size=4)
    with pytest.raises(FileNotFoundError):
        data.setup("fit")
    data.prepare_data()
    data.setup("fit")
    assert data.index.root.parent == tmp_path / "cache" / "shards"
    assert "preparing frames" in capsys.readouterr().err
    data.prepare_data()
    assert not capsys.readouterr().err


def test_an_unknown_root_fails_before_training_with_the_command_to_run(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"trainer ingest.*trainer prepare"):
        Shards(str(tmp_path / "nothing")).prepare_data()


def test_a_buffer_that_the_shards_lack_names_the_command(index: Index):
    with pytest.raises(ValueError, match=r"no buffer motion.*trainer prepare .*--buffers motion"):
        module(index, buffers=("motion",)).train_dataloader()


def test_rank_for_which_no_evaluation_sample_is_left_has_a_batch_that_counts_nowhere(
    index: Index, monkeypatch: pytest.MonkeyPatch
):
    shards = module(index)
    total = shards.counts()["test"]
    monkeypatch.setattr(shards, "_place", lambda: (total, total + 1))
    (batch,) = list(shards.test_dataloader())
    assert batch["scene"] == batch["key"] == []
    assert batch["reference"].shape[0] == 1
    monkeypatch.setattr(shards, "_place", lambda: (total - 1, total + 1))
    (batch,) = list(shards.test_dataloader())
    assert len(batch["scene"]) == len(batch["key"]) == 1


def test_more_ranks_than_shards_is_an_error(index: Index, monkeypatch: pytest.MonkeyPatch):
    data = module(index)
    monkeypatch.setattr(data, "_place", lambda: (0, 99))
    with pytest.raises(ValueError, match=r"training shards for 99 ranks.*--samples-per-shard"):
        data.train_dataloader()


@pytest.mark.parametrize("workers", [0, 1])
def test_damaged_samples_stop_the_run_unless_skipping_is_asked(index, tmp_path, workers):
    for path in index.root.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    damaged = index.of("train")[2]
    path = tmp_path / damaged.file
    content = bytearray(path.read_bytes())
    content[damaged.samples[0].offset + 1000] ^= 255
    path.write_bytes(content)
    changed = Index.read(tmp_path)
    with pytest.raises(ValueError, match=rf"{damaged.file}, sample {damaged.samples[0].key}: its checksum"):
        list(module(changed, workers).train_dataloader())
    data = module(changed, workers, on_corrupt="skip", batch_size=1)
    with pytest.warns(UserWarning, match=r"left out \(1 so far\): .*its checksum differs"):
        keys = [key for batch in data.train_dataloader() for key in batch["key"]]
    assert len(keys) == index.count("train")
    assert damaged.samples[0].key not in keys
    assert list(data.corrupt) == [f"{path}, sample {damaged.samples[0].key}"]


def test_samples_that_fill_no_batch_are_reported(index: Index, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "data"):
        loader = module(index, batch_size=7).train_dataloader()
    assert loader.left_out == index.count("train") % 7 > 0
    assert f"{loader.left_out} of {index.count('train')} training samples" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size 0"),
        ({"workers": -1}, "workers -1"),
        ({"on_corrupt": "ignore"}, "expected 'raise' or 'skip'"),
        ({"buffers": ("colour",)}, "unknown buffer 'colour'"),
        ({"exposure_stops": -1.0}, "expected 0 to 16"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        Shards(**options)


def test_two_ranks_share_the_samples_and_lightning_keeps_the_loader(index: Index, tmp_path: Path):
    command = [sys.executable, "-m", "tests.data.ddp_reading", str(index.root), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    ranks = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    length = index.count("train") // 4
    for epoch in range(2):
        parts = [rank["train"][epoch * length : (epoch + 1) * length] for rank in ranks]
        assert [len(part) for part in parts] == [length, length]
        assert not {k for batch in parts[0] for k in batch} & {k for batch in parts[1] for k in batch}
    for split, passes in (("validation", 2), ("test", 1)):
        keys = [key for rank in ranks for batch in rank[split] for key in batch]
        assert len(keys) == passes * index.count(split)
        assert len(set(keys)) == index.count(split)
    assert len(ranks[0]["test"]) == len(ranks[1]["test"]) + 1


def stills(folder: Path) -> Index:
    return prepare(write_stills(folder / "frames", 2, (4,), samples=True), folder / "shards", OPTIONS)


def test_samples_are_delivered_to_a_network_that_reads_them(tmp_path: Path):
    index = stills(tmp_path)
    data = Shards(str(index.root), 2, 0, augment=False, buffers=("samples",), temporal=False)
    batch = next(iter(data.train_dataloader()))
    assert batch["samples"].shape == (2, 4, len(CHANNELS), 16, 16)
    assert batch["sample_channels"] == list(CHANNELS)
    assert "samples" not in next(iter(Shards(str(index.root), 2, 0, buffers=("color",)).train_dataloader()))


def test_samples_through_a_worker_are_those_read_here(tmp_path: Path):
    index = stills(tmp_path)
    here, there = (
        next(iter(Shards(str(index.root), 2, workers, augment=False, buffers=("samples",)).val_dataloader()))
        for workers in (0, 1)
    )
    assert torch.equal(here["samples"], there["samples"])
    assert here["sample_channels"] == there["sample_channels"]


def test_shards_without_samples_are_told_from_a_missing_buffer(index: Index):
    with pytest.raises(ValueError, match="no samples of each pixel, which the network reads"):
        Shards(str(index.root), 2, 0, augment=False, buffers=("samples",)).train_dataloader()


def test_a_root_is_prepared_here_by_recipe_and_samples_per_pixel(tmp_path: Path):
    root = write_stills(tmp_path / "frames")
    options = Shards(str(root), recipe="afgsa", spp=[8], patch_size=16).options
    assert (options.sampling, options.candidates, options.spp) == ("importance", 400, (8,))
    assert (options.recipe, options.train_patches, options.accumulate) == ("afgsa", 80, False)
    assert Shards(str(root)).options == PrepareOptions()
    assert Shards(str(root), recipe="layers").options.train_patches == 56


@pytest.mark.parametrize(("levels", "independent"), [((4,), ()), ((4, 8), ("hall", "roof"))])
def test_frames_of_one_view_do_not_follow_one_another(
    tmp_path: Path, levels: tuple[int, ...], independent: tuple[str, ...]
):
    root = write_stills(tmp_path / "frames", 2, levels, path=True)
    data = Shards(str(prepare(root, tmp_path / "shards", OPTIONS).root), 2, 0)
    assert data.independent_views("train") == independent


def test_training_batches_keep_a_random_number_of_samples_and_evaluation_all(tmp_path: Path):
    index = stills(tmp_path)
    data = Shards(str(index.root), 2, 0, buffers=("samples",), sample_counts=(2, 8))
    found = {len(batch["samples"][0]) for batch in data.train_dataloader()}
    assert found <= {2, 3, 4}
    assert len(found) > 1
    assert next(iter(data.val_dataloader()))["samples"].shape[1] == 4


def test_sample_counts_out_of_range_are_named() -> None:
    with pytest.raises(ValueError, match=r"sample_counts is \[4, 2\]; expected two numbers"):
        Shards(sample_counts=(4, 2))
