"""Shards of patches chosen by importance: which candidates they hold, whoever makes them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from data.frames import FrameSet
from data.importance import importance_map, importance_positions
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.patches import Position, patch_count
from data.shards.division import plan_shards
from data.shards.index import Index
from data.shards.prepare import prepare
from tests.data.small_sets import OPTIONS, frame, write_set
from tests.trainer.test_prepare import ARGUMENTS, command, content, run_until

IMPORTANCE = replace(OPTIONS, sampling="importance", candidates=8000)
CHOICE = ["--sampling", "importance", "--candidates", "8000", "--samples-per-shard", "4"]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set") / "frames", frames=4, calm=True)


@pytest.fixture(scope="module")
def chosen(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    output = tmp_path_factory.mktemp("chosen") / "shards"
    prepare(frames, output, IMPORTANCE)
    return content(output)


def test_importance_patches_are_the_candidates_that_were_not_dropped(frames, chosen, tmp_path):
    index = prepare(frames, tmp_path / "shards", IMPORTANCE)
    found: dict[tuple[str, int], list[Position]] = {}
    for shard in index.of("train"):
        for sample in shard.samples:
            start = sample.offset + 512
            text = (index.root / shard.file).read_bytes()[start : start + 2000].split(b"\0")[0]
            meta = json.loads(text)
            found.setdefault((meta["scene"], meta["frame"]), []).append(Position(meta["x"], meta["y"]))
    total = 0
    for (scene, number), places in found.items():
        frame = FrameSet(frames).read(scene, number)
        importance = importance_map(frame.buffers["color"], frame.buffers["normal"], 16)
        count = patch_count(8000, 48, 40, number)
        seed = (1, "importance", "train", scene, number)
        assert places == importance_positions(importance, count, 16, seed)
        total += count
    planned = [plan for plan in plan_shards(FrameSet(frames), IMPORTANCE) if plan.split == "train"]
    assert sum(len(plan.samples) for plan in planned) == total
    assert index.pruned == sum(shard.pruned for shard in index.shards) > 0
    assert content(tmp_path / "shards") == chosen


def test_importance_patches_do_not_depend_on_the_number_of_processes(frames, chosen, tmp_path):
    prepare(frames, tmp_path / "shards", IMPORTANCE, processes=3)
    assert content(tmp_path / "shards") == chosen


def test_importance_patches_are_the_same_after_a_kill(frames, chosen, tmp_path, monkeypatch):
    output = tmp_path / "shards"
    assert run_until(frames, output, 1, 3, CHOICE) >= 3
    assert command(monkeypatch, frames, "--output", output, *ARGUMENTS, *CHOICE) == 0
    assert content(output) == chosen


def test_the_command_says_how_many_candidates_were_dropped(frames, tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", *ARGUMENTS, *CHOICE) == 0
    index = Index.read(tmp_path / "shards")
    kept = index.count("train") + index.count("validation")
    out, err = capsys.readouterr()
    assert f"{index.pruned} of {index.pruned + kept} candidates were dropped" in out
    assert "no normal" not in out
    assert " candidates" in err


def test_frames_without_normal_are_judged_by_colour_and_the_command_says_so(tmp_path, monkeypatch, capsys):
    scenes = {}
    for scene in ("hall", "cave"):
        made = [frame(scene, i) for i in range(2)]
        for one in made:
            del one.buffers["normal"]
        scenes[scene] = SceneRecord(tuple(write_record(one, tmp_path / "frames") for one in made))
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": ["cave"]}
    Manifest("bare", "penumbra", "euclidean", splits, scenes).save(tmp_path / "frames")
    arguments = [*ARGUMENTS, "--sampling", "importance"]
    assert command(monkeypatch, tmp_path / "frames", "--output", tmp_path / "shards", *arguments) == 0
    assert "2 frames have no normal, so colour alone chose their patches" in capsys.readouterr().out


def test_validation_candidates_of_training_frames_are_in_proportion(frames: Path):
    options = replace(IMPORTANCE, candidates=800, train_patches=80, validation_patches=20)
    plans = plan_shards(FrameSet(write_set_of_size(frames.parent, 640)), options)
    count = {s: sum(len(p.samples) for p in plans if p.split == s) for s in ("train", "validation")}
    assert count == {"train": 2 * 200, "validation": 2 * 50}


def write_set_of_size(folder: Path, width: int) -> Path:
    return write_set(folder / str(width), frames=1, size=(width, width * 9 // 16))
