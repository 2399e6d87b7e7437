"""Figures 6 and 10 of Fan et al. 2021: times over the number of bilateral grids and of WSKP's kernels.

Figure 6 is reconstruction alone, of random guides and importance maps. Grids are those of NBGD, the finest
first; kernels grow from 3 to 13 pixels. Figure 10, of which only times are measured here, is all of WSKP with
six layers. Part of `tests.benchmarks.realtime`, which says how and what "paper" is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from models import WSKP, Denoiser
from models.denoiser import Buffers
from models.nbgd import GRIDS
from models.ops.bilateral_grid import create_grid, slice_grid
from models.ops.sharing import reconstruct
from tests.benchmarks.timing import Row, medians, row

SIZES: tuple[int, ...] = (3, 5, 7, 9, 11, 13)
PAPER_MS = {"1 grid": 2.15, "3 grids": 5.35, "kernel of 9": 0.31, "6 kernels": 1.10}


def growth_rows(buffers: Buffers, repeats: int) -> list[Row]:
    """Measure both figures with one frame, each call so often."""
    return [*filter_rows(filter_times(buffers["irradiance"], repeats)), *kernel_rows(buffers, repeats)]


def filter_times(irradiance: Tensor, repeats: int) -> dict[str, float]:
    """Measure reconstruction alone, over the number of bilateral grids, finest first, and of kernels."""
    _, _, height, width = irradiance.shape
    generator = torch.Generator().manual_seed(1)
    log_importance = 3 * torch.randn(1, len(SIZES), height, width, generator=generator)
    logits = torch.randn(1, len(SIZES), height, width, generator=generator)
    guides, blend = _guides(height, width), torch.softmax(logits[:, : len(GRIDS)], 1)

    def kernels(chosen: slice) -> Tensor:
        return reconstruct(irradiance, log_importance[:, chosen], logits[:, chosen], SIZES[chosen])

    calls: dict[str, Callable[[], Tensor]] = {}
    for count in range(1, len(GRIDS) + 1):
        calls[_counted(count, "grid")] = partial(grids_filtered, irradiance, guides, blend, count)
    for count in range(1, len(SIZES) + 1):
        calls[_counted(count, "kernel")] = partial(kernels, slice(count))
    nine = SIZES.index(9)
    calls["kernel of 9"] = partial(kernels, slice(nine, nine + 1))
    return medians(calls, dict.fromkeys(calls, repeats))


def filter_rows(times: Mapping[str, float]) -> list[Row]:
    """Return figure 6."""
    rows = []
    for name, seconds in times.items():
        theirs = PAPER_MS.get(name)
        note = f"paper {theirs:g} ms" if theirs else ""
        rows.append(row(f"filter, {name}", seconds * 1e3, "ms", note))
    for one, other in (("1 grid", "kernel of 9"), ("3 grids", "6 kernels")):
        note = f"paper {PAPER_MS[one] / PAPER_MS[other]:.2f}"
        rows.append(row(f"filter, {one} / {other}", times[one] / times[other], "x", note))
    grid = (times["3 grids"] - times["1 grid"]) / (len(GRIDS) - 1)
    kernel = (times["6 kernels"] - times["1 kernel"]) / (len(SIZES) - 1)
    rows.append(row("filter, one more grid", grid * 1e3, "ms"))
    rows.append(row("filter, one more kernel", kernel * 1e3, "ms"))
    return rows


def grids_filtered(irradiance: Tensor, guides: Tensor, blend: Tensor, count: int) -> Tensor:
    """Return the blend of what is read from some of NBGD's grids."""
    total = torch.zeros_like(irradiance)
    for index, cells in enumerate(GRIDS[:count]):
        guide = guides[:, index : index + 1]
        grid = create_grid(irradiance, guide, cells)
        total.addcmul_(slice_grid(grid, guide, cells), blend[:, index : index + 1])
    return total


def kernel_rows(buffers: Buffers, repeats: int) -> list[Row]:
    """Figure 10, its times: all of WSKP over the number of kernels."""
    counts = range(1, len(SIZES) + 1)
    calls = {_counted(count, "kernel"): partial(_wskp(count), buffers) for count in counts}
    times = medians(calls, dict.fromkeys(calls, repeats))
    rows = [row(f"WSKP, {name}", seconds * 1e3, "ms") for name, seconds in times.items()]
    first, *_, last = times
    return [*rows, row(f"WSKP, {last} / {first}", times[last] / times[first], "x")]


def _wskp(count: int) -> Denoiser:
    return WSKP(kernel_sizes=SIZES[:count]).eval().requires_grad_(False).deploy()


def _guides(height: int, width: int) -> Tensor:
    """Return guides (1, G, H, W): smooth for the most part, as scenes are, with some noise of their own."""
    noise = torch.rand(1, len(GRIDS), height, width, generator=torch.Generator().manual_seed(2))
    smooth = torch.nn.functional.avg_pool2d(noise, 31, 1, 15)
    low, high = smooth.min(), smooth.max()
    return 255 * (0.8 * (smooth - low) / (high - low) + 0.2 * noise)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
