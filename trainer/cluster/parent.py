"""The MLflow run of a search, whose trials are nested below it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainer.cluster.outcome import STOPPED, Trial

if TYPE_CHECKING:
    from trainer.cluster.sweep import Search

RUN_FILE = "mlflow.txt"


@dataclass
class ParentRun:
    """The run; without a tracking store it is none, and the trials stand alone.

    Attributes:
        run_id: Identifier, empty for none.
        client: MLflow's client.
        search: What is searched.
    """

    run_id: str
    client: Any
    search: Search

    @classmethod
    def begin(cls, search: Search, results: Path) -> ParentRun:
        """Open the run, or the one of the search that is resumed."""
        from mlflow.exceptions import MlflowException

        from trainer.tracking import experiment_id, open_client, tracking_uri

        note = results / RUN_FILE
        try:
            uri = tracking_uri(None, Path(search.training.root))
            client = open_client(uri)
            if note.is_file():
                run = note.read_text().strip()
                client.set_terminated(run, "RUNNING")
                return cls(run, client, search)
            experiment = experiment_id(client, uri, search.training.experiment)
            tags = {"tune.search": results.name, "penumbra.folder": str(results)}
            run = client.create_run(experiment, run_name=f"search {results.name}", tags=tags).info.run_id
            for key, entry in search.space.items():
                client.log_param(run, key, f"{entry.kind} {list(entry.values)}"[:500])
            for key in ("trials", "epochs", "metric", "mode", "reduction", "seed"):
                client.log_param(run, f"search.{key}", getattr(search, key))
        except (MlflowException, OSError) as error:
            print(f"note: the search has no run of its own in the tracking store: {error}", file=sys.stderr)
            return cls("", None, search)
        note.write_text(run + "\n")
        return cls(run, client, search)

    def settle(self, trials: Sequence[Trial]) -> None:
        """End the runs of trials that were stopped early; their processes had no time for it."""
        from trainer.tracking import MLflowTracking

        for trial in trials:
            folder = Path(trial.run)
            if trial.state != STOPPED or not trial.run or not (folder / "run.json").is_file():
                continue
            logger = MLflowTracking(
                self.search.training.experiment, root=self.search.training.root, system_metrics=False,
                resume_from=str(folder),
            )  # fmt: skip
            logger.set_tags({"tune.state": f"stopped after epoch {trial.epoch}"})
            logger.finalize("success")

    def end(self, trials: Sequence[Trial], files: Sequence[Path]) -> None:
        """Record what was found, and end the run."""
        if self.client is None:
            return
        from mlflow.exceptions import MlflowException

        best = next((trial for trial in trials if trial.best), None)
        try:
            if best is not None:
                self.client.log_metric(self.run_id, "best/score", best.score)
                self.client.log_metric(self.run_id, "best/ms_per_megapixel", best.cost)
                self.client.set_tag(self.run_id, "tune.best", best.name)
            for path in files:
                self.client.log_artifact(self.run_id, str(path))
            self.client.set_terminated(self.run_id, "FINISHED" if best is not None else "FAILED")
        except (MlflowException, OSError) as error:
            print(f"note: the results are not in the tracking store: {error}", file=sys.stderr)
