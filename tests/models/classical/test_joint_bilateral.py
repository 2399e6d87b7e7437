"""The joint bilateral filter is its formula."""

from __future__ import annotations

import math

import pytest
import torch

from models import JointBilateral
from tests.models.frames import largest_relative, random_buffers


def test_every_pixel_is_the_weighted_mean_of_its_window() -> None:
    buffers = random_buffers(1, 16, 17)
    network = JointBilateral(radius=2, spatial=1.5, albedo=0.5, normal=0.8, depth=0.3)
    found = network(buffers).color
    images = {name: image[0].double() for name, image in buffers.items()}
    for y, x in [(0, 0), (15, 16), (7, 8), (1, 15), (14, 3)]:
        total, weight = torch.zeros(3, dtype=torch.float64), 0.0
        for v in range(max(0, y - 2), min(16, y + 3)):
            for u in range(max(0, x - 2), min(17, x + 3)):
                exponent = ((v - y) ** 2 + (u - x) ** 2) / 1.5**2
                for name, bandwidth in (("albedo", 0.5), ("normal", 0.8)):
                    difference = images[name][:, v, u] - images[name][:, y, x]
                    exponent += float((difference**2).sum()) / bandwidth**2
                depths = (float(images["depth"][0, v, u]), float(images["depth"][0, y, x]))
                exponent += (math.log(depths[0] / depths[1]) / 0.3) ** 2
                share = math.exp(-0.5 * exponent)
                total += share * images["irradiance"][:, v, u]
                weight += share
        expected = total / weight * images["albedo"][:, y, x]
        assert largest_relative(found[0, :, y, x], expected) < 1e-5


def test_an_edge_in_depth_is_not_crossed() -> None:
    buffers = random_buffers(1, 16, 32)
    buffers["depth"] = torch.ones(1, 1, 16, 32)
    buffers["depth"][..., 16:] = 2.0
    buffers["irradiance"][..., 16:] = 0.0
    assert (JointBilateral()(buffers).color[..., 16:] == 0).all()


def test_depth_in_other_units_changes_nothing() -> None:
    buffers = random_buffers(1, 20, 20)
    scaled = {**buffers, "depth": buffers["depth"] * 1000}
    expected = JointBilateral()(buffers).color
    assert largest_relative(JointBilateral()(scaled).color, expected) < 1e-4


@pytest.mark.parametrize("name", ["spatial", "albedo", "normal", "depth"])
def test_a_bandwidth_of_0_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"bandwidth {name} must be positive"):
        JointBilateral(**{name: 0.0})  # type: ignore[arg-type]


def test_a_radius_of_0_is_refused() -> None:
    with pytest.raises(ValueError, match="radius must be at least 1"):
        JointBilateral(radius=0)
