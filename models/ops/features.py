"""Filtered feature buffers, as NFOR makes them (section 5.1 there) and joint filters use them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

from models.ops.halves import Halves, Noise, independent
from models.ops.nlm import Guide, PatchKernel, nlm_filter


class Filtered(NamedTuple):
    """A filtered feature, (B, T, C, H, W) throughout.

    Attributes:
        a: Half A, filtered with weights of half B.
        b: Half B, filtered with weights of half A.
        final: Their mean, filtered once more.
    """

    a: Tensor
    b: Tensor
    final: Tensor


@dataclass(frozen=True)
class Prefilter:
    """How features are filtered, every channel with weights of its own.

    Attributes:
        window: Radius of the window that filters the halves.
        patch: Radius of the patches.
        again: Radius of the window that filters a second time, with what the halves still differ by.
        second: What is filtered a second time: the `mean` of the halves, as the public implementation of
            NFOR does, or the `halves` with weights from each other, as its paper says.
        memory: Working memory in bytes; sets the height of strips, see `models.ops.nlm.strips`.
        fused: See `models.ops.nlm.use_fused`.
    """

    window: int = 5
    patch: int = 3
    again: int = 2
    second: Literal["mean", "halves"] = "mean"
    memory: float | None = None
    fused: bool | None = None

    @property
    def reach(self) -> int:
        """How far the halves look."""
        return self.window + self.patch + (self._further if self.second == "halves" else 0)

    @property
    def reach_final(self) -> int:
        """How far the final form looks."""
        return self.window + self.patch + self._further

    @property
    def _further(self) -> int:
        return self.again + self.patch

    def __call__(self, halves: Halves, noise: Noise) -> Filtered:
        """Filter a feature.

        What has no noise stays as it is. Where one buffer stands for both halves it is filtered once, with
        its own weights: nothing tells how noisy the result is.

        Args:
            halves: (B, T, C, H, W).
            noise: Where they come from.
        """
        a, b = self.halves(halves, noise)
        if not independent(noise):
            return Filtered(a, b, a)
        mean = 0.5 * (a + b)
        if self.second == "halves":
            return Filtered(a, b, mean)
        again = PatchKernel(self.again, self.patch, (0.5,))
        return Filtered(a, b, self.nlm(mean, mean, 0.25 * (b - a).square(), again))

    def halves(self, halves: Halves, noise: Noise) -> tuple[Tensor, Tensor]:
        """Filter the halves only; arguments as for the whole filter."""
        a, b, variance = halves
        if noise == "none":
            return a, b
        first = PatchKernel(self.window, self.patch, (0.5,), scale=2.0)
        if not independent(noise):
            once = self.nlm(a, a, variance, first)
            return once, once
        a, b = self.nlm(a, b, variance, first), self.nlm(b, a, variance, first)
        if self.second == "halves":
            residual = 0.25 * (b - a).square()
            second = PatchKernel(self.again, self.patch, (0.5,), scale=2.0)
            a, b = self.nlm(a, b, residual, second), self.nlm(b, a, residual, second)
        return a, b

    def nlm(self, image: Tensor, guide: Tensor, variance: Tensor, kernel: PatchKernel) -> Tensor:
        """Filter an image (B, T, C, H, W), each frame by itself."""
        return filter_frames(image[None], guide, variance, kernel, self.memory, fused=self.fused)[0]


def filter_frames(
    images: Tensor,
    guide: Tensor,
    variance: Tensor,
    kernel: PatchKernel,
    memory: float | None,
    *,
    fused: bool | None = None,
) -> Tensor:
    """Filter G images (G, B, T, C, H, W), frame by frame, with the weights of a guide (B, T, C, H, W)."""
    flat = images.flatten(1, 2).transpose(0, 1)
    guides = [Guide(guide.flatten(0, 1), variance.flatten(0, 1))]
    found = nlm_filter(flat, guides, kernel, memory, fused=fused)
    return found.transpose(0, 1).reshape(images.shape)
