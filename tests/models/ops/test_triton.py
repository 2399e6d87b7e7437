"""The Triton forms equal the plain ones: on a CUDA device, otherwise in Triton's interpreter."""

from __future__ import annotations

import platform
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch
from torch import Tensor

from models.ops import kernel_blocks
from models.ops.kernel_blocks import Kernels
from models.ops.triton import usable
from tests.models.ops.test_splat import close, made

SHIFTS = ["weights", "source", "target", "both"]
LINUX = sys.platform == "linux" and platform.machine() == "x86_64"
"""Where Triton can be installed."""
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels(numbers: torch.Tensor, shift: str, rows: int) -> Kernels:
    batch, count, _, height, width = numbers.shape
    source = torch.rand(batch, count, 1, height, width, dtype=numbers.dtype)
    target = torch.rand(batch, 1, rows, width, dtype=numbers.dtype)
    return Kernels(
        numbers,
        round(numbers.shape[2] ** 0.5),
        numbers.dtype,
        source if shift in ("source", "both") else None,
        target if shift in ("target", "both") else None,
    )


def compare(shift: str, size: int, beyond: bool) -> None:
    """Compare scatter, collect and gradients of both forms, in float64."""
    from models.ops.triton import kernel_sums

    values, numbers = made(size, 5, 6)
    rows = 5 + 2 * (size // 2) * beyond
    plain = kernels(numbers, shift, rows)
    parts = {n: t.to(DEVICE) for n in ("numbers", "source", "target") if (t := getattr(plain, n)) is not None}
    ours, sent = replace(plain, **parts), values.to(DEVICE)
    same(kernel_sums.scatter(ours, sent, beyond), kernel_blocks.scatter(plain, values, beyond))
    incoming = torch.rand(2, 1, 3, rows, 6, dtype=values.dtype)
    asked = (True, True, plain.source is not None)
    found = kernel_sums.slopes(ours, sent, incoming.to(DEVICE), asked)
    for one, other in zip(found, kernel_blocks.slopes(plain, values, incoming, asked), strict=True):
        same(one, other)
    taller = torch.rand(*values.shape[:3], rows, 6, dtype=values.dtype)
    same(kernel_sums.collect(ours, taller.to(DEVICE)), kernel_blocks.collect(plain, taller))


def same(found: Tensor | None, expected: Tensor | None) -> None:
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        close((found.cpu(),), (expected,))


@pytest.mark.slow  # the interpreter is
@pytest.mark.parametrize(("shift", "size", "beyond"), [(s, 3, False) for s in SHIFTS] + [("target", 5, True)])
def test_it_equals_the_plain_form(shift: str, size: int, beyond: bool) -> None:
    if LINUX or find_spec("triton") is not None:
        compare(shift, size, beyond)


def test_nothing_imports_triton_before_a_device_needs_it() -> None:
    code = "import sys, models.ops.splat; sys.exit('triton' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert not usable(torch.zeros(1))
