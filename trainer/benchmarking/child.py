"""The process that measures one case, told what to do in lines of JSON on its standard input.

    {"case": {...}, "file": null, "warmup": 2}  →  {"ready": {...}}
    {"calls": 3}                                →  {"seconds": [...]}
    {"end": true}                               →  {"end": {...}}, and it ends
    {"export": {...}, "format": "onnx", "path": "…"}  →  {"exported": "…"}, and it ends

Before an answer may come `{"stage": "…"}`. What cannot be measured is answered by `{"failed": "why"}`. The
process ends when its input does, which is when whoever started it is gone.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from trainer.benchmarking.cases import Case, Method

NO_MEMORY = ("can't allocate memory", "bad allocation", "bad_alloc", "Failed to allocate")
LONGEST = 600
"""Characters of a reason."""


class Timer:
    """Measures calls, on a GPU by its own events.

    Args:
        call: What to measure.
        case: Where it runs.
    """

    def __init__(self, call: Callable[[], None], case: Case) -> None:
        self._call = call
        self._cuda = case.device if case.device.startswith("cuda") else None
        self._events = self._cuda is not None and case.mode != "onnx"  # whose work PyTorch does not see
        self._busy = self._own = 0.0

    def __call__(self, calls: int) -> list[float]:
        """Return the seconds of every call."""
        busy, own = _busy_seconds(), time.process_time()
        seconds = self._by_events(calls) if self._events else self._by_clock(calls)
        self._busy += _busy_seconds() - busy
        self._own += time.process_time() - own
        return seconds

    def others(self, wall: float) -> float:
        """Return the share of all cores that other programs took while calls were measured for so long."""
        cores = os.cpu_count() or 1
        return min(max(self._busy - self._own, 0.0) / max(wall * cores, 1e-9), 1.0)

    def _by_clock(self, calls: int) -> list[float]:
        seconds = []
        for _ in range(calls):
            start = time.perf_counter()
            self._call()
            if self._cuda:
                _synchronize(self._cuda)
            seconds.append(time.perf_counter() - start)
        return seconds

    def _by_events(self, calls: int) -> list[float]:
        import torch

        assert self._cuda is not None
        seconds = []
        with torch.cuda.device(self._cuda):
            for _ in range(calls):
                start, stop = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                start.record()
                self._call()
                stop.record()
                stop.synchronize()
                seconds.append(start.elapsed_time(stop) / 1e3)
        return seconds


def _synchronize(device: str) -> None:
    import torch

    torch.cuda.synchronize(device)


def _busy_seconds() -> float:
    """Return the seconds that all cores together have worked since the machine started."""
    import psutil

    times = psutil.cpu_times()._asdict()
    # What virtual machines take is in `user` and `nice`, too.
    return float(sum(times[n] for n in times if n not in ("idle", "iowait", "guest", "guest_nice")))


class Child:
    """Answers the commands.

    Args:
        commands: Next command; None ends.
        answer: Sends an answer.
    """

    def __init__(self, commands: Callable[[], Any], answer: Callable[[dict[str, Any]], None]) -> None:
        self._commands, self._answer = commands, answer

    def run(self) -> None:
        """Do what the first command says."""
        first = self._commands()
        if "export" in first:
            self._export(first)
            return
        method = Method(first["case"]["method"]["model"], tuple(first["case"]["method"]["options"]))
        self._measure(Case(**{**first["case"], "method": method}), first)

    def _measure(self, case: Case, first: dict[str, Any]) -> None:
        self._answer({"stage": "loading"})
        import torch

        from trainer.benchmarking.memory import watch
        from trainer.benchmarking.subject import Subject
        from trainer.commands.denoise import check_device

        if case.device != "cpu":
            check_device(case.device)
        subject = Subject(case, Path(first["file"]) if first["file"] else None)
        case = replace(case, mode=subject.mode)
        timer = Timer(subject, case)
        self._answer({"stage": "compiling" if case.mode == "compiled" else "first call"})
        compiled: list[float] = []
        if case.mode == "compiled":  # the compiler's own memory is not the model's
            compiled = timer(1)
        subject.settle()
        memory = watch(case.device, case.mode)
        first_seconds = timer(1)
        self._answer({"stage": "warming up"})
        timer(max(first["warmup"] - 1, 0))
        timer = Timer(subject, case)
        cuda = case.device.startswith("cuda")
        self._answer({"ready": {
            "first_seconds": (compiled or first_seconds)[0],
            "mode": subject.mode,
            "megapixels": subject.megapixels,
            "threads": torch.get_num_threads(),
            "device_name": torch.cuda.get_device_name(case.device) if cuda else None,
        }})  # fmt: skip
        wall = 0.0
        while "calls" in (command := self._commands()):
            start = time.perf_counter()
            seconds = timer(command["calls"])
            wall += time.perf_counter() - start
            self._answer({"seconds": seconds})
        self._answer({"end": {"peak_bytes": memory.taken(), "others": timer.others(wall)}})

    def _export(self, command: dict[str, Any]) -> None:
        self._answer({"stage": "exporting"})
        import torch

        from models.denoiser import Denoiser
        from trainer.benchmarking.subject import load
        from trainer.export import export

        torch.manual_seed(0)
        method = Method(command["export"]["model"], tuple(command["export"]["options"]))
        model = load(method, "cpu")
        if not isinstance(model, Denoiser):
            raise ValueError(
                f"an exported file of the format {model.description.format} is not exported again"
            )
        export(model, command["path"], command["format"])
        self._answer({"exported": command["path"]})


def reason_of(error: BaseException) -> str:
    """Return in one line why something cannot be measured."""
    text = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    text = text[:LONGEST]
    if "out of memory" in text:
        return text
    if isinstance(error, MemoryError) or any(part in text for part in NO_MEMORY):
        return f"out of memory: {text}".removesuffix(": ")
    if isinstance(error, (ValueError, OSError)):
        return text or type(error).__name__
    return f"{type(error).__name__}: {text}".removesuffix(": ")


def main() -> None:
    """Serve standard input until it ends."""
    # Libraries may print: answers go to a channel of their own.
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    with suppress(OSError):  # where memory runs out, this process shall be the one that ends
        Path("/proc/self/oom_score_adj").write_text("1000")
    commands: queue.Queue[Any] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            commands.put(json.loads(line))
        os._exit(1)

    def answer(content: dict[str, Any]) -> None:
        channel.write(json.dumps(content) + "\n")

    threading.Thread(target=read, daemon=True).start()
    try:
        Child(commands.get, answer).run()
    except Exception as error:
        if not isinstance(error, (ValueError, OSError, MemoryError)):
            import traceback

            traceback.print_exc()
        answer({"failed": reason_of(error)})
    channel.flush()
    os._exit(0)  # without waiting for threads of libraries
