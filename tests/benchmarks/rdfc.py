"""What sharing saves RDFC, against its candidates written down one by one.

The first pass of RDFC: three candidates in windows of 21x21 and the derivatives of two of them, on a crop of
a shipped still with normal, albedo and depth (not filtered beforehand). Against the same weights
- with every candidate and each of its derivatives a filter of its own, over all neighbours of the window, and
  the mean of each patch from an unfolded stack of its distances;
- in float32 and PyTorch as well, on one thread.
The unfolded form computes some rows only; times count per pixel and are taken in turns.

    python -m tests.benchmarks.rdfc
"""

from __future__ import annotations

import time

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.halves import halves
from models.ops.joint import EPSILON
from models.ops.nlm import Guide
from models.ops.opposite import CENTRE, NEAR, FeatureMap, PairKernel, Rule
from models.ops.paired import pair_filter
from models.ops.symmetric import mirrored_border
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.timing import Row, print_table, row

SIDE, PLAIN_ROWS, REPEATS, STEP = 128, 24, 3, 0.01
NAMES = ("color", "normal", "albedo", "depth")
RULES = (Rule(1, 1e-3), Rule(3, 1e-3), Rule(None, 1e-4))
KERNEL = PairKernel(10, RULES, 0.45, 0.6)
AT_LEAST, LIMIT_ERROR = 3.0, 1e-4


def run() -> list[Row]:
    """Return times, their ratio and the difference of the results."""
    guide, features = frame()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    times: dict[str, list[float]] = {"shared": [], "unfolded": []}
    try:
        with torch.inference_mode():
            for _ in range(REPEATS):
                start = time.perf_counter()
                found = shared(guide, features)
                times["shared"].append((time.perf_counter() - start) / SIDE**2)
                start = time.perf_counter()
                expected = unfolded(guide, features)
                times["unfolded"].append((time.perf_counter() - start) / (PLAIN_ROWS * SIDE))
    finally:
        torch.set_num_threads(before)
    least = {name: min(values) * 1e6 for name, values in times.items()}
    rows = [row(f"RDFC first pass, {name}: wall time", value, "us/px") for name, value in least.items()]
    ratio = least["unfolded"] / least["shared"]
    rows.append(row("RDFC first pass: unfolded / shared", ratio, "x", f">= {AT_LEAST:g}x", ratio >= AT_LEAST))
    whole = slice(0, PLAIN_ROWS - KERNEL.window - KERNEL.margin)  # rows that miss nothing below
    images, plain = (x[0][..., whole, :] for x in (found, expected))
    error = float((images - plain).abs().max() / plain.abs().max())
    name = "RDFC first pass: largest difference of the candidates"
    return [*rows, row(name, error, "", f"<= {LIMIT_ERROR:g}", error <= LIMIT_ERROR)]


def frame() -> tuple[Guide, list[FeatureMap]]:
    """Return the noisy colour and the features."""
    buffers = mosaic(SIDE, SIDE, [f"{name}_{part}" for name in NAMES for part in ("a", "b", "variance")])
    found = {name: halves(buffers, name, "measured") for name in NAMES}
    color = found.pop("color")
    unit = torch.ones(1, 1, 1, 1)
    features = [
        FeatureMap(f.mean, f.variance, f.mean.amax() * unit if name == "depth" else unit)
        for name, f in found.items()
    ]
    return Guide(color.mean, color.variance), features


def shared(guide: Guide, features: list[FeatureMap]) -> tuple[Tensor, Tensor]:
    """Return the candidates (1, 3, 3, H, W) and their derivatives."""
    images, derivative = pair_filter(guide.image, guide, KERNEL, features, step=STEP)
    assert derivative is not None
    return images, derivative


def unfolded(guide: Guide, features: list[FeatureMap]) -> tuple[Tensor, Tensor]:
    """Return the first rows of the same, made one by one."""
    images, derivatives = [], []
    for rule in RULES:
        image, share = one_filter(guide, features, rule, 0.0)
        derivative = share.expand_as(image)
        if rule.patch is not None:
            moved = one_filter(guide, features, rule, STEP)[0]
            found = (moved - image) / (STEP * guide.image[..., :PLAIN_ROWS, :])
            valid = ((found >= 0) & (found <= 1)).all(1, keepdim=True)
            derivative = torch.where(valid, found, derivative)
        images.append(image)
        derivatives.append(derivative)
    return torch.stack(images, 1), torch.stack(derivatives, 1)


def one_filter(guide: Guide, features: list[FeatureMap], rule: Rule, step: float) -> tuple[Tensor, Tensor]:
    """Filter the first rows with one rule; returns the image and the share of the pixel itself."""
    u = guide.image[..., :PLAIN_ROWS, :]
    total, norm = torch.zeros_like(u), torch.zeros_like(u[:, :1])
    largest = norm + CENTRE
    radius = KERNEL.window
    around = [
        mirrored_border(mirrored_border(x[..., :PLAIN_ROWS, :], radius, -1), radius, -2)
        for x in (*guide, *(y for f in features for y in (f.image, f.variance, f.spread(rule.tau or 0.0))))
    ]
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            if (down, right) == (0, 0):
                continue
            one, other, own = (
                [x[..., radius + a : radius + a + PLAIN_ROWS, radius + b : radius + b + SIDE] for x in around]
                for a, b in ((down, right), (-down, -right), (0, 0))
            )
            weight = torch.ones_like(norm)
            if rule.patch is not None:
                weight = weights(color_distances(own, one, other, rule.patch, step))
            for i in range(2, len(own), 3):
                maps = [[side[i], side[i + 1], side[i + 2]] for side in (own, one, other)]
                weight = torch.minimum(weight, weights(distances(*maps, KERNEL.feature_bandwidth)))
            total, norm = total + weight * one[0], norm + weight
            largest = torch.maximum(largest, weight)
    norm = norm + largest
    return (total + largest * (1 + step) * u) / norm, largest / norm


def color_distances(
    own: list[Tensor], one: list[Tensor], other: list[Tensor], patch: int, step: float
) -> list[Tensor]:
    """Return the three patch distances of the colour."""
    maps = [[side[0], side[1], side[1]] for side in (own, one, other)]
    still = distances(*maps, KERNEL.bandwidth)
    means = [patch_mean(d, patch) for d in still]
    if step:
        moved = distances([(1 + step) * maps[0][0], *maps[0][1:]], maps[1], maps[2], KERNEL.bandwidth)
        side = (2 * patch + 1) ** 2
        means = [mean + (y - x) / side for mean, x, y in zip(means, still, moved, strict=True)]
    return means


def distances(own: list[Tensor], one: list[Tensor], other: list[Tensor], k: float) -> list[Tensor]:
    """Return d to one neighbour, to the opposite one and to their mean; value, variance, spread of each."""
    (f, v, t), (f1, v1, t1), (f2, v2, t2) = own, one, other
    least = torch.minimum(v, v1), torch.minimum(v, v2)
    terms = (
        ((f - f1).square() - (v + least[0]), t + t1),
        ((f - f2).square() - (v + least[1]), t + t2),
        ((f - (f1 + f2) / 2).square() - (v + (least[0] + least[1]) / 4), t + (t1 + t2) / 4),
    )
    return [(n / (EPSILON + k * k * s)).mean(1, keepdim=True) for n, s in terms]


def patch_mean(image: Tensor, radius: int) -> Tensor:
    """Average the part of every patch that is inside, from all its pixels side by side."""
    side = 2 * radius + 1
    stack = F.unfold(image, side, padding=radius)
    inside = F.unfold(torch.ones_like(image), side, padding=radius)
    return (stack.sum(1, keepdim=True) / inside.sum(1, keepdim=True)).reshape(image.shape)


def weights(d: list[Tensor]) -> Tensor:
    """Return the weight of the first neighbour."""
    w1, w2, mean = (torch.exp(-x.clamp_min(0.0)) for x in d)
    share = torch.where((d[0] < NEAR) & (d[1] < NEAR), (mean / (w1 + w2) - 1).clamp(0, 1), 0.0)
    return share * mean + (1 - share) * w1


if __name__ == "__main__":
    print_table(run())
