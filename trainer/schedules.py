"""Learning-rate schedules that span the whole training, however long it is."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, ReduceLROnPlateau

MakeOptimizer = Callable[[Iterable], Optimizer]
MakeSchedule = Callable[[Optimizer], LRScheduler]


class OneCycle(LambdaLR):
    """One rise and one fall of the learning rate, both along a cosine (Smith and Topin 2019).

    The optimiser's own learning rate is the peak. The number of steps is not an argument: the training
    module sets it from the trainer (`span`), so longer training stretches the cycle.

    Args:
        optimizer: Whose learning rate is scheduled.
        warmup: Share of the steps that the rate rises.
        start: First rate as a fraction of the peak.
        end: Last rate as a fraction of the peak.

    Raises:
        ValueError: `warmup` is not within [0, 1), or `start` or `end` not within (0, 1].
    """

    interval = "step"

    def __init__(
        self, optimizer: Optimizer, warmup: float = 0.15, start: float = 0.1, end: float = 0.001
    ) -> None:
        if not (0 <= warmup < 1 and 0 < start <= 1 and 0 < end <= 1):
            raise ValueError(f"OneCycle: warmup {warmup}, start {start}, end {end} are out of range")
        self.warmup, self.start, self.end = warmup, start, end
        self.steps = 1
        super().__init__(optimizer, self.factor)

    def span(self, steps: int) -> None:
        """Set the number of optimiser steps of the whole training."""
        self.steps = max(int(steps), 1)

    def state_dict(self) -> dict[str, Any]:
        """Return the position; shape and length follow from the configuration, also of a resumed run."""
        own = ("steps", "warmup", "start", "end")
        return {key: value for key, value in super().state_dict().items() if key not in own}

    def factor(self, step: int) -> float:
        """Return the learning rate of a step as a fraction of the peak; constant after the last."""
        place = min(step / self.steps, 1.0)
        if place < self.warmup:
            low, share = self.start, place / self.warmup
        else:
            low, share = self.end, (1 - place) / (1 - self.warmup)
        return low + (1 - low) * 0.5 * (1 - math.cos(math.pi * share))


class InverseRoot(LambdaLR):
    """The learning rate rises geometrically and falls with the root of the epoch, as Chaitanya et al. 2017.

    Within `warmup` epochs it rises from `start` of the optimiser's own to all of it; epoch t after that has
    `sqrt(warmup / t)` of it, or `1 / sqrt(t)` where there is no rise.

    Args:
        optimizer: Whose learning rate is scheduled.
        warmup: Epochs of the rise.
        start: First rate as a fraction of the peak.

    Raises:
        ValueError: `warmup` is negative or `start` not within (0, 1].
    """

    def __init__(self, optimizer: Optimizer, warmup: int = 10, start: float = 0.1) -> None:
        if warmup < 0 or not 0 < start <= 1:
            raise ValueError(f"InverseRoot: warmup {warmup}, start {start} are out of range")
        self.warmup, self.start = warmup, start
        super().__init__(optimizer, self.factor)

    def state_dict(self) -> dict[str, Any]:
        """Return the position; the shape follows from the configuration, also of a resumed run."""
        return {key: value for key, value in super().state_dict().items() if key not in ("warmup", "start")}

    def factor(self, epoch: int) -> float:
        """Return the learning rate of an epoch, from 0, as a fraction of the peak."""
        if epoch < self.warmup:
            return float(self.start ** (1 - epoch / self.warmup))
        return math.sqrt(max(self.warmup, 1) / max(epoch, 1))


class Halving(LambdaLR):
    """The learning rate falls to a fraction at each milestone and is constant between.

    Args:
        optimizer: Whose learning rate is scheduled.
        milestones: Finished epochs, or steps, after which it falls.
        per: What milestones count: `epoch` or `step`.
        factor: The fraction.

    Raises:
        ValueError: Milestones do not ascend from 1, or `per` or `factor` is wrong.
    """

    def __init__(
        self,
        optimizer: Optimizer,
        milestones: Sequence[int] = (),
        per: Literal["epoch", "step"] = "epoch",
        factor: float = 0.5,
    ) -> None:
        if list(milestones) != sorted({m for m in milestones if m > 0}):
            raise ValueError(f"milestones must be ascending positive numbers, got {list(milestones)}")
        if per not in ("epoch", "step") or not 0 < factor < 1:
            raise ValueError(
                f"Halving: per {per!r}, factor {factor}; expected epoch or step, and 0 < factor < 1"
            )
        self.milestones, self.interval, self.decay = tuple(milestones), per, factor
        super().__init__(optimizer, self.factor)

    def state_dict(self) -> dict[str, Any]:
        """Return the position; milestones follow from the configuration, also of a resumed run."""
        own = ("milestones", "interval", "decay")
        return {key: value for key, value in super().state_dict().items() if key not in own}

    def factor(self, count: int) -> float:
        """Return the learning rate after `count` epochs or steps as a fraction of the first."""
        return float(self.decay ** bisect.bisect_right(self.milestones, count))


def scheduled(optimizer: Optimizer, make: MakeSchedule | None, steps: float, owner: str) -> dict[str, Any]:
    """Return an optimiser and its schedule as Lightning takes them.

    Args:
        optimizer: The optimiser.
        make: Makes its schedule, stepped as often as its attribute `interval` says, every epoch without one.
        steps: Steps of the optimiser in the whole training.
        owner: Who trains, for messages.

    Raises:
        ValueError: The schedule waits for a score, which is not known here.
    """
    if make is None:
        return {"optimizer": optimizer}
    schedule = make(optimizer)
    if isinstance(schedule, ReduceLROnPlateau):
        raise ValueError(f"{owner} cannot use ReduceLROnPlateau; use trainer.schedules.Halving or OneCycle")
    if isinstance(schedule, OneCycle):
        schedule.span(int(steps))
    interval = getattr(schedule, "interval", "epoch")
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": interval}}
