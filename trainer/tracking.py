"""MLflow tracking that needs no server and survives the loss of one.

Without a server everything goes to a local store (`runs/mlflow.db`). With one (`MLFLOW_TRACKING_URI` or the
option `tracking_uri`) runs go there; when it cannot be reached, or breaks away later, training goes on with
the local store, says so once, and `trainer upload` sends the rest afterwards.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from trainer.runs import RunRecord, new_folder

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient
    from PIL.Image import Image

T = TypeVar("T")
RUNS = Path("runs")


def local_store(root: Path) -> str:
    """Return the URI of the local store below `root`, creating the folder."""
    root.mkdir(parents=True, exist_ok=True)
    database = root / "mlflow.db"
    if not os.access(database if database.exists() else root, os.W_OK):
        # MLflow would try again for minutes.
        raise PermissionError(f"the local tracking store {database} cannot be written")
    return f"sqlite:///{(root / 'mlflow.db').resolve()}"


def tracking_uri(given: str | None, root: Path = RUNS) -> str:
    """Return the store to use: the given one, `MLFLOW_TRACKING_URI`, or the local one."""
    return given or os.environ.get("MLFLOW_TRACKING_URI") or local_store(root)


def is_server(uri: str) -> bool:
    """Return whether a store is reached over the network."""
    return uri.startswith(("http://", "https://"))


def unreachable(uri: str, timeout_s: float = 5.0) -> str | None:
    """Return why a tracking server cannot be used, None if it answers.

    Connection errors, timeouts and statuses from 500 count; a request that is refused does not.
    """
    import requests

    try:
        answer = requests.get(f"{uri.rstrip('/')}/health", timeout=timeout_s)
    except requests.RequestException as error:
        return type(error).__name__
    # A proxy may hide or protect the path (401, 403, 404): it answers, so the server is there.
    return f"HTTP status {answer.status_code}" if answer.status_code >= 500 else None


def quiet_mlflow() -> None:
    """Keep MLflow's set-up messages off the terminal and its retries short."""
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # It logs every database error with its traceback, and raises it as well.
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
    # Seven retries with doubling waits would stop training for minutes when a server goes away.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "30")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")


def open_client(uri: str) -> MlflowClient:
    """Return a client of a store; the local store is created if absent."""
    quiet_mlflow()
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=uri, registry_uri=uri)


def experiment_id(client: MlflowClient, uri: str, name: str) -> str:
    """Return the identifier of an experiment, creating it if absent.

    In a local store its artifacts lie beside the database, not below the current directory.
    """
    found = client.get_experiment_by_name(name)
    if found is not None:
        return str(found.experiment_id)
    location = None
    if uri.startswith("sqlite:///"):
        location = (Path(uri.removeprefix("sqlite:///")).parent / "artifacts" / name).as_uri()
    # The kind chooses what the experiment's page shows; without it MLflow takes us for a language model.
    tags = {"mlflow.experimentKind": "custom_model_development"}
    return str(client.create_experiment(name, artifact_location=location, tags=tags))


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
        self._keeps_status = False
        self.evaluation = evaluation
        self._folder: Path | None = None
        self._record: RunRecord | None = None
        self._client: MlflowClient | None = None
        self._monitor: Any = None
        self._params: set[str] = set()

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
        """The run's record, after the run was opened."""
        self.client()
        assert self._record is not None
        return self._record

    @property
    def run_id(self) -> str:
        """Identifier of the MLflow run."""
        return self.record.run_id or ""

    @property
    def uri(self) -> str:
        """Store that the run is in at present."""
        return self.record.tracking_uri or ""

    def client(self) -> MlflowClient:
        """Return the client, opening or continuing the run on first use."""
        if self._client is None:
            self._open()
        assert self._client is not None
        return self._client

    def call(self, action: Callable[[MlflowClient, str], T]) -> T:
        """Do `action(client, run_id)`; if the server breaks away, do it in the local store instead."""
        from mlflow.exceptions import MlflowException

        try:
            return action(self.client(), self.run_id)
        except (MlflowException, OSError) as error:
            if not is_server(self.uri) or unreachable(self.uri) is None:
                raise
            self._fall_back(self.uri, type(error).__name__, self.run_id)
            return action(self.client(), self.run_id)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log numbers at a global step."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        entries = [
            Metric(re.sub(r"[^\w/. -]", "_", key), float(value), now, step or 0)
            for key, value in metrics.items()
            if isinstance(value, (int, float))
        ]
        self.call(lambda client, run: client.log_batch(run, metrics=entries))

    @rank_zero_only
    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Ignore Lightning's own call: the resolved configuration is recorded by `RunRecorder`."""

    @rank_zero_only
    def log_params(self, params: Mapping[str, Any]) -> None:
        """Log parameters that the run does not have yet; a resumed run keeps its first values."""
        from mlflow.entities import Param

        if not self._params:
            self._params = set(self.call(lambda c, run: c.get_run(run)).data.params)
        new = [Param(key, str(value)[:500]) for key, value in params.items() if key not in self._params]
        for start in range(0, len(new), 100):
            self.call(partial(_log_params, new[start : start + 100]))
        self._params.update(params)

    @rank_zero_only
    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Set tags of the run."""
        for key, value in tags.items():
            self.call(partial(_set_tag, key, value))

    @rank_zero_only
    def log_file(self, path: Path, folder: str | None = None) -> None:
        """Store a file with the run."""
        self.call(lambda client, run: client.log_artifact(run, str(path), folder))

    @rank_zero_only
    def log_text(self, text: str, file: str) -> None:
        """Store a text file with the run."""
        self.call(lambda client, run: client.log_text(run, text, file))

    @rank_zero_only
    def log_picture(self, picture: Image, key: str, step: int) -> None:
        """Store a picture as one step of a series that the run's page can play."""
        self.call(lambda client, run: client.log_image(run, picture, key=key, step=step))

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """End the run: `success` or `finished` → FINISHED, anything else → FAILED.

        A run that was continued for evaluation keeps its status, which is that of its training.
        """
        if self._client is None:
            return
        if self._monitor is not None:
            self._monitor.finish()
            self._monitor = None
        if self._keeps_status:
            return
        word = "FINISHED" if status in ("success", "finished") else "FAILED"
        self.call(lambda client, run: client.set_terminated(run, word))

    def _open(self) -> None:
        if self.resume_from is not None:
            self._record = RunRecord.load(self.resume_from)
        uri = tracking_uri(self.given_uri, self.root)
        if self._record is not None and self._record.tracking_uri:
            uri = self._record.tracking_uri
        if is_server(uri) and (reason := unreachable(uri)):
            self._fall_back(uri, reason, self._record.run_id if self._record else None)
            return
        self._client = open_client(uri)
        if self._record is not None and self._continued(self._client):
            self._start_monitor(resumed=True)
            return
        self._create(uri)

    def _continued(self, client: MlflowClient) -> bool:
        from mlflow.exceptions import MlflowException

        assert self._record is not None
        try:
            if self.evaluation:
                client.get_run(self._record.run_id or "")
            else:
                client.set_terminated(self._record.run_id or "", "RUNNING")
        except MlflowException:
            print(
                f"The run {self._record.name} is no longer in its store; a new one takes its place.",
                file=sys.stderr,
            )
            return False
        self._keeps_status = self.evaluation
        return True

    def _create(self, uri: str, unreached_uri: str | None = None, server_run_id: str | None = None) -> None:
        client = self._client
        assert client is not None
        run: Run = client.create_run(
            experiment_id(client, uri, self.experiment_name),
            run_name=self.folder.name,
            tags={"penumbra.folder": str(self.folder)},
        )
        record = RunRecord(
            self.experiment_name, self.folder.name, uri, run.info.run_id, unreached_uri, server_run_id
        )
        record.save(self.folder)
        self._record = record
        self._keeps_status = False
        self._start_monitor(resumed=False)

    def _fall_back(self, server: str, reason: str, server_run: str | None) -> None:
        if self._monitor is not None:
            self._monitor.finish()
            self._monitor = None
        uri = local_store(self.root)
        print(
            f"The tracking server {server} cannot be reached ({reason}). Training goes on with the local "
            f"store; send the run later with `trainer upload {self.folder}`.",
            file=sys.stderr,
        )
        self._params.clear()
        self._client = open_client(uri)
        self._create(uri, unreached_uri=server, server_run_id=server_run)

    def _start_monitor(self, resumed: bool) -> None:
        if not self.system_metrics:
            return
        from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

        self._monitor = SystemMetricsMonitor(
            self.run_id, sampling_interval=10, resume_logging=resumed, tracking_uri=self.uri
        )
        self._monitor.start()


def _first_rank() -> bool:
    return getattr(rank_zero_only, "rank", 0) == 0  # Lightning sets the attribute on its function


def _log_params(params: Sequence[Any], client: MlflowClient, run: str) -> None:
    client.log_batch(run, params=params)


def _set_tag(key: str, value: str, client: MlflowClient, run: str) -> None:
    client.set_tag(run, key, value)
