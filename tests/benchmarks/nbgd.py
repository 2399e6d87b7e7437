"""NBGD's bilateral grids, forward and backward, against a plain implementation with index arrays.

Three grids, of 4, 8 and 16 pixels and levels, each splatted and read with a guide of its own, as one training
step does it: gradients go to the guides. Plain: indices, weights and products of the eight cells around every
pixel, `scatter_add` and `gather`, ordinary automatic differentiation (`tests.models.plain_nbgd`). Peak memory
is that of PyTorch's allocator, results and gradients included. Inference is the same without gradients.

    python -m tests.benchmarks.nbgd
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from models.nbgd import GRIDS
from models.ops.bilateral_grid import create_grid, slice_grid
from models.ops.grid_cells import Cells
from tests.benchmarks.memory import peak_bytes
from tests.benchmarks.timing import Row, medians, print_table, row
from tests.models.plain_nbgd import indexed_grid, indexed_slice

CROPS, SIDE = 4, 128

Filter = Callable[[Tensor, Tensor, Cells], Tensor]


def run(repeats: int = 7) -> list[Row]:
    """Measure and return the rows."""
    generator = torch.Generator().manual_seed(0)
    image = -2.0 * torch.log1p(-torch.rand(CROPS, 3, SIDE, SIDE, generator=generator))
    noise = torch.rand(CROPS, len(GRIDS), SIDE, SIDE, generator=generator)
    # Guides of a scene are smooth for the most part, with some noise of their own.
    smooth = torch.nn.functional.avg_pool2d(noise, 31, 1, 15)
    guides = (255 * (0.8 * (smooth - smooth.min()) / (smooth.max() - smooth.min()) + 0.2 * noise)).detach()
    weights = torch.rand(image.shape, generator=generator)

    def step(filter_: Filter) -> Tensor:
        given = guides.clone().requires_grad_()
        (filtered(filter_, image, given) * weights).sum().backward()
        assert given.grad is not None
        return given.grad

    @torch.no_grad()
    def inference(filter_: Filter) -> Tensor:
        return filtered(filter_, image, guides)

    name = f"NBGD grids, {CROPS}x{SIDE}x{SIDE}"
    return [
        *compared(f"{name}, forward and backward", step, repeats, 2.0),
        *compared(f"{name}, inference", inference, repeats, None),
    ]


def filtered(filter_: Filter, image: Tensor, guides: Tensor) -> Tensor:
    """Return the mean of what is read from the three grids."""
    parts = [filter_(image, guides[:, n : n + 1], cells) for n, cells in enumerate(GRIDS)]
    return torch.stack(parts).mean(0)


def ours(image: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """Splat and read."""
    return slice_grid(create_grid(image, guide, cells), guide, cells)


def plain(image: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """The same with index arrays."""
    return indexed_slice(indexed_grid(image, guide, *cells), guide, *cells)


def exact(image: Tensor, guide: Tensor, cells: Cells) -> Tensor:
    """The same in float64: in float32 the plain form has a slope where a pixel lies 1 from a cell."""
    return plain(image.double(), guide.double(), cells).float()


def compared(name: str, call: Callable[[Filter], Tensor], repeats: int, target: float | None) -> list[Row]:
    """Return times, memory, their ratios and the difference of two contestants."""
    calls = {"ours": lambda: call(ours), "plain": lambda: call(plain)}
    expected, found = call(exact), calls["ours"]()
    error = float((found - expected).abs().max() / expected.abs().max())
    times = medians(calls, dict.fromkeys(calls, repeats))
    memory = {key: peak_bytes(each) for key, each in calls.items()}
    speed, share = times["plain"] / times["ours"], memory["ours"] / memory["plain"]
    limit = "" if target is None else f">= {target:g}"
    return [
        *(row(f"{name}: {key}", times[key] * 1e3, "ms") for key in calls),
        row(f"{name}: plain / ours", speed, "x", limit, None if target is None else speed >= target),
        *(row(f"{name}: memory, {key}", memory[key] / 1e6, "MB") for key in calls),
        row(f"{name}: memory ours / plain", share, ""),
        row(f"{name}: largest difference to float64", error, "", "<= 1e-4", error <= 1e-4),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    print_table(run())
