"""NFOR is its float64 transcription, step by step and end to end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.classical.nfor import NFOR, estimated_error
from models.denoiser import Buffers
from models.ops.halves import Halves
from tests.models import plain_nfor

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

SIZE = 24
NAMES = ("normal", "albedo", "depth")


def scene(seed: int = 0) -> dict[str, Tensor]:
    """A small image with edges, gradients, noisy halves, a constant feature and a textured one."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    left = (x + 0.3 * y < 0.6)[..., None]
    normal = np.where(left, [0.0, 0.0, 1.0], np.stack([x, 0 * x + 0.2, 1 - x], -1))
    albedo = np.where(left, 0.5 + 0.4 * np.sin(25 * y)[..., None] * [1, 0.5, 0.2], [0.2, 0.3, 0.6])
    depth = np.where(left, 3 + 2 * y[..., None], 7.0)
    light = np.where(left, 1.5 - x[..., None], 0.2 + y[..., None]) + (y > 0.7)[..., None] * 0.5
    buffers: dict[str, Tensor] = {}
    clean = {"color": albedo * light, "normal": normal, "albedo": albedo, "depth": depth}
    levels = {"color": 0.25, "normal": 0.02, "albedo": 0.05, "depth": 0.0}
    for name, image in clean.items():
        spread = levels[name] * np.sqrt(np.abs(image) + 0.05)
        for half in "ab":
            noisy = image + 2**0.5 * spread * random.standard_normal(image.shape)
            buffers[f"{name}_{half}"] = tensor(noisy)
        buffers[f"{name}_variance"] = tensor(spread**2)
    return buffers


def tensor(image: Any) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].double()


def image(buffers: Buffers, name: str) -> Any:
    return buffers[name][0].permute(1, 2, 0).double().numpy()


def single(buffers: Buffers) -> dict[str, Tensor]:
    return {name: image.float() for name, image in buffers.items()}


def image_of(color: Tensor) -> Any:
    return color[0].permute(1, 2, 0).double().numpy()


def transcription(buffers: Buffers, names: tuple[str, ...] = NAMES, **radii: int) -> plain_nfor.Steps:
    parts = ("a", "b", "variance")
    colors = [image(buffers, f"color_{part}") for part in parts]
    none = colors[0][..., :0]
    features = [np.concatenate([none, *(image(buffers, f"{n}_{part}") for n in names)], -1) for part in parts]
    return plain_nfor.nfor(
        colors[0], colors[1], colors[2], (features[0], features[1], features[2]), plain_nfor.Radii(**radii)
    )


@pytest.fixture(scope="module")
def buffers() -> dict[str, Tensor]:
    return scene()


@pytest.fixture(scope="module")
def expected(buffers: dict[str, Tensor]) -> plain_nfor.Steps:
    return transcription(buffers)


def relative(found: Tensor, expected: Any) -> float:
    found_image = found[0].permute(1, 2, 0).double().numpy()
    return float(np.abs(found_image - expected).max() / (expected.max() - expected.min()))


@pytest.mark.parametrize("fused", [False, True])
def test_every_result_equals_the_transcription(
    buffers: dict[str, Tensor], expected: plain_nfor.Steps, fused: bool
) -> None:
    found = NFOR(fused=fused).details(single(buffers))
    assert 0.1 < expected.selection.mean() < 0.9
    assert relative(torch.cat(list(found.features.values()), 1), expected.features) < 1e-4
    for k in range(2):
        assert relative(found.errors[k], expected.errors[k]) < 1e-3
    assert relative(found.selection, expected.selection) < 1e-3
    assert relative(found.color, expected.color) < 1e-3


@pytest.mark.parametrize("names", [(), ("depth",), ("albedo", "roughness")])
def test_any_features_can_be_named_and_absent_ones_are_not_replaced(names: tuple[str, ...]) -> None:
    whole = scene(3)
    rough = {f"roughness_{part}": whole[f"depth_{part}"] * 0.1 for part in ("a", "b", "variance")}
    cut = {n: image[..., :12, :14] for n, image in {**whole, **rough}.items()}
    names_and_radii = {"window": 3, "patch": 1, "prefilter": 2, "final": 1}
    expected = transcription(cut, names, **names_and_radii)
    network = NFOR(features=names, window=3, patch=1, prefilter_window=2, final_window=1)
    assert network.inputs == tuple(f"{n}_{p}" for n in ("color", *names) for p in ("a", "b", "variance"))
    assert relative(network(single(cut)).color, expected.color) < 1e-3


def test_the_error_estimate_is_right_in_the_mean() -> None:
    torch.manual_seed(0)
    clean, bias, variance = torch.tensor(2.0), 0.3, torch.tensor(0.5)
    a, b = (clean + torch.randn(400_000) for _ in "ab")  # each half has twice the variance of the mean
    filtered = [clean + bias + 0.2 * torch.randn(400_000) for _ in "ab"]
    found = estimated_error(Halves(a, b, variance), *filtered).mean()
    assert abs(found - (bias**2 + 0.2**2 / 2)) < 0.01


def test_pixels_without_variance_do_not_spread(buffers: dict[str, Tensor]) -> None:
    holes = single(buffers)
    holes["albedo_variance"] = holes["albedo_variance"].clone()
    holes["albedo_variance"][..., ::5, ::7] = torch.nan
    holes["color_variance"] = holes["color_variance"].clone()
    holes["color_variance"][..., 3, 20] = torch.nan
    found = NFOR().details(holes)
    assert found.color.isfinite().all()
    assert found.selection is not None
    assert (found.selection[..., 3, 20] == 1).all()  # as for a tie


def test_nothing_beyond_the_halo_matters_and_its_rim_does() -> None:
    network = NFOR(features=("albedo",), window=1, patch=1, prefilter_window=1, final_window=1)
    halo, seen = network.halo, 0
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        size = (1, 3, 2 * halo + 3, 20)
        buffers = {n: torch.rand(size, generator=generator) for n in network.inputs}
        buffers["color_variance"] *= 2.0
        middle = network(buffers).color[..., halo + 1, :]
        for distance in (halo, halo + 1):
            moved = dict(buffers)
            for name in network.inputs:
                moved[name] = buffers[name].clone()
                moved[name][..., halo + 1 + distance, :] = 5 * torch.rand(1, 3, 20, generator=generator)
            changed = not torch.equal(network(moved).color[..., halo + 1, :], middle)
            assert not (changed and distance > halo)
            seen += changed
    assert seen > 0


def test_the_paper_preset_filters_the_halves_twice_and_halves_the_last_variance(
    buffers: dict[str, Tensor],
) -> None:
    public, paper = NFOR("public"), NFOR("paper")
    assert paper.halo == public.halo + 5
    found, other = paper.details(single(buffers)), public.details(single(buffers))
    assert 1e-3 < relative(found.color, image_of(other.color)) < 0.5


def test_a_sequence_of_one_frame_is_a_still_and_neighbours_add_to_it(buffers: dict[str, Tensor]) -> None:
    small = {n: b[..., :16, :17] for n, b in single(buffers).items()}
    settings: dict[str, Any] = {"window": 2, "patch": 1, "prefilter_window": 1, "final_window": 1}
    still = NFOR(**settings)(small).color
    one = {n: b[:, None] for n, b in small.items()}
    over = NFOR("public", frames=2, **settings)
    assert torch.equal(over(one).color, still)
    assert torch.equal(NFOR(**settings).sequence(one)[:, 0], still)
    noisier = {
        n: b + 0.2 * b.std() * torch.randn(b.shape) if n[-2:] in ("_a", "_b") else b for n, b in small.items()
    }
    three = {n: torch.stack([small[n], noisier[n], small[n]], 1) for n in small}
    frames = over.sequence(three)
    assert frames.shape == (1, 3, 3, 16, 17)
    assert torch.equal(over(three).color, frames[:, 1])
    assert relative(frames[:, 0], image_of(still)) > 1e-3


def test_exposure_scales_only_the_constant_of_the_distances(buffers: dict[str, Tensor]) -> None:
    plain = single(buffers)
    dark = {n: b * (1e-4 if n == "color_variance" else 1e-2) if "color" in n else b for n, b in plain.items()}
    expected = NFOR().details(plain)
    found = NFOR().details({**dark, "exposure": torch.tensor([100.0])})
    assert relative(100 * found.color, image_of(expected.color)) < 1e-4
    assert relative(1e4 * found.errors[0], image_of(expected.errors[0])) < 1e-4


def test_wrong_arguments_are_refused(buffers: dict[str, Tensor]) -> None:
    with pytest.raises(ValueError, match="preset must be public or paper, got 'fast'"):
        NFOR("fast")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="frames and smoothing must be at least 0"):
        NFOR(frames=-1)
    with pytest.raises(ValueError, match="unknown buffer 'gloss'"):
        NFOR(features=("gloss",))
    with pytest.raises(ValueError, match=r"'color_a' has shape .* expected a sequence \(B, T, C, H, W\)"):
        NFOR(frames=1)(single(buffers))
