"""When and how the two sides of an adversarial training are updated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from lightning.pytorch import Trainer
from torch import Tensor, distributed, nn
from torch.nn import Parameter
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer

from models.denoiser import Denoiser, Pair


class Turn(NamedTuple):
    """What one batch is used for.

    Attributes:
        net: The denoiser learns from it; the critic learns from every batch.
        ends: Updates are due after it.
    """

    net: bool
    ends: bool


def turn(batch: int, batches: float, accumulate: int, critic_steps: int) -> Turn:
    """Return what a batch is used for.

    The critic is updated after every `accumulate` batches, the denoiser at every `critic_steps`-th of these
    updates. The last batch of an epoch ends both, so that nothing is carried into the next; an epoch has
    ceil(batches / (accumulate * critic_steps)) updates of the denoiser.

    Args:
        batch: Number of the batch in its epoch, from 0.
        batches: Number of batches of the epoch, infinite where unknown.
        accumulate: Batches per update.
        critic_steps: Updates of the critic per update of the denoiser.
    """
    window, last = batch // accumulate, (batches - 1) // accumulate
    ends = (batch + 1) % accumulate == 0 or batch + 1 >= batches
    return Turn((window + 1) % critic_steps == 0 or window >= last, ends)


def average_gradients(parameters: Sequence[Parameter], batches: int) -> None:
    """Make summed gradients the average over batches and processes.

    All processes must have gradients of the same parameters. They are sent as one vector: hooks that send
    them during the backward pass expect one pass per step through parameters that are all used, and here are
    several, through parts.
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    world = processes()
    if not gradients or batches * world == 1:
        return
    if world > 1:
        joint = torch.cat([g.reshape(-1) for g in gradients])
        distributed.all_reduce(joint)
        parts = joint.split([g.numel() for g in gradients])
        torch._foreach_copy_(gradients, [p.view_as(g) for p, g in zip(parts, gradients, strict=True)])
    torch._foreach_mul_(gradients, 1 / (batches * world))


def processes() -> int:
    """Return the number of processes that train together."""
    together = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if together else 1


class Side:
    """What one side, the denoiser or the critics, has learned since its last update.

    Args:
        prefix: Of the names of its numbers.

    Attributes:
        numbers: Means over batches and processes at the last update, and the norm of the gradient.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.numbers: dict[str, float] = {}
        self._batches = 0
        self._sums: dict[str, Tensor] = {}

    def count(self, numbers: Mapping[str, Sequence[Tensor]], names: Sequence[str]) -> None:
        """Add the numbers of one batch: one per name, or one for all; their sum is counted, too."""
        self._batches += 1
        for kind, values in numbers.items():
            parts = (
                {f"{kind}/{name}": v for name, v in zip(names, values, strict=True)}
                if len(values) > 1
                else {}
            )
            whole = {kind: torch.stack(list(values)).sum()} if values else {}
            for key, value in (whole | parts).items():
                name, value = f"{self.prefix}/{key}", value.detach().float()
                self._sums[name] = self._sums[name] + value if name in self._sums else value

    def settle(self, parameters: Sequence[Parameter], limit: float | None) -> None:
        """Average the gradients, clip their joint norm to `limit`, and set `numbers`."""
        average_gradients(parameters, self._batches)
        norm = clip_grad_norm_(parameters, math.inf if limit is None else limit)
        joint = torch.stack(list(self._sums.values())) / self._batches
        if processes() > 1:
            distributed.all_reduce(joint)
            joint /= processes()
        self.numbers = dict(zip(self._sums, joint.tolist(), strict=True))
        self.numbers[f"{self.prefix}/gradient_norm"] = float(norm)
        self._batches, self._sums = 0, {}


def advance(trainer: Trainer, optimizer: Optimizer, interval: str) -> None:
    """Step the schedules of an optimiser that count `interval`, step or epoch."""
    for config in trainer.lr_scheduler_configs:
        if config.scheduler.optimizer is optimizer and config.interval == interval:
            config.scheduler.step()  # type: ignore[call-arg]


def check_crops(critics: nn.ModuleDict, pairs: Mapping[str, Pair]) -> None:
    """Raise a ValueError unless the images of each pair have the size that its critic takes."""
    for name, critic in critics.items():
        size, (height, width) = getattr(critic, "size", None), pairs[name].target.shape[-2:]
        if size is not None and (height, width) != (size, size):
            raise ValueError(
                f"crops are {width}x{height} pixels, the critic takes {size}x{size}: prepare the data with "
                f"--data.patch_size {size}, or set --model.critic.init_args.size"
            )


def check_number(name: str, value: float | None, zero: bool = False) -> None:
    """Raise a ValueError unless an option is positive, or None, or zero where that is allowed."""
    if value is not None and not (value > 0 or (zero and value == 0)):
        raise ValueError(f"{name} is {value}, expected {'at least 0' if zero else 'more than 0'}")


def check_groups(net: Denoiser, option: str, values: Mapping[str, float], zero: bool = False) -> None:
    """Raise a ValueError unless an option names parameter groups of the denoiser, with positive numbers."""
    groups = net.parameter_groups()
    for name, value in values.items():
        if name not in groups:
            known = ", ".join(groups)
            raise ValueError(
                f"{option}: {type(net).__name__} has no parameter group {name!r}, it has {known}"
            )
        check_number(f"{option}: {name}", value, zero)
