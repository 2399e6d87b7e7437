"""References that grow: sums over passes on disk, refined later by more passes without starting again."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.frame import Image

ENERGY_LIMIT = 4.0
"""Standard errors beyond which the mean of a noisy frame counts as different from that of its reference: one
frame in 5000 with three channels of normal noise."""

ROUNDING = 2.0**-11
"""Relative error of a number that was stored in half precision: what is compared comes from a file."""

RELATIVE_FLOOR = 1e-4
"""Added to the squared reference where its relative error is estimated, as in the metric `relmse_layer`."""


@dataclass
class Reference:
    """Sums of the passes rendered so far.

    Attributes:
        passes: Number of passes in the sums.
        count: Samples per pixel in the sums.
        total: Sums (H, W, 3) of radiance, or (H, W, 6) with its diffuse part; float64.
        squares: Sums of squared radiance (H, W, 3), float64.
        invalid: Samples that were NaN or Inf and count as 0.
    """

    passes: int
    count: int
    total: NDArray[np.float64] = field(repr=False)
    squares: NDArray[np.float64] = field(repr=False)
    invalid: int = 0

    @staticmethod
    def empty(height: int, width: int, split: bool = False) -> Reference:
        """Return a reference without passes; `split`: with the diffuse part."""
        return Reference(0, 0, np.zeros((height, width, 6 if split else 3)), np.zeros((height, width, 3)))

    @staticmethod
    def load(path: Path, height: int, width: int, split: bool = False) -> Reference:
        """Read what an earlier call saved; an empty reference where there is nothing readable."""
        nothing = Reference.empty(height, width, split)
        try:
            with np.load(path, allow_pickle=False) as file:
                passes, count, invalid = (int(n) for n in file["counts"])
                result = Reference(passes, count, file["total"], file["squares"], invalid)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            return nothing
        fits = (result.total.shape, result.squares.shape) == (nothing.total.shape, nothing.squares.shape)
        return result if fits else nothing

    def save(self, path: Path) -> None:
        """Write the sums, whole or not at all.

        Raises:
            OSError: They cannot be written; the file that was there stays.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as file:
                counts = np.array([self.passes, self.count, self.invalid], np.int64)
                np.savez(file, counts=counts, total=self.total, squares=self.squares)
            os.replace(temporary, path)
        except OSError as error:
            raise OSError(f"{path}: cannot write: {error.strerror or error}; check free space") from error
        finally:
            temporary.unlink(missing_ok=True)

    def add(
        self, rows: slice, radiance: NDArray[np.float32], diffuse: NDArray[np.float32] | None = None
    ) -> None:
        """Add samples (S, h, W, 3) of a band of rows; the caller counts passes and samples."""
        self.total[rows, :, :3] += radiance.sum(0, dtype=np.float64)
        if diffuse is not None:
            self.total[rows, :, 3:] += diffuse.sum(0, dtype=np.float64)
        self.squares[rows] += np.einsum("shwc,shwc->hwc", radiance, radiance, dtype=np.float64)

    def radiance(self) -> Image:
        """Return the mean radiance (H, W, 3)."""
        return (self.total[..., :3] / self.count).astype(np.float32)

    def diffuse(self) -> Image:
        """Return the mean of the diffuse part (H, W, 3)."""
        return (self.total[..., 3:] / self.count).astype(np.float32)

    def sample_variance(self) -> NDArray[np.float64]:
        """Return the variance of single samples (H, W, 3), 0 while there is one sample only."""
        mean = self.total[..., :3] / self.count
        spread = np.maximum(self.squares / self.count - mean * mean, 0)
        return spread * self.count / max(self.count - 1, 1)

    def relative_error(self, exposure: float) -> float:
        """Return the reference's own noise: the mean of its variance over (reference^2 + 1e-4).

        Both are exposed, so that it is what the reference adds to the metric `relmse_layer` of any image.
        """
        mean = exposure * self.total[..., :3] / self.count
        variance = exposure * exposure * self.sample_variance() / self.count
        return float((variance / (mean * mean + RELATIVE_FLOOR)).mean())


def energy_z(noisy: Image, spp: int, reference: Reference) -> float:
    """Return how far the mean of a noisy image is from that of its reference, in standard errors.

    Both are means of independent samples of the same pixels, so that
    `z = (mean(noisy) - mean(reference)) / sqrt(sum(variance) (1 / spp + 1 / n)) * pixels`, with the variance
    of single samples taken from the reference. What rounding to half precision can explain is taken off the
    difference first. The channel with the largest magnitude is returned, at most 999.

    Args:
        noisy: Mean radiance (H, W, 3) of `spp` samples per pixel.
        spp: Its samples per pixel.
        reference: With `n` samples per pixel.
    """
    pixels = noisy.shape[0] * noisy.shape[1]
    difference = noisy.mean((0, 1), dtype=np.float64) - reference.radiance().mean((0, 1), dtype=np.float64)
    rounding = ROUNDING * np.abs(noisy).mean((0, 1), dtype=np.float64)
    difference = np.sign(difference) * np.maximum(np.abs(difference) - rounding, 0)
    variance = reference.sample_variance().sum((0, 1)) * (1 / spp + 1 / reference.count)
    error = np.sqrt(variance) / pixels
    z = np.where(error > 0, difference / np.where(error > 0, error, 1), np.where(difference == 0, 0, np.inf))
    return float(np.clip(z[np.abs(z).argmax()], -999, 999))
