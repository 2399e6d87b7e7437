"""How much memory calls take: growth of this process's resident memory, or of a GPU's allocations.

What is there before, the libraries, the weights and the images, is not counted.
"""

from __future__ import annotations

import ctypes
import gc
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

_STATUS = Path("/proc/self/status")
_INTERVAL_S = 0.002


def reset_peak() -> int:
    """Forget the peak of this process and return its present resident set in bytes.

    Memory that was released before is given back first: what reuses it would not be seen.

    Raises:
        OSError: This system does not let a process do so; Linux does.
    """
    gc.collect()
    with suppress(AttributeError, TypeError):  # only the GNU library has it
        ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    return status("VmRSS")


def status(key: str) -> int:
    """Return a size of this process in bytes: `VmRSS`, resident now, or `VmHWM`, its peak."""
    lines = _STATUS.read_text().splitlines()
    return int(next(line for line in lines if line.startswith(f"{key}:")).split()[1]) * 1024


class _Resident:
    """Growth of resident memory, by the system's own peak."""

    def __init__(self) -> None:
        self._before = reset_peak()

    def taken(self) -> int:
        return max(status("VmHWM") - self._before, 0)


class _Watched:
    """The same where the system has no peak that can be reset: looked at every two milliseconds."""

    def __init__(self) -> None:
        gc.collect()
        self._process, self._over = psutil.Process(), threading.Event()
        self._before = self._peak = self._process.memory_info().rss
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(_INTERVAL_S):
            self._peak = max(self._peak, self._process.memory_info().rss)

    def taken(self) -> int:
        self._over.set()
        self._thread.join()
        return self._peak - self._before


class _Allocated:
    """Growth of what PyTorch has allocated on a GPU."""

    def __init__(self, device: str) -> None:
        from torch import cuda

        self._cuda, self._device = cuda, device
        cuda.synchronize(device)
        cuda.empty_cache()
        cuda.reset_peak_memory_stats(device)
        self._before = cuda.memory_allocated(device)

    def taken(self) -> int:
        return int(self._cuda.max_memory_allocated(self._device) - self._before)


class _Free:
    """Loss of free memory of a GPU: ONNX Runtime allocates past PyTorch, and keeps what it had."""

    def __init__(self, device: str) -> None:
        from torch import cuda

        self._cuda, self._device = cuda, device
        self._before = cuda.mem_get_info(device)[0]

    def taken(self) -> int:
        return max(self._before - self._cuda.mem_get_info(self._device)[0], 0)


def watch(device: str, mode: str) -> Any:
    """Begin to watch, and return an object whose `taken()` gives the bytes of the peak since then."""
    if device.startswith("cuda"):
        return _Free(device) if mode == "onnx" else _Allocated(device)
    try:
        return _Resident()
    except OSError:
        return _Watched()
