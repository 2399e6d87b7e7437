"""Tracking stores: a server, or a database below the folder of runs; their clients."""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from data.remote_patience import shown

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

RUNS = Path("runs")


def local_store(root: Path) -> str:
    """Return the URI of the local store below `root`, creating the folder.

    Raises:
        PermissionError: It cannot be written; MLflow would try again for minutes.
    """
    root.mkdir(parents=True, exist_ok=True)
    database = root / "mlflow.db"
    if not os.access(database if database.exists() else root, os.W_OK):
        raise PermissionError(f"the local tracking store {database} cannot be written")
    return f"sqlite:///{(root / 'mlflow.db').resolve()}"


def tracking_uri(given: str | None, root: Path = RUNS) -> str:
    """Return the store to use: the given one, `MLFLOW_TRACKING_URI`, or the local one."""
    return given or os.environ.get("MLFLOW_TRACKING_URI") or local_store(root)


def is_server(uri: str) -> bool:
    """Return whether a store is reached over the network."""
    return uri.startswith(("http://", "https://"))


def described(uri: str) -> str:
    """Return what to call a store in messages."""
    return f"the tracking server {shown(uri)}" if is_server(uri) else f"the tracking store {shown(uri)}"


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


def quiet_mlflow(retries: int = 2) -> None:
    """Keep MLflow's set-up messages off the terminal and its retries short.

    Args:
        retries: How often a request is repeated, unless `MLFLOW_HTTP_REQUEST_MAX_RETRIES` says it. MLflow's
            own seven, with doubling waits, take minutes.
    """
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # It logs every database error with its traceback, and raises it as well.
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", str(retries))
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "30")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    # A bar for every uploaded file would break the one of the training.
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")


def load_mlflow(uri: str) -> None:
    """Import what a client of a store needs.

    To be called on the main thread: imports on two threads at once may see each other's half-made modules.
    """
    import mlflow.artifacts
    import mlflow.tracking

    if uri.startswith("sqlite:"):
        import mlflow.store.model_registry.sqlalchemy_store
        import mlflow.store.tracking.sqlalchemy_store  # noqa: F401


def open_client(uri: str) -> MlflowClient:
    """Return a client of a store; the local store is created if absent."""
    quiet_mlflow()
    from mlflow.tracking import MlflowClient

    database = Path(uri.removeprefix("sqlite:///"))
    if uri.startswith("sqlite:///") and not database.exists():
        _make_database(database)
    return MlflowClient(tracking_uri=uri, registry_uri=uri)


def _make_database(path: Path) -> None:
    """Make a database beside its name and give it that when it is complete.

    MLflow makes dozens of tables one by one; whoever is killed meanwhile would leave some, with which it
    never opens the database again.
    """
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    partial = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        store = SqlAlchemyStore(f"sqlite:///{partial}", "./mlruns")  # of the experiment "Default", never used
        store.engine.dispose()
        try:
            os.link(partial, path)
        except FileExistsError:
            pass  # another run was faster
        except OSError:  # a file system without links
            if not path.exists():
                os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def experiment_id(client: MlflowClient, uri: str, name: str) -> str:
    """Return the identifier of an experiment, creating it if absent.

    In a local store its artifacts lie beside the database, not below the current directory.
    """
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is not None:
        return str(found.experiment_id)
    location = None
    if uri.startswith("sqlite:///"):
        location = (Path(uri.removeprefix("sqlite:///")).parent / "artifacts" / name).as_uri()
    # The kind chooses what the experiment's page shows; without it MLflow takes us for a language model.
    tags = {"mlflow.experimentKind": "custom_model_development"}
    try:
        return str(client.create_experiment(name, artifact_location=location, tags=tags))
    except MlflowException:
        found = client.get_experiment_by_name(name)  # another run may have been faster
        if found is None:
            raise
        return str(found.experiment_id)
