"""Views of kernels equal filters written out, and explain the image that the network makes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models import WSKP, MultiResolutionWSKP
from models.denoiser import Denoised, Denoiser
from models.ops.kernel_views import full_size, kernel_names, kernel_views
from models.ops.resolutions import blended
from models.tiling import denoise_in_tiles
from tests.models.frames import largest_relative, random_buffers
from tests.models.plain_wskp_mr import plain_filter

pytestmark = pytest.mark.usefixtures("one_thread")


def network(kind: type = WSKP, seed: int = 4, **arguments: object) -> Denoiser:
    """A network whose maps are far from flat."""
    torch.manual_seed(seed)
    made: Denoiser = kind(**arguments).eval().requires_grad_(False)
    for parameter in made.parameters():
        torch.nn.init.uniform_(parameter, -0.4, 0.4)
    made.aux = True  # type: ignore[assignment]
    return made


def aux_of(result: Denoised) -> dict[str, Tensor]:
    assert result.aux is not None
    return dict(result.aux)


SINGLE = {"layers": 2, "width": 6, "kernel_sizes": (3, 7, 7)}
SEVERAL = {"width": 4, "levels": 3, "resolutions": 3, "kernel_sizes": (3, 5)}
FORMS = [(WSKP, SINGLE), (MultiResolutionWSKP, SEVERAL)]


def test_kernels_are_named_by_size_and_those_of_one_size_are_numbered() -> None:
    assert kernel_names((3, 5, 13)) == ["kernel03", "kernel05", "kernel13"]
    assert kernel_names((13, 3, 13)) == ["kernel13_1", "kernel03", "kernel13_2"]


def test_every_view_equals_its_formula_written_out() -> None:
    torch.manual_seed(2)
    image, maps, logits = torch.rand(2, 3, 6, 7), torch.randn(2, 2, 6, 7), torch.randn(2, 2, 6, 7)
    image, maps, logits = image.double(), 3 * maps.double(), logits.double()
    views = kernel_views(image, maps, logits, (3, 5))
    for index, (name, size) in enumerate((("kernel03", 3), ("kernel05", 5))):
        one = maps[:, index : index + 1]
        expected = plain_filter(image, one, torch.zeros_like(one), (size,))
        assert largest_relative(views[f"{name}_filtered"], expected) < 1e-12
        share = logits[:, index].exp() / logits.exp().sum(1)
        torch.testing.assert_close(views[f"{name}_weight"][:, 0], share)
        assert torch.equal(views[f"{name}_importance"], one)


def test_a_lit_pixel_becomes_the_window_of_each_kernel_cut_at_the_border() -> None:
    image, flat = torch.zeros(1, 3, 9, 9), torch.zeros(1, 2, 9, 9)
    image[..., 0, 4] = 1
    views = kernel_views(image, flat, flat, (1, 5))
    assert torch.equal(views["kernel01_filtered"], image)
    lit = views["kernel05_filtered"][0, 0]
    assert lit[:3, 2:7].min() > 0
    assert (lit > 0).sum() == 15
    torch.testing.assert_close(lit[:3, 4], torch.tensor([1 / 15, 1 / 20, 1 / 25]))


def test_coarse_views_have_every_pixel_repeated_and_only_images_have_the_albedo() -> None:
    coarse = torch.arange(4.0).reshape(1, 1, 2, 2)
    views = {"kernel03_filtered": coarse.expand(1, 3, 2, 2), "kernel03_weight": coarse, "alpha": coarse}
    made = full_size(views, 4, torch.full((1, 3, 7, 8), 0.5))
    expected = torch.tensor([[0.0, 1], [2, 3]]).repeat_interleave(4, 0).repeat_interleave(4, 1)[:7]
    assert torch.equal(made["kernel03_weight"][0, 0], expected)
    assert torch.equal(made["alpha"][0, 0], expected)
    assert torch.equal(made["kernel03_filtered"][0, 2], 0.5 * expected)


def test_the_sum_of_weights_times_views_is_the_image_of_wskp() -> None:
    net, buffers = network(**SINGLE), random_buffers(2, 18, 21)
    made = net(buffers)
    views = aux_of(made)
    names = ("kernel03", "kernel07_1", "kernel07_2")
    assert [name for name in views if name.endswith("filtered")] == [f"{name}_filtered" for name in names]
    found = sum(views[f"{name}_weight"] * views[f"{name}_filtered"] for name in names)
    assert largest_relative(found, made.color) < 1e-6
    net.aux = False  # type: ignore[assignment]
    assert net(buffers).aux is None
    assert torch.equal(net(buffers).color, made.color)


def test_equation_7_of_the_views_is_the_image_of_the_form_for_stills() -> None:
    net, buffers = network(MultiResolutionWSKP, **SEVERAL), random_buffers(1, 24, 16)
    buffers["albedo"] = torch.ones_like(buffers["albedo"])
    made = net(buffers)
    views = aux_of(made)
    assert {view.shape[-2:] for view in views.values()} == {(24, 16)}

    def fused(factor: int) -> Tensor:
        total = sum(
            views[f"x{factor}_kernel{size:02d}_weight"] * views[f"x{factor}_kernel{size:02d}_filtered"]
            for size in (3, 5)
        )
        assert isinstance(total, Tensor)
        return total[..., ::factor, ::factor]

    half = blended(fused(2), fused(4), views["x2_alpha"][..., ::2, ::2])
    found = blended(fused(1), half, views["x1_alpha"]).clamp_min(0)
    assert largest_relative(found, made.color) < 1e-5
    assert "x4_alpha" not in views


@pytest.mark.parametrize(("kind", "arguments"), FORMS)
def test_views_in_tiles_are_those_of_the_whole_frame(kind: type, arguments: dict[str, object]) -> None:
    net, buffers = network(kind, **arguments), random_buffers(1, 67, 50)
    buffers |= net.measure(buffers)
    whole, tiled = aux_of(net(buffers)), aux_of(denoise_in_tiles(net, buffers, tile=16))
    assert tiled.keys() == whole.keys()
    for name, view in whole.items():
        assert view.shape[-2:] == (67, 50)
        torch.testing.assert_close(tiled[name], view, rtol=0, atol=1e-5 * view.abs().max().item())


@pytest.mark.parametrize(("kind", "arguments"), FORMS)
def test_the_deployed_form_has_the_same_views(kind: type, arguments: dict[str, object]) -> None:
    net, buffers = network(kind, **arguments), random_buffers(1, 16, 16)
    whole, deployed = aux_of(net(buffers)), aux_of(net.deploy()(buffers))
    assert deployed.keys() == whole.keys()
    for name, view in whole.items():
        assert largest_relative(deployed[name], view) < 1e-4, name


@pytest.mark.parametrize(("kind", "arguments"), FORMS)
@pytest.mark.parametrize("value", [0.0, 65504.0])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_views_of_black_and_of_the_largest_half_number_are_finite(
    kind: type, arguments: dict[str, object], value: float, precision: str
) -> None:
    net, buffers = network(kind, **arguments), random_buffers(1, 16, 16)
    buffers["irradiance"] = torch.full_like(buffers["irradiance"], value)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        views = aux_of(net(buffers))
    assert all(view.dtype == torch.float32 and view.isfinite().all() for view in views.values())


@pytest.mark.parametrize(("kind", "arguments"), FORMS)
def test_what_the_views_hold_is_in_the_declared_memory(kind: type, arguments: dict[str, object]) -> None:
    net, buffers = network(kind, **arguments), random_buffers(1, 16, 16)
    held = sum(view.shape[1] * view.element_size() for view in aux_of(net(buffers)).values())
    with_views = net.bytes_per_pixel
    net.aux = False  # type: ignore[assignment]
    assert with_views - net.bytes_per_pixel >= held
