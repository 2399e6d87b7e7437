"""NBGD written down step by step from its description: the reference that tests and benchmarks compare with.

Nothing of the product's code is used. `literal_grid` and `literal_slice` weigh every pixel for every cell, as
the formulas stand; `indexed_grid` and `indexed_slice` visit the eight cells around a pixel with index arrays,
as one would write it first.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = 256
SIZES = ((4, 4), (8, 8), (16, 16))


def tent(x: Tensor) -> Tensor:
    """1 at 0, 0 from 1 on, with a rounded tip."""
    return torch.clamp(1 - torch.sqrt(x * x + 1e-8), min=0)


def positions(count: int, step: int, like: Tensor) -> Tensor:
    """Where pixels 0, 1 … lie among the cells of a side."""
    return (torch.arange(count, dtype=like.dtype) + 0.5) / step


def all_weights(guide: Tensor, space: int, depth: int) -> Tensor:
    """Weights (B, cells down, cells across, cells deep, H, W) of every pixel for every cell."""
    _, _, height, width = guide.shape
    down = torch.arange(height // space) + 0.5
    across = torch.arange(width // space) + 0.5
    deep = torch.arange(LEVELS // depth) + 0.5
    rows = tent(positions(height, space, guide) - down[:, None].to(guide))
    columns = tent(positions(width, space, guide) - across[:, None].to(guide))
    levels = tent((guide + 0.5) / depth - deep[None, :, None, None].to(guide))
    return torch.einsum("vy,ux,bdyx->bvudyx", rows, columns, levels)


def literal_grid(image: Tensor, guide: Tensor, space: int, depth: int) -> Tensor:
    """Weighted means of the pixels around every cell, (B, C, cells down, across, deep); 0 where none is."""
    weights = all_weights(guide, space, depth)
    total = torch.einsum("bvudyx,bcyx->bcvud", weights, image)
    weight = weights.sum((-2, -1))[:, None]
    return torch.where(weight > 0, total / torch.where(weight > 0, weight, 1), 0)


def literal_slice(grid: Tensor, guide: Tensor, space: int, depth: int) -> Tensor:
    """Weighted means of the cells around every pixel that are above 0 in a channel, (B, C, H, W)."""
    weights = all_weights(guide, space, depth)
    lit = (grid > 0).to(grid.dtype)
    total = torch.einsum("bvudyx,bcvud->bcyx", weights, grid * lit)
    weight = torch.einsum("bvudyx,bcvud->bcyx", weights, lit)
    return torch.where(weight > 0, total / torch.where(weight > 0, weight, 1), 0)


def _around(guide: Tensor, space: int, depth: int) -> list[tuple[Tensor, Tensor]]:
    """Index (B, H, W) into the flattened cells and weight of each of the eight cells around every pixel."""
    _, _, height, width = guide.shape
    counts = (height // space, width // space, LEVELS // depth)
    places = (
        positions(height, space, guide)[:, None] - 0.5,
        positions(width, space, guide) - 0.5,
        (guide[:, 0] + 0.5) / depth - 0.5,
    )
    found = []
    for corner in itertools.product((0, 1), repeat=3):
        index, weight = torch.zeros((), dtype=torch.int64), torch.ones((), dtype=guide.dtype)
        for step, place, count in zip(corner, places, counts, strict=True):
            cell = torch.floor(place).long() + step
            weight = weight * tent(place - cell) * ((cell >= 0) & (cell < count))
            index = index * count + cell.clamp(0, count - 1)
        found.append((index, weight))
    return found


def indexed_grid(image: Tensor, guide: Tensor, space: int, depth: int) -> Tensor:
    """`literal_grid` with index arrays."""
    batch, channels, height, width = image.shape
    shape = (height // space, width // space, LEVELS // depth)
    joined = torch.cat([image, torch.ones_like(image[:, :1])], 1)
    sums = image.new_zeros(batch, channels + 1, shape[0] * shape[1] * shape[2])
    for index, weight in _around(guide, space, depth):
        where = index[:, None].expand(joined.shape).flatten(2)
        sums = sums.scatter_add(2, where, (joined * weight[:, None]).flatten(2))
    total, weights = sums[:, :-1], sums[:, -1:]
    return torch.where(weights > 0, total / torch.where(weights > 0, weights, 1), 0).unflatten(2, shape)


def indexed_slice(grid: Tensor, guide: Tensor, space: int, depth: int) -> Tensor:
    """`literal_slice` with index arrays."""
    cells = grid.flatten(2)
    total: Tensor | float = 0.0
    weights: Tensor | float = 0.0
    for index, weight in _around(guide, space, depth):
        where = index[:, None].expand(-1, grid.shape[1], -1, -1)
        value = cells.gather(2, where.flatten(2)).unflatten(2, guide.shape[2:])
        share = weight[:, None] * (value > 0)
        total, weights = total + share * value, weights + share
    assert isinstance(weights, Tensor)
    return torch.where(weights > 0, total / torch.where(weights > 0, weights, 1), 0)


def gamma(radiance: Tensor) -> Tensor:
    """The curve of the authors' tables and losses."""
    return radiance.clamp(min=0).pow(0.454545).clamp(0, 1)


def filmic(radiance: Tensor) -> Tensor:
    """The curve of the authors' 64 spp frames."""
    t = (radiance - 0.004).clamp(min=0)
    return t * (6.2 * t + 0.5) / (t * (6.2 * t + 1.7) + 0.06)


def outputs(state: Mapping[str, Tensor], features: Tensor) -> Tensor:
    """Guides and blend weights of the network with any number of layers, (B, 5, H, W), in [0, 1]."""
    weights = [value for name, value in state.items() if name.endswith("weight")]
    biases = [value for name, value in state.items() if name.endswith("bias")]
    maps = F.leaky_relu(F.conv2d(features, weights[0], biases[0], padding=2), 0.2)
    for weight, bias in zip(weights[1:-1], biases[1:-1], strict=True):
        maps = F.leaky_relu(torch.cat([maps, F.conv2d(maps, weight, bias, padding=2)], 1), 0.2)
    return torch.sigmoid(F.conv2d(maps, weights[-1], biases[-1], padding=2))


def plain_nbgd(state: Mapping[str, Tensor], buffers: Mapping[str, Tensor], curve: str = "gamma") -> Tensor:
    """Denoised radiance of buffers whose sides are multiples of 16, exposure 1."""
    irradiance, albedo, depth = buffers["irradiance"], buffers["albedo"], buffers["depth"]
    low, high = depth.amin((1, 2, 3), keepdim=True), depth.amax((1, 2, 3), keepdim=True)
    tone = gamma if curve == "gamma" else filmic
    scaled = (depth - low) / (high - low)
    features = [tone(irradiance * albedo), albedo, buffers["normal"] * 0.5 + 0.5, scaled]
    found = outputs(state, torch.cat(features, 1))
    first, second = found[:, 3:4], found[:, 4:5]
    filtered = []
    for index, (space, depth_step) in enumerate(SIZES):
        guide = 255 * found[:, index : index + 1]
        grid = literal_grid(irradiance, guide, space, depth_step)
        filtered.append(literal_slice(grid, guide, space, depth_step))
    blended = first * filtered[0] + second * filtered[1] + (1 - first - second) * filtered[2]
    return blended * albedo


def plain_outliers(irradiance: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
    """One image (3, H, W), pixel by pixel: outliers among similar neighbours become the mean of these."""
    _, height, width = irradiance.shape
    grey = (torch.tensor([0.2989, 0.5870, 0.1140]).to(irradiance)[:, None, None] * filmic(irradiance)).sum(0)
    result = irradiance.clone()
    for y, x in itertools.product(range(height), range(width)):
        accepted = [
            (v, u)
            for v in range(max(0, y - 1), min(height, y + 2))
            for u in range(max(0, x - 1), min(width, x + 2))
            if (v, u) != (y, x)
            and ((albedo[:, v, u] - albedo[:, y, x]) ** 2).sum() < 0.1
            and ((normal[:, v, u] - normal[:, y, x]) ** 2).sum() < 0.1
        ]
        if len(accepted) < 2:
            continue
        greys = torch.stack([grey[v, u] for v, u in accepted])
        if abs(grey[y, x] - greys.mean()) > 3 * greys.std():
            result[:, y, x] = torch.stack([irradiance[:, v, u] for v, u in accepted]).mean(0)
    return result
