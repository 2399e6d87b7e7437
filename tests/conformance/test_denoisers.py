"""What every denoiser in `models.__all__` promises."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import models
from data.buffers import BUFFERS, FRAME_NUMBERS, SAMPLE_BUFFERS, SAMPLES, buffer
from models.blocks.per_sample import PerSample
from models.denoiser import Denoiser, select
from models.tiling import denoise_in_tiles, denoise_tiled
from tests.models.frames import largest_relative, lit, luminous, sampled, split_buffers

pytestmark = pytest.mark.usefixtures("one_thread")

LAYERS = {"Layer", "Optimized", "PixelGather", "SampleSplat"}
"""Methods on samples that are kept apart."""

KERNEL_METHODS = {
    *("KP", "KPCN", "MRKP", "NBGD", "WSKP", "MultiResolutionWSKP", "JointBilateral", "RHF", "SBMC", "WLR"),
    "LBF",
    *LAYERS,
}
"""Outputs are sums of input pixels whose weights sum to 1: a constant image stays constant."""

CLEANING = {"ACFM", "AFGSA", "KPCN", "NBGD", "RAE", "SBMC", *LAYERS}
"""Methods that take radiance which is negative, infinite or not a number; the data module repairs it for the
others."""

STEEP = {"RAE": 5}
"""How much larger rounding is in the output: it is the fifth power of what the network makes."""

DECIDE = {"LBF", "NFOR", "JointNLM", "RDFC", "RHF", "SBMC", "WLR", *LAYERS}
"""Methods that choose, between candidates or by an extremum: gradients reach less far than values."""

ARGUMENTS: dict[str, dict[str, Any]] = {
    "AFGSA": {"width": 16, "blocks": 2, "heads": 2},
    "KPCN": {"width": 8, "layers": 3, "kernel_size": 7},
    "ACFM": {"blocks": 2, "width": 16, "condition_width": 16, "condition": 8},
    "LBF": {
        "features": ("normal", "albedo", "depth"),
        "window": 2,
        "prefilter_window": 1,
        "prefilter_patch": 1,
        "prefilter_smoothing": 1,
        "spike_window": 3,
        "variance_spikes": 3.0,
    },
    "MRKP": {"width": 16},
    "MultiResolutionWSKP": {"width": 16},
    "NFOR": {"window": 1, "patch": 1, "prefilter_window": 1, "final_window": 1},
    "NLM": {"window": 2, "patch": 1},
    "JointNLM": {"window": 2, "patch": 1, "prefilter_window": 1},
    "MultiScaleNLM": {"window": 2, "patch": 1},
    "RDFC": {"window": 1, "patches": (0, 1), "prefilter_window": 1, "selection_window": 1},
    "RHF": {"window": 1},
    "RAE": {"stages": (4, 5), "tail": (6, 5)},
    "SBMC": {"features": PerSample.samples, "width": 4, "levels": 2, "rounds": 2, "kernel_size": 5},
    "WLR": {"window": 2},
    **{key: {"width": 4, "levels": 3, "kernel_size": 5, "embedding": 8} for key in LAYERS},
}
"""Narrower forms of large networks, with the same structure; the full sizes have tests of their own."""


def make(name: str) -> Denoiser:
    made: Denoiser = getattr(models, name)(**ARGUMENTS.get(name, {}))
    return made.eval()


@pytest.fixture(params=models.__all__)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def denoiser(name: str) -> Denoiser:
    torch.manual_seed(7)
    return make(name)


def inputs(
    denoiser: Denoiser, batch: int = 1, height: int = 32, width: int = 40, seed: int = 0
) -> dict[str, Tensor]:
    """Random buffers for a method, with the frame numbers that it reads."""
    return select(denoiser, everything(batch, height, width, seed))


def everything(batch: int, height: int, width: int, seed: int = 0) -> dict[str, Tensor]:
    """Random buffers and frame numbers for any method."""
    numbers = {"exposure": torch.ones(batch), "depth_range": torch.tensor([[1.0, 6.0]]).repeat(batch, 1)}
    generator = torch.Generator().manual_seed(seed)
    rows, columns = (
        side.float() for side in torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    )
    slanted = torch.stack([columns, rows, 0.3 * columns])[None] + 0.1 * torch.rand(
        batch, 3, height, width, generator=generator
    )
    moved = 4 * torch.rand(batch, 2, height, width, generator=generator) - 2
    placed = {"position": slanted, "motion": moved}
    return {**sampled({**split_buffers(batch, height, width, seed), **placed}), **numbers}


def relit(whole: dict[str, Tensor]) -> dict[str, Tensor]:
    """The buffers with light, and samples, as irradiance and albedo make them."""
    return sampled(lit(whole))


def kind(name: str) -> str:
    """What a buffer holds: samples count as the radiance among them."""
    return "radiance" if name == SAMPLES else buffer(name).kind


def scaled_radiance(name: str, image: Tensor, factor: float) -> Tensor:
    """A buffer of radiance, or its variance, in other units."""
    if name == SAMPLES:
        return torch.cat([image[:, :, :3] * factor, image[:, :, 3:]], 2)
    return image * factor ** {"radiance": 1, "variance": 2}[kind(name)]


def test_the_catalogue_lists_exactly_the_denoisers() -> None:
    found = {
        key
        for key, value in vars(models).items()
        if isinstance(value, type) and issubclass(value, Denoiser) and value is not Denoiser
    }
    assert set(models.__all__) == found


def test_declarations_are_in_the_vocabulary(denoiser: Denoiser) -> None:
    assert denoiser.inputs
    assert set(denoiser.inputs) <= {*BUFFERS, SAMPLES}
    assert (SAMPLES in denoiser.inputs) == denoiser.per_sample == bool(denoiser.samples)
    assert set(denoiser.samples) <= set(SAMPLE_BUFFERS)
    assert set(denoiser.frame_numbers) <= set(FRAME_NUMBERS)
    assert denoiser.halo >= 0
    assert denoiser.multiple >= 1
    assert denoiser.bytes_per_pixel > 0
    assert set(denoiser.measure(inputs(denoiser))) <= set(denoiser.frame_numbers)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 31), (31, 17), (16, 129), (50, 33)])
def test_the_output_has_the_size_of_the_input(denoiser: Denoiser, height: int, width: int) -> None:
    with torch.no_grad():
        result = denoiser(inputs(denoiser, 2, height, width))
    assert result.color.shape == (2, 3, height, width)
    assert result.color.dtype == torch.float32
    assert result.color.isfinite().all()
    assert (result.state is not None) == denoiser.recurrent


@pytest.mark.parametrize("value", [0.3, 1000.0])
def test_constant_irradiance_stays_constant_borders_included(
    denoiser: Denoiser, name: str, value: float
) -> None:
    if name not in KERNEL_METHODS:
        return
    whole = everything(1, 33, 29)
    if "irradiance" not in denoiser.inputs:  # then what is filtered is divided by a slightly larger albedo
        whole["albedo"] = torch.full_like(whole["albedo"], 0.5)
    constant = relit(luminous(whole, value))
    with torch.no_grad():
        found = denoiser(select(denoiser, constant)).color / constant["albedo"]
    torch.testing.assert_close(found, torch.full_like(found, value), rtol=1e-5, atol=0)


def extreme(case: str, denoiser: Denoiser, seed: int = 0) -> dict[str, Tensor]:
    whole = everything(1, 32, 40, seed)
    noisy = whole["irradiance"].clone()
    if case == "black":
        black = {key: torch.zeros_like(value) for key, value in whole.items() if key not in FRAME_NUMBERS}
        return select(denoiser, black)
    if case == "bright":
        noisy = torch.full_like(noisy, 65504.0)
    if case == "fireflies":
        noisy[..., ::7, ::5] = 65504.0
    if case == "one firefly in black":
        noisy = torch.zeros_like(noisy)
        noisy[..., 9, 11] = 1e9
    if case == "no normals and no depth":
        whole |= {name: torch.zeros_like(whole[name]) for name in ("normal", "depth")}
        whole["depth_range"] = torch.zeros_like(whole["depth_range"])
    return select(denoiser, relit({**whole, "irradiance": noisy}))


def damaged(denoiser: Denoiser) -> dict[str, Tensor]:
    """Inputs with radiance that no renderer should write: not a number, infinite, negative."""
    buffers = inputs(denoiser)
    for key in denoiser.inputs:
        if kind(key.removesuffix("_variance")) == "radiance":
            image = buffers[key] = buffers[key].clone()
            image[..., 3, 4], image[..., 5, 30], image[..., 20:23, 7] = torch.nan, torch.inf, -0.5
    return buffers


def radiance(denoiser: Denoiser) -> str:
    """Return the name of a buffer that a method filters."""
    return next(name for name in denoiser.inputs if kind(name) == "radiance")


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize(
    "kind", ["black", "bright", "fireflies", "one firefly in black", "no normals and no depth"]
)
def test_extreme_inputs_stay_finite_with_finite_gradients(
    denoiser: Denoiser, kind: str, precision: str
) -> None:
    buffers = extreme(kind, denoiser)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        color = denoiser(buffers).color
    assert color.dtype == torch.float32
    assert color.isfinite().all()
    if any(True for _ in denoiser.parameters()):
        color.mean().backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in denoiser.parameters())


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_damaged_radiance_gives_finite_images_where_the_network_cleans_its_input(
    denoiser: Denoiser, name: str, precision: str
) -> None:
    if name not in CLEANING:
        return
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        color = denoiser(damaged(denoiser)).color
    assert color.isfinite().all()
    assert (color >= 0).all()
    color.clamp_max(1e4).mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in denoiser.parameters())


def test_every_parameter_has_a_gradient(denoiser: Denoiser) -> None:
    denoiser.train()
    if not any(True for _ in denoiser.parameters()):
        return
    buffers = inputs(denoiser, 2)
    weights = torch.rand(2, 3, 32, 40)
    (denoiser(buffers).color * weights).mean().backward()
    for key, parameter in denoiser.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.abs().max() > 0, key


def test_the_noisy_image_has_a_finite_gradient(denoiser: Denoiser) -> None:
    buffers = inputs(denoiser)
    noisy = buffers[radiance(denoiser)]
    noisy[..., :8, :8] = 0.0
    noisy.requires_grad_()
    denoiser(buffers).color.sum().backward()
    assert noisy.grad is not None
    assert noisy.grad.isfinite().all()
    assert noisy.grad.abs().max() > 0


def test_a_batch_element_never_influences_another(denoiser: Denoiser, name: str) -> None:
    one, other = inputs(denoiser, 1, seed=1), extreme("fireflies", denoiser, seed=2)
    together = {key: torch.cat([one[key], other[key]]) for key in one}
    with torch.no_grad():
        alone, first = denoiser(one).color, denoiser(together).color[:1]
    assert largest_relative(first, alone) < 1e-6 * STEEP.get(name, 1)


def test_the_deployed_form_is_equal(denoiser: Denoiser) -> None:
    buffers = inputs(denoiser, 2, 40, 37)
    with torch.no_grad():
        expected = denoiser(buffers).color
        assert largest_relative(denoiser.deploy()(buffers).color, expected) < 1e-5
    deployed = denoiser.deploy()
    for attribute in (
        "targets",
        "compared",
        "inputs",
        "frame_numbers",
        "halo",
        "multiple",
        "temporal",
        "per_sample",
    ):
        assert getattr(deployed, attribute) == getattr(denoiser, attribute)


def test_tiled_equals_untiled(denoiser: Denoiser) -> None:
    buffers = inputs(denoiser, 2, 61, 75)
    buffers.pop("depth_range", None)  # left to `measure`, which sees the whole frame
    with torch.no_grad():
        expected = denoiser(buffers).color
        assert largest_relative(denoise_tiled(denoiser, buffers, tile=32), expected) < 1e-5


def frames_of(denoiser: Denoiser, count: int, height: int, width: int) -> list[dict[str, Tensor]]:
    return [select(denoiser, everything(1, height, width, seed)) for seed in range(count)]


def carried(denoiser: Denoiser, frames: list[dict[str, Tensor]], **options: Any) -> list[Tensor]:
    """Denoise the frames of a sequence, in tiles where options say so."""
    state, colors = None, []
    for frame in frames:
        with torch.no_grad():
            result = denoise_in_tiles(denoiser, frame, state=state, **options)
        state = result.state
        colors.append(result.color)
    return colors


def test_tiles_carry_the_state(denoiser: Denoiser) -> None:
    if not denoiser.recurrent:
        return
    frames = frames_of(denoiser, 3, 61, 75)
    whole, tiled = carried(denoiser, frames), carried(denoiser, frames, tile=16)
    for found, expected in zip(tiled, whole, strict=True):
        assert largest_relative(found, expected) < 1e-5
    with torch.no_grad():
        assert largest_relative(denoiser(frames[-1]).color, whole[-1]) > 1e-3


def test_sequences_of_a_batch_carry_their_own_states(denoiser: Denoiser) -> None:
    if not denoiser.recurrent:
        return
    one, other = frames_of(denoiser, 2, 32, 40), frames_of(denoiser, 4, 32, 40)[2:]
    together = [{key: torch.cat([a[key], b[key]]) for key in a} for a, b in zip(one, other, strict=True)]
    alone, first = carried(denoiser, one), carried(denoiser, together)
    assert largest_relative(first[-1][:1], alone[-1]) < 1e-5


def sensitive(denoiser: Denoiser) -> Denoiser:
    """The same network with gains that carry influence through every layer to the rim of the halo."""
    network = copy.deepcopy(denoiser).double()
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.uniform_(module.weight, -0.3, 0.3)
    return network


def test_the_halo_is_the_reach_no_more_and_no_less(denoiser: Denoiser, name: str) -> None:
    if denoiser.whole:  # it is never cut into tiles
        return
    network, halo, side = sensitive(denoiser), denoiser.halo, denoiser.multiple
    before = -(-(halo + 2) // side) * side  # an aligned core with room for the halo and two more pixels
    size = before + side + before
    buffers = {key: value.double() for key, value in inputs(denoiser, 1, size, size).items()}
    images = [buffers[key] for key in denoiser.inputs]
    for image in images:
        image.requires_grad_()
    core = slice(before, before + side)
    # Squares cannot cancel in the sum over the core.
    total = network(buffers).color[..., core, core].square().sum()
    gradients = torch.autograd.grad(total, images, allow_unused=True)
    reached = torch.zeros(size, size, dtype=torch.bool)
    for gradient in gradients:
        if gradient is not None:
            reached |= (gradient[0].abs() > 0).flatten(0, -3).any(0)
    rows, columns = reached.nonzero().unbind(1)
    for axis in (rows, columns):
        reach = (before - int(axis.min()), int(axis.max()) - (before + side - 1))
        assert max(reach) <= halo if name in DECIDE else max(reach) == halo


def test_the_state_dict_round_trips(denoiser: Denoiser, name: str) -> None:
    torch.manual_seed(99)
    other = make(name)
    other.load_state_dict(denoiser.state_dict())
    buffers = inputs(denoiser)
    with torch.no_grad():
        assert torch.equal(other(buffers).color, denoiser(buffers).color)


def test_a_missing_buffer_is_named(denoiser: Denoiser) -> None:
    for missing in denoiser.inputs:
        buffers = inputs(denoiser)
        del buffers[missing]
        with pytest.raises(ValueError, match=f"missing: {missing}"):
            denoiser(buffers)


def test_a_buffer_of_another_shape_is_named(denoiser: Denoiser) -> None:
    last = denoiser.inputs[-1]
    inner = tuple(inputs(denoiser)[last].shape[1:-2])  # channels; samples and channels
    wrong: dict[str, Any] = {
        "size": torch.rand(1, *inner, 32, 41),
        "channels": torch.rand(1, *inner[:-1], inner[-1] + 1, 32, 40),
        "batch": torch.rand(2, *inner, 32, 40),
        "rank": torch.rand(*inner, 32, 40),
    }
    if len(denoiser.inputs) == 1:  # then it sets size and batch itself
        del wrong["size"], wrong["batch"]
    for tensor in wrong.values():
        with pytest.raises(ValueError, match=f"buffer '{last}' has shape .* expected"):
            denoiser({**inputs(denoiser), last: tensor})


def test_radiance_in_other_units_comes_back_in_those_units(denoiser: Denoiser) -> None:
    buffers = inputs(denoiser)
    names = [n for n in denoiser.inputs if kind(n.removesuffix("_variance")) == "radiance"]
    scaled = {**buffers, **{n: scaled_radiance(n, buffers[n], 50) for n in names}}
    if "exposure" in denoiser.frame_numbers:
        scaled["exposure"] = torch.tensor([1 / 50])
    with torch.no_grad():
        expected = denoiser(buffers).color
        assert largest_relative(denoiser(scaled).color / 50, expected) < 1e-5


def test_a_traced_module_runs_at_another_size(denoiser: Denoiser) -> None:
    if denoiser.whole:  # it is not exported, since its state is looked up anywhere
        return

    class Positional(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = denoiser.deploy().requires_grad_(False)  # parameters are constants of loops

        def forward(self, *tensors: Tensor) -> Tensor:
            color: Tensor = self.inner(dict(zip(names, tensors, strict=True))).color
            return color

    small, large = inputs(denoiser, 1, 17, 31), inputs(denoiser, 2, 43, 29, seed=4)
    names = tuple(small)
    with torch.no_grad(), pytest.warns(DeprecationWarning, match="torch.jit.trace"):
        traced = torch.jit.trace(Positional(), tuple(small.values()), check_trace=False)
    with torch.no_grad():
        assert largest_relative(traced(*large.values()), denoiser(large).color) < 1e-5


def test_training_pairs_are_what_is_announced_and_reach_every_parameter(denoiser: Denoiser) -> None:
    denoiser.train()
    pairs = denoiser.training_pairs(everything(2, 32, 40))
    assert tuple(pairs) == denoiser.compared
    for pair in pairs.values():
        assert pair.output.shape == pair.target.shape
        assert pair.output.dtype == pair.target.dtype == torch.float32
        assert not pair.target.requires_grad
    if any(True for _ in denoiser.parameters()):
        torch.stack([(pair.output - pair.target).square().mean() for pair in pairs.values()]).sum().backward()
        assert all(p.grad is not None and p.grad.abs().max() > 0 for p in denoiser.parameters())


def test_parameter_groups_hold_every_parameter_once(denoiser: Denoiser) -> None:
    grouped = [id(p) for group in denoiser.parameter_groups().values() for p in group]
    assert sorted(grouped) == sorted(id(p) for p in denoiser.parameters())


def test_targets_are_in_the_vocabulary(denoiser: Denoiser) -> None:
    assert set(denoiser.targets) <= set(BUFFERS)
    assert "reference" in denoiser.targets
