"""Tiles with a halo give what the whole image gives."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from models import NFOR, WSKP
from models.tiling import core_size, denoise_in_tiles, denoise_tiled, tiles, times_read
from tests.models.frames import largest_relative, random_buffers, split_buffers


class Pyramid:
    """Not a module: only what tiling asks for. Averages 8x8 blocks, so that it needs aligned tiles."""

    inputs = ("color",)
    frame_numbers: tuple[str, ...] = ("exposure",)
    halo = 5
    multiple = 8

    def __init__(self) -> None:
        self.sizes: list[tuple[int, int]] = []
        self.given: list[set[str]] = []

    def measure(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {"exposure": 1 / buffers["color"].mean((1, 2, 3))}

    def __call__(self, buffers: Mapping[str, Tensor]) -> Tensor:
        color = buffers["color"]
        self.sizes.append((color.shape[-2], color.shape[-1]))
        self.given.append(set(buffers))
        coarse = F.interpolate(F.avg_pool2d(color, 8), scale_factor=8)
        near = F.avg_pool2d(F.pad(color, [5] * 4, mode="replicate"), 11, stride=1)
        return (coarse + near) * buffers["exposure"][:, None, None, None]


@pytest.mark.parametrize(("height", "width"), [(40, 64), (37, 61), (8, 100)])
@pytest.mark.parametrize("tile", [1, 16, 20, 1000])
def test_a_method_on_a_grid_of_8_gives_the_same_tiled(height: int, width: int, tile: int) -> None:
    buffers = {"color": random_buffers(2, height, width)["irradiance"]}
    padded = F.pad(buffers["color"], (0, -width % 8, 0, -height % 8), mode="replicate")
    exposure = Pyramid().measure(buffers)
    expected = Pyramid()({"color": padded, **exposure})[..., :height, :width]
    found = denoise_tiled(Pyramid(), buffers, tile=tile)
    assert found.shape == buffers["color"].shape
    assert largest_relative(found, expected) < 1e-5


def test_every_tile_has_aligned_sizes_and_the_frame_numbers() -> None:
    method = Pyramid()
    denoise_tiled(method, {"color": torch.rand(1, 3, 45, 70)}, tile=16)
    assert all(h % 8 == 0 and w % 8 == 0 for h, w in method.sizes)
    assert all(names == {"color", "exposure"} for names in method.given)


def test_given_frame_numbers_are_not_measured_again() -> None:
    color = torch.ones(1, 3, 16, 16)
    found = denoise_tiled(Pyramid(), {"color": color, "exposure": torch.tensor([10.0])})
    torch.testing.assert_close(found, color * 20)


@pytest.mark.parametrize("tile", [16, 33])
def test_wskp_tiled_equals_untiled(tile: int) -> None:
    network = WSKP().eval()
    buffers = {**random_buffers(2, 70, 83), "exposure": torch.tensor([1.0, 0.3])}
    with torch.no_grad():
        expected = network(buffers).color
        assert largest_relative(denoise_tiled(network, buffers, tile=tile), expected) < 1e-5


def test_cores_cover_every_pixel_once() -> None:
    covered = torch.zeros(37, 61)
    for piece in tiles(37, 61, (16, 20), 5):
        covered[piece.core] += 1
        for core, read in zip(piece.core, piece.read, strict=True):
            assert read.start <= core.start
            assert core.stop <= read.stop
    assert (covered == 1).all()


class Wide(WSKP):
    """WSKP with a large lasting allocation."""

    bytes_once = 15_000_000


@pytest.mark.parametrize("network", [WSKP(), Wide()])
@pytest.mark.parametrize("budget", [20_000_000, 60_000_000])
def test_tiles_fit_the_budget_and_use_it(network: WSKP, budget: int) -> None:
    rows, columns = core_size(network, (720, 1280), budget)
    halo = -(-network.halo // network.multiple) * network.multiple

    def needed(rows: int, columns: int) -> int:
        pieces = tiles(720, 1280, (rows, columns), halo)
        areas = [(r.stop - r.start) * (c.stop - c.start) for r, c in (piece.read for piece in pieces)]
        return max(areas) * network.bytes_per_pixel + network.bytes_once

    assert needed(rows, columns) <= budget
    assert needed(2 * rows, 2 * columns) > budget
    assert needed(720, columns) > budget or rows == 720


def test_cores_read_no_more_pixels_than_square_ones_do() -> None:
    network = WSKP()
    budget = 30_000_000

    def read(core: tuple[int, int]) -> int:
        pieces = [piece.read for piece in tiles(720, 1280, core, network.halo)]
        return sum((r.stop - r.start) * (c.stop - c.start) for r, c in pieces)

    side = math.isqrt(budget // network.bytes_per_pixel) - 2 * network.halo
    assert read(core_size(network, (720, 1280), budget)) < read((side, side))


def test_an_image_that_fits_is_one_tile() -> None:
    assert core_size(WSKP(), (720, 1280), 720 * 1280 * WSKP().bytes_per_pixel) == (720, 1280)


def test_a_budget_too_small_for_one_tile_says_how_much_is_needed() -> None:
    with pytest.raises(ValueError, match=r"memory budget of 0\.1 MB is too small .* expected at least"):
        denoise_tiled(WSKP(), random_buffers(1, 64, 64), budget=100_000)


def test_a_missing_buffer_is_named() -> None:
    buffers = random_buffers(1, 16, 16)
    del buffers["albedo"]
    with pytest.raises(ValueError, match="missing: albedo"):
        denoise_tiled(WSKP(), buffers)


def test_buffers_of_different_size_are_refused() -> None:
    buffers = {**random_buffers(1, 16, 16), "depth": torch.ones(1, 1, 16, 17)}
    with pytest.raises(ValueError, match="depth 17x16"):
        denoise_tiled(WSKP(), buffers)


@pytest.fixture
def narrow() -> NFOR:
    """NFOR with windows so small that its halo fits several times into a small image."""
    return NFOR(features=("normal",), window=1, patch=1, prefilter_window=1, final_window=1, aux=True)


def test_nfor_tiled_equals_untiled_with_all_that_it_made_on_its_way(narrow: NFOR) -> None:
    buffers = {**split_buffers(2, 53, 47), "exposure": torch.tensor([1.0, 0.3])}
    shares: list[float] = []
    with torch.inference_mode():
        whole = narrow(buffers)
        tiled = denoise_in_tiles(narrow, buffers, tile=16, progress=shares.append)
    assert largest_relative(tiled.color, whole.color) < 1e-5
    assert tiled.aux is not None
    assert whole.aux is not None
    assert tiled.aux.keys() == whole.aux.keys() == {"normal", "error_k0.5", "error_k1", "selection"}
    for name, layer in whole.aux.items():
        assert largest_relative(tiled.aux[name], layer) < 1e-5
    assert len(shares) == 12
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)


def test_a_clip_tiled_equals_the_clip_untiled() -> None:
    method = NFOR(features=(), frames=1, window=1, patch=0, aux=True)
    stills = [split_buffers(1, 36, 34, seed) for seed in range(2)]
    buffers = {name: torch.stack([s[name] for s in stills], 1) for name in method.inputs}
    with torch.inference_mode():
        whole, tiled = method.clip(buffers), denoise_in_tiles(method, buffers, tile=18)
    assert tiled.color.shape == (1, 2, 3, 36, 34)
    assert largest_relative(tiled.color, whole.color) < 1e-5
    assert whole.aux is not None
    assert tiled.aux is not None
    assert largest_relative(tiled.aux["error_k1"], whole.aux["error_k1"]) < 1e-4


@pytest.mark.parametrize("budget", [30e6, 150e6, 400e6])
def test_a_large_halo_is_read_about_nine_times_at_most_and_once_where_memory_allows(budget: float) -> None:
    method, size = NFOR(), (720, 1280)
    assert times_read(method, size, core_size(method, size, int(budget))) < 10
    assert core_size(method, size, size[0] * size[1] * method.bytes_per_pixel) == size


def test_without_layers_there_is_no_aux() -> None:
    assert denoise_in_tiles(WSKP(), random_buffers(1, 40, 40), tile=16).aux is None
