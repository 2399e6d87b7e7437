"""Does an artifact compute what the module it was made from computes?

The error of an image is the largest `|artifact - eager| / (|eager| + 0.01 m)`, m being the image's median
`|eager|`, which keeps black pixels next to bright ones from dividing by nothing.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from models.denoiser import Denoised, Denoiser, State
from trainer.export.artifact import Artifact
from trainer.export.description import Parity
from trainer.export.entry import Sampled, example, numbers

LIMIT = 1e-4
ROUNDING = 2.0
"""How much less exact than eager an artifact may be where float32 itself rounds by more than the limit."""
UNUSABLE = 1e-2
"""An error, relative to the brightest of the pixels around, that no rounding excuses."""
SIZES = ((1, 17, 31), (2, 63, 50), (1, 128, 128), (2, 45, 80), (3, 16, 97))
"""(batch, height, width): none is the size that was traced, most are odd."""
COUNTS = (3, 8, 1, 2, 5)
"""Samples per pixel at each of these sizes."""


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Return the largest relative difference of two images (B, C, H, W); infinite where one is not finite."""
    if found.shape != expected.shape:
        raise ValueError(f"shape {tuple(found.shape)}, expected {tuple(expected.shape)}")
    error = (found - expected).abs() / _scale(expected)
    return float(error.amax()) if bool(torch.isfinite(error).all()) else float("inf")


def _scale(image: Tensor) -> Tensor:
    """Return what the errors of the pixels are divided by, (B, C, H, W)."""
    size = image.abs()
    return size + 0.01 * size.flatten(1).median(dim=1).values[:, None, None, None] + 1e-8


@torch.inference_mode()
def measure_parity(artifact: Artifact, denoiser: Denoiser, runtime: str, limit: float = LIMIT) -> Parity:
    """Compare an artifact with the eager, deployed, float32 module on `SIZES` (and `COUNTS`).

    Each size is run without frame numbers and with numbers unlike the defaults, on inputs with fireflies.
    Networks that end in an exponential or a difference magnify rounding: where the difference exceeds the
    limit, both are compared with the module in float64, and the artifact may be off by `ROUNDING` times what
    eager is.

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
        state = None
        for buffers in (plain, plain | numbers(denoiser, plain)):
            expected = _denoised(denoiser, buffers, state)
            try:
                found = _denoised(artifact, buffers, state)
                error, own = agreement(denoiser, buffers, found.color, expected.color, limit, state)
                _compare_states(found.state, expected.state, limit)
            except Exception as failure:
                raise ValueError(f"the exported file does not run at {place}: {failure}") from failure
            if own is None:
                raise ValueError(f"the exported file differs by {error:.2g} at {place}, allowed {limit:g}")
            rounding = max(rounding, own)
            worst = max(worst, error)
            state = expected.state  # the second goes on from the first where the method is recurrent
    return Parity(worst, limit, SIZES, runtime, rounding, COUNTS if denoiser.per_sample else ())


def agreement(
    denoiser: Denoiser,
    buffers: Mapping[str, Tensor],
    found: Tensor,
    expected: Tensor,
    limit: float = LIMIT,
    state: State | None = None,
) -> tuple[float, float | None]:
    """Return how far an artifact's image is from eager's, and the rounding that excuses it.

    The rounding is 0 where the error is within the limit, and None where nothing excuses it.

    Args:
        denoiser: What the artifact was made from.
        buffers: Its input.
        found: The artifact's image.
        expected: Eager's.
        limit: Largest error that needs no excuse.
        state: Of the frame before, for recurrent methods.
    """
    error = relative_error(found, expected)
    if error <= limit:
        return error, 0.0
    return error, _as_exact(found, expected, _in_double(denoiser, buffers, state), denoiser.rounding_reach)


def _in_double(denoiser: Denoiser, buffers: Mapping[str, Tensor], state: State | None) -> Tensor:
    """Return what the module computes in float64."""
    wide = {name: value.double() for name, value in buffers.items()}
    before = None if state is None else {name: value.double() for name, value in state.items()}
    return _denoised(copy.deepcopy(denoiser).double(), wide, before).color


def _denoised(method: Denoiser | Artifact, buffers: Mapping[str, Tensor], state: State | None) -> Denoised:
    made: Denoised = method(buffers) if state is None else method(buffers, state)
    return made


def _compare_states(found: State | None, expected: State | None, limit: float) -> None:
    """Raise a ValueError where a map differs by more than a share of its largest number."""
    for name, maps in (expected or {}).items():
        apart = float((found[name] - maps).abs().amax()) if found else float("inf")
        if not apart <= limit * float(maps.abs().amax()):
            raise ValueError(f"its state {name!r} differs by {apart:.2g}")


def _as_exact(found: Tensor, eager: Tensor, exact: Tensor, reach: int) -> float | None:
    """Return eager's error against float64 where the artifact's is not much larger, otherwise None.

    Not much larger than the largest of the image, relative to pixels; or at no pixel than the largest
    difference among those around: where a bright neighbour is subtracted, what is left has its rounding.
    """
    found, eager = found.double(), eager.double()
    own, theirs = relative_error(eager, exact), relative_error(found, exact)

    def around(image: Tensor) -> Tensor:
        return F.max_pool2d(image, 2 * reach + 1, 1, reach)

    apart = torch.maximum((found - exact).abs(), ROUNDING * (eager - exact).abs())
    if not bool((apart < UNUSABLE * around(_scale(exact))).all()):
        return None
    noise = around((eager - exact).abs().amax(1, keepdim=True))
    bound = torch.maximum(ROUNDING * noise, LIMIT * _scale(exact))
    return own if theirs <= ROUNDING * own or bool(((found - exact).abs() <= bound).all()) else None


def _compare_measured(artifact: Artifact, denoiser: Denoiser, buffers: Mapping[str, Tensor]) -> None:
    expected = {k: v for k, v in denoiser.measure(buffers).items() if k in denoiser.frame_numbers}
    found = artifact.measure(buffers)
    for name, value in expected.items():
        if name not in found or not torch.equal(found[name], value):
            raise ValueError(
                f"{type(denoiser).__name__} measures {name!r} in its own way, so that tiles of an exported "
                "file would differ; follow the definition in data.buffers.FRAME_NUMBERS"
            )
