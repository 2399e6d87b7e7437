"""Clips from frames to shards: which frames they are cut from, how many, and what is stored."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.frames import FrameSet
from data.ingestion import write_record
from data.inspection import inspect_path
from data.manifest import FrameRecord, Manifest, SceneRecord
from data.patches import REFERENCE_AREA, Position
from data.shards.clips import clip_counts, clips_of
from data.shards.cut import make_scene
from data.shards.division import plan_shards
from data.shards.estimate import estimate
from data.shards.index import INDEX, Index
from data.shards.options import PrepareOptions, recipe_options
from data.shards.planes import Planes
from data.shards.prepare import cached_path, prepare, prepare_cached
from data.shards.read import CorruptSampleError, ShardReader
from tests.data.small_sets import OPTIONS, frame, with_samples, write_set, write_stills
from tests.data.test_shards_read import copy, flip_byte
from tests.trainer.test_prepare import command

CLIPS = replace(OPTIONS, frames=3, accumulate=False)
"""A scene of five frames of 48x40 gives 41 patches, so 13 training clips and 3 validation clips."""


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set") / "frames", frames=5)


@pytest.fixture(scope="module")
def index(frames: Path) -> Index:
    return prepare(frames, frames.parent / "clips", CLIPS)


def place_of(depth: np.ndarray, width: int = 48) -> Position:
    """Return where a patch was cut, from the depth that numbers the pixels."""
    y, x = divmod(int(depth[0, 0]) - 1, width)
    return Position(x, y)


def test_frames_of_a_clip_equal_patches_cut_from_the_single_frames_to_the_bit(frames: Path, index: Index):
    stored = FrameSet(frames)
    for split in ("train", "validation"):
        reader = ShardReader(index, split)
        for number in range(len(reader)):
            sample = reader.sample(number)
            place = place_of(reader.array(number, "depth")[0, 0].numpy())
            assert sample.frames == 3
            for name in ("color", "albedo", "normal", "depth", "reference", "irradiance"):
                found = reader.array(number, name).numpy()
                for step in range(3):
                    image = stored.read(sample.scene, sample.frame + step).buffers[name]
                    expected = Planes.of(name, image).cut(place, 16)
                    assert np.array_equal(found[step], expected), (name, step)
                    assert found.dtype == expected.dtype


def odd_set(root: Path, odd: int, scale: float) -> Path:
    """Write a sequence of which one frame has another scale of light."""
    records = [write_record(frame("hall", i, scale=scale if i == odd else 1.0), root) for i in range(3)]
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("odd", "penumbra", "euclidean", splits, {"hall": SceneRecord(tuple(records))}).save(root)
    return root


@pytest.mark.parametrize("odd", [0, 2])
def test_half_precision_of_a_clip_needs_all_frames_and_the_values_stay_those_of_single_patches(
    tmp_path: Path, odd: int
):
    root = odd_set(tmp_path / "frames", odd, 1e7)
    reader = ShardReader(prepare(root, tmp_path / "clips", replace(CLIPS, samples="none")), "train")
    assert reader.array(0, "albedo").numpy().dtype == np.float16
    color = reader.array(0, "color").numpy()
    assert color.dtype == np.float32
    place = place_of(reader.array(0, "depth")[0, 0].numpy())
    for step in range(3):
        image = FrameSet(root).read("hall", step).buffers["color"]
        single = Planes.of("color", image).cut(place, 16)
        assert (single.dtype == np.float32) == (step == odd)
        assert np.array_equal(color[step], single)


def test_a_clip_tells_its_first_frame_its_exposure_and_a_depth_range_for_each_frame(tmp_path: Path):
    root = tmp_path / "frames"
    records = []
    for i in range(4):
        made = frame("hall", i)
        records.append(
            write_record(made.with_buffers(depth=made.buffers["depth"] + 100 * np.float32(i)), root)
        )
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("deep", "penumbra", "euclidean", splits, {"hall": SceneRecord(tuple(records))}).save(root)
    reader = ShardReader(prepare(root, tmp_path / "clips", CLIPS), "train")
    seen = set()
    for sample in map(reader.sample, range(len(reader))):
        seen.add(sample.frame)
        assert sample.exposure == 0.5 + sample.frame
        ranges = [(1.0 + 100 * i, 1920.0 + 100 * i) for i in range(sample.frame, sample.frame + 3)]
        assert sample.depth_range == tuple(bound for pair in ranges for bound in pair)
    assert seen == {0, 1}


def test_test_samples_stay_whole_single_frames_in_order(frames: Path, index: Index):
    single = prepare(frames, frames.parent / "single", replace(CLIPS, frames=1))
    for shard, other in zip(index.of("test"), single.of("test"), strict=True):
        assert shard.sha256 == other.sha256
    reader = ShardReader(index, "test")
    assert [reader.sample(i).frame for i in range(5)] == list(range(5))
    assert reader.array(0, "color").shape == (3, 40, 48)


def test_there_are_a_third_as_many_clips_of_three_frames_as_patches_evenly_over_the_beginnings(frames: Path):
    plans = plan_shards(FrameSet(frames), CLIPS)
    for split, number in (("train", 4000), ("validation", 1000)):
        mine = [plan for plan in plans if plan.split == split]
        assert {plan.frames for plan in mine} == {3}
        for scene in ("hall", "roof"):
            begins = Counter(i for plan in mine if plan.scene == scene for i, _ in plan.samples)
            assert set(begins) <= {0, 1, 2}
            assert sum(begins.values()) == int(5 * Fraction(number * 48 * 40, REFERENCE_AREA) / 3)
            assert max(begins.values()) - min(begins[i] for i in range(3)) <= 1
    assert {plan.frames for plan in plans if plan.split == "test"} == {1}


def record(index: int, width: int = 1280, view: int | None = None, spp: int = 1) -> FrameRecord:
    return FrameRecord(index, f"f{index}.exr", 1, "0" * 64, width, 720, 1.0, spp, view=view)


def test_clips_run_neither_through_gaps_nor_through_changes_of_size():
    records = [record(i) for i in (0, 1, 2, 4, 5)] + [record(6, 640), record(7, 640)]
    assert clips_of(records, 2) == {0: (0, 1), 1: (1, 2), 4: (4, 5), 6: (6, 7)}
    assert clips_of(records, 3) == {0: (0, 1, 2)}
    assert clips_of(records, 4) == {}


def test_frames_of_one_view_with_different_samples_per_pixel_do_not_follow_one_another():
    both = [record(2 * view + level, view=view, spp=4**level) for view in range(3) for level in range(2)]
    assert clips_of(both, 2) == {1: (1, 2), 3: (3, 4)}
    assert clips_of([r for r in both if r.spp == 1], 3) == {0: (0, 2, 4)}


@pytest.mark.parametrize("length", [2, 3, 7])
@pytest.mark.parametrize("per_reference", [1, 5, 80])
def test_the_number_of_clips_keeps_the_density_and_is_at_least_one(length: int, per_reference: int):
    records = [record(i) for i in range(9)] + [record(i, 320) for i in range(10, 18)]
    counts = clip_counts(records, length, per_reference, (1, "seed"))
    assert set(counts) == set(clips_of(records, length))
    pixels = 9 * 1280 * 720 + 8 * 320 * 720
    assert sum(counts.values()) == max(1, per_reference * pixels // (REFERENCE_AREA * length))


def test_no_clips_are_cut_where_no_patches_are_asked_for():
    assert set(clip_counts([record(0), record(1)], 2, 0, (1,)).values()) == {0}


def test_over_many_seeds_every_beginning_gets_the_clip_that_is_left_over():
    records = [record(i) for i in range(9)]
    seen = Counter(
        start
        for seed in range(300)
        for start, count in clip_counts(records, 7, 1, (seed,)).items()
        for _ in range(count)
    )
    assert sum(seen.values()) == 300
    assert min(seen[start] for start in (0, 1, 2)) > 60


def test_short_scenes_are_left_out_and_said(tmp_path: Path, monkeypatch, capsys):
    root = mixed_set(tmp_path / "frames")
    output = tmp_path / "shards"
    arguments = ["--patch-size", 16, "--train-patches", 4000, "--validation-patches", 1000]
    assert command(monkeypatch, root, "--output", output, *arguments, "--clip-frames", 3) == 0
    printed = capsys.readouterr().out
    said = "2 scenes were left out, clips need 3 consecutive frames of a sequence: "
    assert said + "short has 2 in a row, views is no sequence" in printed
    made = Index.read(output)
    assert made.scenes("train") == ["long"]
    assert f"  train      {made.count('train'):>6} clips of 3 frames of long" in printed
    assert command(monkeypatch, root, "--output", tmp_path / "single", *arguments) == 0
    assert "left out" not in capsys.readouterr().out
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    prepare_cached(root, CLIPS)
    announced, remark = capsys.readouterr().err.splitlines()
    assert "clips of 3 frames and 2 whole frames" in announced
    assert remark == said + "short has 2 in a row, views is no sequence"


def mixed_set(root: Path, train: tuple[str, ...] = ("long", "short", "views")) -> Path:
    """Write scenes of which clips of three frames fit into `long` alone, and a test scene of two frames."""
    numbers = {"long": 4, "short": 2, "views": 4, "cave": 2}
    scenes = {
        name: SceneRecord(
            tuple(write_record(frame(name, i), root) for i in range(numbers[name])), sequence=name != "views"
        )
        for name in (*train, "cave")
    }
    splits = {"train": list(train), "validation": [], "test": ["cave"]}
    Manifest("mixed", "penumbra", "euclidean", splits, scenes).save(root)
    return root


def test_it_is_an_error_that_names_the_scenes_where_no_clip_fits(tmp_path: Path):
    root = mixed_set(tmp_path / "frames", ("short", "views"))
    expected = (
        r"no training scene with 3 consecutive frames of one sequence: short has 2 in a row, views is no "
        r"sequence; take shorter clips, --clip-frames N \(in training --data\.frames N\)"
    )
    with pytest.raises(ValueError, match=expected):
        plan_shards(FrameSet(root), CLIPS)
    views = mixed_set(tmp_path / "views", ("views",))
    with pytest.raises(ValueError, match="sequence: views is no sequence; use data of sequences"):
        plan_shards(FrameSet(views), CLIPS)


def test_it_is_an_error_where_no_clip_fits_into_the_scenes_for_validation(tmp_path: Path):
    root = mixed_set(tmp_path / "frames")
    manifest = FrameSet(root).manifest
    replace(manifest, splits={"train": ["long"], "validation": ["short"], "test": ["cave", "views"]}).save(
        root
    )
    with pytest.raises(ValueError, match=r"no validation scene with 3 consecutive .*: short has 2 in a row"):
        plan_shards(FrameSet(root), CLIPS)
    plans = plan_shards(FrameSet(root), replace(CLIPS, validation_patches=0))
    assert {plan.split for plan in plans} == {"train", "test"}


def test_frames_with_samples_kept_apart_are_refused_unless_these_are_left_out(tmp_path: Path):
    root = tmp_path / "frames"
    records = tuple(write_record(with_samples(frame("hall", i), 1), root) for i in range(3))
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("apart", "penumbra", "euclidean", splits, {"hall": SceneRecord(records)}).save(root)
    with pytest.raises(ValueError, match=r"hall/f000\.exr keeps samples apart, which clips do not hold"):
        plan_shards(FrameSet(root), CLIPS)
    made = prepare(root, tmp_path / "clips", replace(CLIPS, samples="none"))
    assert made.count("train") > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0}, "frames is 0; expected at least 1"),
        ({"frames": 5000}, "frames is 5000; expected at most 1024"),
        ({"frames": 2, "validation_share": 0.1}, "holds out single views; clips of 2 frames would run"),
        ({"frames": 2, "samples": "half"}, "clips hold no samples of each pixel"),
    ],
)
def test_options_that_clips_cannot_have_are_refused(options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        PrepareOptions(**options)


def test_the_recurrent_recipe_is_that_of_the_paper():
    options = recipe_options("recurrent", {})
    assert (options.frames, options.patch_size, options.sampling) == (7, 128, "uniform")
    assert (options.accumulate, options.samples) == (False, "none")
    assert "history" not in options.stored
    assert recipe_options("recurrent", {"frames": 4}).frames == 4


def test_a_clip_is_left_out_only_where_all_its_references_are_black(tmp_path: Path):
    root = write_set(tmp_path / "one", frames=3, black=("hall", 1))
    assert prepare(root, tmp_path / "clips", CLIPS).skipped == 0
    assert prepare(root, tmp_path / "pairs", replace(CLIPS, frames=1)).skipped > 0
    black = tmp_path / "black"
    records = [
        write_record(made.with_buffers(reference=np.zeros_like(made.buffers["reference"])), black)
        for made in (frame("hall", i) for i in range(3))
    ]
    more = [write_record(frame("roof", i), black) for i in range(3)]
    scenes = {"hall": SceneRecord(tuple(records)), "roof": SceneRecord(tuple(more))}
    splits: dict[str, list[str]] = {"train": ["hall", "roof"], "validation": [], "test": []}
    Manifest("black", "penumbra", "euclidean", splits, scenes).save(black)
    made = prepare(black, tmp_path / "left", CLIPS)
    assert made.scenes("train") == ["roof"]
    assert made.skipped == made.count("train") + made.count("validation")


def test_each_number_of_samples_of_a_path_is_accumulated_by_itself(tmp_path: Path):
    index = prepare(write_stills(tmp_path / "frames", 3, (4, 8), path=True), tmp_path / "shards", OPTIONS)
    whole = [FrameSet(index.root.parent / "frames").read("hall", i).buffers["irradiance"] for i in range(6)]
    reader = ShardReader(index, "train")
    seen = set()
    for number in range(len(reader)):
        sample = reader.sample(number)
        if sample.scene != "hall":
            continue
        seen.add(sample.frame)
        x, y = place_of(reader.array(number, "depth")[0].numpy())
        before = range(sample.frame % 2, sample.frame + 1, 2)  # as many samples, one view after the other
        assert (reader.array(number, "history") == len(before)).all()
        mean = np.mean([whole[i][y : y + 16, x : x + 16] for i in before], axis=0)
        found = reader.array(number, "irradiance").numpy().transpose(1, 2, 0)
        assert np.allclose(found, mean, rtol=2e-3, atol=1e-4)
    assert len(seen) > 3


def test_accumulated_clips_hold_the_history_of_each_frame(frames: Path, tmp_path: Path):
    options = replace(CLIPS, accumulate=True)
    reader = ShardReader(prepare(frames, tmp_path / "clips", options), "train")
    whole = [FrameSet(frames).read("hall", i).buffers["irradiance"] for i in range(5)]
    for number in range(len(reader)):
        sample = reader.sample(number)
        if sample.scene != "hall":
            continue
        assert sample.accumulated
        x, y = place_of(reader.array(number, "depth")[0, 0].numpy())
        for step in range(3):
            count = sample.frame + step + 1
            assert (reader.array(number, "history")[step] == count).all()
            mean = np.mean([image[y : y + 16, x : x + 16] for image in whole[:count]], axis=0)
            found = reader.array(number, "irradiance")[step].numpy().transpose(1, 2, 0)
            assert np.allclose(found, mean, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("no depth", "hall/frame 0 has color, depth, reference; hall/frame 1 has color, reference; name"),
        ("accumulated", "hall/frame 1 and hall/frame 0 are in one clip, and one of them is accumulated"),
    ],
)
def test_frames_that_hold_different_things_make_no_clip(tmp_path: Path, change: str, message: str):
    root, records = tmp_path / "frames", []
    for i in range(3):
        made = frame("hall", i)
        if change == "accumulated":
            made = replace(made.with_buffers(irradiance=made.buffers["color"]), accumulated=i == 1)
        elif i == 1:
            made = replace(made, buffers={n: b for n, b in made.buffers.items() if n != "depth"})
        records.append(write_record(made, root))
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("unlike", "penumbra", "euclidean", splits, {"hall": SceneRecord(tuple(records))}).save(root)
    with pytest.raises(ValueError, match=message):
        prepare(root, tmp_path / "clips", replace(CLIPS, only=("color", "depth")))


def test_importance_of_the_first_frame_decides_where_a_clip_is_cut(tmp_path: Path):
    root = write_set(tmp_path / "frames", frames=4, calm=True)
    options = replace(CLIPS, sampling="importance", candidates=8000)
    made = prepare(root, tmp_path / "clips", options)
    single = prepare(root, tmp_path / "single", replace(options, frames=1))
    assert made.pruned > 0
    reader = ShardReader(made, "train")
    columns = [place_of(reader.array(i, "depth")[0, 0].numpy()).x + 8 for i in range(len(reader))]
    assert np.mean(columns) > 24  # the left half is calm
    judged = made.pruned + made.skipped + made.count("train") + made.count("validation")
    assert judged < single.pruned + single.skipped + single.count("train") + single.count("validation")


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_shard_of_clips_is_the_same_whichever_others_are_made_with_it(frames, index, tmp_path):
    for folder in ("shards", "records"):
        (tmp_path / folder).mkdir()
    plans = plan_shards(FrameSet(frames), CLIPS)
    for plan in reversed(plans):
        make_scene(str(frames), plan.scene, [plan], CLIPS, str(tmp_path))
    expected = content(index.root)
    del expected[INDEX]
    assert content(tmp_path / "shards") == expected


def test_an_index_of_clips_has_a_version_that_readers_of_single_frames_refuse(index: Index, tmp_path: Path):
    record = json.loads((index.root / INDEX).read_text())
    assert (record["version"], record["options"]["frames"], index.frames) == (2, 3, 3)
    for number, change in enumerate(
        ({"version": 1}, {"options": {"frames": 1}}, {"options": {"frames": "3"}})
    ):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / INDEX).write_text(json.dumps({**record, **change}))
        with pytest.raises(ValueError, match="not an index of shards that this version reads"):
            Index.read(tmp_path / str(number), check_sizes=False)


def test_shards_made_before_there_were_clips_stay_readable(frames: Path, tmp_path: Path):
    made = prepare(frames, tmp_path / "single", OPTIONS)
    path = made.root / INDEX
    record = json.loads(path.read_text())
    assert (record["version"], record["options"].pop("frames")) == (1, 1)
    path.write_text(json.dumps(record))
    found = Index.read(made.root)
    assert found.frames == 1
    assert ShardReader(found, "train").sample(0).frames == 1
    assert ShardReader(found, "train").array(0, "color").shape == (3, 16, 16)


def test_clips_and_patches_have_different_places_in_the_cache(frames: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    assert len({cached_path(frames, replace(CLIPS, frames=n)) for n in (1, 2, 3)}) == 3


def test_the_estimate_counts_clips_and_their_bytes(frames: Path, index: Index):
    found = estimate(FrameSet(frames), CLIPS)
    assert found.patches == index.count("train") + index.count("validation")
    assert (found.frames, found.clip_frames) == (5, 3)
    assert found.bytes == pytest.approx(sum(shard.bytes for shard in index.shards), rel=0.05)


def test_inspection_counts_clips_and_looks_at_all_their_frames(frames, index, capsys, monkeypatch):
    found = inspect_path(index.root)
    assert found["splits"]["train"]["frames"] == 3
    assert found["splits"]["test"]["frames"] == 1
    assert found["splits"]["train"]["buffers"]["color"]["shape"] == [3, 3, 16, 16]
    assert found["splits"]["test"]["buffers"]["color"]["shape"] == [3, 40, 48]
    normal = found["splits"]["train"]["buffers"]["normal"]
    assert (normal["min"], normal["max"], normal["no_hit_percent"]) == (0.0, 1.0, 0.0)
    monkeypatch.setattr("sys.argv", ["trainer", "inspect", str(index.root)])
    from trainer.cli import main

    assert main() == 0
    assert f"train: {index.count('train')} clips of 3 frames in" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 2}, r"has the shape \(3, .*in a clip of 2 frames"),
        ({"frames": 1}, "has the shape"),
        ({"frames": 0}, "frames is 0, expected a whole number from 1"),
        ({"depth_range": [[0.0, 1.0]]}, "its depth_range has 1 pairs, expected 3"),
        ({"depth_range": [[0.0, 1.0], [0.0, 1.0], [0.0, "far"]]}, "depth_range is 'far'"),
    ],
)
def test_descriptions_that_do_not_fit_their_clip_are_refused(index, change, message):
    from data.shards.description import parse
    from data.shards.write import record_of

    meta = {"scene": "hall", "frame": 0, "x": 0, "y": 0, "width": 4, "height": 4, "exposure": 1.0,
            "depth_range": [[0.0, 1.0]] * 3, "accumulated": False, "frames": 3}  # fmt: skip
    arrays = {"color": np.ones((3, 3, 4, 4), np.float16)}
    assert parse("a", memoryview(record_of("a", meta, arrays)), 0).frames == 3
    with pytest.raises(ValueError, match=message):
        parse("a", memoryview(record_of("a", {**meta, **change}, arrays)), 0)


def test_an_altered_byte_of_a_clip_is_found(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    record = index.of("train")[0].samples[1]
    flip_byte(root / index.of("train")[0].file, record.offset + record.size // 2)
    reader = ShardReader(Index.read(root), "train")
    reader.sample(0)
    with pytest.raises(CorruptSampleError, match=f"sample {record.key}: its checksum differs"):
        reader.sample(1)
