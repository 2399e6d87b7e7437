"""Mirrors a run to a shared folder or an object store while it trains."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.cluster.storage import JOURNAL, send_run, storage_url
from trainer.tracking import MLflowTracking

LOOK_S = 1.0
"""Seconds between two looks for new checkpoints."""

END_LOOK_S = 0.2
"""The same while the run ends, and waits for what it recorded last."""


class MirrorRun(Callback):
    """Sends a run to a shared folder or an object store as it is saved, without holding up training.

    The tracking store gets what the mirror has, and nothing before: a run that goes on from the mirror
    records again what the mirror lacks, with other times, and the store would have it twice.

    Args:
        storage: `s3://bucket/path`, or a folder that all nodes share.
        journal_s: Seconds between two copies of journals and configurations, which change all the time; by
            so much later the tracking store hears of them.
    """

    def __init__(self, storage: str, journal_s: float = 30.0) -> None:
        self.storage = storage_url(storage)
        self.journal_s = journal_s
        self._sent: dict[str, tuple[int, int]] = {}
        self._ending, self._over = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._logger: MLflowTracking | None = None
        self._folder = Path()
        self._trouble = ""
        self._trained = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Begin to watch the run's folder, on the first rank."""
        logger = trainer.logger
        if stage == "fit" and trainer.is_global_zero and isinstance(logger, MLflowTracking):
            self._logger, self._folder = logger, logger.folder
            logger.deliver_up_to(0)
            self._trained = False
            self._ending.clear()
            self._over.clear()
            self._sent.clear()
            self._thread = threading.Thread(target=self._watch, name="mirror", daemon=True)
            self._thread.start()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Mirror at once what the run records from now on: its end waits for the tracking store."""
        self._trained = True  # nothing of it will be recorded again, so the store need not wait for a mirror
        if self._trouble and self._logger is not None and self._thread is not None:
            self._logger.deliver_up_to(None)
        self._ending.set()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Mirror at once what the run records from now on, which another node may have to go on from."""
        self._ending.set()

    def finish(self) -> None:
        """Send what the run recorded last, after its end, and say so where that fails."""
        if self._thread is None:
            return
        self._ending.set()
        self._over.set()
        self._thread.join()
        self._thread = None
        if self._trouble:
            print(
                f"warning: the end of the run is not in {self.storage}: {self._trouble}. It is whole in "
                f"{self._folder}, and only there; copy it before this machine goes away.",
                file=sys.stderr,
                flush=True,
            )

    def _watch(self) -> None:
        copied = float("-inf")
        while True:
            over, now = self._over.is_set(), time.monotonic()
            journals = self._ending.is_set() or now - copied >= self.journal_s
            good = self._pass(journals)
            if good and journals:
                copied = now
            if over or (self._over.is_set() and not good):
                return
            if self._ending.is_set():
                self._over.wait(END_LOOK_S)
            else:
                self._ending.wait(LOOK_S)

    def _pass(self, journals: bool) -> bool:
        """Send what has changed; returns whether that worked, and says once where it does not."""
        assert self._logger is not None
        try:
            send_run(self._folder, self.storage, self._sent, journals)
        except Exception as error:  # this thread must not end for what a library raises
            if self._trained:
                self._logger.deliver_up_to(None)
            if not self._trouble:
                print(
                    f"The run is not mirrored: {error}. It is tried again; the tracking store gets what is "
                    "recorded when the mirror has it.",
                    file=sys.stderr,
                    flush=True,
                )
            self._trouble = str(error)
            return False
        self._logger.deliver_up_to(self._sent.get(JOURNAL, (0, 0))[0])
        if self._trouble:
            print(f"The run is mirrored to {self.storage} again.", file=sys.stderr, flush=True)
            self._trouble = ""
        return True
