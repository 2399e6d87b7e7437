"""Training of recurrent denoisers on short sequences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from models.denoiser import Denoised, Denoiser, Pair, State, select
from trainer.losses import Recurrent
from trainer.modules.evaluation import Batch
from trainer.modules.regression import Regression
from trainer.schedules import MakeOptimizer, MakeSchedule


class Sequence(Regression):
    """Minimise a loss of whole sequences, through which a recurrent denoiser carries its state.

    Training and validation batches hold sequences (B, T, C, H, W) (`data.Shards` with `recipe: recurrent`):
    the first frame starts without a state, and gradients flow back through all T frames. Test frames come
    one at a time, in order; the state is carried until another scene begins or a frame is missing, and not
    between independent views. Metrics are averages over all frames, first ones included.

    Args:
        net: The denoiser to train; with `recurrent`.
        loss: Module called with what `Denoiser.next_pair` compares, of all frames: (B, T, C, H, W).
        optimizer: As in `Regression`.
        lr_scheduler: As in `Regression`.
        clip_norm: As in `Regression`.
        clip_value: As in `Regression`.

    Raises:
        ValueError: The denoiser carries no state, or a clip is not positive.
    """

    clips = True

    def __init__(
        self,
        net: Denoiser,
        loss: nn.Module | None = None,
        optimizer: MakeOptimizer = torch.optim.Adam,
        lr_scheduler: MakeSchedule | None = None,
        clip_norm: float | None = None,
        clip_value: float | None = None,
    ) -> None:
        loss = Recurrent() if loss is None else loss
        super().__init__(net, loss, optimizer, lr_scheduler, clip_norm, clip_value, pairs=True)
        if not net.recurrent:
            raise ValueError(f"{type(net).__name__} carries no state from frame to frame; use Regression")
        self._tested = Tested()
        self._views: frozenset[str] = frozenset()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch."""
        loss: Tensor = self.loss(*_together(pair for pair, _ in self.unrolled(batch)))
        self.log("train/loss_step", loss)
        self.count_loss(loss)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score every frame of one batch of fixed crops."""
        assert self.scores is not None
        exposure = batch["exposure"].float().reshape(-1, 1, 1, 1)
        pairs = []
        for number, (pair, result) in enumerate(self.unrolled(batch)):
            pairs.append(pair)
            target = batch["reference"][:, number].float()
            self.scores.update(result.color.float() * exposure, target * exposure, batch["scene"])
        loss = self.loss(*_together(iter(pairs)))
        self.log("val/loss", loss, batch_size=len(batch["scene"]), sync_dist=True)

    def on_test_epoch_start(self) -> None:
        """Start new sums and a new sequence."""
        super().on_test_epoch_start()
        self._tested = Tested()
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        self.check_ranks(data, self.trainer.world_size)
        views = getattr(data, "independent_views", None)
        self._views = frozenset(views("test") if views is not None else ())

    def check_ranks(self, data: Any, world: int) -> None:
        """Raise a ValueError where no process would see two frames of a test in a row."""
        if world > 1 and not getattr(data, "whole_scenes", True):
            raise ValueError(
                f"{type(self.net).__name__} carries a state from frame to frame, and {world} processes would "
                "get every other frame of a test or fewer: use --data.whole_scenes true"
            )

    def forward(self, batch: Batch) -> Denoised:
        """Denoise the next whole frame of a test."""
        place = self._place(batch)
        follows = place is not None and place == self._tested.following
        result: Denoised = self.net(select(self.net, batch), self._tested.state if follows else None)
        self._tested = Tested() if place is None else Tested((place[0], place[1] + 1), result.state)
        return result

    def pictured(self, batch: Batch) -> tuple[Batch, Denoised]:
        """Return the last frames of sequences, and their results."""
        *_, (_, result) = self.unrolled(batch)
        *_, frame = frames(batch)
        return frame, result

    def unrolled(self, batch: Batch) -> Iterator[tuple[Pair, Denoised]]:
        """Denoise sequences frame by frame; yields what is compared, and the result.

        Raises:
            ValueError: The batch holds single images.
        """
        state: State | None = None
        for frame in frames(batch):
            pair, result = self.net.next_pair(frame, state)
            state = result.state
            yield pair, result

    def _place(self, batch: Batch) -> tuple[str, int] | None:
        """Return scene and number of a test frame; None: it belongs to no sequence, or counts nowhere."""
        scene = str(batch["scene"][0]) if batch["scene"] else None
        return None if scene is None or scene in self._views else (scene, int(batch["frame"][0]))


class Tested(NamedTuple):
    """Where a test is.

    Attributes:
        following: Scene and number of the frame that would go on with the state.
        state: Of the last frame; None: there was none.
    """

    following: tuple[str, int] | None = None
    state: State | None = None


def frames(batch: Batch) -> Iterator[Batch]:
    """Yield the frames of a batch of sequences, each as a batch of images.

    Raises:
        ValueError: The batch holds single images.
    """
    shape = batch["reference"].shape
    if len(shape) != 5:
        raise ValueError(
            f"Sequence trains on sequences (B, T, C, H, W), the batches are {tuple(shape)}: use "
            "--data.recipe recurrent, or shards of trainer prepare --recipe recurrent"
        )
    for number in range(shape[1]):
        yield {name: _of_frame(name, value, number) for name, value in batch.items()}


def _of_frame(name: str, value: object, number: int) -> object:
    moving = isinstance(value, Tensor) and (value.ndim == 5 or (name == "depth_range" and value.ndim == 3))
    return value[:, number] if moving and isinstance(value, Tensor) else value


def _together(pairs: Iterator[Pair]) -> tuple[Tensor, Tensor]:
    """Return outputs and targets (B, T, C, H, W)."""
    outputs, targets = zip(*pairs, strict=True)
    return torch.stack(outputs, 1), torch.stack(targets, 1)
