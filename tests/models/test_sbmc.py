"""SBMC against a literal transcription, and what it promises beyond the contract of all denoisers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from data.buffers import sample_channels
from models import sbmc as module
from models.blocks.multisteps import Context, NormalisedConv
from models.blocks.sbmc_features import GROUPS, expanded
from models.denoiser import select
from models.ops import streaming
from models.sbmc import SBMC
from tests.benchmarks.memory import live_bytes
from tests.models.plain_sbmc import plain_sbmc

pytestmark = pytest.mark.usefixtures("one_thread")

NARROW: dict[str, Any] = {"width": 4, "kernel_size": 5, "rounds": 2, "levels": 2}
RENDERED = ("radiance", "normal", "depth", "diffuse_albedo", "lens", "time")


def network(**options: Any) -> SBMC:
    torch.manual_seed(3)
    made = SBMC(**{**NARROW, **options}).eval()
    for layer in made.modules():
        if isinstance(layer, NormalisedConv):
            assert layer.gain is not None
            nn.init.uniform_(layer.gain, 0.5, 2.0)
            nn.init.uniform_(layer.bias, -0.3, 0.3)  # type: ignore[arg-type]
    return made


def samples(made: SBMC, count: int = 3, height: int = 12, width: int = 16, batch: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(count * height)
    shape = (batch, count, len(sample_channels(*made.samples)), height, width)
    return torch.rand(shape, generator=generator, dtype=torch.float64) * 2


def seen(made: SBMC, values: Tensor, camera: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """The features of one frame (S, C, H, W) as the paper's code makes them, and radiance."""
    places = {n: [sample_channels(*made.samples).index(c) for c in sample_channels(n)] for n in made.samples}
    features = values[0].clone()
    if "radiance" in places:
        radiance = values[0, :, places["radiance"]]
        features[:, places["radiance"]] = torch.log(1 + radiance) / 10
    else:
        specular = values[0, :, places["specular"]]
        radiance = values[0, :, places["diffuse"]] + specular
        features[:, places["diffuse"]] = torch.log(1 + radiance) / 10
        features[:, places["specular"]] = torch.log(1 + specular) / 10
    if made.camera:
        constant = torch.tensor(camera, dtype=torch.float64)[None, :, None, None]
        features = torch.cat([features, constant.expand(len(features), 3, *features.shape[2:])], 1)
    return features, radiance


def test_the_published_network_has_its_features_and_parameters() -> None:
    made = SBMC()
    assert len(sample_channels(*made.samples)) == 93
    assert [len(sample_channels(*names)) for names in GROUPS.values()] == [5, 6, 16, 24, 12, 30]
    gains = sum(p.numel() for name, p in made.named_parameters() if name.endswith("gain"))
    assert sum(p.numel() for p in made.parameters()) - gains == 34_799_801
    assert sum(p.numel() for p in made.deploy().parameters()) == 34_799_801


@pytest.mark.parametrize(
    "options",
    [
        {"levels": 3, "rounds": 3, "kernel_size": 7},
        {"features": RENDERED, "camera": False},
        {"features": RENDERED, "filter": "gather"},
    ],
    ids=["published features", "no camera", "gather"],
)
def test_it_equals_the_literal_form(options: dict[str, Any]) -> None:
    made = network(outside="weigh", depth="raw", **options).double()
    values = samples(made)
    camera = (0.3, 1.5, 0.7)
    buffers = {"samples": values, "thin_lens": torch.tensor([camera], dtype=torch.float64)}
    features, radiance = seen(made, values, camera)
    gather, levels = options.get("filter") == "gather", options.get("levels", 2)
    expected = plain_sbmc(made.state_dict(), features, radiance, made.kernel_size, levels, gather)
    with torch.no_grad():
        found = made(buffers).color[0].permute(1, 2, 0)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_averaged_samples_are_treated_as_one() -> None:
    made = network(average=True, outside="weigh", depth="raw").double()
    values = samples(made)
    features, radiance = (part.mean(0, keepdim=True) for part in seen(made, values, (0.0, 0.0, 0.0)))
    with torch.no_grad():
        found = made({"samples": values}).color[0].permute(1, 2, 0)
    torch.testing.assert_close(found, plain_sbmc(made.state_dict(), features, radiance, 5, 2))


def test_leaving_out_what_is_outside_changes_only_the_border_that_the_paper_cuts_off() -> None:
    drop, weigh = network(features=RENDERED), network(features=RENDERED, outside="weigh")
    buffers = {"samples": samples(drop).float()}
    with torch.no_grad():
        one, other = drop(buffers).color, weigh(buffers).color
    torch.testing.assert_close(one[..., 2:-2, 2:-2], other[..., 2:-2, 2:-2])
    assert ((one - other).abs()[..., :2, :] > 1e-4).any()


@pytest.mark.parametrize("options", [{}, {"outside": "weigh"}, {"filter": "gather"}, {"average": True}])
def test_strips_and_the_order_of_samples_change_nothing(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = network(features=RENDERED, **options).double()
    values = samples(made, 4, 13, 18, batch=2)  # no multiple of the grid
    weights = torch.rand(2, 3, 13, 18, dtype=torch.float64)

    def gradients(values: Tensor) -> tuple[Tensor, list[Tensor]]:
        color = made({"samples": values}).color
        return color.detach(), list(torch.autograd.grad((color * weights).sum(), list(made.parameters())))

    made.recompute = False
    expected = gradients(values)
    made.recompute = True
    monkeypatch.setattr(module, "_ROWS", 1 << 12)
    monkeypatch.setattr(streaming, "_CHUNK", 1 << 14)
    found = gradients(values.flip(1))
    torch.testing.assert_close(found[0], expected[0])
    for one, other in zip(found[1], expected[1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9)


def test_damaged_samples_are_left_out_pixel_by_pixel() -> None:
    made = network(features=RENDERED)
    values = samples(made, 3).float()
    values[0, 2, 4] = torch.nan
    values[0, 1, 0, 3, 4] = torch.inf
    with torch.no_grad():
        found = made({"samples": values, "depth_range": torch.tensor([[0.0, 2.0]])}).color
        two = made({"samples": values[:, :2], "depth_range": torch.tensor([[0.0, 2.0]])}).color
    assert found.isfinite().all()
    torch.testing.assert_close(found, two)
    values[..., :6, :6] = torch.nan
    with torch.no_grad():
        assert made({"samples": values}).color.isfinite().all()


def test_memory_does_not_grow_with_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ROWS", 1 << 18)
    monkeypatch.setattr(streaming, "_CHUNK", 1 << 17)
    made = network(features=RENDERED, width=8, kernel_size=9)
    parameters = list(made.parameters())

    def step(values: Tensor) -> None:
        torch.autograd.grad(made({"samples": values}).color.sum(), parameters)

    few, many = (samples(made, count, 32, 32).float() for count in (2, 6))
    kernels = 4 * 9 * 9 * 32 * 32  # of one sample
    assert live_bytes(lambda: step(many)) - live_bytes(lambda: step(few)) < 2 * kernels + 4 * many.numel()
    with torch.no_grad():
        difference = live_bytes(lambda: made({"samples": many})) - live_bytes(lambda: made({"samples": few}))
    assert difference < kernels + 4 * many.numel()


def test_training_compares_compressed_radiance_without_the_border() -> None:
    made = network(features=RENDERED)
    batch = {"samples": samples(made).float(), "reference": torch.rand(1, 3, 12, 16) * 9}
    batch["sample_channels"] = sample_channels(*made.samples)  # type: ignore[assignment]
    pair = made.training_pairs(batch)["color"]
    assert pair.output.shape == pair.target.shape == (1, 3, 8, 12)
    inner = batch["reference"][..., 2:-2, 2:-2]
    torch.testing.assert_close(pair.target, inner / (1 + inner))
    small = {key: value[..., :4, :] if key != "sample_channels" else value for key, value in batch.items()}
    with pytest.raises(ValueError, match=r"a crop of 16x4 pixels has nothing left.*crop=False"):
        made.training_pairs(small)


def test_the_camera_counts_where_it_is_given() -> None:
    made = network(features=RENDERED)
    buffers = {"samples": samples(made).float()}
    with torch.no_grad():
        plain = made(buffers).color
        zero = made({**buffers, "thin_lens": torch.zeros(1, 3)}).color
        lens = made({**buffers, "thin_lens": torch.tensor([[0.5, 2.0, 0.9]])}).color
    assert torch.equal(plain, zero)
    assert (lens - plain).abs().max() > 1e-4


@pytest.mark.parametrize(("depth", "equal"), [("relative", True), ("raw", False)])
def test_distances_in_other_units_make_no_difference_where_they_are_relative(depth: str, equal: bool) -> None:
    made = network(features=RENDERED, depth=depth)
    values = samples(made).float()
    scaled = values.clone()
    scaled[:, :, sample_channels(*made.samples).index("depth.Z")] *= 10
    lens = torch.tensor([[0.5, 2.0, 45.0]])
    with torch.no_grad():
        one = made({"samples": values, "thin_lens": lens}).color
        other = made({"samples": scaled, "thin_lens": lens * torch.tensor([10.0, 10.0, 1.0])}).color
    assert bool((one - other).abs().max() < 1e-5) is equal


def test_batches_and_frames_bring_the_camera_to_networks_that_read_it() -> None:
    made, blind = network(features=RENDERED), network(features=RENDERED, camera=False)
    batch = {"samples": samples(made).float(), "thin_lens": torch.ones(1, 3)}
    assert set(select(made, batch)) == {"samples", "thin_lens"}
    assert set(select(blind, batch)) == {"samples"}


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (
            ["light", "glints"],
            "features: glints unknown; expected groups .coordinates.* or quantities .radiance",
        ),
        (["coordinates"], "light once"),
        (["light", "radiance"], "light once"),
        (["diffuse"], "light once"),
    ],
)
def test_features_that_make_no_input_are_named(features: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expanded(features)


@pytest.mark.parametrize(
    "options",
    [{"kernel_size": 4}, {"rounds": 0}, {"filter": "sort"}, {"outside": "mirror"}, {"depth": "log"}],
)
def test_options_out_of_range_are_named(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        SBMC(**options)


@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_the_reach_of_a_context_is_where_its_input_counts(levels: int) -> None:
    torch.manual_seed(levels)
    unet, grid = Context(2, levels).double(), 1 << (levels - 1)
    for layer in unet.modules():  # positive weights carry gradients through every ReLU
        if isinstance(layer, NormalisedConv):
            nn.init.uniform_(layer.weight, 0.1, 1.0)
    for needed in (0, 3):
        reach = Context.reach(needed, levels)
        before = -(-(reach + 2) // grid) * grid + grid
        image = torch.rand(1, 2, before * 2 + grid, 8 * grid, dtype=torch.float64).requires_grad_()
        core = unet(image)[..., before - needed : before + grid + needed, :]
        (gradient,) = torch.autograd.grad(core.sum(), image)
        rows = (gradient[0].abs() > 0).any(0).any(-1).nonzero().flatten()
        assert before - int(rows.min()) <= reach
        assert int(rows.max()) - (before + grid - 1) <= reach
