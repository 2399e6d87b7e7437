"""The MLflow run of a search, whose trials are nested below it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.cluster.outcome import FINISHED, RUNNING, STOPPED, Trial
from trainer.cluster.trials import launch_of
from trainer.runs import RUN_FILE, Launch, RunRecord, end_launch, run_of_launch
from trainer.spool.store import described, tracking_uri
from trainer.tracking import MLflowTracking

if TYPE_CHECKING:
    from trainer.cluster.sweep import Search

WAIT_S = 30.0
"""Seconds that a search waits for the tracking store before its first trial."""


class ParentRun:
    """The run, recorded in the search's folder as every run is: what a store lacks is sent by `trainer sync`.

    Args:
        search: What is searched.
        results: Folder of the search; that of one that is resumed has a run already.
    """

    def __init__(self, search: Search, results: Path) -> None:
        self._search, self._results = search, results
        training = search.training
        if not (results / RUN_FILE).exists():
            uri = tracking_uri(training.tracking_uri, Path(training.root))
            RunRecord(training.experiment, f"search {results.name}", uri).save(results)
        self._logger = self._opened(results)
        self._logger.set_tags({"tune.search": results.name})
        space = {key: f"{entry.kind} {list(entry.values)}"[:500] for key, entry in search.space.items()}
        keys = ("trials", "epochs", "metric", "mode", "reduction", "seed")
        self._logger.log_params(space | {f"search.{key}": getattr(search, key) for key in keys})
        self._logger.flush(WAIT_S)
        self.run_id = self._logger.run_id
        """Identifier in the tracking store, empty where that cannot be reached: trials then stand alone."""
        if not self.run_id:
            print(
                f"note: {described(self._logger.uri)} cannot be reached; the trials will not be nested below "
                "the run of the search",
                file=sys.stderr,
            )

    def _opened(self, folder: Path) -> MLflowTracking:
        training = self._search.training
        return MLflowTracking(
            training.experiment, root=training.root, system_metrics=False, resume_from=str(folder)
        )

    def settle(self, trials: Sequence[Trial]) -> None:
        """End the runs of trials whose processes were ended and had no time for it."""
        training = self._search.training
        for trial in trials:
            launch = Launch(launch_of(self._results.name, trial.name), unfinished=True)
            folder = run_of_launch(launch, Path(training.root), training.experiment)
            if folder is None:
                continue  # it ended by itself, or never began
            logger = self._opened(folder)
            logger.set_tags({"tune.state": f"{trial.state} after epoch {trial.epoch}"})
            logger.finalize("success" if trial.state == STOPPED else "failed")
            if trial.state == STOPPED:
                end_launch(folder)

    def keep(self, trials: Sequence[Trial], files: Sequence[Path]) -> None:
        """Record what was found."""
        best = next((trial for trial in trials if trial.best), None)
        if best is not None:
            found = {"best/score": best.score, "best/ms_per_megapixel": best.cost}
            trained = sum(trial.state == FINISHED for trial in trials)
            self._logger.log_metrics(found, trained)  # a search that is resumed finds another best later
            self._logger.set_tags({"tune.best": best.name})
        for path in files:
            self._logger.log_file(path)

    def end(self, trials: Sequence[Trial]) -> None:
        """End the run, well where nothing was interrupted and a trial was trained."""
        good = any(trial.best for trial in trials) and all(trial.state != RUNNING for trial in trials)
        self._logger.finalize("success" if good else "failed")
