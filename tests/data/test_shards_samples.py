"""Samples in shards: those that do not count stay so, ranges of half precision, numbers that must agree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data.augment import Augmentation
from data.buffers import sample_channels
from data.frame import Frame, Samples
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.shards.batch import Batches, Order
from data.shards.planes import HALF_MAX, Planes
from data.shards.prepare import prepare
from data.shards.read import ShardReader
from models import PixelGather
from models.denoiser import select
from tests.data.small_sets import OPTIONS, frame, with_samples

LENS = (0.25, 3.0, 50.0)


def write(root: Path, frames: list[Frame]) -> Path:
    records = tuple(write_record(made, root) for made in frames)
    splits: dict[str, list[str]] = {"train": ["hall"], "validation": [], "test": []}
    Manifest("set", "penumbra", "euclidean", splits, {"hall": SceneRecord(records, sequence=False)}).save(
        root
    )
    return root


def sampled(index: int, count: int, spp: int | None) -> Frame:
    return replace(with_samples(frame("hall", index), count), spp=spp, thin_lens=LENS)


def test_dropped_samples_and_the_lens_reach_a_batch_through_frames_and_shards(tmp_path: Path) -> None:
    made = sampled(0, 3, 3)
    assert made.samples is not None
    made.samples.values[1, ::3] = np.nan
    made.samples.values[:, 5, 6] = np.nan
    index = prepare(write(tmp_path / "frames", [made]), tmp_path / "shards", OPTIONS)
    reader = ShardReader(index, "train")
    assert reader.array(0, "samples").dtype == torch.float16
    batches = Batches(reader, ("samples", "depth", "color"), False)
    batch = batches[Order(0, tuple(range(len(reader))))].unpack()
    assert torch.equal(batch["thin_lens"], torch.tensor([LENS] * len(reader)))
    for row in range(len(reader)):
        y, x = divmod(int(batch["depth"][row, 0, 0, 0]) - 1, 48)
        stored = made.samples.values[:, y : y + 16, x : x + 16].transpose(0, 3, 1, 2)
        np.testing.assert_allclose(batch["samples"][row], stored, rtol=1e-3, atol=1e-4, equal_nan=True)
    assert torch.isfinite(batch["color"]).all()


@pytest.mark.parametrize(
    "augmentation", [Augmentation("dihedral", permute=True), Augmentation("none", samples=(1, 1))]
)
def test_augmented_batches_keep_what_is_dropped_and_train_to_finite_gradients(
    tmp_path: Path, augmentation: Augmentation
) -> None:
    made = sampled(0, 3, 3)
    assert made.samples is not None
    made.samples.values[1, ::2] = np.nan  # a random subset of one leaves these rows without any
    index = prepare(write(tmp_path / "frames", [made]), tmp_path / "shards", OPTIONS)
    batches = Batches(ShardReader(index, "train"), ("samples", "reference"), False, augmentation=augmentation)
    net = PixelGather(
        width=4,
        levels=2,
        kernel_size=3,
        embedding=6,
        fill=dict.fromkeys(
            ("depth", "diffuse_albedo", "specular_albedo", "motion", "coc", "lens", "time"), 0.0
        ),
    )
    shares = set()
    for number in range(4):
        batch = batches[Order(0, (number,))].unpack()
        gone = batch["samples"].isnan()
        assert torch.equal(gone.all(2), gone.any(2))
        shares.add(gone.float().mean().item())
        color = net(select(net, batch)).color
        assert torch.isfinite(color).all()
        net.zero_grad()
        (color - batch["reference"]).square().mean().backward()
        grads = [p.grad for p in net.parameters() if p.grad is not None]
        assert grads
        assert all(torch.isfinite(g).all() for g in grads)
    assert max(shares) > 0.1


def planes(half: bool, **parts: np.ndarray) -> Planes:
    made = {n: np.asarray(v, np.float32) for n, v in parts.items()}
    return Planes.of_samples(Samples.of(made), half)


def test_radiance_is_clipped_to_half_and_other_overflows_keep_their_patch_in_float32() -> None:
    radiance, depth = np.ones((2, 8, 16, 3)), np.full((2, 8, 16, 1), 7.0)
    radiance[0, 1, 1], depth[1, 2, 12] = 1e6, 1e5
    made = planes(True, radiance=radiance, depth=depth)
    left, right = made.cut((0, 0), 8), made.cut((8, 0), 8)
    assert left.dtype == np.float16
    assert left[0, 0, 1, 1] == HALF_MAX
    assert right.dtype == np.float32
    assert right[1, 3, 2, 4] == 1e5
    assert np.isfinite(left).all()


def test_depths_too_small_for_half_precision_stay_in_float32() -> None:
    radiance, depth = np.ones((2, 8, 8, 3)), np.full((2, 8, 8, 1), 2e-5)
    assert planes(True, radiance=radiance, depth=depth).cut(None, 8).dtype == np.float32
    assert planes(True, radiance=radiance, depth=depth * 1e4).cut(None, 8).dtype == np.float16
    assert planes(False, radiance=radiance, depth=depth * 1e4).cut(None, 8).dtype == np.float32


def test_dropped_samples_do_not_decide_about_precision() -> None:
    radiance = np.full((2, 8, 8, 3), 1e-4)
    radiance[0, 4, 4] = np.nan
    assert planes(True, radiance=radiance).cut(None, 8).dtype == np.float32
    assert planes(True, radiance=radiance * 1e4).cut(None, 8).dtype == np.float16


def test_samples_that_are_not_marked_are_refused() -> None:
    radiance = np.ones((2, 8, 8, 3))
    radiance[0, 4, 4, 1] = np.inf
    with pytest.raises(ValueError, match=r"samples: channel radiance\.G holds NaN or Inf"):
        planes(True, radiance=radiance)


def test_frames_with_different_numbers_of_samples_are_refused_by_name_with_the_way_out(
    tmp_path: Path,
) -> None:
    root = write(tmp_path / "frames", [sampled(0, 4, 4), sampled(1, 8, 8)])
    expected = (
        r"hall/f000\.exr has 4 samples per pixel; hall/f001\.exr has 8 samples per pixel\. "
        r"Choose frames with --spp N \(in training --data\.spp \[N\]\), or leave .* --samples none"
    )
    with pytest.raises(ValueError, match=expected):
        prepare(root, tmp_path / "shards", OPTIONS)
    index = prepare(root, tmp_path / "shards", replace(OPTIONS, spp=(8,)))
    assert {shard.per_sample and shard.per_sample[0] for shard in index.shards} == {8}


def test_frames_whose_manifest_hides_the_difference_are_refused_when_they_are_cut(tmp_path: Path) -> None:
    root = write(tmp_path / "frames", [sampled(0, 4, None), sampled(1, 8, None)])
    with pytest.raises(ValueError, match=r"has 4 samples per pixel; .* has 8 samples per pixel"):
        prepare(root, tmp_path / "shards", replace(OPTIONS, samples_per_shard=256))


def test_frames_with_other_quantities_are_refused_with_both_lists(tmp_path: Path) -> None:
    other = sampled(1, 4, 4)
    assert other.samples is not None
    other.samples = Samples(other.samples.values[..., :6], sample_channels("radiance", "normal"))
    root = write(tmp_path / "frames", [sampled(0, 4, 4), other])
    with pytest.raises(
        ValueError, match=r"4 samples per pixel of radiance, normal, roughness; .* of radiance, normal"
    ):
        prepare(root, tmp_path / "shards", OPTIONS)


def test_a_list_of_images_is_refused_where_one_tensor_is_expected() -> None:
    samples = [torch.ones(4, 20, 16, 16), torch.ones(8, 20, 16, 16)]
    with pytest.raises(ValueError, match="'samples' is a list, expected one tensor; images of different"):
        PixelGather(width=4, levels=2, kernel_size=3)({"samples": samples})  # type: ignore[dict-item]
