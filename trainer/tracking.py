"""MLflow tracking that training never waits for.

What a run records goes into a journal in its folder (`trainer.spool`), at once and in order, and a thread
sends it to the tracking store: the server of `MLFLOW_TRACKING_URI` or of the option `tracking_uri`, or else
a local database (`runs/mlflow.db`). A server may be slow, restart, or be away for days; what it does not have
at the end of a run is sent when the run is continued, or by `trainer sync`.
"""

from __future__ import annotations

import atexit
import io
import re
import sys
import threading
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from trainer.runs import RUN_FILE, RunRecord, new_folder
from trainer.spool.delivery import LIMITS
from trainer.spool.journal import Event, Journal, number
from trainer.spool.machine import Sampler
from trainer.spool.recorded import Recorded
from trainer.spool.sender import Sender, wait_for
from trainer.spool.store import (
    described,
    experiment_id,
    is_server,
    load_mlflow,
    local_store,
    open_client,
    quiet_mlflow,
    tracking_uri,
)

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["MLflowTracking", "experiment_id", "is_server", "local_store", "open_client", "quiet_mlflow",
           "tracking_uri"]  # fmt: skip
INTERRUPTED_WAIT_S = 15.0
"""How long a run that failed or was interrupted waits for its server at the end."""


class MLflowTracking(Logger):
    """Lightning logger of one MLflow run, bound to one run folder.

    Args:
        experiment: Experiment name; also the folder below `root`.
        tracking_uri: Store; `MLFLOW_TRACKING_URI` or the local store where None.
        registered_model: Name under which the exported model is registered; none where empty.
        root: Folder of all runs.
        system_metrics: Record load and memory of the machine every ten seconds.
        resume_from: Run folder to continue; set by the command when a checkpoint of it is given.
        evaluation: Only add scores to the continued run and leave its status; set by the command.
    """

    def __init__(
        self,
        experiment: str = "penumbra",
        tracking_uri: str | None = None,
        registered_model: str | None = None,
        root: str = "runs",
        system_metrics: bool = True,
        resume_from: str | None = None,
        evaluation: bool = False,
    ) -> None:
        super().__init__()
        self.experiment_name = experiment
        self.given_uri = tracking_uri
        self.registered_model = registered_model
        self.root = Path(root)
        self.system_metrics = system_metrics
        self.resume_from = Path(resume_from) if resume_from else None
        self.evaluation = evaluation
        self._folder: Path | None = None
        self._journal: Journal | None = None
        self._recorded = Recorded()
        self._sender: Sender | None = None
        self._sampler: Sampler | None = None
        self._lock = threading.Lock()
        self._limit: int | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> MLflowTracking:
        """Return the logger itself: a copied module, such as one of averaged weights, has the same run."""
        return self

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.experiment_name

    @property
    def version(self) -> str | None:
        """Name of the run; None on other ranks until `share_folder`."""
        return self.folder.name if self._has_folder() else None

    @property
    def save_dir(self) -> str | None:
        """Folder of the run; None on other ranks until `share_folder`."""
        return str(self.folder) if self._has_folder() else None

    @property
    def folder(self) -> Path:
        """Folder of the run, created on first use by the first rank.

        Raises:
            RuntimeError: Another rank asks before `share_folder` was called.
        """
        if self._folder is None:
            if not self._has_folder():
                raise RuntimeError(
                    "only the first rank knows the run's folder; call share_folder on all ranks"
                )
            self._folder = self.resume_from or new_folder(self.root, self.experiment_name)
        return self._folder

    def share_folder(self, broadcast: Callable[[str], str]) -> Path:
        """Let every rank know the folder that the first one created; to be called on all ranks.

        Args:
            broadcast: Sends the first rank's text to all, as `trainer.strategy.broadcast` does.
        """
        shared = broadcast(str(self.folder.resolve()) if _first_rank() else "")
        if not _first_rank():
            self._folder = Path(shared)
        return Path(shared)

    def _has_folder(self) -> bool:
        # A folder that another rank creates would be an empty run beside the real one.
        return _first_rank() or self._folder is not None

    @property
    def record(self) -> RunRecord:
        """The run's record as it is now; its `run_id` is None until the store has answered."""
        if not (self.folder / RUN_FILE).exists():
            self._open()
        return RunRecord.load(self.folder)

    @property
    def run_id(self) -> str:
        """Identifier of the MLflow run, empty until the store has answered."""
        return self.record.run_id or ""

    @property
    def uri(self) -> str:
        """Store that the run is sent to."""
        return self.record.tracking_uri or ""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Record numbers at a global step, unless they are recorded already.

        Of a step that is trained again after a kill the first numbers stay. Only an evaluation records
        another number at a step that has one.
        """
        step = step or 0
        values = {
            re.sub(r"[^\w/. -]", "_", key): float(value)
            for key, value in metrics.items()
            if isinstance(value, (int, float))
        }
        self._open()
        known = self._recorded.has_equal if self.evaluation else self._known
        new = {key: number(value) for key, value in values.items() if not known(key, step, value)}
        if new:
            self._append({"type": "metrics", "step": step, "values": new})

    def _known(self, key: str, step: int, value: float) -> bool:
        return self._recorded.has_value(key, step)

    @rank_zero_only
    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Ignore Lightning's own call: the resolved configuration is recorded by `RunRecorder`."""

    def log_params(self, params: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
        """Record parameters; one that is recorded keeps its first value, as MLflow demands.

        Returns:
            What differs: the first value and the given one by name.
        """
        if not _first_rank():
            return {}
        self._open()
        texts = {key: str(value)[: LIMITS["params"]] for key, value in params.items()}
        first = self._recorded.params
        if new := {key: text for key, text in texts.items() if key not in first}:
            self._append({"type": "params", "values": new})
        return {key: (first[key], text) for key, text in texts.items() if first[key] != text}

    @rank_zero_only
    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Set tags of the run."""
        self._open()
        self._append({"type": "tags", "values": {key: str(value) for key, value in tags.items()}})

    @rank_zero_only
    def log_file(self, path: Path, folder: str | None = None) -> None:
        """Store a file with the run, as it is now."""
        to = f"{folder}/{path.name}" if folder else path.name
        self._append_new({"type": "file", "to": to, **self._opened().keep(path)})

    @rank_zero_only
    def log_text(self, text: str, file: str) -> None:
        """Store a text file with the run."""
        kept = self._opened().keep_bytes(text.encode(), Path(file).name)
        self._append_new({"type": "file", "to": file, **kept})

    @rank_zero_only
    def log_picture(self, picture: Image, key: str, step: int) -> None:
        """Store a picture as one step of a series that the run's page can play."""
        event: Event = {"type": "picture", "key": re.sub(r"[^\w/. -]", "_", key), "step": step}
        self._open()
        if not self._recorded.has(event):
            data = io.BytesIO()
            picture.save(data, "png")
            self._append(event | self._opened().keep_bytes(data.getvalue(), "picture.png"))

    @rank_zero_only
    def log_model(self, path: Path, name: str, weights: str) -> None:
        """Register an exported ONNX file as a version of a model, once for the same weights.

        Args:
            path: What `trainer.export.export` wrote.
            name: Name of the registered model.
            weights: Which weights these are, as `trainer.export.register.weights_of` says it.
        """
        import mlflow.onnx  # noqa: F401  # see `load_mlflow`

        event: Event = {"type": "model", "name": name, "weights": weights}
        self._open()
        if not self._recorded.has(event):
            self._append(event | self._opened().keep(path))

    @rank_zero_only
    def before_checkpoint(self) -> None:
        """Write down what waits for disk space: a run that continues from the checkpoint would lack it.

        Raises:
            OSError: There is no space; the checkpoint must not be saved.
        """
        if self._journal is not None and not self._journal.flush():
            raise OSError(
                f"cannot write {self._journal.path}: the disk is full; continue with --ckpt_path last"
            )
        if self._journal is not None:
            self._journal.sync()

    def deliver_up_to(self, offset: int | None) -> None:
        """Keep from the store what lies behind an offset in bytes of the journal; None: nothing.

        For what mirrors a run: where the run goes on from a mirror that lacks what the store has, that would
        be recorded again, with other times, and be in the store twice.
        """
        self._limit = offset
        if self._sender is not None:
            self._sender.deliver_up_to(offset)

    def flush(self, wait_s: float | None = None) -> int:
        """Wait until the store has everything; returns the number of events that it does not have.

        Args:
            wait_s: Longest wait in seconds; as at the end of a run where None.
        """
        self._open()
        assert self._sender is not None
        return self._sender.drain(wait_for(self.uri) if wait_s is None else wait_s)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """End the run: `success` or `finished` → FINISHED, anything else → FAILED.

        A run that was continued for evaluation keeps its status, which is that of its training. What the
        store does not take in time stays in the journal.
        """
        if self._journal is None:
            return
        if self._sampler is not None:
            self._sampler.stop()
        done = status in ("success", "finished")
        event: Event = {"type": "status", "status": "FINISHED" if done else "FAILED"}
        if not self.evaluation or not self._recorded.trained:
            self._append(event | ({"evaluation": True} if self.evaluation else {}))
        wait = wait_for(self.uri)
        rest = self.flush(wait if done else min(wait, INTERRUPTED_WAIT_S))
        self._close()
        if rest:
            print(
                f"{rest} events of the run are not in {described(self.uri)} yet; "
                f"`trainer sync {self.folder}` sends them.",
                file=sys.stderr,
            )

    def _opened(self) -> Journal:
        self._open()
        assert self._journal is not None
        return self._journal

    def _open(self) -> None:
        """Begin or continue the run, without a word to the server."""
        if self._journal is not None:
            return
        uri = self._begin_record()
        self._recorded = Recorded.of(self.folder)
        folder = self.folder.resolve()  # the current directory may change
        self._journal = Journal(folder, self._recorded.last_ms)
        if not self._recorded.id:
            self._append({"type": "run", "id": uuid.uuid4().hex})
        if not self.evaluation:
            self._append({"type": "status", "status": "RUNNING"})
        quiet_mlflow(retries=0)
        load_mlflow(uri)
        self._sender = Sender(folder, self._journal)
        self._sender.deliver_up_to(self._limit)
        self._sender.start()
        atexit.register(self._close)
        if self.system_metrics:
            self._sampler = Sampler(self._record_machine, self._recorded.next_step("system/"))
            self._sampler.start()

    def _begin_record(self) -> str:
        """Return the store of the run; a new one is noted."""
        if self.resume_from is not None or (self.folder / RUN_FILE).exists():
            record = RunRecord.load(self.folder)
            if record.tracking_uri:
                return record.tracking_uri
        else:
            record = RunRecord(self.experiment_name, self.folder.name)
        record.tracking_uri = tracking_uri(self.given_uri, self.root)
        record.save(self.folder)
        return record.tracking_uri

    def _record_machine(self, numbers: dict[str, float], step: int) -> None:
        self._append({"type": "metrics", "step": step, "values": numbers})

    def _append_new(self, event: Event) -> None:
        if not self._recorded.has(event):
            self._append(event)

    def _append(self, event: Event) -> None:
        assert self._journal is not None
        with self._lock:
            self._journal.append(event)
            self._recorded.add({"t": 0, **event})

    def _close(self) -> None:
        """Stop the threads and close the journal; the logger can be used again."""
        atexit.unregister(self._close)
        if self._journal is None or self._sender is None:
            return
        if self._sampler is not None:
            self._sampler.stop()
            self._sampler = None
        self._sender.stop()
        lost = self._journal.close()
        self._journal = self._sender = None
        if lost:
            print(
                f"The disk is full: {lost} events of {self.folder} could not be written. They are recorded "
                "again when the run continues with --ckpt_path last.",
                file=sys.stderr,
            )


def _first_rank() -> bool:
    return getattr(rank_zero_only, "rank", 0) == 0  # Lightning sets the attribute on its function
