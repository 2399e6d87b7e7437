"""WLR is its float64 transcription, and what its parts promise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models.classical.nfor import NFOR
from models.classical.wlr import WLR
from models.denoiser import Buffers
from models.ops.shared_bandwidth import shared_bandwidth
from models.tiling import denoise_tiled
from tests.models import plain_wlr
from tests.models.classical.test_nfor import scene
from tests.models.frames import split_buffers

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAMES = ("depth", "normal", "albedo")


def means(buffers: Buffers) -> dict[str, Tensor]:
    """The buffers and the mean of all halves."""
    return {**buffers, **{n: 0.5 * (buffers[f"{n}_a"] + buffers[f"{n}_b"]) for n in ("color", *NAMES)}}


def image(tensor: Tensor) -> Any:
    return tensor[0].permute(1, 2, 0).double().numpy()


def transcription(
    buffers: Buffers, radius: int, names: tuple[str, ...] = NAMES, **changes: Tensor
) -> plain_wlr.Steps:
    given = {**buffers, **changes}
    return plain_wlr.wlr(
        plain_wlr.Scene(
            image(given["color"]),
            image(given["color_variance"]),
            [image(given[name]) for name in names],
            [image(given[f"{name}_variance"]) for name in names],
            radius,
        )
    )


@pytest.fixture(scope="module")
def buffers() -> dict[str, Tensor]:
    """Around the corner of two edges, with noisy, textured, smooth and constant features."""
    return {name: x[..., 4:16, 8:20] for name, x in means(scene()).items()}


@pytest.fixture(scope="module")
def expected(buffers: dict[str, Tensor]) -> plain_wlr.Steps:
    return transcription(buffers, 3)


def single(buffers: Buffers) -> dict[str, Tensor]:
    return {name: x.float() for name, x in buffers.items()}


def relative(found: Tensor, expected: Any) -> float:
    return float(np.abs(image(found) - expected).max() / (expected.max() - expected.min()))


@pytest.mark.parametrize("fused", [False, True])
def test_every_step_equals_the_transcription(
    buffers: dict[str, Tensor], expected: plain_wlr.Steps, fused: bool
) -> None:
    found = WLR(window=3, fused=fused).details(buffers)
    assert set(np.unique(expected.rank)) >= {2, 3, 4}
    assert 0.1 < (expected.first < 1).mean() < 0.9
    assert (image(found.rank)[..., 0] == expected.rank).all()
    assert np.abs(image(found.bandwidth)[..., 0] - expected.bandwidth).max() < 1e-9
    assert relative(found.color, expected.color) < 1e-9


@pytest.mark.parametrize("fused", [False, True])
def test_float32_buffers_give_the_same_image(
    buffers: dict[str, Tensor], expected: plain_wlr.Steps, fused: bool
) -> None:
    found = WLR(window=3, fused=fused)(single(buffers)).color
    assert found.dtype == torch.float32
    assert relative(found, expected.color) < 1e-5


@pytest.mark.slow
def test_the_published_window_equals_the_transcription(buffers: dict[str, Tensor]) -> None:
    expected = transcription(buffers, 9).color
    for fused in (False, True):
        assert relative(WLR(fused=fused)(buffers).color, expected) < 1e-9


@pytest.mark.parametrize("fused", [False, True])
def test_memory_changes_nothing_but_memory(buffers: dict[str, Tensor], fused: bool) -> None:
    whole = WLR(window=3, fused=fused)(buffers).color
    for memory in (100, 200_000, 1_000_000):  # single pixels, parts of rows, rows
        found = WLR(window=3, memory=memory, fused=fused)(buffers).color
        torch.testing.assert_close(found, whole, rtol=1e-10, atol=0)


def test_compiled_kernels_give_the_same_for_every_number_of_rows_and_threads() -> None:
    given = means(scene(7))
    whole = WLR(window=2, map_sigma=2.0, fused=False).details(given)
    for memory in (100, 400_000, None):
        found = WLR(window=2, map_sigma=2.0, memory=memory, fused=True).details(given)
        assert torch.equal(found.rank, whole.rank)
        torch.testing.assert_close(found.bandwidth, whole.bandwidth, rtol=1e-9, atol=0)
        torch.testing.assert_close(found.color, whole.color, rtol=1e-9, atol=1e-12)
    torch.set_num_threads(2)
    assert torch.equal(WLR(window=2, map_sigma=2.0, fused=True)(given).color, found.color)


@pytest.mark.parametrize("fused", [False, True])
def test_a_fit_that_turns_negative_is_an_average(fused: bool) -> None:
    made = means(scene(5))
    cut = {name: x[..., :9, 3:14] for name, x in made.items()}
    cut["color"] = (cut["color"] - 0.45).clamp_min(0.0)
    expected = transcription(cut, 3)
    found = WLR(window=3, fused=fused)(cut).color
    assert relative(found, expected.color) < 1e-9
    assert found.min() >= 0
    linear = WLR(window=3, fused=fused)({**cut, "color": cut["color"] + 1.0}).color - 1.0
    assert linear.min() < -0.01


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("names", [(), ("albedo",), ("depth", "roughness")])
def test_any_features_can_be_named(names: tuple[str, ...], fused: bool) -> None:
    whole = means(scene(3))
    rough = {f"roughness{part}": 0.1 * whole[f"depth{part}"] ** 2 for part in ("", "_variance")}
    cut = {n: x[..., :9, 5:15] for n, x in {**whole, **rough}.items()}
    network = WLR(names, window=2, fused=fused)
    assert network.inputs == tuple(f"{n}{part}" for n in ("color", *names) for part in ("", "_variance"))
    assert relative(network(cut).color, transcription(cut, 2, names).color) < 1e-9


def noiseless(height: int = 14, width: int = 16) -> dict[str, Tensor]:
    """Smooth features without noise, and a colour whose variance lets all neighbours pass."""
    y, x = (side.double()[None, None] for side in torch.meshgrid(
        torch.arange(height), torch.arange(width), indexing="ij"
    ))  # fmt: skip
    features = {
        "depth": 3 + 0.2 * x + 0.1 * y,
        "normal": torch.cat([(0.3 * x).sin(), (0.2 * y).cos(), (0.1 * x * y).sin()], 1),
        "albedo": torch.cat([(0.5 * y).sin(), (0.4 * x).cos(), (0.3 * (x - y)).sin()], 1),
    }
    color = torch.ones(1, 3, height, width, dtype=torch.float64)
    zeros = {f"{name}_variance": torch.zeros_like(f) for name, f in features.items()}
    return {**features, **zeros, "color": color, "color_variance": 0.9 * color}


def test_what_is_linear_in_position_and_features_is_kept_but_for_the_ridge() -> None:
    given = noiseless()
    y, x = torch.meshgrid(torch.arange(14).double(), torch.arange(16).double(), indexing="ij")
    plane = 4 + 0.05 * x - 0.03 * y + 0.3 * given["albedo"][:, :1] - 0.2 * given["normal"][:, 1:2]
    given["color"] = plane * torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64).reshape(1, 3, 1, 1)
    given["color_variance"][:] = 0.9
    network = WLR(window=3, ridge=1e-13, least_singular=1e-6)
    found = network.details(given)
    assert found.rank.min() >= 8
    torch.testing.assert_close(found.color, given["color"], rtol=1e-6, atol=0)
    biased = WLR(window=3, ridge=1e-2, least_singular=1e-6)(given).color
    assert (biased - given["color"]).abs().max() > 1e-3


@pytest.mark.parametrize("fused", [False, True])
def test_constant_images_stay_constant_whatever_the_features(fused: bool) -> None:
    given = noiseless()
    torch.testing.assert_close(WLR(window=3, fused=fused)(given).color, given["color"], rtol=1e-12, atol=0)


def test_directions_that_noise_explains_are_cut_off() -> None:
    given = noiseless()
    clean = WLR(window=3).details(given).rank
    for name in NAMES:
        given[f"{name}_variance"] = torch.full_like(given[name], 0.05)
    some = WLR(window=3).details(given).rank
    for name in NAMES:
        given[f"{name}_variance"] = torch.full_like(given[name], 10.0)
    assert clean.min() >= 6
    assert some.mean() < clean.mean() - 2
    assert (WLR(window=3).details(given).rank == 2).all()
    assert WLR(window=3, variance_limit=0.0).details(given).rank.equal(clean)


def test_the_shared_bandwidth_minimises_squared_bias_and_variance() -> None:
    trials = (0.2, 0.4, 0.6, 0.8, 1.0)
    h = torch.tensor(trials, dtype=torch.float64)[:, None]
    rank = torch.tensor([2.0, 5.0, 9.0], dtype=torch.float64)
    slope, fall = torch.tensor([0.3, -2.0, 0.7]).double(), torch.tensor([1e-3, 1e-4, 1e-5]).double()
    bias, variance = 0.1 + slope * h.square(), 0.02 + fall * h.pow(-rank)
    found = shared_bandwidth(trials, bias, variance, rank)
    fine = torch.linspace(0.01, 1.0, 99_001, dtype=torch.float64)[:, None]
    errors = slope.square() * fine.pow(4) + fall * fine.pow(-rank)
    torch.testing.assert_close(found, fine[errors.argmin(0), 0], rtol=0, atol=2e-5)


def test_the_shared_bandwidth_stays_between_its_limits() -> None:
    trials, rank = (0.5, 1.0), torch.tensor([2.0, 2.0, 2.0])
    bias = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 1e9]])
    falling, rising = torch.tensor([[2.0], [1.0]]), torch.tensor([[1.0], [2.0]])
    assert shared_bandwidth(trials, bias, falling.expand(2, 3), rank)[0] == 1.0
    assert shared_bandwidth(trials, bias, falling.expand(2, 3), rank)[2] == pytest.approx(0.01)
    assert shared_bandwidth(trials, bias, rising.expand(2, 3), rank).allclose(torch.tensor(0.01))


def test_prefiltered_features_without_noise_are_the_features() -> None:
    given = single(noiseless())
    for name in NAMES:
        given |= {f"{name}_a": given[name], f"{name}_b": given[name]}
    plain = WLR(window=3, feature_noise="none")(given).color
    assert torch.equal(WLR(window=3, prefilter=True, feature_noise="none")(given).color, plain)


def test_prefiltered_features_are_those_of_nfor(buffers: dict[str, Tensor]) -> None:
    given = single(buffers)
    options: dict[str, Any] = {"patch": 1, "prefilter_window": 2, "final_window": 1, "fused": False}
    found = WLR(window=3, prefilter=True, aux=True, **options)(given)
    features = NFOR(window=2, **options).details(given).features
    assert found.aux is not None
    for name in NAMES:
        assert torch.equal(found.aux[name], features[name])
    residual = {}
    for name in NAMES:
        filtered = WLR(window=3, prefilter=True, **options)._feature(given, name)
        residual |= {name: filtered.image, f"{name}_variance": filtered.variance}
    assert relative(found.color, transcription(given, 3, **residual).color) < 1e-5


@pytest.mark.parametrize(
    "options", [{}, {"prefilter": True}, {"color_noise": "halves", "fireflies": "limit"}], ids=str
)
def test_nothing_beyond_the_halo_matters_and_its_rim_does(options: dict[str, Any]) -> None:
    network = WLR(("albedo",), window=2, patch=1, prefilter_window=1, final_window=1, **options)
    halo, seen = network.halo, 0
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        size = (1, 3, 2 * halo + 3, 18)
        given = {n: torch.rand(size, generator=generator, dtype=torch.float64) for n in network.inputs}
        given |= {n: (2.0 if "color" in n else 0.2) * x for n, x in given.items() if "variance" in n}
        middle = network(given).color[..., halo + 1, :]
        for distance in (halo, halo + 1):
            moved = {n: x.clone() for n, x in given.items()}
            for x in moved.values():
                x[..., halo + 1 + distance, :] *= 4.0
            changed = not network(moved).color[..., halo + 1, :].allclose(middle, rtol=1e-12, atol=0)
            assert not (changed and distance > halo)
            seen += changed
    assert seen > 0


def test_tiles_with_the_halo_give_the_whole_image() -> None:
    network = WLR(window=1, prefilter=True, patch=1, prefilter_window=1, final_window=1)
    given = split_buffers(1, 20, 60)
    torch.testing.assert_close(
        denoise_tiled(network, given, tile=16), network(given).color, rtol=1e-5, atol=1e-5
    )
