"""Peak memory of one call: bytes that PyTorch's CPU allocator has handed out at the same time.

The profiler reports every allocation and release; the peak of their running sum, starting at 0 when the
call starts, is what the call needs beyond its inputs. Scratch memory that oneDNN takes for itself is not
seen, in either contestant.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable
from typing import Any

from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def peak_bytes(call: Callable[[], object]) -> int:
    """Run `call` once and return its peak of allocated bytes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with profile(activities=[ProfilerActivity.CPU], profile_memory=True, acc_events=True) as recorded:
            result = call()
    profiler = recorded.profiler
    assert profiler is not None
    assert profiler.kineto_results is not None
    events = [event for event in profiler.kineto_results.events() if event.name() == "[memory]"]
    current = peak = 0
    for event in sorted(events, key=lambda event: event.start_ns()):
        current += event.nbytes()
        peak = max(peak, current)
    del result
    return peak


def live_bytes(call: Callable[[], object]) -> int:
    """Run `call` once and return the most bytes of new tensors that were alive at the same time.

    What operators allocate inside and release again is not seen; in return this costs a fraction of
    `peak_bytes`, which takes part in every allocation.
    """
    with _Live() as live:
        result = call()
    del result
    return live.peak


class _Live(TorchDispatchMode):
    """Counts the storages that operators return, until they are released."""

    def __init__(self) -> None:
        super().__init__()
        self.current = self.peak = 0
        self.known: dict[int, Any] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        for tensor in _tensors((args, kwargs)):
            self._meet(tensor, 0)
        result = func(*args, **(kwargs or {}))
        for tensor in _tensors(result):
            self._meet(tensor, tensor.untyped_storage().nbytes())
        return result

    def _meet(self, tensor: Tensor, size: int) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self.known:
            return

        def released(_: object) -> None:
            self.current -= size
            del self.known[key]

        self.known[key] = weakref.ref(storage, released)
        self.current += size
        self.peak = max(self.peak, self.current)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]
