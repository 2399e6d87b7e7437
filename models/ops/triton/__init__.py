"""Forms of operations for CUDA devices, written in Triton.

Never required: without Triton, or on other devices, the plain PyTorch forms run, which these are tested
against. Triton is imported when a tensor on a CUDA device first needs it.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

from torch import Tensor


def usable(tensor: Tensor) -> bool:
    """Return whether a tensor's device runs Triton, and Triton is there."""
    return tensor.is_cuda and _found()


@cache
def _found() -> bool:
    return find_spec("triton") is not None
