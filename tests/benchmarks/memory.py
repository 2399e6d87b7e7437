"""Peak memory of one call: bytes that PyTorch's CPU allocator has handed out at the same time.

The profiler reports every allocation and release; the peak of their running sum, starting at 0 when the
call starts, is what the call needs beyond its inputs. Scratch memory that oneDNN takes for itself is not
seen, in either contestant.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from torch.profiler import ProfilerActivity, profile


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
