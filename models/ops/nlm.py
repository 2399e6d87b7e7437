"""Weights of non-local means with a variance per pixel, one window offset at a time.

Fabrice Rousselle, Claude Knaus, Matthias Zwicker: "Adaptive rendering with non-local means filtering", ACM
Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214, equation 2 there; equations 4 and 6 of
NFOR (`models.classical.nfor`). With the guide u, the variance v of its values, and the bandwidth k,

    d(p, q) = [(u_p - u_q)^2 - (v_p + min(v_p, v_q))] / (epsilon + k^2 (v_p + v_q))
    w(p, q) = exp(-max(0, mean of d(p + n, q + n) over the offsets n of a patch))

per channel. Pixels outside the image take no part: as neighbours they weigh nothing, and patches lose the
positions where p + n or q + n lies outside. d is capped from above before the patch mean; where it is not a
number (a variance of 0 / 0 samples) it counts as the cap, so that such pixels stay nearly unfiltered.

Everything works on whole images per offset: an image of d, a box sum, one exponential. No array grows with
the window, and the cost does not depend on the patch. Box sums add only numbers of their own window
(`models.ops.boxes`), so that float32 keeps its relative accuracy with values up to the cap.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.boxes import box_sum_valid, exporting
from models.pace import tick

CENTRE_FLOOR = 1e-4
"""Least weight of a pixel in its own window; it matters only where a variance is not a number."""

UNROLLED = (
    "it visits hundreds of window offsets one by one, which a graph would hold as so many copies of its "
    "operations; use it from Python or with `trainer denoise`"
)
"""Why methods made of these operations are not exported."""


@dataclass(frozen=True)
class PatchKernel:
    """How patches are compared.

    Attributes:
        window: Radius R of the window, (2 R + 1)^2 pixels.
        patch: Radius F of a patch.
        bandwidths: Values of k; weights are made for each.
        scale: Factor of the variance: 2 where a half is compared with the variance of the mean of both.
        channels: What happens to the channels: `own` gives each its own weight, `least` one weight for all,
            the smallest, `mean` one weight from the mean of the channels' d.
        epsilon: Added to the denominator of d.
        cap: Largest d of a pixel.
    """

    window: int
    patch: int
    bandwidths: tuple[float, ...] = (1.0,)
    scale: float = 1.0
    channels: str = "own"
    epsilon: float = 1e-7
    cap: float = 1e4

    def __post_init__(self) -> None:
        """Check the radii, bandwidths and the rule for channels."""
        if self.window < 1 or self.patch < 0:
            raise ValueError(
                f"non-local means needs a window radius >= 1 and a patch radius >= 0, "
                f"got {self.window} and {self.patch}"
            )
        if not self.bandwidths or not all(k > 0 for k in self.bandwidths):
            raise ValueError(f"non-local means needs bandwidths > 0, got {self.bandwidths}")
        if self.channels not in ("own", "least", "mean"):
            raise ValueError(f"channels must be own, least or mean, got {self.channels!r}")

    @property
    def reach(self) -> int:
        """How far a weight looks from its pixel."""
        return self.window + self.patch


class Guide(NamedTuple):
    """An image that weights are made from.

    Attributes:
        image: (B, C, H, W).
        variance: Variance of its pixel values, (B, C, H, W).
    """

    image: Tensor
    variance: Tensor


class Offset(NamedTuple):
    """Where a neighbour lies relative to its pixel: frames ahead, rows below, columns to the right."""

    frames: int
    down: int
    right: int


def offsets(window: int, before: int = 0, after: int = 0) -> Iterator[Offset]:
    """Yield the offsets of a window row by row, for every frame from `before` back to `after` ahead."""
    for frame in range(-before, after + 1):
        for down in range(-window, window + 1):
            for right in range(-window, window + 1):
                yield Offset(frame, down, right)


class PatchWeights:
    """Weights of a strip of rows towards each offset of the window.

    Args:
        guides: The guides of consecutive frames, one for a still.
        kernel: How patches are compared.
        centre: Index of the frame whose pixels the windows belong to.
    """

    def __init__(self, guides: Sequence[Guide], kernel: PatchKernel, centre: int = 0) -> None:
        self.kernel, self.centre = kernel, centre
        self.size = guides[centre].image.shape[-2:]
        self.guides = [
            Guide(
                F.pad(g.image, [kernel.reach] * 4),
                F.pad(g.variance * kernel.scale if kernel.scale != 1 else g.variance, [kernel.reach] * 4),
            )
            for g in guides
        ]

    @property
    def offsets(self) -> list[Offset]:
        """The offsets whose frames exist."""
        return list(offsets(self.kernel.window, self.centre, len(self.guides) - 1 - self.centre))

    def at(self, offset: Offset, rows: tuple[int, int]) -> list[Tensor]:
        """Return the weights of rows start … stop - 1 towards one offset, for each bandwidth.

        Returns:
            Tensors (B, C or 1, stop - start, W), 0 where the neighbour lies outside the image.
        """
        kernel, (start, stop) = self.kernel, rows
        across = self._shares(offset.right, self.size[1], 0, self.size[1])
        down = self._shares(offset.down, self.size[0], start, stop)
        square, noise, spread = self._differences(offset, rows)
        numerator = square - noise
        result = []
        for k in kernel.bandwidths:
            d = numerator / (k * k * spread + kernel.epsilon)
            if kernel.channels == "mean":
                d = d.mean(1, keepdim=True)
            # Comparisons with NaN are false: those become the cap too.
            d = torch.where(d < kernel.cap, d, kernel.cap) * (down.inside[:, None] * across.inside)
            mean = box_sum_valid(d, 2 * kernel.patch + 1) * (down.share[:, None] * across.share)
            if kernel.channels == "least":
                mean = mean.amax(1, keepdim=True)
            weight = torch.exp(-mean.clamp_min(0.0)) * (down.reached[:, None] * across.reached)
            result.append(weight.clamp_min(CENTRE_FLOOR) if offset == (0, 0, 0) else weight)
        tick((stop - start) / self.size[0])
        return result

    def _differences(self, offset: Offset, rows: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Return (u_p - u_q)^2, v_p + min(v_p, v_q) and v_p + v_q of a strip and its patch margin."""
        (start, stop), window, margin = rows, self.kernel.window, 2 * self.kernel.patch
        width = self.size[1] + margin
        here, there = self.guides[self.centre], self.guides[self.centre + offset.frames]
        p = (..., slice(window + start, window + stop + margin), slice(window, window + width))
        top, left = window + offset.down, window + offset.right
        q = (..., slice(top + start, top + stop + margin), slice(left, left + width))
        own, other = here.variance[p], there.variance[q]
        square = (here.image[p] - there.image[q]).square()
        return square, own + torch.minimum(own, other), own + other

    def _shares(self, step: int, size: int, start: int, stop: int) -> _Axis:
        patch = self.kernel.patch
        like = self.guides[0].image
        places = torch.arange(start - patch, stop + patch, device=like.device)
        inside = (places >= 0) & (places < size) & (places + step >= 0) & (places + step < size)
        inside = inside.to(like.dtype)
        count = inside.unfold(0, 2 * patch + 1, 1).sum(-1)
        core = inside[patch : inside.shape[0] - patch]
        return _Axis(inside, count.clamp_min(1.0).reciprocal(), core)


class _Axis(NamedTuple):
    """One axis of an offset: which places of the patch margin exist, 1 / their number, which cores exist."""

    inside: Tensor
    share: Tensor
    reached: Tensor


def strips(
    height: int, row_bytes: float, budget: float | None, device: torch.device
) -> list[tuple[int, int]]:
    """Cut rows 0 … height - 1 into equal strips that fit a budget.

    Args:
        height: Rows of the image.
        row_bytes: Working memory per row.
        budget: Working memory in bytes; a strip has at least 8 rows whatever it is. None: 64 MB on a CPU,
            whose cache larger strips leave, and 4 GB on other devices, where every call costs.
        device: Where the image is.
    """
    if budget is None:
        budget = 64e6 if device.type == "cpu" else 4e9
    rows = max(8, int(budget / row_bytes))
    if rows >= height:
        return [(0, height)]
    pieces = math.ceil(height / rows)
    cuts = [height * i // pieces for i in range(pieces + 1)]
    return list(pairwise(cuts))


def nlm_filter(
    images: Tensor,
    guides: Sequence[Guide],
    kernel: PatchKernel,
    budget: float | None = None,
    *,
    neighbours: Sequence[Tensor] | None = None,
    centre: int = 0,
    fused: bool | None = None,
) -> Tensor:
    """Filter an image with the weights that a guide gives.

    Args:
        images: (B, G, C, H, W): G images filtered with the same weights, channel by channel; C is that of
            the guide, or anything where the kernel gives one weight for all channels.
        guides: Of one frame, or of consecutive frames.
        kernel: Has one bandwidth.
        budget: Working memory in bytes, which sets the height of the strips that are worked on; see `strips`.
        neighbours: `images` of every frame, where the window spans frames.
        centre: Which frame is filtered.
        fused: See `use_fused`.

    Returns:
        (B, G, C, H, W).
    """
    if use_fused(fused, images, *(part for guide in guides for part in guide)):
        return _filter_fused([images] if neighbours is None else neighbours, guides, kernel, centre)
    weights, window = PatchWeights(guides, kernel, centre), kernel.window
    frames = [F.pad(i, [window] * 4) for i in ([images] if neighbours is None else neighbours)]
    height, width = images.shape[-2:]
    planes = 4 * images[..., 0, 0].numel() + 8 * guides[0].image[..., 0, 0].numel()
    row_bytes = images.element_size() * width * planes
    result = []
    for start, stop in [(0, height)] if exporting() else strips(height, row_bytes, budget, images.device):
        total: Tensor | None = None
        norm: Tensor | None = None
        for offset in weights.offsets:
            (weight,) = weights.at(offset, (start, stop))
            weight = weight[:, None]
            top, left = window + offset.down, window + offset.right
            q = frames[centre + offset.frames if neighbours is not None else 0]
            q = q[..., top + start : top + stop, left : left + width]
            total = weight * q if total is None else torch.addcmul(total, weight, q)
            norm = weight if norm is None else norm + weight
        assert total is not None
        assert norm is not None
        result.append(total / norm)
    return result[0] if len(result) == 1 else torch.cat(result, -2)


def _filter_fused(
    images: Sequence[Tensor], guides: Sequence[Guide], kernel: PatchKernel, centre: int
) -> Tensor:
    from models.ops import fused

    (bandwidth,) = kernel.bandwidths
    numbers = fused.Kernel.of(kernel, bandwidth, torch.get_num_threads())
    stacks = [torch.stack(list(parts)) for parts in (images, *guide_parts(guides, kernel))]
    results = []
    for b in range(images[0].shape[0]):
        image, guide, variance = (stack[:, b].numpy() for stack in stacks)
        results.append(torch.from_numpy(fused.filter_images(image, guide, variance, numbers, centre)))
    return torch.stack(results)


def guide_parts(guides: Sequence[Guide], kernel: PatchKernel) -> tuple[list[Tensor], list[Tensor]]:
    """Return the images of the guides and their scaled variances."""
    return [g.image for g in guides], [g.variance * kernel.scale for g in guides]


def use_fused(wanted: bool | None, *tensors: Tensor, kinds: Sequence[torch.dtype] = (torch.float32,)) -> bool:
    """Say whether the kernels of `models.ops.fused` take over from the PyTorch form.

    They need float32 on the CPU, no gradient, no export, and Numba.

    Args:
        wanted: None: where possible. False: never. True: wherever the tensors allow it, and Numba must be
            there.
        tensors: What is to be worked on.
        kinds: Types of tensors that the kernels work on.

    Raises:
        ValueError: `wanted` is True and Numba is not installed.
    """
    if wanted and not _has_numba():
        raise ValueError(
            "the fused kernels need Numba, which is not installed: pip install 'penumbra-denoise[fast]', or "
            "leave out fused=True"
        )
    if wanted is False or exporting():
        return False
    plain = all(t.dtype in kinds and t.device.type == "cpu" for t in tensors)
    tracked = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    return plain and not tracked and _has_numba()


@cache
def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None
