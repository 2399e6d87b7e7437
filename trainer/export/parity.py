"""Does an artifact compute what the module it was made from computes?

The error of an image is the largest `|artifact - eager| / (|eager| + 0.01 m)`, m being the image's median
`|eager|`, which keeps black pixels next to bright ones from dividing by nothing. Where a method's weights are
rounded as shares of 1 (`models.denoiser.Denoiser.rounding_reach`), the divisor has the channel's largest
`|eager|` within that reach in place of the pixel's own.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from models.denoiser import Denoiser
from trainer.export.artifact import Artifact
from trainer.export.description import Parity
from trainer.export.entry import Sampled, example, numbers

LIMIT = 1e-4
ROUNDING = 2.0
"""How much less exact than eager an artifact may be where float32 itself rounds by more than the limit."""
UNUSABLE = 1e-2
"""An error that no rounding excuses."""
SIZES = ((1, 17, 31), (2, 63, 50), (1, 128, 128), (2, 45, 80), (3, 16, 97))
"""(batch, height, width): none is the size that was traced, most are odd."""
COUNTS = (3, 8, 1, 2, 5)
"""Samples per pixel at each of these sizes."""


def relative_error(found: Tensor, expected: Tensor, reach: int = 0) -> float:
    """Return the largest relative difference of two images (B, C, H, W); infinite where one is not finite.

    Args:
        found: What is judged.
        expected: What it should be.
        reach: Differences are relative to the largest expected value within so many pixels.
    """
    if found.shape != expected.shape:
        raise ValueError(f"shape {tuple(found.shape)}, expected {tuple(expected.shape)}")
    size = expected.abs()
    floor = 0.01 * size.flatten(1).median(dim=1, keepdim=True).values + 1e-8
    if reach:
        size = F.max_pool2d(size, 2 * reach + 1, 1, reach)
    error = (found - expected).abs().flatten(1) / (size.flatten(1) + floor)
    return float(error.amax()) if bool(torch.isfinite(error).all()) else float("inf")


@torch.inference_mode()
def measure_parity(artifact: Artifact, denoiser: Denoiser, runtime: str, limit: float = LIMIT) -> Parity:
    """Compare an artifact with the eager, deployed, float32 module on `SIZES` (and `COUNTS`).

    Each size is run without frame numbers and with numbers unlike the defaults, on inputs with fireflies.
    Networks that end in an exponential magnify rounding: where the difference exceeds the limit, both are
    compared with the module in float64, and the artifact may be off by `ROUNDING` times what eager is.

    Raises:
        ValueError: The artifact fails at a size or differs by more than that; the message says where.
    """
    worst = rounding = 0.0
    for seed, (size, count) in enumerate(zip(SIZES, COUNTS, strict=True)):
        plain = example(denoiser.inputs, *size, seed, Sampled(denoiser.samples, count))
        _compare_measured(artifact, denoiser, plain)
        place = f"batch {size[0]}, {size[2]}x{size[1]}"
        if denoiser.per_sample:
            place += f", {count} samples per pixel"
        for buffers in (plain, plain | numbers(denoiser, plain)):
            expected = denoiser(buffers).color
            try:
                found = artifact(buffers).color
                error = relative_error(found, expected, denoiser.rounding_reach)
            except Exception as failure:
                raise ValueError(f"the exported file does not run at {place}: {failure}") from failure
            if not error <= limit:
                exact = _in_double(denoiser, buffers)
                own = _as_exact(found, expected, exact, denoiser.rounding_reach)
                if own is None:
                    raise ValueError(
                        f"the exported file differs by {error:.2g} at {place}, allowed {limit:g}"
                    )
                rounding = max(rounding, own)
            worst = max(worst, error)
    return Parity(worst, limit, SIZES, runtime, rounding, COUNTS if denoiser.per_sample else ())


def _in_double(denoiser: Denoiser, buffers: Mapping[str, Tensor]) -> Tensor:
    """Return what the module computes in float64."""
    wide = {name: value.double() for name, value in buffers.items()}
    return copy.deepcopy(denoiser).double()(wide).color


def _as_exact(found: Tensor, eager: Tensor, exact: Tensor, reach: int) -> float | None:
    """Return eager's error against float64 where the artifact's is not much larger, otherwise None."""
    own = relative_error(eager.double(), exact, reach)
    return own if relative_error(found.double(), exact, reach) <= ROUNDING * own < UNUSABLE else None


def _compare_measured(artifact: Artifact, denoiser: Denoiser, buffers: Mapping[str, Tensor]) -> None:
    expected = {k: v for k, v in denoiser.measure(buffers).items() if k in denoiser.frame_numbers}
    found = artifact.measure(buffers)
    for name, value in expected.items():
        if name not in found or not torch.equal(found[name], value):
            raise ValueError(
                f"{type(denoiser).__name__} measures {name!r} in its own way, so that tiles of an exported "
                "file would differ; follow the definition in data.buffers.FRAME_NUMBERS"
            )
