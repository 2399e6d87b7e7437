"""Layer embeddings: equal to a literal transcription, any number of samples in any order, some bad."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from data.buffers import sample_channels
from models import layers as layers_module
from models.blocks.per_sample import PerSample
from models.denoiser import select
from models.layers import Layer, Optimized, PixelGather, SampleSplat, occupancy
from models.ops import kernel_blocks, streaming
from models.ops.splat import splat_exp
from models.tiling import denoise_tiled
from tests.benchmarks.memory import live_bytes
from tests.models import plain_layers as plain
from tests.models.frames import largest_relative, random_samples

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL: dict[str, Any] = {"width": 4, "levels": 2, "kernel_size": 3, "embedding": 5}
NETWORKS: dict[str, functools.partial[PerSample]] = {
    "alpha": functools.partial(Layer, **SMALL),
    "weighted": functools.partial(Layer, compositing="weighted", layers=3, **SMALL),
    "splat": functools.partial(SampleSplat, **SMALL),
    "gather": functools.partial(PixelGather, **SMALL),
    "optimized": functools.partial(Optimized, **{**SMALL, "levels": 3}),
}


def made(network: nn.Module) -> Any:
    """Return a network whose kernels and partitions differ visibly from pixel to pixel."""
    generator = torch.Generator().manual_seed(5)
    for parameter in network.parameters():
        bound = 2.0 / math.sqrt(parameter[0].numel()) if parameter.ndim > 1 else 0.3
        parameter.data.uniform_(-bound, bound, generator=generator)
    return network.double().eval()


@pytest.fixture(params=sorted(NETWORKS))
def network(request: pytest.FixtureRequest) -> Any:
    return made(NETWORKS[request.param]())


def denoised(network: nn.Module, samples: Tensor, **numbers: Tensor) -> Tensor:
    with torch.no_grad():
        color: Tensor = network({"samples": samples, **numbers}).color
    return color


@pytest.mark.parametrize(
    ("network", "parameters", "unet"),
    [
        (Layer, 17_284_435, 17_201_536),
        (SampleSplat, 17_278_721, 17_201_536),
        (PixelGather, 17_279_361, 17_201_536),
        (Optimized, 16_602_176, 16_574_528),
    ],
)
def test_parameters_are_those_of_the_published_networks(
    network: type[PerSample], parameters: int, unet: int
) -> None:
    with torch.device("meta"):
        found = network()
    assert sum(p.numel() for p in found.unet.parameters()) == unet
    assert sum(p.numel() for p in found.parameters()) == parameters


@pytest.mark.parametrize("layers", [1, 2, 3, 5])
@pytest.mark.parametrize("compositing", ["alpha", "weighted", "printed"])
def test_layer_equals_the_literal_form(layers: int, compositing: Any) -> None:
    network = made(Layer(layers, compositing, **SMALL))
    samples = random_samples(2, 3, 8, 12).double()
    found = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]] * 2))
    for number in range(2):
        expected = plain.layers(network.state_dict(), samples[number], 3, compositing, 7.0)
        assert largest_relative(found[number], expected) < 1e-9


def test_bilinear_upsampling_is_that_of_the_literal_form() -> None:
    network = made(Layer(upsampling="bilinear", **SMALL))
    samples = random_samples(1, 2, 8, 8).double()
    found = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]]))
    expected = plain.layers(network.state_dict(), samples[0], 3, "alpha", 7.0, "bilinear")
    assert largest_relative(found[0], expected) < 1e-9
    network.unet.upsampling = "nearest"
    other = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]]))
    assert largest_relative(other[0], expected) > 1e-4


LITERAL: dict[str, Any] = {
    "alpha": lambda state, samples: plain.layers(state, samples, 3, "alpha", 7.0),
    "weighted": lambda state, samples: plain.layers(state, samples, 3, "weighted", 7.0),
    "splat": lambda state, samples: plain.sample_splat(state, samples, 3, 7.0),
    "gather": lambda state, samples: plain.pixel_gather(state, samples, 3, 7.0),
    "optimized": lambda state, samples: plain.optimized(state, samples, 3, 7.0),
}


@pytest.mark.parametrize("spp", [1, 3, 33])
@pytest.mark.parametrize("name", ["splat", "gather", "optimized"])
def test_the_other_networks_equal_their_literal_forms(name: str, spp: int) -> None:
    network = made(NETWORKS[name]())
    samples = random_samples(1, spp, 8, 8 if spp > 3 else 16).double()
    found = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]]))
    assert largest_relative(found[0], LITERAL[name](network.state_dict(), samples[0])) < 1e-9


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_samples_out_of_range_are_clipped_as_in_the_literal_form(name: str) -> None:
    network = made(NETWORKS[name]())
    samples = random_samples(1, 3, 8, 8).double()
    samples[0, 0, 0, :2], samples[0, 1, 1, 3:], samples[0, 2, 2, 1] = 1e6, 0.0, 1e-7
    samples[0, 0, 14, 4], samples[0, 1, 16, :, 5] = 1e7, -1e5
    found = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]]))
    assert largest_relative(found[0], LITERAL[name](network.state_dict(), samples[0])) < 1e-9


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_gradients_equal_those_of_the_literal_form(name: str) -> None:
    network = made(NETWORKS[name]())
    samples, weights = random_samples(1, 2, 8, 8).double(), torch.rand(3, 8, 8, dtype=torch.float64)
    color = network({"samples": samples, "depth_range": torch.tensor([[0.0, 7.0]])}).color[0]
    found = torch.autograd.grad((color * weights).sum(), list(network.parameters()))
    state = {key: value.clone().requires_grad_() for key, value in network.state_dict().items()}
    literal = (LITERAL[name](state, samples[0]) * weights).sum()
    expected = torch.autograd.grad(literal, list(state.values()))
    scale = max(float(gradient.abs().max()) for gradient in expected)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-10 * scale)


def test_exposure_scales_what_the_networks_see_and_is_taken_out_of_the_result(network: Any) -> None:
    samples = random_samples(1, 2, 16, 16).double()
    bright = samples.clone()
    bright[:, :, :3] *= 4
    found = denoised(network, samples, exposure=torch.tensor([4.0]))
    assert largest_relative(found * 4, denoised(network, bright)) < 1e-12
    assert largest_relative(found, denoised(network, samples)) > 1e-4


def test_a_narrow_context_of_optimized_has_half_the_channels_at_full_resolution() -> None:
    network = made(Optimized(narrow_context=True, **{**SMALL, "levels": 3}))
    assert network.unet.exit.out_channels == SMALL["width"]
    samples = random_samples(1, 2, 8, 8).double()
    found = denoised(network, samples, depth_range=torch.tensor([[0.0, 7.0]]))
    assert largest_relative(found[0], LITERAL["optimized"](network.state_dict(), samples[0])) < 1e-9


def test_one_alpha_layer_is_a_splat_of_pixels() -> None:
    network = made(Layer(1, **SMALL))
    samples = random_samples(1, 4, 8, 12).double()
    frame = network._frame({"samples": samples})
    with torch.no_grad():
        contexts = network._contexts(frame)
        layers = network._sorted(frame, contexts[0])
    mean = samples[:, :, :3].mean(1, keepdim=True)
    torch.testing.assert_close(layers.radiance, mean)
    logits = network.generator.joint(layers.embedding, contexts[0])
    total = splat_exp(torch.cat([mean, torch.ones_like(mean[:, :, :1])], 2), logits, 3).total
    expected = total[:, :3] / (total[:, 3:] + 1e-6)
    assert largest_relative(denoised(network, samples), expected) < 1e-9


def test_a_layer_is_occupied_by_its_own_samples_and_those_behind() -> None:
    weight = torch.tensor([0.5, 0.3, 0.2]).reshape(1, 3, 1, 1, 1)
    torch.testing.assert_close(occupancy(weight).flatten(), torch.tensor([1.0, 0.5, 0.2]))


def test_the_order_of_samples_does_not_matter(network: Any) -> None:
    samples = random_samples(1, 6, 16, 24).double()
    shuffled = samples[:, [3, 0, 5, 1, 4, 2]]
    assert largest_relative(denoised(network, shuffled), denoised(network, samples)) < 1e-12


def test_every_sample_twice_is_the_same_image_where_shares_are_divided_by_their_number(network: Any) -> None:
    samples = random_samples(1, 3, 16, 16).double()
    twice = torch.cat([samples, samples], 1)
    assert largest_relative(denoised(network, twice), denoised(network, samples)) < 1e-5


@pytest.mark.parametrize("spp", [1, 2, 33])
def test_any_number_of_samples_is_denoised(network: Any, spp: int) -> None:
    color = denoised(network, random_samples(1, spp, 16, 16).double())
    assert color.shape == (1, 3, 16, 16)
    assert color.isfinite().all()


def test_constant_radiance_stays_constant_borders_included(network: Any) -> None:
    samples = random_samples(1, 4, 13, 18).double()
    samples[:, :, :3] = 0.7
    color = denoised(network, samples)
    torch.testing.assert_close(color, torch.full_like(color, 0.7), rtol=1e-4, atol=0)


def test_samples_that_are_no_numbers_are_as_if_they_were_not_there(network: Any) -> None:
    samples = random_samples(1, 3, 16, 16).double()
    bad = random_samples(1, 2, 16, 16, seed=9).double()
    bad[:, 0, 1], bad[:, 1, 5] = torch.nan, torch.inf
    bad[:, :, 6] = 1000  # their depth does not count either
    found = denoised(network, torch.cat([bad[:, :1], samples, bad[:, 1:]], 1))
    assert largest_relative(found, denoised(network, samples)) < 1e-12


def test_infinite_depth_is_that_of_a_ray_that_left_the_scene(network: Any) -> None:
    samples = random_samples(1, 3, 16, 16).double()
    samples[:, 1:, 6, 8:] = 0
    far = samples.clone()
    far[:, 1:, 6, 8:] = torch.inf
    assert torch.equal(denoised(network, far), denoised(network, samples))


def test_pixels_without_samples_are_filled_from_around_them(network: Any) -> None:
    samples = random_samples(1, 3, 16, 16).double()
    samples[:, :, :3] = 0.7
    samples[:, :, 0, 7, 8] = torch.nan
    color = denoised(network, samples)
    torch.testing.assert_close(color, torch.full_like(color, 0.7), rtol=1e-4, atol=0)


def test_a_frame_without_any_sample_is_black(network: Any) -> None:
    assert (denoised(network, torch.full((1, 2, 20, 16, 16), torch.nan).double()) == 0).all()


def test_radiance_without_end_in_one_sample_leaves_gradients_finite(network: Any) -> None:
    samples = random_samples(1, 3, 16, 16).double()
    samples[0, 1, 0, 4, 4], samples[0, 2, 6, 9, 9] = torch.inf, torch.nan
    network({"samples": samples}).color.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in network.parameters())


def test_streaming_in_strips_changes_nothing(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = random_samples(2, 3, 16, 24).double()
    expected = denoised(network, samples)
    monkeypatch.setattr(streaming, "_CHUNK", 20000)
    assert largest_relative(denoised(network, samples), expected) < 1e-12


@pytest.mark.parametrize("spp", [3, 9])
def test_samples_that_are_splatted_apart_make_the_image_of_all_at_once(
    spp: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = made(NETWORKS["splat"]())
    samples = random_samples(2, spp, 13, 17).double()
    samples[0, 1, 4, 3:9, 2:5] = torch.nan
    samples[:, :, 0, 9, 9] = torch.inf
    expected = network({"samples": samples}).color
    monkeypatch.setattr(layers_module, "strip_rows", lambda *_: 0)
    assert largest_relative(denoised(network, samples), expected) < 1e-12
    monkeypatch.setattr(streaming, "_CHUNK", 5000)
    assert largest_relative(denoised(network, samples), expected) < 1e-12


def test_rows_that_are_too_long_are_computed_in_parts(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = random_samples(1, 3, 16, 24).double()
    expected = denoised(network, samples)
    monkeypatch.setattr(streaming, "_CHUNK", 2000)
    assert largest_relative(denoised(network, samples), expected) < 1e-12
    network({"samples": samples}).color.sum().backward()
    assert all(p.grad.isfinite().all() for p in network.parameters())


def test_memory_beside_the_input_does_not_grow_with_samples(
    network: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "_CHUNK", 1 << 14)
    few, many = (random_samples(1, spp, 18, 26).double() for spp in (4, 12))  # no multiple of the grid
    peaks = [live_bytes(lambda s=samples: denoised(network, s)) for samples in (few, many)]
    assert peaks[1] <= 1.1 * peaks[0]


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (Layer, {}),
        (Layer, {"layers": 5}),
        (SampleSplat, {}),
        (PixelGather, {}),
        (PixelGather, {"kernel_size": 17}),
        (Optimized, {"width": 32, "embedding": 16}),
    ],
)
def test_a_call_takes_no_more_memory_than_declared(
    kind: Any, arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (streaming, kernel_blocks):  # next to nothing: `bytes_once` stands for strips
        monkeypatch.setattr(module, "_CHUNK", 1 << 13)
    network = kind(**{"width": 16, "levels": 3, "kernel_size": 5, "embedding": 32, **arguments}).eval()
    samples = random_samples(1, 3, 24, 24)
    used = live_bytes(lambda: denoised(network, samples)) / 24**2
    assert used <= network.bytes_per_pixel
    assert network.bytes_per_pixel <= 2.5 * used


def test_computing_again_gives_the_gradients_of_keeping(
    network: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "_CHUNK", 20000)
    samples, gradients = random_samples(1, 3, 16, 16).double(), []
    for recompute in (True, False):
        network.recompute = recompute
        network.zero_grad()
        network({"samples": samples}).color.square().mean().backward()
        gradients.append([p.grad.clone() for p in network.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def test_layers_add_up_to_the_mean_and_composite_to_the_image() -> None:
    network = made(Layer(3, **SMALL))
    samples = random_samples(2, 4, 14, 17).double()
    exposure = torch.tensor([0.5, 3.0])
    with torch.no_grad():
        layered = network.layered({"samples": samples, "exposure": exposure})
    torch.testing.assert_close(layered.unfiltered.sum(1), samples[:, :, :3].mean(1))
    color, through = torch.zeros_like(layered.color), torch.ones_like(layered.color)
    for radiance, alpha in zip(layered.filtered.unbind(1), layered.alpha.unbind(1), strict=True):
        color, through = color + through * radiance, through * (1 - alpha)
    torch.testing.assert_close(color, layered.color)
    torch.testing.assert_close(layered.color, denoised(network, samples, exposure=exposure))
    assert (layered.alpha >= 0).all()
    assert (layered.alpha <= 1).all()


def test_tiles_have_the_whole_frames_result_where_sides_do_not_divide(network: Any) -> None:
    samples = random_samples(1, 2, 61, 75).double()
    with torch.no_grad():
        tiled = denoise_tiled(network, {"samples": samples}, tile=16)
    assert largest_relative(tiled, denoised(network, samples)) < 1e-9


def test_a_batch_of_other_channels_is_brought_into_order_and_filled() -> None:
    names = ("time", "radiance", "hit", "depth", "normal", "diffuse_albedo", "specular_albedo", "roughness")
    network = Layer(fill={"motion": 0.0, "coc": 0.0, "lens": 0.25}, **SMALL)
    channels = sample_channels(*names)
    samples = torch.rand(1, 2, len(channels), 16, 16)
    found = select(network, {"samples": samples, "sample_channels": list(channels)})["samples"]
    order = sample_channels(*network.samples)
    assert found.shape == (1, 2, 20, 16, 16)
    assert torch.equal(found[:, :, order.index("depth.Z")], samples[:, :, channels.index("depth.Z")])
    assert (found[:, :, order.index("lens.Y")] == 0.25).all()
    assert (found[:, :, order.index("coc.Z")] == 0.0).all()


def test_missing_guides_are_named_with_the_option_that_fills_them() -> None:
    channels = sample_channels("radiance", "normal", "depth")
    batch = {"samples": torch.rand(1, 2, len(channels), 16, 16), "sample_channels": list(channels)}
    with pytest.raises(ValueError, match=r"no diffuse_albedo, .*coc, lens, time; they have radiance, normal"):
        select(Layer(**SMALL), batch)
    with pytest.raises(ValueError, match=r"fill: \{diffuse_albedo: 0, specular_albedo: 0, roughness: 0"):
        select(Layer(**SMALL), batch)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"layers": 6}, "layers is 6"),
        ({"compositing": "beta"}, "compositing 'beta'"),
        ({"kernel_size": 4}, "kernel_size must be odd"),
        ({"levels": 6}, "1 to 5 levels"),
        ({"fill": {"radiance": 0.0}}, "'radiance' is no guide"),
        ({"upsampling": "cubic"}, "upsampling 'cubic'"),
    ],
)
def test_arguments_out_of_range_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Layer(**{**SMALL, **arguments})


def test_optimized_needs_a_level_of_the_network_for_each_of_its_own() -> None:
    with pytest.raises(ValueError, match="needs as many"):
        Optimized(**SMALL)
