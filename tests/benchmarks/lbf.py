"""What one pass saves LBF, against windows that are written out side by side.

The filter of LBF, window 55x55 and five groups of features, on a crop of a shipped still; and the same with
its gradient by the scales of every pixel. Against

- autograd through all offsets, each with its tensors kept for the backward pass;
- the same formula over windows that `unfold` writes out, a few rows at a time;

in float32 on one thread, taken in turns. Times are per pixel, of fewer rows for the last. Memory is that of
tensors that exist at the same time, beyond the inputs; where it grows with the window, a smaller one is
measured, and the growth from there counts.

    python -m tests.benchmarks.lbf
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from models import LBF
from models.ops.scaled_bilateral import BilateralRule, Pixels, scaled_bilateral
from tests.benchmarks.memory import live_bytes
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.timing import Row, print_table, row

FEATURES = ("depth", "normal", "diffuse_albedo", "specular_albedo", "visibility")
NOISE = ("measured", "measured", "measured", "measured", "estimated")
SIDE, PLAIN_ROWS, REPEATS = 96, 2, 3
AT_LEAST, AT_LEAST_FILTER, LIMIT_ERROR = 3.0, 3.0, 1e-4
SMALL, LARGE = 2, 6
"""Windows between which memory grows or not."""


def run() -> list[Row]:
    """Return times, ratios, memory and the difference of the results."""
    pixels, scales, rule = filtered_by()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rows = [*_times(pixels, scales, rule), *_memory(pixels, scales, rule)]
        return [*rows, *_errors(pixels, scales, rule)]
    finally:
        torch.set_num_threads(before)


def filtered_by() -> tuple[Pixels, Tensor, BilateralRule]:
    """Return what LBF filters a crop of the sample with, and scales around those that it starts with."""
    method = LBF(FEATURES, feature_noise=NOISE)
    with torch.no_grad():
        buffers = mosaic(SIDE, SIDE, method.inputs)
        color = method._noisy(buffers, "color")
        features = method._features(buffers, color.image)
        return method._pixels(color, features), method.network(features.statistics), method.rule


def _times(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> list[Row]:
    few, few_scales = first_rows(pixels, PLAIN_ROWS + rule.window), scales[..., : PLAIN_ROWS + rule.window, :]
    calls: dict[str, tuple[Callable[[], Tensor], int]] = {
        "one pass": (lambda: scaled_bilateral(pixels, scales, rule), SIDE**2),
        "one pass with gradient": (lambda: gradient(pixels, scales, rule), SIDE**2),
        "PyTorch": (lambda: scaled_bilateral(pixels, scales, rule, fused=False), SIDE**2),
        "unfolded": (lambda: unfolded(few, few_scales, rule), PLAIN_ROWS * SIDE),
        "unfolded with gradient": (lambda: gradient(few, few_scales, rule, unfolded), PLAIN_ROWS * SIDE),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(REPEATS + 1):
        for name, (call, count) in calls.items():
            began = time.process_time()
            call()
            if turn:  # the first compiles
                times[name].append((time.process_time() - began) / count * 1e6)
    least = {name: min(found) for name, found in times.items()}
    rows = [row(f"LBF filter, {name}: processor time", found, "us/px") for name, found in least.items()]
    for part, target in (("", AT_LEAST_FILTER), (" with gradient", AT_LEAST)):
        ratio = least[f"unfolded{part}"] / least[f"one pass{part}"]
        rows.append(
            row(f"LBF filter{part}: unfolded / one pass", ratio, "x", f">= {target:g}x", ratio >= target)
        )
    return rows


def _memory(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> list[Row]:
    rows = []
    for name, form in (("one pass", in_tensors), ("autograd through every offset", offset_by_offset)):
        found = [
            live_bytes(lambda r=radius, f=form: gradient(pixels, scales, BilateralRule(rule.groups, r), f))  # type: ignore[misc]
            for radius in (SMALL, LARGE)
        ]
        growth = (found[1] - found[0]) / ((2 * LARGE + 1) ** 2 - (2 * SMALL + 1) ** 2) / SIDE**2
        limit = 1.0 if form is in_tensors else None
        text, met = ("<= 1 byte", growth <= limit) if limit is not None else ("", None)
        rows.append(row(f"LBF gradient, {name}: memory per offset", growth, "B/px", text, met))
    return rows


def _errors(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> list[Row]:
    few, few_scales = first_rows(pixels, PLAIN_ROWS), scales[..., :PLAIN_ROWS, :]
    pairs = {
        "result": (scaled_bilateral(few, few_scales, rule), unfolded(few, few_scales, rule)),
        "gradient": (gradient(few, few_scales, rule), gradient(few, few_scales, rule, unfolded)),
    }
    rows = []
    for name, (found, expected) in pairs.items():
        error = float((found - expected).abs().max() / expected.abs().max())
        title = f"LBF filter: difference of the {name}"
        rows.append(row(title, error, "", f"<= {LIMIT_ERROR:g}", error <= LIMIT_ERROR))
    return rows


def first_rows(pixels: Pixels, count: int) -> Pixels:
    """Return the first rows of an image."""
    return Pixels(*(part[..., :count, :] for part in pixels))


def gradient(
    pixels: Pixels, scales: Tensor, rule: BilateralRule, form: Callable[..., Tensor] = scaled_bilateral
) -> Tensor:
    """Return the gradient of the sum of the result by the scales."""
    wanted = scales.detach().clone().requires_grad_()
    (found,) = torch.autograd.grad(form(pixels, wanted, rule).sum(), wanted)
    return found


def in_tensors(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> Tensor:
    """Filter in PyTorch, whose tensors are counted."""
    return scaled_bilateral(pixels, scales, rule, fused=False)


def offset_by_offset(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> Tensor:
    """Filter with an image of weights for every offset, all kept by autograd."""
    return scaled_bilateral(
        Pixels(*(part.detach().clone().requires_grad_() for part in pixels)), scales, rule
    )


def unfolded(pixels: Pixels, scales: Tensor, rule: BilateralRule) -> Tensor:
    """Filter the first rows, `PLAIN_ROWS`, with all neighbours of a pixel side by side."""
    height, width = pixels.color.shape[-2:]
    side, rows = 2 * rule.window + 1, min(PLAIN_ROWS, height)
    own = [part[:, :, None, :rows] for part in pixels]

    def windows(image: Tensor) -> Tensor:
        padded = F.pad(image, [rule.window] * 4)[..., : rows + 2 * rule.window, :]
        return F.unfold(padded, side).reshape(1, image.shape[1], side**2, rows, width)

    color, variance, features = (windows(part) for part in pixels[:3])
    inside = windows(torch.ones_like(pixels.color[:, :1]))
    steps = torch.arange(-rule.window, rule.window + 1).float()
    place = (steps[:, None].square() + steps.square()).reshape(1, 1, -1, 1, 1)
    a = scales[:, :, None, :rows]
    distance = ((color - own[0]).square() / (rule.epsilon + own[1] + variance)).sum(1, keepdim=True)
    exponent = rule.factor * distance + a[:, :1] * place
    each = (features - own[2]).square() / own[3]
    for k, group in enumerate(each.split(list(rule.groups), 1)):
        exponent = exponent + a[:, k + 1 : k + 2] * group.sum(1, keepdim=True)
    weight = torch.exp(-exponent) * inside
    return (weight * color).sum(2) / weight.sum(2)


if __name__ == "__main__":
    print_table(run())
