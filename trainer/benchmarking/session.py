"""One run of `trainer benchmark`: measure or compare in order, keep what is done, tell how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from trainer.benchmarking.cases import Case, Effort, Outcome
from trainer.benchmarking.measuring import Watcher, exports, measure
from trainer.benchmarking.pairing import Comparison, Contestant, compare
from trainer.benchmarking.revisions import unpacked
from trainer.benchmarking.table import seconds_text

if TYPE_CHECKING:
    from trainer.progress import FrameProgress

Keep = Callable[[Sequence[Outcome], Sequence[Comparison]], object]


@dataclass
class Session:
    """What has been measured so far, and who is told.

    Attributes:
        progress: Counts cases or comparisons.
        effort: How long to measure each.
        processes: Pairs of processes of a comparison.
        keep: Called with all that is done after every case or comparison, before it is told.
        outcomes: Of all cases that were measured, or failed.
        comparisons: All that were made.
    """

    progress: FrameProgress
    effort: Effort
    processes: int = 5
    keep: Keep = lambda outcomes, comparisons: None
    outcomes: list[Outcome] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)

    def measure(self, cases: Iterable[Case]) -> None:
        """Measure every case in a process of its own."""
        with exports() as made:
            for case in cases:
                outcome = measure(case, self.effort, made, self._watcher(case.label))
                self.outcomes.append(outcome)
                said = seconds_text(outcome.median) if outcome.done else f"failed: {outcome.reason}"
                self._advance(f"{case.label}: {said}")

    def compare_models(self, pairs: Iterable[tuple[Case, Case]]) -> None:
        """Compare cases of two models."""
        with exports() as made:
            for one, other in pairs:
                self._compare(*(Contestant(case.method.label, case, made) for case in (one, other)))

    def compare_revisions(self, cases: Iterable[Case], revisions: Sequence[str]) -> None:
        """Compare cases in two revisions.

        Raises:
            ValueError: There is no such revision.
        """
        old, new = revisions
        with unpacked(revisions) as places, exports(places[old]) as first, exports(places[new]) as second:
            for case in cases:
                sides = ((old, first), (new, second))
                self._compare(*(Contestant(name, replace(case, revision=name), made) for name, made in sides))

    def _compare(self, one: Contestant, other: Contestant) -> None:
        label = " ".join(value for name, value in one.case.settings.items() if name != "model")
        label = f"{one.name} and {other.name} {label}"
        comparison = compare(one, other, self.effort, self.processes, self._watcher(label))
        self.comparisons.append(comparison)
        self.outcomes += comparison.sides
        said = f"{comparison.ratio:.3f}" if comparison.done else "failed"
        self._advance(f"{label}: {said}")

    def _advance(self, said: str) -> None:
        self.keep(self.outcomes, self.comparisons)
        with suppress(BrokenPipeError):  # nobody reads how far it is; figures are kept all the same
            self.progress.advance(self._plain(said))

    def _watcher(self, label: str) -> Watcher:
        def tell(stage: str) -> None:
            self.progress.doing(self._plain(f"{label}: {stage}"))

        return Watcher(tell, self.progress.within)

    def _plain(self, text: str) -> str:
        """Return what shows the text as it is: a bar reads brackets, as a path may hold, as markup."""
        if self.progress.bar is None:
            return text
        from rich.markup import escape

        return escape(text)
