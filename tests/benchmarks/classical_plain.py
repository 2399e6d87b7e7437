"""Figure 1 of the training-free methods: what their exact accelerations save, against their plain forms.

For the methods with an exact acceleration, on a crop of the sample's stills, on one thread, both forms in
turns; processor time per pixel, the least of several turns:

    NLM         box sums per offset against patches compared pixel by pixel, compiled (`plain_filter`)
    joint NLM   the same with features against sums of unfolded patches, in PyTorch
    NFOR        one regression by sums of products against unfolded windows, in PyTorch and float64
    RDFC        candidates that share their distances against each by itself (`tests.benchmarks.rdfc`)
    RHF         box sums per offset against patches compared bin by bin, compiled (`tests.benchmarks.rhf`)
    WLR         as compiled against windows cut out whole, in PyTorch

A form that is compiled does more than save arithmetic, and one in PyTorch wastes memory traffic: where only
such an opponent exists the quotient holds both. Differences are relative to the largest value.

    python -m tests.benchmarks.classical_plain
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple
from unittest.mock import patch

import torch
import torch.nn.functional as F
from torch import Tensor

from models import WLR, JointNLM
from models.ops import nlm
from models.ops.nlm import Guide, PatchKernel, PatchWeights
from models.ops.regression import NOISE, RIDGE, Sample, collaborative_regression
from tests.benchmarks import rdfc, rhf
from tests.benchmarks.mosaic import mosaic
from tests.benchmarks.nlm import KERNEL, ours
from tests.benchmarks.plain_filter import plain_filter
from tests.benchmarks.timing import Row, print_table, row

FEATURES = ("normal", "albedo", "depth")
REPEATS, AT_LEAST = 3, 3.0


class Pair(NamedTuple):
    """A method in two forms.

    Attributes:
        fast: What ships; returns an image whose first rows are those of the other form.
        plain: The other form.
        pixels: How many each computes.
        error: Largest difference that is allowed, relative to the largest value.
    """

    fast: Callable[[], Tensor]
    plain: Callable[[], Tensor]
    pixels: tuple[int, int]
    error: float


def run() -> list[Row]:
    """Return quotients and differences of all methods."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    rows: list[Row] = []
    try:
        with torch.inference_mode():
            for name, make in PAIRS.items():
                rows += pair_rows(name, make())
    finally:
        torch.set_num_threads(before)
    return rows


def pair_rows(name: str, pair: Pair) -> list[Row]:
    """Measure both forms in turns."""
    times: dict[str, list[float]] = {"fast": [], "plain": []}
    found, expected = pair.fast(), pair.plain()
    for _ in range(REPEATS):
        for kind, call, pixels in zip(times, pair[:2], pair.pixels, strict=True):
            began = time.process_time()
            call()
            times[kind].append((time.process_time() - began) / pixels * 1e6)
    fast, plain = (min(values) for values in times.values())
    same = (..., slice(0, expected.shape[-2]), slice(None))
    error = float((found[same] - expected).abs().max() / expected.abs().max())
    ratio = plain / fast
    return [
        row(f"{name}: processor time", fast, "us/px"),
        row(f"{name}, plain: processor time", plain, "us/px"),
        row(f"{name}: plain / ours", ratio, "x", f">= {AT_LEAST:g}x", ratio >= AT_LEAST),
        row(f"{name}: largest difference", error, "", f"<= {pair.error:g}", error <= pair.error),
    ]


def nlm_pair() -> Pair:
    """Return NLM of a half with its own weights."""
    side, rows = 192, 16
    image, variance = (t[0] for t in mosaic(side, side, ("color_a", "color_variance")).values())
    arrays = image.numpy(), 2 * variance.numpy()
    return Pair(
        lambda: ours(image, 2 * variance, fused=True),
        lambda: torch.from_numpy(plain_filter(*arrays, KERNEL, rows, 1)),
        (side**2, rows * side),
        1e-4,
    )


def joint_pair() -> Pair:
    """Return joint NLM, features filtered beforehand left out of neither."""
    side = 96
    fast, plain = JointNLM(features=FEATURES, fused=True), JointNLM(features=FEATURES, fused=False)
    buffers = mosaic(side, side, fast.inputs)

    def unfolded() -> Tensor:
        with patch.object(nlm, "box_sum_valid", unfolded_sum):
            return plain(buffers).color

    return Pair(lambda: fast(buffers).color, unfolded, (side**2, side**2), 1e-3)


def unfolded_sum(maps: Tensor, size: int) -> Tensor:
    """Sum every size x size window that lies inside the image, from all its pixels side by side."""
    batch, channels, height, width = maps.shape
    columns = F.unfold(maps.flatten(0, 1)[:, None], size).sum(1)
    return columns.reshape(batch, channels, height - size + 1, width - size + 1)


def nfor_pair() -> Pair:
    """Return a regression of one half, with weights and features of the other, not filtered beforehand."""
    sample, pixels = half_of_a_still(40)
    kernel = PatchKernel(9, 3, (0.5,), 2.0, "least")
    return Pair(
        lambda: collaborative_regression([sample], kernel, fused=True)[0][0],
        lambda: unfolded_regression(sample, kernel),
        (pixels, pixels),
        1e-3,
    )


def half_of_a_still(side: int) -> tuple[Sample, int]:
    """Return what a regression reads of a crop, and its number of pixels."""
    names = ("color_a", "color_b", "color_variance", *(f"{name}_b" for name in FEATURES))
    image, other, variance, *features = mosaic(side, side, names).values()
    return Sample(image, torch.cat(features, 1), Guide(other, variance)), side**2


def unfolded_regression(sample: Sample, kernel: PatchKernel) -> Tensor:
    """Fit and predict every window by itself, all of its pixels side by side, in float64."""
    window, (height, width) = kernel.window, sample.image.shape[-2:]
    side, weights = 2 * window + 1, PatchWeights([sample.guide], kernel)
    every = [weights.at(offset, (0, height))[0] for offset in weights.offsets]
    w = torch.cat(every, 1)[0].flatten(1).T.double()  # pixels, neighbours
    joined = torch.cat([sample.features, sample.image], 1).double()
    around = F.unfold(F.pad(joined, [window] * 4), side).reshape(joined.shape[1], side * side, -1)
    own = sample.features.double().flatten(2)[0]
    steps = torch.tensor([(1.0, o.down, o.right) for o in weights.offsets], dtype=torch.float64)
    z = torch.cat([steps.T[:, :, None].expand(-1, -1, w.shape[0]), around[:-3] - own[:, None]])
    z, y = z.permute(2, 1, 0), around[-3:].permute(2, 1, 0)
    total = w.sum(1)[:, None, None]
    normal, right = (z * w[..., None]).mT @ z, (z * w[..., None]).mT @ y
    mean, mean_right = normal[:, :1] / total, right[:, :1] / total
    covariance = (normal - normal[:, :1].mT @ mean)[:, 1:, 1:]
    ridge = RIDGE * normal.diagonal(dim1=1, dim2=2)[:, 1:] + 1e-30 * total[:, 0]
    ridge[:, 2:] += total[:, 0] * (NOISE * own.T).square()
    slopes = torch.linalg.solve(
        covariance + ridge.diag_embed(), (right - normal[:, :1].mT @ mean_right)[:, 1:]
    )
    constant = mean_right - mean[:, :, 1:] @ slopes
    predicted = (z[..., 1:] @ slopes + constant) * w[..., None]
    sums = torch.cat([predicted, w[..., None]], -1).permute(2, 1, 0).flatten(0, 1)
    image = F.fold(sums[None], (height + 2 * window, width + 2 * window), side)
    image = image[..., window : window + height, window : window + width]
    return (image[:, :3] / image[:, 3:]).float()


def rdfc_pair() -> Pair:
    """Return the candidates of RDFC, one below the other; rows whose windows the plain form cuts are left."""
    guide, features = rdfc.frame()
    whole = slice(0, rdfc.PLAIN_ROWS - rdfc.KERNEL.window - rdfc.KERNEL.margin)
    return Pair(
        lambda: rdfc.shared(guide, features)[0],
        lambda: rdfc.unfolded(guide, features)[0][..., whole, :],
        (rdfc.SIDE**2, rdfc.PLAIN_ROWS * rdfc.SIDE),
        rdfc.LIMIT_ERROR,
    )


def rhf_pair() -> Pair:
    """Return RHF at one scale; the plain form's last row lacks patches."""
    color, histogram = rhf.frame()
    side = color.shape[-1]
    return Pair(
        lambda: torch.from_numpy(rhf.ours(color, histogram, fused=True)),
        lambda: torch.from_numpy(rhf.plain_rows(color, histogram, rhf.ROWS)[:, : rhf.ROWS - 1]),
        (side**2, rhf.ROWS * side),
        rhf.LIMIT_ERROR,
    )


def wlr_pair() -> Pair:
    """Return WLR."""
    side = 64
    fast, plain = WLR(features=FEATURES, fused=True), WLR(features=FEATURES, fused=False)
    buffers = mosaic(side, side, fast.inputs)
    return Pair(lambda: fast(buffers).color, lambda: plain(buffers).color, (side**2, side**2), 1e-6)


PAIRS: dict[str, Callable[[], Pair]] = {
    "NLM": nlm_pair,
    "joint NLM": joint_pair,
    "NFOR, one regression": nfor_pair,
    "RDFC, candidates": rdfc_pair,
    "RHF, one scale": rhf_pair,
    "WLR": wlr_pair,
}
"""Name in the table → what makes both forms."""

if __name__ == "__main__":
    print_table(run())
