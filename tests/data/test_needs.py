"""Buffers beside the usual ones, from frames to batches: targets, light in two parts, variances."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from data.augment import Augmentation, reordered, turned
from data.frame import Frame
from data.frames import FrameSet
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.module import Shards
from data.shards.read import ShardReader
from tests.data.small_sets import frame, write_set

READ = ("diffuse", "specular", "albedo", "normal", "depth")
VARIANCES = tuple(f"{name}_variance" for name in READ)
TARGETS = ("reference", "reference_diffuse")


def split_frame(scene: str, index: int) -> Frame:
    """A frame with diffuse light, variances and the diffuse part of the reference, but without specular."""
    made = frame(scene, index)
    plain = made.buffers
    color = plain["color"]
    added = {"diffuse": 0.75 * color, "reference_diffuse": 0.75 * plain["reference"]}
    added = {n: image.astype(np.float16).astype(np.float32) for n, image in added.items()}
    for name in ("diffuse", "normal", "depth"):
        added[f"{name}_variance"] = np.full_like({**plain, **added}[name], 1e-9)
    added["specular_variance"] = 3e-9 * color
    added["diffuse_albedo_variance"] = added["specular_albedo_variance"] = np.full_like(color, 2e-9)
    added |= {"diffuse_albedo": 0.5 * plain["albedo"], "specular_albedo": 0.5 * plain["albedo"]}
    return made.with_buffers(**{n: i.astype(np.float32) for n, i in added.items()})


@pytest.fixture(scope="module")
def split_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("split")
    scenes = {
        scene: SceneRecord(tuple(write_record(split_frame(scene, i), root) for i in range(2)), sequence=False)
        for scene in ("hall", "roof")
    }
    Manifest(
        "split", "penumbra", "euclidean", {"train": ["hall"], "validation": [], "test": ["roof"]}, scenes
    ).save(root)
    return root


@pytest.fixture
def shards(split_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Shards]:
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))

    def make(root: Path | str = split_set, **options: Any) -> Shards:
        usual = {"workers": 0, "batch_size": 2, "patch_size": 16, "temporal": False, "targets": TARGETS}
        return Shards(str(root), **{**usual, "train_patches": 2000, "buffers": READ, **options})

    return make


def test_the_diffuse_reference_is_delivered_with_the_patch_that_it_belongs_to(shards):
    data = shards(augment=False)
    data.prepare_data()
    for loader in (data.train_dataloader(), data.val_dataloader(), data.test_dataloader()):
        batch = next(iter(loader))
        assert torch.allclose(batch["reference_diffuse"], 0.75 * batch["reference"], rtol=1e-3, atol=1e-6)
    assert shards(targets=()).targets == ("reference",)


def test_specular_light_is_derived_and_stored_where_frames_hold_the_rest(shards):
    data = shards(augment=False, recipe="afgsa")
    data.prepare_data()
    batch = next(iter(data.train_dataloader()))
    assert set(READ) < set(batch)
    assert torch.allclose(batch["specular"], batch["diffuse"] / 3, rtol=2e-2, atol=1e-3)


def test_radiance_is_stored_in_half_precision_and_variances_in_float32(shards):
    data = shards(augment=False, buffers=(*READ, *VARIANCES))
    data.prepare_data()
    reader = ShardReader(data.index, "train", True)
    kinds = {name: reader.array(0, name).dtype for name in (*READ, *VARIANCES, *TARGETS)}
    assert {kinds[name] for name in ("diffuse", "specular", "albedo", "normal", *TARGETS)} == {torch.float16}
    assert {kinds[name] for name in ("depth", *VARIANCES)} == {torch.float32}
    batch = next(iter(data.train_dataloader()))
    assert torch.allclose(batch["diffuse_variance"], torch.tensor(1e-9))
    assert torch.allclose(batch["albedo_variance"], torch.tensor(4e-9))


def test_all_buffers_of_a_patch_are_turned_and_permuted_alike(shards):
    plain, changed = (
        shards(augment=on, augment_rule="dihedral", permute=on, seed=5, buffers=(*READ, *VARIANCES))
        for on in (False, True)
    )
    plain.prepare_data()
    before, after = (next(iter(data.train_dataloader())) for data in (plain, changed))
    assert before["key"] == after["key"]
    reader = ShardReader(changed.index, "train", True)
    numbers = {reader.sample(number).key: number for number in range(len(reader))}
    for row, key in enumerate(before["key"]):
        change = Augmentation("dihedral", seed=5, permute=True).change(0, numbers[key])
        for name in (*READ, *VARIANCES, *TARGETS):
            expected = turned(reordered(before[name][row].numpy(), name, change), change.turn)
            assert np.array_equal(after[name][row].numpy(), expected), name


def test_exposure_is_varied_by_its_number_alone_so_that_nothing_else_can_disagree(shards):
    options = {"augment_rule": "none", "buffers": (*READ, *VARIANCES)}
    plain, varied = (shards(exposure_stops=stops, **options) for stops in (0.0, 3.0))
    plain.prepare_data()
    before, after = (next(iter(data.train_dataloader())) for data in (plain, varied))
    for name in (*READ, *VARIANCES, *TARGETS):
        assert torch.equal(before[name], after[name]), name
    assert not torch.equal(before["exposure"], after["exposure"])


@pytest.mark.parametrize(
    ("buffers", "named", "advice"),
    [
        (
            READ,
            "diffuse, specular, reference_diffuse",
            "diffuse and specular light apart, such as sample:stills",
        ),
        (("color", "normal_variance"), "normal_variance", "variances of the mean, such as sample:stills"),
        (("color", "visibility"), "visibility, reference_diffuse", "diffuse and specular light apart"),
    ],
)
def test_frames_that_lack_what_the_network_reads_are_told_before_anything_is_prepared(
    shards, tmp_path, buffers, named, advice
):
    root = write_set(tmp_path / "plain", frames=1)
    data = shards(root, buffers=buffers)
    data.trainer = SimpleNamespace(lightning_module=SimpleNamespace(net=torch.nn.Identity()))
    with pytest.raises(
        ValueError, match=rf"^Identity reads .*{named}.*, which .*f000\.exr.*{advice}"
    ) as told:
        data.prepare_data()
    assert "\n" not in str(told.value)
    assert not (tmp_path / "cache" / "shards").exists()


def test_the_first_frame_that_lacks_something_is_found(split_set, tmp_path):
    frames = FrameSet(split_set)
    assert frames.lacking((*READ, *VARIANCES, "color", "irradiance", "history")) is None
    found = frames.lacking(("diffuse", "roughness", "color_a"))
    assert found is not None
    assert (found[0].file, found[1]) == ("hall/f000.exr", ["roughness", "color_a"])


def test_a_sample_has_enough_candidates_by_importance(shards):
    assert shards("sample:stills", recipe="afgsa", train_patches=None).options.candidates == 3600
    assert shards("sample:stills", recipe="afgsa", train_patches=50).options.candidates == 50
    assert shards(recipe="afgsa", train_patches=None).options.candidates == 400
    assert shards("sample:stills", train_patches=None).options.train_patches == 320


def test_afgsas_recipe_keeps_validation_views_of_the_sample_out_of_training(shards):
    data = shards("sample:stills", recipe="afgsa", train_patches=400, patch_size=64, buffers=("color",))
    data.prepare_data()
    assert data.counts()["validation"] > 0
    assert len(data.scenes("train")) == 4
    assert len(data.scenes("validation")) == 1
    assert not set(data.scenes("train")) & set(data.scenes("validation"))
