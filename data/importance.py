"""Importance-driven patch positions: more patches where a frame is noisy or its geometry is busy.

A map says how much a patch centred at a pixel is worth, candidates are thrown over the frame so that they
keep their distance, and pruning drops those of little worth at random. In this form, relative variance of
noisy colour plus variance of normals, it chose the training patches of AFGSA.

Sources: Bako et al. 2017, "Kernel-Predicting Convolutional Networks for Denoising Monte Carlo Renderings",
section 5, doi:10.1145/3072959.3073708, which introduced it; Yu et al. 2021, "Monte Carlo Denoising via
Auxiliary Feature Guided Self-Attention", section 4.1, doi:10.1145/3478513.3480565, whose published code
settles what the text leaves open.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from data.frame import Image
from data.patches import Position, check_size, generator_of

CANDIDATES = 400
"""Candidates of a frame in AFGSA, whatever its size; here those of a 1280x720 frame."""

FLOOR = 1e-4
"""Smallest squared mean that the variance of colour is divided by, in AFGSA; 1e-2 in another published form
of the same code, which gives dark regions less weight."""

PUBLISHED_SHARE = 258 / 400
"""Share of candidates that AFGSA kept on average."""

FAILURES = 5000
"""Candidates in a row that may be too near before the distance shrinks."""

SHRINK = 0.96
"""Factor by which the distance shrinks."""

REGION = 4
"""Side of a pruning region, in patches."""

GAMMA = 2.2

_BLOCK = 1024

_STRIP = 64
"""Columns that are summed at a time, so that what is in between stays within the cache."""


def importance_map(color: Image, normal: Image | None, patch: int, floor: float = FLOOR) -> Image:
    """Return how much a patch centred at each pixel is worth, (H, W) float32 in [0, 1], 1 at its maximum.

    For colour and normal: v is the largest over the channels of `max(mean of squares - squared mean, 0)`,
    for colour divided by `max(squared mean, floor)`; the map is `min(v^(1/2.2), 1)` divided by its maximum
    (at least 1e-4). Their sum is divided by its maximum. The means are over windows as large as a patch, from
    patch // 2 pixels before the centre on: exactly the patch that would be cut there. Beyond the border the
    frame is mirrored, pixels at the border repeated; the published code leaves that to its library, which
    does so. Only the maxima depend on it, since patches lie inside.

    Args:
        color: Noisy radiance (H, W, 3).
        normal: Normals as they are (H, W, 3); without them the map is that of colour alone.
        patch: Width and height of a patch, at most those of the frame.
        floor: Smallest squared mean that counts as such.

    Raises:
        ValueError: The frame is smaller than a patch, or the floor is not positive.
    """
    height, width = color.shape[:2]
    check_size((width, height), patch)
    if not floor > 0:
        raise ValueError(f"the floor of relative variance is {floor}; expected a positive number")
    total = _worth(_variance(color, patch, floor))
    if normal is not None:
        total += _worth(_variance(normal, patch, None))
    return (total / max(float(total.max()), 1e-4)).astype(np.float32)


def importance_positions(
    importance: Image, count: int, patch: int, seed: tuple[int | str, ...], label: str = "frame"
) -> list[Position]:
    """Return positions of patches, denser where the importance is high, in no particular order.

    Args:
        importance: What `importance_map` returned for this patch size (H, W).
        count: Number of candidates; the expected number of positions is the sum of their importances.
        patch: Width and height of a patch.
        seed: Whatever tells this draw from others; the same seed gives the same positions on every machine.
        label: Name of the frame, for the error.

    Raises:
        ValueError: The frame is smaller than a patch.
    """
    return [p for p in importance_candidates(importance, count, patch, seed, label) if p is not None]


def importance_candidates(
    importance: Image, count: int, patch: int, seed: tuple[int | str, ...], label: str = "frame"
) -> list[Position | None]:
    """Return the position of each of `count` candidates, None for those that were pruned.

    Arguments and errors are those of `importance_positions`.
    """
    height, width = importance.shape
    check_size((width, height), patch, label)
    generator = generator_of(seed)
    corners = throw_darts(count, (width, height), patch, generator)
    centres = corners + patch // 2
    worths = importance[centres[:, 1], centres[:, 0]].astype(np.float64)
    kept = prune(centres, worths, (width, height), REGION * patch, generator)
    return [Position(int(x), int(y)) if keep else None for (x, y), keep in zip(corners, kept, strict=True)]


def throw_darts(
    count: int, size: tuple[int, int], patch: int, generator: np.random.Generator
) -> NDArray[np.int64]:
    """Return top left corners (count, 2), as x and y, that keep their distance from each other.

    Corners are drawn uniformly from [0, W - patch - 1] x [0, H - patch - 1], 0 alone where that is empty.
    One is accepted if its squared distance to all accepted ones exceeds (2r)^2,
    r = sqrt(W H / count / pi). After 5000 failures in a row r shrinks by 0.96. Where 2r is below one pixel
    only equal corners would be told apart, and there may be fewer different ones than are wanted: from there
    on all are accepted.

    The result is that of testing one candidate after the other. `nearest` holds the squared distance of each
    corner to the accepted ones as far as it matters; r only shrinks, so it stays valid.
    """
    width, height = size
    bounds = np.array([max(width - patch, 1), max(height - patch, 1)])
    limit = 2 * math.sqrt(width * height / max(count, 1) / math.pi)
    nearest = np.full(bounds[::-1], np.iinfo(np.int64).max)
    accepted: list[NDArray[np.int64]] = []
    failures = 0
    for block in _candidates(bounds, generator):
        start = 0
        while start < len(block) and len(accepted) < count:
            rest = block[start : start + FAILURES - failures]
            far = nearest[rest[:, 1], rest[:, 0]] > (limit * limit if limit >= 1 else -1.0)
            first = int(far.argmax())
            if far[first]:
                accepted.append(rest[first])
                _note(nearest, rest[first], math.floor(limit))
                start, failures = start + first + 1, 0
                continue
            start, failures = start + len(rest), failures + len(rest)
            if failures == FAILURES:
                limit, failures = limit * SHRINK, 0
        if len(accepted) == count:
            break
    return np.array(accepted, np.int64).reshape(-1, 2)


def prune(
    centres: NDArray[np.int64],
    worths: NDArray[np.float64],
    size: tuple[int, int],
    side: int,
    generator: np.random.Generator,
) -> NDArray[np.bool_]:
    """Return which candidates are kept, (N,).

    Regions of `side` pixels are visited in snake order: left to right in the first row, right to left in the
    next. A candidate of importance i is kept if i - e exceeds a uniform random number; the error e, which
    begins at 0, becomes e + 1 - i then and e - i otherwise. So at any point of the visit the number that is
    kept differs from the sum of the importances by less than 1.

    Args:
        centres: Centres of the patches (N, 2), as x and y.
        worths: Importance of each (N,).
        size: Width and height of the frame.
        side: Width and height of a region.
        generator: Source of the random numbers.
    """
    columns, rows = centres[:, 0] // side, centres[:, 1] // side
    last = (size[0] - 1) // side
    visit = np.lexsort((np.where(rows % 2 == 0, columns, last - columns), rows))
    kept = np.zeros(len(centres), bool)
    error = 0.0
    for candidate, chance in zip(visit.tolist(), generator.random(len(centres)).tolist(), strict=True):
        worth = float(worths[candidate])
        kept[candidate] = worth - error > chance
        error += float(kept[candidate]) - worth
    return kept


def box_mean(plane: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Return means over windows of side x side pixels, (H, W), from side // 2 before each pixel on.

    Nothing is ever subtracted, as differences of a running sum would be, so that a firefly leaves no rounding
    error outside of the windows that hold it.
    """
    return _mean_rows(_mean_rows(plane, side), side)


def _mean_rows(plane: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Return the transposed means over `side` successive rows, (W, H)."""
    height, width = plane.shape
    before = side // 2
    mirrored = np.pad(np.arange(height), (before, side - 1 - before), "symmetric")
    result = np.empty((width, height))
    for left in range(0, width, _STRIP):
        result[left : left + _STRIP] = _window_sums(plane[:, left : left + _STRIP][mirrored], side).T
    result /= side
    return result


def _window_sums(rows: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Return sums of `side` successive rows, made of sums of 1, 2, 4 … rows."""
    number = len(rows) - side + 1
    result = np.zeros((number, rows.shape[1]))
    length, begin = 1, 0
    while True:
        if side & length:
            result += rows[begin : begin + number]
            begin += length
        if 2 * length > side:
            return result
        rows = rows[:-length] + rows[length:]
        length *= 2


def _variance(image: Image, patch: int, floor: float | None) -> NDArray[np.float64]:
    """Return the largest variance over the channels (H, W), relative where there is a floor."""
    largest = np.zeros(image.shape[:2])
    for channel in np.moveaxis(image, -1, 0):
        plane = np.ascontiguousarray(channel, np.float64)
        mean = box_mean(plane, patch)
        variance = box_mean(plane * plane, patch)
        mean *= mean
        variance -= mean
        if floor is not None:
            variance /= np.maximum(mean, floor, out=mean)
        np.maximum(largest, variance, out=largest)
    return largest


def _worth(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    worth = np.minimum(variance ** (1 / GAMMA), 1)
    return np.asarray(worth / max(float(worth.max()), 1e-4))


def _candidates(bounds: NDArray[np.int64], generator: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Yield blocks (N, 2) of corners below `bounds`, without end."""
    while True:
        yield generator.integers(0, bounds, size=(_BLOCK, 2))


def candidate_stream(
    size: tuple[int, int], patch: int, generator: np.random.Generator
) -> Iterator[NDArray[np.int64]]:
    """Yield the corners that `throw_darts` tests, one after the other."""
    bounds = np.array([max(size[0] - patch, 1), max(size[1] - patch, 1)])
    return chain.from_iterable(_candidates(bounds, generator))


def _note(nearest: NDArray[np.int64], corner: NDArray[np.int64], reach: int) -> None:
    """Lower the squared distances around an accepted corner, up to `reach` pixels away."""
    x, y = int(corner[0]), int(corner[1])
    height, width = nearest.shape
    columns = np.arange(max(x - reach, 0), min(x + reach + 1, width))
    rows = np.arange(max(y - reach, 0), min(y + reach + 1, height))
    window = nearest[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    np.minimum(window, (rows[:, None] - y) ** 2 + (columns - x) ** 2, out=window)
