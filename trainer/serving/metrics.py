"""What Prometheus is told."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    generate_latest,
)

from trainer.loading import Loaded

BUCKETS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0, 120.0)


class Metrics:
    """The counters of one service.

    Args:
        loaded: The model.
        queue: Returns how many requests wait.
        deaths: Returns how many readers died or hung.
    """

    def __init__(self, loaded: Loaded, queue: Callable[[], int], deaths: Callable[[], int]) -> None:
        self.registry = CollectorRegistry()
        registry = self.registry
        ProcessCollector(registry=registry)
        self.requests = Counter(
            "penumbra_requests", "Answers by path and status.", ["path", "status"], registry=registry
        )
        self.latency = Histogram(
            "penumbra_denoise_seconds",
            "Seconds from the last byte of a request to its result, of requests that got one.",
            buckets=BUCKETS,
            registry=registry,
        )
        self.upload = Histogram(
            "penumbra_upload_bytes",
            "Bytes of uploaded files.",
            buckets=[10.0**n for n in range(3, 10)],
            registry=registry,
        )
        self.megapixels = Counter("penumbra_megapixels", "Megapixels of denoised frames.", registry=registry)
        self.tiles = Counter("penumbra_tiles", "Tiles that the model denoised.", registry=registry)
        self.batches = Counter("penumbra_batches", "Calls of the model.", registry=registry)
        self.tile_megapixels = Counter(
            "penumbra_tile_megapixels", "Megapixels of tiles, with their context.", registry=registry
        )
        self.abandoned = Counter("penumbra_abandoned", "Requests whose client went away.", registry=registry)
        self.active = Gauge("penumbra_active", "Requests that are worked on.", registry=registry)
        self.active.set(0)
        Gauge("penumbra_queue_length", "Requests that wait.", registry=registry).set_function(queue)
        Gauge(
            "penumbra_reader_deaths",
            "Readers of EXR files that died or hung, and were replaced.",
            registry=registry,
        ).set_function(deaths)
        source = loaded.source
        Info("penumbra_model", "The model.", registry=registry).info(
            {"reference": source.reference, "class": type(loaded.model).__name__, "sha256": source.sha256}
        )

    def told(self, tiles: int, megapixels: float) -> None:
        """Count a batch."""
        self.batches.inc()
        self.tiles.inc(tiles)
        self.tile_megapixels.inc(megapixels)

    def text(self) -> bytes:
        """Return all of them in Prometheus' text format."""
        return generate_latest(self.registry)
