"""Recipes, samples per pixel, held-out views and samples kept apart, from the options to the shards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data.frames import FrameSet
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.shards.division import plan_shards
from data.shards.index import Index
from data.shards.options import RECIPES, PrepareOptions, recipe_options
from data.shards.prepare import prepare
from data.shards.read import ShardReader
from tests.data.small_sets import OPTIONS, frame, with_samples, write_set, write_stills
from tests.trainer.test_prepare import ARGUMENTS, command


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set") / "frames", frames=7)


@pytest.mark.parametrize("recipe", RECIPES)
def test_recipes_are_offered_recorded_and_overridden(recipe, frames, tmp_path, monkeypatch):
    arguments = ["--recipe", recipe, "--patch-size", "16", "--train-patches", "2000", "--candidates", "2000"]
    output = tmp_path / "shards"
    assert command(monkeypatch, frames, "--output", output, *arguments, "--seed", "3") == 0
    index = Index.read(output)
    overridden = {"patch_size": 16, "train_patches": 2000, "candidates": 2000, "seed": 3}
    assert index.options == recipe_options(recipe, overridden).to_dict()
    assert index.options["recipe"] == recipe
    assert {"sampling", "validation_share", "spp", "samples", "only"} <= index.options.keys()
    held = ShardReader(index, "train").sample(0).buffers.keys()
    assert ("history" in held) == (recipe == "bmfr")


def test_the_recipes_are_those_of_the_papers():
    bmfr, afgsa, layers = (recipe_options(name, {}) for name in ("bmfr", "afgsa", "layers"))
    assert (bmfr.sampling, bmfr.train_patches, bmfr.validation_patches, bmfr.accumulate) == (
        "uniform", 80, 20, True,
    )  # fmt: skip
    assert (afgsa.sampling, afgsa.candidates, afgsa.validation_share) == ("importance", 400, 0.05)
    assert (layers.sampling, layers.samples, layers.train_patches) == (
        "uniform",
        "half",
        1280 * 720 // 128**2,
    )
    assert {option.patch_size for option in (bmfr, afgsa, layers)} == {128}
    with pytest.raises(ValueError, match="unknown recipe 'kpcn'; expected one of bmfr, afgsa, layers"):
        recipe_options("kpcn", {})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampling": "poisson"}, "sampling is 'poisson'; expected one of uniform, importance"),
        ({"samples": "all"}, "expected one of auto, half, none"),
        ({"validation_share": 1.0}, "expected a share"),
        ({"importance_floor": 0.0}, "expected a positive number"),
        ({"candidates": 0}, "candidates is 0; expected at least 1"),
        ({"sampling": "importance", "wskp_legacy_crops": True}, "legacy crops of WSKP are uniform"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        PrepareOptions(**options)


def test_held_out_views_are_in_one_split_with_all_their_samples_per_pixel(tmp_path: Path):
    frames = FrameSet(write_stills(tmp_path / "frames", views=10))
    plans = plan_shards(frames, replace(OPTIONS, validation_share=0.2))
    views = {
        split: {(p.scene, index // 2) for p in plans if p.split == split for index, _ in p.samples}
        for split in ("train", "validation")
    }
    assert len(views["validation"]) == 4
    assert len(views["train"]) == 16
    assert not views["train"] & views["validation"]
    other = plan_shards(frames, replace(OPTIONS, validation_share=0.2, seed=9))
    assert {(p.scene, i // 2) for p in other if p.split == "validation" for i, _ in p.samples} != views[
        "validation"
    ]


def test_samples_per_pixel_choose_the_frames(tmp_path, monkeypatch, capsys):
    frames = write_stills(tmp_path / "frames", levels=(4, 8, 16))
    arguments = [*ARGUMENTS, "--spp", 8, 16]
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", *arguments) == 0
    index = Index.read(tmp_path / "shards")
    reader = ShardReader(index, "train")
    assert {reader.sample(i).frame % 3 for i in range(len(reader))} == {1, 2}
    assert index.options["spp"] == [8, 16]
    assert command(monkeypatch, frames, "--output", tmp_path / "more", *ARGUMENTS, "--spp", 32) == 1
    assert "no training frame with --spp 32; its frames have 4, 8, 16" in capsys.readouterr().err


def test_frames_with_different_numbers_of_samples_are_refused(tmp_path, monkeypatch, capsys):
    frames = write_stills(tmp_path / "frames", samples=True)
    place = (frames, "--output", tmp_path / "shards", *ARGUMENTS)
    assert command(monkeypatch, *place) == 1
    message = capsys.readouterr().err
    assert "hall/f000.exr has 4 samples per pixel; hall/f001.exr has 8 samples per pixel" in message
    assert "Choose frames with --spp N" in message
    assert "or leave samples out with --samples none" in message
    assert command(monkeypatch, *place, "--spp", 8, "--force") == 0
    assert "8 samples of 7 channels per pixel are kept apart" in capsys.readouterr().out
    index = prepare(frames, tmp_path / "without", replace(OPTIONS, samples="none"))
    assert "samples" not in ShardReader(index, "train").sample(0).buffers


def test_a_number_of_samples_that_the_manifest_does_not_tell_is_refused_before_publishing(tmp_path: Path):
    scenes = {
        scene: SceneRecord((write_record(with_samples(frame(scene, 0), count), tmp_path / "frames"),))
        for scene, count in (("hall", 2), ("roof", 3))
    }  # both say 1 sample per pixel
    splits: dict[str, list[str]] = {"train": ["hall", "roof"], "validation": [], "test": []}
    Manifest("odd", "penumbra", "euclidean", splits, scenes).save(tmp_path / "frames")
    with pytest.raises(ValueError, match=r"hall \(train\) has 2 samples .*; roof \(train\) has 3 samples"):
        prepare(tmp_path / "frames", tmp_path / "shards", OPTIONS)
    assert not (tmp_path / "shards").exists()


@pytest.mark.parametrize(
    ("kept", "depth", "bright", "half"),
    [
        ("auto", False, 0, True),
        ("auto", True, 0, False),  # depth needs more than eleven bits
        ("auto", False, 1e6, False),
        ("half", True, 1e6, True),
    ],
)
def test_samples_are_stored_in_half_precision_where_it_holds_them(tmp_path, kept, depth, bright, half):
    made = with_samples(frame("hall", 0), 4, depth, bright)
    scenes = {"hall": SceneRecord((write_record(made, tmp_path / "frames"),))}
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("one", "penumbra", "euclidean", splits, scenes).save(tmp_path / "frames")
    options = replace(OPTIONS, samples=kept, patch_size=40)
    index = prepare(tmp_path / "frames", tmp_path / "shards", options)
    read = FrameSet(tmp_path / "frames").read("hall", 0).samples
    assert read is not None
    for number in range(index.count("train")):
        found = ShardReader(index, "train").array(number, "samples").numpy()
        assert (found.dtype == np.float16) is half
    assert index.of("train")[0].per_sample == (4, read.channels)
    if kept == "half":
        assert found.max() <= 65504


def test_only_the_named_buffers_are_kept_with_the_reference(frames: Path, tmp_path: Path):
    index = prepare(frames, tmp_path / "shards", replace(OPTIONS, only=("color", "depth")))
    assert list(ShardReader(index, "train").sample(0).buffers) == ["color", "depth", "reference"]
