"""The training command as it runs in the processes of a Ray Train job."""

from __future__ import annotations

import os
import threading
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy

from trainer.cluster.checked import strategy_options
from trainer.training import TrainingCLI


class ExtendedCLI(TrainingCLI):
    """`trainer fit` with callbacks that the recorded configuration does not show, or without some of it."""

    extra: tuple[Callback, ...] = ()
    left_out: tuple[str, ...] = ()

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer with these callbacks."""
        configured = self._get(self.config_init, "trainer.callbacks", default=None) or []
        kept = [callback for callback in configured if type(callback).__name__ not in self.left_out]
        return super().instantiate_trainer(callbacks=[*kept, *self.extra], **kwargs)


class RayTrainingCLI(ExtendedCLI):
    """`trainer fit` on the processes that Ray started; the recorded configuration stays the user's."""

    gpus: float = 0

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer with Ray's strategy and environment."""
        from ray.train.lightning import RayDDPStrategy, RayLightningEnvironment, prepare_trainer

        given = self._get(self.config_init, "trainer.strategy", default="auto")
        plugins = self._get(self.config_init, "trainer.plugins", default=None) or []
        trainer = super().instantiate_trainer(
            strategy=RayDDPStrategy(**_hooks(given), **strategy_options(given)),
            plugins=[*(plugins if isinstance(plugins, list) else [plugins]), RayLightningEnvironment()],
            accelerator="gpu" if self.gpus else "cpu",
            devices="auto",
            num_nodes=1,
            **kwargs,
        )
        return prepare_trainer(trainer)


def _hooks(given: Any) -> dict[str, Any]:
    """Return the hooks of a configured strategy."""
    if not isinstance(given, DDPStrategy):
        return {}
    names = ("ddp_comm_state", "ddp_comm_hook", "ddp_comm_wrapper", "model_averaging_period")
    return {name: getattr(given, f"_{name}") for name in names}


class Cancelled(Exception):  # noqa: N818  # no error
    """The submitter asked for the end of a training.

    Not a KeyboardInterrupt: Lightning then changes the handling of signals, which only the main thread may
    do, and Ray trains in another one.
    """


class Cancelling(Callback):
    """Ends a training as Ctrl-C does when its submitter asks for it.

    Args:
        board: The job's board.
    """

    def __init__(self, board: Any) -> None:
        self._board = board
        self._asked = threading.Event()

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to look at the board, on the first rank."""
        if os.environ.get("RANK") == "0":
            threading.Thread(target=self._look, daemon=True).start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop between two steps.

        Raises:
            Cancelled: The submitter asked for it.
        """
        if self._asked.is_set():
            raise Cancelled

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Say how the run continues."""
        if isinstance(exception, Cancelled):
            print(f"interrupted at step {trainer.global_step}; continue with --ckpt_path last")

    def _look(self) -> None:
        import ray

        try:
            while not ray.get(self._board.cancelled.remote()):
                threading.Event().wait(1.0)
        except ray.exceptions.RayError:
            return  # the submitter is gone, and this process with it
        self._asked.set()
