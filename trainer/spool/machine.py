"""Load and memory of the machine, sampled beside the training."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

INTERVAL_S = 10.0


class Sampler(threading.Thread):
    """Measures processor, memory, disk, network and NVIDIA GPUs with MLflow's own monitors.

    MLflow's thread would ask the server before every sample; this one only records. The steps of these
    metrics count samples: unlike a time they have no gap where a run was stopped, and never go back.

    Args:
        record: Takes the numbers, by MLflow's names, and the step.
        step: First step.
    """

    def __init__(self, record: Callable[[dict[str, float], int], None], step: int) -> None:
        super().__init__(name="system metrics", daemon=True)
        self._record = record
        self._step = step
        self._over = threading.Event()
        self._monitors = _monitors()

    def run(self) -> None:
        """Sample until `stop`."""
        while not self._over.is_set():
            for monitor in self._monitors:
                monitor.collect_metrics()
            if self._over.wait(INTERVAL_S):
                return
            numbers: dict[str, float] = {}
            for monitor in self._monitors:
                numbers |= {f"system/{name}": value for name, value in monitor.aggregate_metrics().items()}
                monitor.clear_metrics()
            try:
                self._record(numbers, self._step)
            except OSError:
                return  # the training thread meets the same disk, and says so
            self._step += 1

    def stop(self) -> None:
        """Stop at once."""
        self._over.set()
        self.join()


def _monitors() -> list[Any]:
    from mlflow.system_metrics.metrics.cpu_monitor import CPUMonitor
    from mlflow.system_metrics.metrics.disk_monitor import DiskMonitor
    from mlflow.system_metrics.metrics.gpu_monitor import GPUMonitor
    from mlflow.system_metrics.metrics.network_monitor import NetworkMonitor

    monitors = [CPUMonitor(), DiskMonitor(), NetworkMonitor()]
    with contextlib.suppress(ImportError, RuntimeError):  # no NVIDIA GPU
        monitors.append(GPUMonitor())
    return monitors
