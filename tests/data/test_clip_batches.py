"""Clips from shards to batches: order of their frames, turns, resuming, damage, ranks."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from data.augment import Augmentation, reordered, turned
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord, load_manifest
from data.module import Shards
from data.sample import SAMPLES
from data.shards.batch import Batches, Order
from data.shards.index import Index
from data.shards.plan import evaluation_samples
from data.shards.prepare import prepare
from data.shards.read import ShardReader
from tests.data.small_sets import OPTIONS, frame, write_set
from tests.data.test_module import Seen, fit
from tests.data.test_shards_read import copy, flip_byte

NAMES = ("color", "irradiance", "albedo", "normal", "depth", "reference")
CLIPS = replace(OPTIONS, frames=4, accumulate=False)
SPLITS = {"train": ["hall", "roof"], "validation": [], "test": ["cave", "dome", "arch"]}
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval.*"),
    pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`, callbacks used to create"),
]


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Index:
    """Clips of four frames; depths of the frames differ, and so do their ranges."""
    root = tmp_path_factory.mktemp("clips")
    scenes = {}
    for scene in (name for names in SPLITS.values() for name in names):
        made = [frame(scene, i) for i in range(5 if scene != "arch" else 2)]
        made = [f.with_buffers(depth=f.buffers["depth"] + 100 * np.float32(f.index)) for f in made]
        scenes[scene] = SceneRecord(tuple(write_record(f, root / "frames") for f in made))
    Manifest("deep", "penumbra", "euclidean", SPLITS, scenes).save(root / "frames")
    return prepare(root / "frames", root / "shards", replace(CLIPS, buffers=("motion",)))


def read(index: Index, augmentation: Augmentation | None, numbers: tuple[int, ...], **options: Any) -> dict:
    names = options.pop("names", NAMES)
    batches = Batches(ShardReader(index, "train"), names, False, augmentation=augmentation, **options)
    return batches[Order(2, numbers)].unpack()


def module(index: Index, workers: int = 0, **options: Any) -> Shards:
    usual = {"batch_size": 4, "buffers": ("irradiance", "depth"), "exposure_stops": 1.0, "frames": 4}
    return Shards(str(index.root), workers=workers, **{**usual, "reverse": 0.5, "freeze": 0.5, **options})


def test_batches_of_clips_have_the_frames_in_order_before_the_channels(index: Index):
    batch = read(index, None, (0, 3, 5))
    assert batch["color"].shape == (3, 4, 3, 16, 16)
    assert batch["depth"].shape == (3, 4, 1, 16, 16)
    assert (batch["exposure"].shape, batch["depth_range"].shape) == ((3,), (3, 4, 2))
    for row, first in enumerate(batch["frame"].tolist()):
        depth = batch["depth"][row, :, 0, 0, 0]
        assert torch.equal(depth - depth[0], 100 * torch.arange(4.0))
        lows = 1 + 100 * (first + torch.arange(4.0))
        assert torch.equal(batch["depth_range"][row], torch.stack([lows, lows + 1919], 1))
        assert batch["exposure"][row] == 0.5 + first


def test_all_frames_of_a_clip_and_all_buffers_are_turned_and_permuted_alike(index: Index):
    numbers = tuple(range(len(ShardReader(index, "train"))))
    augmentation = Augmentation("dihedral", seed=5, permute=True)
    plain, made = (read(index, how, numbers, names=(*NAMES, "motion")) for how in (None, augmentation))
    changes = [augmentation.change(2, number) for number in numbers]
    assert len({change.turn for change in changes}) > 4
    for row, change in enumerate(changes):
        for name in NAMES:
            for step in range(4):
                expected = turned(reordered(plain[name][row, step].numpy(), name, change), change.turn)
                assert np.array_equal(made[name][row, step].numpy(), expected), name
    assert torch.equal(made["depth_range"], plain["depth_range"])


def test_motion_of_every_frame_turns_with_the_image(index: Index, monkeypatch: pytest.MonkeyPatch):
    reader = ShardReader(index, "train")
    read_array = reader.array

    def moved(number: int, name: str) -> torch.Tensor:
        found = read_array(number, name)
        return torch.tensor([1.0, 2.0]).view(1, 2, 1, 1).expand_as(found) if name == "motion" else found

    monkeypatch.setattr(reader, "array", moved)
    augmentation = Augmentation("dihedral", seed=5)
    numbers = tuple(range(12))
    batch = Batches(reader, ("motion",), False, augmentation=augmentation)[Order(0, numbers)].unpack()
    for row, number in enumerate(numbers):
        bits = int(augmentation.turn(0, number))
        x, y = (2.0, 1.0) if bits & 4 else (1.0, 2.0)
        expected = torch.tensor([-x if bits & 1 else x, -y if bits & 2 else y])
        assert torch.equal(batch["motion"][row], expected.view(1, 2, 1, 1).expand(4, 2, 16, 16))


def test_a_reversed_clip_has_its_frames_and_depth_ranges_backward(index: Index):
    plain, made = (read(index, how, (0, 4, 9)) for how in (None, Augmentation("none", reverse=1.0)))
    for name in (*NAMES, "depth_range"):
        assert torch.equal(made[name], plain[name].flip(1)), name
    for name in ("exposure", "frame"):
        assert torch.equal(made[name], plain[name])


def test_a_frozen_clip_repeats_a_frame_to_the_end_noise_included(index: Index):
    numbers = tuple(range(16))
    augmentation = Augmentation("none", seed=2, freeze=1.0)
    plain, made = (read(index, how, numbers) for how in (None, augmentation))
    stops = set()
    for row, number in enumerate(numbers):
        order = augmentation.frame_order(2, number, 4)
        last = order.index(order[-1])
        stops.add(last)
        assert order == tuple(min(step, last) for step in range(4))
        for name in (*NAMES, "depth_range"):
            assert torch.equal(made[name][row], plain[name][row, list(order)]), name
    assert stops == {0, 1, 2}


def test_nothing_moves_in_the_repeated_frames_of_a_frozen_clip(index: Index, monkeypatch: pytest.MonkeyPatch):
    reader = ShardReader(index, "train")
    read_array = reader.array
    monkeypatch.setattr(
        reader, "array", lambda n, name: read_array(n, name) + 1 if name == "motion" else read_array(n, name)
    )
    augmentation = Augmentation("none", seed=2, freeze=1.0)
    batch = Batches(reader, ("motion",), False, augmentation=augmentation)[Order(2, (0, 1, 2, 3))].unpack()
    for row in range(4):
        order = augmentation.frame_order(2, row, 4)
        for step in range(4):
            assert (batch["motion"][row, step] == (0 if order[step] in order[:step] else 1)).all()


def test_dropped_history_leaves_every_frame_of_an_accumulated_clip_alone(index: Index, tmp_path: Path):
    options = replace(CLIPS, accumulate=True)
    made = prepare(index.root.parent / "frames", tmp_path / "shards", options)
    names = ("irradiance", "history", "color", "albedo")
    kept, dropped = (
        Batches(
            ShardReader(made, "train"), names, True, augmentation=Augmentation("none", drop_history=share)
        )[Order(0, (0, 1, 2))].unpack()
        for share in (0.0, 1.0)
    )
    assert torch.equal(dropped["irradiance"], dropped["color"] / dropped["albedo"])
    assert (dropped["history"] == 1).all()
    counts = kept["history"][:, :, 0, 0, 0] - kept["frame"][:, None]
    assert torch.equal(counts, torch.tensor([1.0, 2, 3, 4]).expand(3, 4))


def test_orders_follow_from_seed_epoch_and_sample_alone_with_the_given_probabilities():
    augmentation = Augmentation(seed=3, reverse=0.25, freeze=0.5)
    orders = [augmentation.frame_order(1, n, 7) for n in range(4000)]
    assert orders == [
        Augmentation("none", 2.0, 3, reverse=0.25, freeze=0.5).frame_order(1, n, 7) for n in range(4000)
    ]
    assert orders != [augmentation.frame_order(2, n, 7) for n in range(4000)]
    backward, frozen = ([order[0] == 6 for order in orders], [order[-1] == order[-2] for order in orders])
    assert abs(np.mean(backward) - 0.25) < 0.03
    assert abs(np.mean(frozen) - 0.5) < 0.03
    both = np.mean(np.logical_and(backward, frozen))
    assert abs(both - 0.125) < 0.03
    stops = Counter(order.index(order[-1]) for order in orders if order[-1] == order[-2])
    assert set(stops) == set(range(6))
    assert max(stops.values()) < 1.4 * min(stops.values())


def test_without_reversal_and_freezing_the_order_stays_and_turns_do_not_depend_on_them():
    plain, changing = Augmentation(seed=8), Augmentation(seed=8, reverse=1.0, freeze=1.0)
    for number in range(50):
        assert plain.frame_order(0, number, 5) == (0, 1, 2, 3, 4)
        assert plain.change(0, number) == changing.change(0, number)


@pytest.mark.parametrize("name", ["reverse", "freeze"])
@pytest.mark.parametrize("value", [-0.1, 1.5])
def test_impossible_probabilities_are_refused(name: str, value: float):
    with pytest.raises(ValueError, match=rf"{name} is {value}; expected a probability, 0 to 1"):
        Augmentation(**{name: value})


def test_clips_with_motion_refuse_to_run_backward(index: Index):
    with pytest.raises(
        ValueError, match=r"motion is wrong in a clip that runs backward; use --data\.reverse 0"
    ):
        module(index, buffers=("color", "motion")).train_dataloader()
    module(index, buffers=("color", "motion"), reverse=0.0).train_dataloader()


def test_reversal_and_freezing_are_for_clips():
    for name in ("reverse", "freeze"):
        with pytest.raises(
            ValueError, match="reverse and freeze change clips, and samples are single frames"
        ):
            Shards(**{name: 0.5})


@pytest.mark.parametrize(
    ("frames", "asked"), [(None, "single frames"), (1, "single frames"), (7, "clips of 7 frames")]
)
def test_shards_of_another_length_than_asked_are_refused_with_the_way_out(index, frames, asked):
    data = Shards(str(index.root), workers=0, frames=frames)
    for loader in (data.train_dataloader, data.val_dataloader):
        with pytest.raises(
            ValueError,
            match=rf"holds clips of 4 frames, and {asked} are to be read: "
            + (r"set --data\.frames 4, or prepare again: " if frames == 7 else "prepare again: ")
            + f"trainer prepare FRAMES --output SHARDS --clip-frames {frames or 1}",
        ):
            loader()
    assert next(iter(data.test_dataloader()))["color"].shape == (1, 3, 40, 48)


def test_single_frames_are_refused_where_clips_are_asked_for(tmp_path: Path):
    made = prepare(write_set(tmp_path / "frames"), tmp_path / "shards", OPTIONS)
    with pytest.raises(ValueError, match="holds single frames, and clips of 7 frames are to be read"):
        Shards(str(made.root), recipe="recurrent").train_dataloader()


def test_a_root_is_prepared_as_clips_by_number_or_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    root = write_set(tmp_path / "frames", frames=7)
    options: dict[str, Any] = {"patch_size": 16, "train_patches": 4000, "batch_size": 2, "workers": 0}
    data = Shards(str(root), recipe="recurrent", buffers=("irradiance", "color", "albedo"), **options)
    data.prepare_data()
    assert (data.frames, data.index.frames, data.options.accumulate) == (7, 7, False)
    for loader in (data.train_dataloader(), data.val_dataloader()):
        batch = next(iter(loader))
        assert batch["irradiance"].shape[1:] == (7, 3, 16, 16)
        assert torch.equal(batch["irradiance"], batch["color"] / batch["albedo"])
        assert "history" not in batch
    assert next(iter(data.test_dataloader()))["irradiance"].shape == (1, 3, 40, 48)
    assert Shards(str(root), frames=3).options.frames == 3
    assert Shards(str(root), recipe="recurrent", frames=3).options.frames == 3


def test_an_epoch_of_clips_of_the_shipped_sample_has_at_least_ten_batches_of_four():
    from data.frames import FrameSet
    from data.shards.division import plan_shards

    options = Shards("sample:bmfr", recipe="recurrent").options
    plans = plan_shards(FrameSet(SAMPLES["bmfr"]), options)
    count = {
        split: sum(len(p.samples) for p in plans if p.split == split) for split in ("train", "validation")
    }
    assert 10 <= count["train"] // 4 <= 20
    assert count["validation"] >= 2
    assert sum(p.split == "train" for p in plans) >= 8


@pytest.fixture(scope="module")
def uninterrupted(index: Index, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    net = Seen()
    fit(module(index), net, tmp_path_factory.mktemp("run"), max_epochs=2)
    return net.batches


@pytest.mark.parametrize("workers", [0, 1])
def test_a_run_resumed_in_the_middle_of_an_epoch_sees_the_clips_that_were_left(
    index, uninterrupted, tmp_path, workers
):
    length = len(uninterrupted) // 2
    assert length == index.count("train") // 4 > 3
    step = length // 2
    saver = ModelCheckpoint(tmp_path, every_n_train_steps=step, save_top_k=-1, filename="{step}")
    with pytest.raises(KeyError):
        fit(module(index, workers), Seen(stop_at=step + 1), tmp_path, callbacks=[saver], max_epochs=2)
    resumed = Seen()
    fit(module(index, workers), resumed, tmp_path, tmp_path / f"step={step}.ckpt", max_epochs=2)
    assert resumed.batches == uninterrupted[step:]


def test_clips_through_a_worker_are_those_read_here(index: Index):
    here, there = (list(module(index, workers).train_dataloader()) for workers in (0, 1))
    for one, other in zip(here, there, strict=True):
        assert one["key"] == other["key"]
        for name in ("irradiance", "depth", "depth_range", "exposure"):
            assert torch.equal(one[name], other[name])


def test_damaged_clips_stop_the_run_unless_skipping_is_asked(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    record = index.of("train")[1].samples[0]
    flip_byte(root / index.of("train")[1].file, record.offset + record.size // 2)
    with pytest.raises(ValueError, match=f"sample {record.key}: its checksum differs"):
        list(module(Index.read(root)).train_dataloader())
    data = module(Index.read(root), on_corrupt="skip", batch_size=1)
    with pytest.warns(UserWarning, match=r"left out \(1 so far\): .*its checksum differs"):
        keys = [key for batch in data.train_dataloader() for key in batch["key"]]
    assert len(keys) == index.count("train")
    assert record.key not in keys


def test_clips_of_different_length_do_not_make_a_batch(index: Index):
    reader = ShardReader(index, "train")
    reader.sample(1)
    reader._samples[1] = reader.sample(1)._replace(frames=2)
    with pytest.raises(ValueError, match="clips of different length in one batch: 2, 4 frames"):
        Batches(reader, NAMES, True)[Order(0, (0, 1))]


@pytest.mark.parametrize("world", [1, 2, 3, 8])
@pytest.mark.parametrize("scenes", [[], [4], [5, 5, 2], [1, 9, 3, 3, 8, 2]])
def test_whole_scenes_are_dealt_once_over_all_ranks_in_order_and_evenly(scenes: list[int], world: int):
    ends = np.cumsum([0, *scenes])
    parts = [evaluation_samples(sum(scenes), rank, world, scenes) for rank in range(world)]
    assert sorted(np.concatenate(parts).tolist()) == list(range(sum(scenes)))
    owned = []
    for part in parts:
        assert (np.diff(part) > 0).all()
        owned.append({int(np.searchsorted(ends, sample, "right")) for sample in part})
    assert sum(map(len, owned)) == len(scenes)
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= max(scenes, default=0)


def test_two_ranks_test_whole_scenes_in_the_order_of_their_frames(index: Index, monkeypatch):
    seen = []
    for rank in range(2):
        data = module(index, rank, whole_scenes=True)
        monkeypatch.setattr(data, "_place", lambda rank=rank: (rank, 2))
        batches = list(data.test_dataloader())
        seen.append([(batch["scene"][0], int(batch["frame"])) for batch in batches])
    cave, dome, arch = ([(s, i) for i in range(n)] for s, n in (("cave", 5), ("dome", 5), ("arch", 2)))
    assert seen == [[*cave, *arch], dome]


def test_scenes_whose_frames_do_not_follow_one_another_are_named(index: Index, tmp_path: Path):
    assert module(index).independent_views("test") == ()
    root = write_set(tmp_path / "frames")
    known = load_manifest(root)
    views = {name: replace(record, sequence=name != "cave") for name, record in known.scenes.items()}
    replace(known, scenes=views).save(root)
    data = Shards(str(prepare(root, tmp_path / "shards", OPTIONS).root), workers=0)
    assert "cave" in data.scenes("test")
    assert data.independent_views("test") == ("cave",)
    assert data.independent_views("train") == ()


def test_validation_is_dealt_clip_by_clip_also_with_whole_scenes(index: Index, monkeypatch):
    keys = []
    for rank in range(2):
        data = module(index, whole_scenes=True, batch_size=1)
        monkeypatch.setattr(data, "_place", lambda rank=rank: (rank, 2))
        keys.append([key for batch in data.val_dataloader() for key in batch["key"]])
    assert len({*keys[0], *keys[1]}) == index.count("validation")
    assert len(keys[0]) - len(keys[1]) in (0, 1)


def test_a_rank_without_a_scene_has_a_batch_that_counts_nowhere(index: Index, monkeypatch):
    data = module(index, whole_scenes=True)
    monkeypatch.setattr(data, "_place", lambda: (3, 4))
    (batch,) = list(data.test_dataloader())
    assert batch["scene"] == batch["key"] == []


@pytest.mark.slow
def test_two_processes_train_on_clips_and_test_whole_scenes(index: Index, tmp_path: Path):
    arguments = [str(index.root), str(tmp_path), "4"]
    done = subprocess.run(
        [sys.executable, "-m", "tests.data.ddp_reading", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    ranks = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    trained = [{key for batch in rank["train"] for key in batch} for rank in ranks]
    assert len(ranks[0]["train"]) == len(ranks[1]["train"]) > 0
    keys = [[key for batch in rank["test"] for key in batch] for rank in ranks]
    reader = ShardReader(index, "test")
    scene = {
        reader.sample(i).key: (reader.sample(i).scene, reader.sample(i).frame) for i in range(len(reader))
    }
    seen = [[scene[key] for key in part] for part in keys]
    assert {name for name, _ in seen[0]} == {"cave", "arch"}
    assert seen[1] == [("dome", i) for i in range(5)]
    assert seen[0] == sorted(seen[0], key=lambda entry: (entry[0] != "cave", entry[1]))
    assert trained[0]
    assert trained[1]
