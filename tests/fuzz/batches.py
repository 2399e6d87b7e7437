"""Many altered inputs in processes that may be killed, and may take no more memory than is stated.

A format is a module of this package that says what is altered and what reads it:

    BOUND                          bytes that reading may take more than the process has
    extra(folder)                  as many more for this input
    SLACK                          optional: bytes that it could take, which are then a violation
    bases()                        inputs that can be read: a list of name of a file → content
    mutated(bases, seed, number)   input `number`, always the same
    read_all(folder)               read the input; ValueError and OSError refuse it

The end of a process by a signal, another exception, `SECONDS` for one input and running out of memory are
violations: the input is kept in a folder, and the next process goes on behind it.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from tests.fuzz.bytewise import Files

SECONDS = 60
BATCH = 2500
MOST = 20
"""Violations after which a run stops."""

_NO_MEMORY = re.compile(
    r"MemoryError|bad_alloc|bad allocation|can.t allocate|[Cc]annot allocate|out of memory"
)


class Violation(Exception):  # noqa: N818  # what is looked for
    """An input was refused for a reason that is none."""


@dataclass
class Outcome:
    """What came of the inputs of one format.

    Attributes:
        counts: `read` and `refused` → number of inputs.
        violations: What happened, and where the input is kept.
        peak: Most bytes that reading one input took.
        share: Largest part of what an input may take that was taken.
        seconds: Wall time.
    """

    counts: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    peak: int = 0
    share: float = 0.0
    seconds: float = 0.0

    def add(self, other: Outcome) -> None:
        """Take in the outcome of other inputs."""
        self.counts.update(other.counts)
        self.violations += other.violations
        self.peak, self.share = max(self.peak, other.peak), max(self.share, other.share)


def measure(name: str, count: int, seed: int = 1, processes: int = 1) -> Outcome:
    """Read `count` altered inputs of the format `name`, in processes of their own.

    Args:
        name: Module of this package.
        count: Number of inputs.
        seed: Another gives other inputs.
        processes: How many work at a time.
    """
    began, total = time.monotonic(), Outcome()
    size = min(BATCH, -(-count // processes))
    spans = [(first, min(first + size, count)) for first in range(0, count, size)]
    with ThreadPoolExecutor(processes) as pool:
        for outcome in pool.map(lambda span: _span(name, *span, seed, total), spans):
            total.add(outcome)
    total.seconds = time.monotonic() - began
    return total


def run(name: str, count: int, seed: int = 1) -> dict[str, int]:
    """Do as `measure`.

    Returns:
        Number of inputs that were read, and that were refused.

    Raises:
        AssertionError: An input was neither; says what happened and where it is kept.
    """
    outcome = measure(name, count, seed)
    assert not outcome.violations, "\n".join(outcome.violations)
    return dict(outcome.counts)


def _span(name: str, first: int, last: int, seed: int, total: Outcome) -> Outcome:
    outcome = Outcome()
    while first < last and len(total.violations) + len(outcome.violations) < MOST:
        with tempfile.TemporaryDirectory(prefix="penumbra-fuzz-") as folder:
            words = ("-m", "tests.fuzz.batches", name, str(first), str(last), str(seed), folder)
            done = subprocess.run(
                (sys.executable, *words), env={**os.environ, "OMP_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False,
            )  # fmt: skip
            state = json.loads((Path(folder) / "state").read_text() or "{}") if _began(folder) else {}
            outcome.add(
                Outcome(Counter(state.get("counts", {})), [], state.get("peak", 0), state.get("share", 0.0))
            )
            if done.returncode == 0:
                break
            if not state:
                raise RuntimeError(f"{name}: no input was read: {done.stderr[-3000:]}")
        how = f"signal {-done.returncode}" if done.returncode < 0 else done.stderr.strip()[-1500:]
        number = state["number"]
        outcome.violations.append(
            f"{name}, input {number} of seed {seed}, kept in {keep(name, seed, number)}: {how}"
        )
        first = number + 1
    return outcome


def _began(folder: str) -> bool:
    return (Path(folder) / "state").is_file()


def keep(name: str, seed: int, number: int) -> Path:
    """Write an input where it can be looked at, and return the folder."""
    module = _format(name)
    folder = Path(tempfile.gettempdir()) / "penumbra-fuzz" / f"{name}-{seed}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    write(module.mutated(module.bases(), seed, number), folder)
    return folder


def write(files: Files, folder: Path) -> None:
    """Write an input; names are those of the base, so they stay in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _format(name: str) -> ModuleType:
    return importlib.import_module(f"tests.fuzz.{name}")


def batch(module: ModuleType, first: int, last: int, seed: int, folder: Path) -> None:
    """Read inputs `first` to `last` in this process, within bounds; `folder` takes what came of them."""
    bases = module.bases()
    root = folder / "input"
    for base in bases:
        write(base, root)
        module.read_all(root)
        shutil.rmtree(root)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    counts: Counter[str] = Counter()
    peak, share = 0, 0.0
    with (folder / "state").open("w") as file:
        for number in range(first, last):
            state = {"number": number, "counts": counts, "peak": peak, "share": share}
            file.seek(0)
            file.write(f"{json.dumps(state):<200}")
            file.flush()
            write(module.mutated(bases, seed, number), root)
            signal.alarm(SECONDS)
            before = _limit(module.BOUND)
            most = module.BOUND + module.extra(root)
            _limit(most + getattr(module, "SLACK", 0))
            counts[_one(module, root)] += 1
            signal.alarm(0)
            took = _memory("VmHWM") - before
            if took > most:
                raise Violation(f"it took {took >> 20} MiB of memory, its bound are {most >> 20} MiB")
            peak, share = max(peak, took), max(share, took / most)
            shutil.rmtree(root)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    (folder / "state").write_text(
        json.dumps({"number": last, "counts": counts, "peak": peak, "share": share})
    )


def _one(module: ModuleType, root: Path) -> str:
    try:
        module.read_all(root)
    except (ValueError, OSError) as error:
        reason: BaseException | None = error
        while reason is not None:
            if _NO_MEMORY.search(f"{type(reason).__name__} {reason}"):
                raise Violation("it took more memory than its bound") from error
            reason = reason.__cause__ or reason.__context__
        return "refused"
    return "read"


def _limit(most: int) -> int:
    """Let the process take `most` bytes more than it has; returns what is resident, and resets the peak."""
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + most, resource.RLIM_INFINITY))
    Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS")


def _memory(name: str) -> int:
    return int(re.search(rf"^{name}:\s+(\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)[1]) << 10  # type: ignore[index]


def main(words: list[str]) -> None:
    """Work on a part of the inputs, as the process that `measure` starts."""
    batch(_format(words[0]), *map(int, words[1:4]), Path(words[4]))


if __name__ == "__main__":
    main(sys.argv[1:])
