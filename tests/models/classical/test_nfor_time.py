"""The space-time mode of NFOR is its float64 transcription."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.classical.nfor import NFOR
from tests.models import plain_nfor_time
from tests.models.plain_nfor import Radii

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

SIZE, FRAMES, REACH = 12, 5, 2
RADII = Radii(window=2, patch=1, prefilter=1, final=1)
SETTINGS: dict[str, Any] = {
    "frames": REACH,
    "features": ("albedo",),
    "window": 2,
    "patch": 1,
    "prefilter_window": 1,
    "final_window": 1,
}
NARROW: dict[str, Any] = {**SETTINGS, "frames": 1, "features": (), "window": 1}


def moving(frames: int, seed: int = 0) -> dict[str, Tensor]:
    """An edge that moves a pixel per frame over a gradient that brightens; noisy halves."""
    random = np.random.default_rng(seed)
    t, y, x = np.mgrid[:frames, :SIZE, :SIZE]
    left = (x + t < 8)[..., None]
    clean = {"albedo": np.where(left, [0.2, 0.5, 0.7], [0.8, 0.7, 0.1]) + 0.02 * y[..., None]}
    clean["color"] = clean["albedo"] * (1.0 + 0.1 * t + 0.05 * x)[..., None]
    buffers: dict[str, Tensor] = {}
    for name, image in clean.items():
        variance = (0.04 if name == "color" else 0.001) * image
        for half in "ab":
            noisy = image + (2 * variance) ** 0.5 * random.standard_normal(image.shape)
            buffers[f"{name}_{half}"] = torch.from_numpy(noisy).permute(0, 3, 1, 2)[None]
        buffers[f"{name}_variance"] = torch.from_numpy(variance).permute(0, 3, 1, 2)[None]
    return buffers


def small(buffers: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: image[..., :7, 2:9] for name, image in buffers.items()}


def arrays(buffers: dict[str, Tensor], name: str) -> Any:
    parts = (buffers[f"{name}_{part}"] for part in ("a", "b", "variance"))
    return tuple(part[0].permute(0, 2, 3, 1).numpy() for part in parts)


@pytest.fixture(scope="module")
def buffers() -> dict[str, Tensor]:
    return moving(FRAMES)


@pytest.fixture(scope="module")
def expected(buffers: dict[str, Tensor]) -> Any:
    a, b, variance = arrays(buffers, "color")
    return plain_nfor_time.nfor(a, b, variance, arrays(buffers, "albedo"), RADII, REACH)


@pytest.mark.parametrize(("fused", "kind"), [(False, torch.float64), (False, torch.float32), (True, None)])
def test_all_frames_equal_the_transcription(
    buffers: dict[str, Tensor], expected: Any, fused: bool, kind: torch.dtype | None
) -> None:
    given = {name: image.to(kind or torch.float32) for name, image in buffers.items()}
    found = NFOR(fused=fused, **SETTINGS).sequence(given)
    difference = np.abs(found[0].permute(0, 2, 3, 1).double().numpy() - expected).max()
    assert difference / (expected.max() - expected.min()) < 1e-3


def test_a_frame_depends_on_frame_halo_frames_on_each_side_and_on_no_more() -> None:
    network = NFOR(fused=False, **NARROW)
    assert network.frame_halo == 4
    count = 2 * network.frame_halo + 3
    middle = count // 2
    given = small(moving(count))
    plain = network(given).color
    moved = {}
    for distance in (network.frame_halo, network.frame_halo + 1):
        changed = {name: image.clone() for name, image in given.items()}
        for name in ("color_a", "color_b"):
            changed[name][:, middle - distance] *= 1.5
        moved[distance] = not torch.equal(network(changed).color, plain)
    assert moved == {network.frame_halo: True, network.frame_halo + 1: False}


def test_a_part_of_a_sequence_with_its_frame_halo_gives_the_same_frames() -> None:
    network = NFOR(fused=False, **NARROW)
    given = small(moving(11))
    whole = network.sequence(given)
    halo = network.frame_halo
    part = network.sequence({name: image[:, 6 - halo :] for name, image in given.items()})
    torch.testing.assert_close(part[:, halo:], whole[:, 6:], rtol=0, atol=0)


def test_without_halves_of_the_colour_there_is_one_pass_and_half_of_the_frame_halo() -> None:
    assert NFOR(color_noise="estimated", frames=2).frame_halo == 4
    assert NFOR(frames=2).frame_halo == 8
    assert NFOR().frame_halo == 0


def test_layers_of_all_frames_come_with_a_clip_and_those_of_the_middle_frame_with_one() -> None:
    given = moving(3)
    network = NFOR(aux=True, fused=False, **{**SETTINGS, "frames": 1})
    clip, frame = network.clip(given), network(given)
    assert clip.aux is not None
    assert frame.aux is not None
    assert set(clip.aux) == {"albedo", "error_k0.5", "error_k1", "selection"}
    for name, layer in clip.aux.items():
        assert layer.shape == (1, 3, 3, SIZE, SIZE)
        assert torch.equal(frame.aux[name], layer[:, 1])
    alone = NFOR(aux=True, fused=False, **{**SETTINGS, "frames": 0}).clip(given)
    assert alone.aux is not None
    assert alone.aux["selection"].shape == (1, 3, 3, SIZE, SIZE)
