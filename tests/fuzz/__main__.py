"""`python -m tests.fuzz --count 20000`: altered files of every format through what reads them.

Prints a line for each format: how many inputs were read and refused, how many were neither (violations), and
the memory that one input took at most, beside what it may take. Exits with 1 where there are violations;
their inputs are kept in the folder that is named.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time

from tests.fuzz import batches, shards

FORMATS = ("shards", "exr", "checkpoints", "artifacts", "records")
WIDTHS = (8, 8, 9, 12, 11, 9, 10)


def measure(name: str, count: int, seed: int, processes: int) -> batches.Outcome:
    """Return what came of the inputs of one format."""
    if name != "shards":
        return batches.measure(name, count, seed, processes)
    began, outcome = time.monotonic(), batches.Outcome()
    try:
        outcome.counts.update(shards.run(count, seed))
    except AssertionError as error:
        outcome.violations.append(str(error))
    outcome.peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss << 10
    outcome.seconds = time.monotonic() - began
    return outcome


def row(name: str, outcome: batches.Outcome) -> str:
    """Return the line of one format."""
    counts, violations = outcome.counts, len(outcome.violations)
    share = f"{100 * outcome.share:7.0f} %" if outcome.share else "  process"
    return (
        f"{name:<12}{sum(counts.values()) + violations:>8}{counts['read']:>8}{counts['refused']:>9}"
        f"{violations:>12}{outcome.peak >> 20:>7} MiB{share}{outcome.seconds:>8.0f} s"
    )


def main() -> int:
    """Return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("formats", nargs="*", choices=[*FORMATS, []], help="all where none is named")
    parser.add_argument("--count", type=int, default=20_000, help="inputs of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    words = parser.parse_args()
    heads = zip(("inputs", "read", "refused", "violations", "peak", "of bound", "time"), WIDTHS, strict=True)
    print(f"{'format':<12}" + "".join(f"{head:>{width}}" for head, width in heads), flush=True)
    violations: list[str] = []
    for name in words.formats or FORMATS:
        outcome = measure(name, words.count, words.seed, words.processes)
        print(row(name, outcome), flush=True)
        violations += outcome.violations
    for violation in violations:
        print(f"\n{violation}", file=sys.stderr)
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
