"""Ray, started on this machine or reached in a cluster, and kept as quiet as the commands that use it."""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from trainer.configs import UsageError

PACKAGE = "penumbra-denoise"
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # future behaviour, without the warning about it
    "RAY_TRAIN_ENABLE_PRINT_PATCH": "0",
    "RAY_TRAIN_METRICS_ENABLED": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.5",
    "RAY_TRAIN_WORKER_GROUP_START_TIMEOUT_S": "300",
    "RAY_AIR_NEW_OUTPUT": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
}
"""Variables of Ray: no usage statistics, no lines of its own, no changes of the working directory."""

FORWARDED = ("MLFLOW_", "AWS_", "PENUMBRA_", "OMP_")
"""Beginnings of the variables that the processes of a job get from the submitting shell."""

LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Where this is 0 Ray keeps to the loopback interface, on every system; read when it is imported."""

CONNECT_S = 10.0
"""Seconds in which the address of a cluster has to answer."""

OBJECT_STORE = 200 * 1024**2
"""Bytes of shared memory of a Ray that is started here; checkpoints of a restart pass through it."""


@dataclass(frozen=True)
class Cluster:
    """Where a job runs.

    Attributes:
        address: Address of a running Ray (`ray://…`, `auto`, `host:port`); None: one is started here.
        workers: Processes of the job at one time.
        cpus: Processor cores of each.
        gpus: GPUs of each.
        together: Whether all must run at one time; otherwise they wait for each other.
    """

    address: str | None = None
    workers: int = 1
    cpus: int = 1
    gpus: float = 0
    together: bool = True


def need_ray() -> None:
    """Raise a ValueError that tells how Ray is installed, where it is not."""
    missing = [name for name in ("ray", "optuna") if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f'{" and ".join(missing)} missing: pip install "{PACKAGE}[ray]"')


def forwarded(address: str | None) -> dict[str, str]:
    """Return the variables that a job takes along; caches are the nodes' own in a cluster."""
    own = () if address is None else ("PENUMBRA_CACHE",)
    return {k: v for k, v in os.environ.items() if k.startswith(FORWARDED) and k not in own}


@contextmanager
def connected(cluster: Cluster) -> Iterator[Any]:
    """Yield the module `ray`, connected; what was started here is ended.

    Raises:
        ValueError: Ray is missing, or the nodes have another release of Penumbra or none, or this machine
            has too few GPUs.
        OSError: Nothing answers at the address.
    """
    need_ray()
    os.environ.update({key: value for key, value in QUIET.items() if key not in os.environ})
    logging.getLogger("ray").setLevel(logging.ERROR)
    if cluster.address is None:
        os.environ[LOOPBACK] = "0"
    else:
        _check_address(cluster.address)
    import ray

    begin = _start if cluster.address is None else _reach
    begin(ray, cluster)
    try:
        _check_room(ray, cluster)
        _check_release(ray)
        yield ray
    finally:
        ray.shutdown()


def _start(ray: Any, cluster: Cluster) -> None:
    os.environ.pop("RAY_ADDRESS", None)  # it would win over "local"
    # On one machine Ray would end processes of the job because others' have filled the memory.
    os.environ.setdefault("RAY_memory_monitor_refresh_ms", "0")
    cores = max(len(os.sched_getaffinity(0)), cluster.workers * cluster.cpus)  # they may share
    print(f"starting Ray on this machine ({cores} CPUs)", file=sys.stderr, flush=True)
    try:
        ray.init(
            address="local",
            num_cpus=cores,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.ERROR,
            configure_logging=True,
            object_store_memory=OBJECT_STORE,
        )
    except Exception as error:  # Ray raises the bare class where its processes do not come up
        reason = str(error).strip().splitlines()[0][:200]
        raise OSError(f"Ray does not start on this machine, perhaps for want of memory: {reason}") from error


def _check_address(address: str) -> None:
    """Find out at once whether something listens at an address; Ray itself would try for minutes.

    Raises:
        UsageError: It is no address.
        OSError: Nothing listens there.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address == "auto":
        return
    if not colon or not port.isdigit() or not 0 < int(port) < 65536 or "/" in host:
        raise UsageError(f"--address {address}: expected ray://HOST:10001, or on a node HOST:6379 or auto")
    try:
        with socket.create_connection((host, int(port)), timeout=CONNECT_S) as found:
            loopback = found.getpeername()[0].startswith("127.")
    except OSError as error:
        raise OSError(f"--address {address}: nothing can be reached there ({error})") from None
    if loopback and not address.startswith("ray://"):
        # Ray replaces a loopback address by the machine's own, at which a cluster that is kept to this
        # machine does not listen.
        try:
            socket.create_connection((_own_address(), int(port)), 2).close()
        except OSError:
            os.environ[LOOPBACK] = "0"


def _own_address() -> str:
    """Return this machine's address in its network, as Ray finds it; nothing is sent for that."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("8.8.8.8", 53))
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


def _reach(ray: Any, cluster: Cluster) -> None:
    address = str(cluster.address)
    print(f"connecting to Ray at {address}", file=sys.stderr, flush=True)
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0][:200]
        outside = "" if address.startswith("ray://") else "; from another machine use ray://HOST:10001"
        raise OSError(f"--address {address}: no Ray cluster can be used there: {reason}{outside}") from None


def _check_room(ray: Any, cluster: Cluster) -> None:
    """Find out whether a job fits into a cluster; others may join one that was not started here, or grow it.

    Raises:
        ValueError: It never will.
    """
    nodes = [node.get("Resources", {}) for node in ray.nodes() if node.get("Alive")]
    count = cluster.workers if cluster.together else 1
    for kind, each in (("CPU", cluster.cpus), ("GPU", cluster.gpus)):
        have = [node.get(kind, 0) for node in nodes]
        if sum(have) >= each * count and max(have, default=0) >= each:
            continue
        needs = f"the job needs {count} × {each:g} {kind}s"
        if cluster.address is None:
            raise ValueError(f"{needs}, and this machine has {sum(have):g}; ask for less or give --address")
        print(
            f"note: {needs}, and the cluster has {sum(have):g}, at most {max(have, default=0):g} on a node; "
            "it waits until nodes join or an autoscaler starts some (Ctrl-C gives up)",
            file=sys.stderr,
            flush=True,
        )


def release() -> str:
    """Return the installed release of Penumbra."""
    return metadata.version(PACKAGE)


def _check_release(ray: Any) -> None:
    """Raise a ValueError unless the cluster has this release of Penumbra."""
    try:
        found = ray.get(ray.remote(num_cpus=0)(_installed).remote(PACKAGE))
    except ray.exceptions.RayError as error:
        raise ValueError(f"the cluster cannot run a task: {str(error).splitlines()[0]}") from None
    if found != release():
        raise ValueError(
            f"the cluster has {PACKAGE} {found or 'not installed'}, this machine {release()}; start its "
            "nodes from an image or environment with the same release"
        )


def _installed(package: str) -> str | None:
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def enter(folder: str, environment: dict[str, str]) -> None:
    """Let this process of a cluster work in a folder and with the submitter's variables.

    Raises:
        OSError: The folder cannot be made on this node.
    """
    os.environ.update(QUIET | environment)
    logging.getLogger("ray").setLevel(logging.CRITICAL)  # what matters is told by the commands themselves
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
    except OSError as error:
        raise OSError(
            f"the folder {folder} cannot be used on node {os.uname().nodename} ({error.strerror}); give "
            "--folder DIR"
        ) from None
