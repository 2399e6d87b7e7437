"""Mirrors a run to a shared folder or an object store while it trains."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.cluster.storage import send_run, storage_url
from trainer.tracking import MLflowTracking

LOOK_S = 1.0
"""Seconds between two looks for new checkpoints."""


class MirrorRun(Callback):
    """Sends checkpoints to a shared folder or an object store as they are saved, without holding up training.

    Args:
        storage: `s3://bucket/path`, or a folder that all nodes share.
        journal_s: Seconds between two copies of journals and configurations, which change all the time.
    """

    def __init__(self, storage: str, journal_s: float = 30.0) -> None:
        self.storage = storage_url(storage)
        self.journal_s = journal_s
        self._sent: dict[str, tuple[int, int]] = {}
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._folder: Path | None = None
        self._complained = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to watch the run's folder, on the first rank."""
        logger = trainer.logger
        if trainer.is_global_zero and isinstance(logger, MLflowTracking):
            self._folder = logger.folder
            self._over.clear()
            self._thread = threading.Thread(target=self._watch, name="mirror", daemon=True)
            self._thread.start()

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Send what is left, and wait for it."""
        self._finish()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Send what is left."""
        self._finish()

    def _finish(self) -> None:
        if self._thread is None:
            return
        self._over.set()
        self._thread.join()
        self._thread = None
        self._pass(everything=True)

    def _watch(self) -> None:
        last = 0.0
        while True:
            now = time.monotonic()
            journals = now - last >= self.journal_s
            if self._pass(everything=journals) and journals:
                last = now
            if self._over.wait(LOOK_S):
                return

    def _pass(self, everything: bool) -> bool:
        """Send what has changed; returns whether that worked, and says once where it does not."""
        assert self._folder is not None
        try:
            send_run(self._folder, self.storage, self._sent, everything)
        except (OSError, ValueError) as error:
            if not self._complained:
                print(f"The run is not mirrored: {error}. It is tried again.", file=sys.stderr, flush=True)
            self._complained = True
            return False
        if self._complained:
            print(f"The run is mirrored to {self.storage} again.", file=sys.stderr, flush=True)
            self._complained = False
        return True
