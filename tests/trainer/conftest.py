"""Tracking stores of the tests: a server on loopback, and local databases that need not be made anew."""

import shutil

import pytest

from tests.tracking_server import Proxy, running


@pytest.fixture(scope="session")
def tracking_server(tmp_path_factory):
    """URI of MLflow's server application, shared by all tests of the session."""
    with running(tmp_path_factory.mktemp("server")) as uri:
        yield uri


@pytest.fixture
def proxy(tracking_server):
    """A proxy before the server, not started, whose faults a test sets."""
    proxy = Proxy(tracking_server)
    yield proxy
    proxy.stop()


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory):
    """An empty local database; making one takes MLflow seconds."""
    from trainer.spool.store import local_store, open_client

    folder = tmp_path_factory.mktemp("store")
    open_client(local_store(folder)).search_experiments()
    return folder / "mlflow.db"


@pytest.fixture
def quick_sending(monkeypatch):
    """Send at once, and give up early."""
    from trainer.spool import sender

    monkeypatch.setattr(sender, "INTERVAL_S", 0.05)
    monkeypatch.setattr(sender, "REST", 0)
    monkeypatch.setattr(sender, "PATIENCE_S", 0.3)
    monkeypatch.setattr(sender.Backoff, "__call__", lambda self: 0.1)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")


@pytest.fixture
def workplace(tmp_path, monkeypatch, empty_store):
    """An empty folder with a local store, and no server named."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "runs").mkdir()
    shutil.copy(empty_store, tmp_path / "runs" / "mlflow.db")
    return tmp_path
