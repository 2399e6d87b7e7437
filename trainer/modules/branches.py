"""Separate, then joint training of a denoiser with branches, as KPCN's (Bako et al. 2017) is trained.

First every branch learns by itself what its own loss compares, the diffuse and the specular image in their
transformed space. The branches share no parameters, so minimising the sum of their losses trains each as if
alone. Then all of them learn together what the recombined image lacks, at a smaller learning rate.

The paper takes about 750,000 steps for each branch and 250,000 together. Learning rates are later groups'
choice: Adam with 1e-4, then 1e-6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from models.denoiser import Denoiser
from trainer.losses import L1
from trainer.modules.evaluation import Batch, Evaluated
from trainer.schedules import MakeOptimizer, MakeSchedule, scheduled

JOINT = "color"
"""Name of the pair that is compared in the joint phase."""


def adam(params: Iterable[Any]) -> Optimizer:
    """Return Adam with learning rate 1e-4, the default of `Branches`."""
    return torch.optim.Adam(params, lr=1e-4)


class Branches(Evaluated):
    """Minimise the sum of the branches' losses first, the loss of the recombined image later.

    Both losses are logged throughout, beside the phase (1 separate, 2 joint). The joint phase starts with
    empty moments of the optimiser, as training anew from the learned weights would. Which phase a step is in
    follows from the number of steps, so a resumed run goes on where it was.

    Args:
        net: The denoiser to train; its `compared` pairs are those of the branches and `color`.
        loss: Module called with output and target (B, 3, H, W) of each pair.
        joint_after: When the joint phase starts: a whole number counts epochs, a fraction (with a point, 0.0
            to 1.0) is the share of all steps.
        joint_lr: Learning rate of the joint phase; None: as before. A schedule goes on scaling it.
        optimizer: Makes the optimiser from the parameters; a class path in a configuration.
        lr_scheduler: Makes a learning-rate schedule, as in `Regression`; none by default.

    Raises:
        ValueError: The denoiser has no branches, or a number is out of range.
    """

    def __init__(
        self,
        net: Denoiser,
        loss: nn.Module | None = None,
        joint_after: int | float = 0.75,
        joint_lr: float | None = 1e-6,
        optimizer: MakeOptimizer = adam,
        lr_scheduler: MakeSchedule | None = None,
    ) -> None:
        super().__init__(net)
        self.keep_arguments()
        self.names = tuple(name for name in net.compared if name != JOINT)
        if not self.names or JOINT not in net.compared:
            raise ValueError(
                f"Branches trains denoisers with branches, such as KPCN; {type(net).__name__} compares only "
                f"{', '.join(net.compared)}; use Regression"
            )
        if joint_after < 0 or (isinstance(joint_after, float) and joint_after > 1):
            raise ValueError(f"joint_after {joint_after}; expected whole epochs or a share from 0.0 to 1.0")
        if joint_lr is not None and joint_lr <= 0:
            raise ValueError(f"joint_lr {joint_lr}; expected a positive number")
        self.loss = loss if loss is not None else L1()
        self.joint_after, self.joint_lr = joint_after, joint_lr
        self.make_optimizer, self.make_lr_scheduler = optimizer, lr_scheduler
        self.joint_step = 0

    @property
    def joint(self) -> bool:
        """Whether the next step belongs to the joint phase."""
        return self.trainer.global_step >= self.joint_step

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch: of the branches or of the image, as the phase is."""
        pairs = self.net.training_pairs(batch)
        losses: dict[str, Tensor] = {
            name: self.loss(pair.output, pair.target) for name, pair in pairs.items()
        }
        separate = torch.stack([losses[name] for name in self.names]).sum()
        result = losses[JOINT] if self.joint else separate
        size = len(pairs[JOINT].target)
        self.log("train/loss_step", result)
        self.count_loss(result)
        numbers = {f"train/{name}": losses[name].detach() for name in self.names}
        numbers |= {"train/separate": separate.detach(), "train/joint": losses[JOINT].detach()}
        self.log_dict(numbers, on_step=True, on_epoch=False, batch_size=size)
        self.log("train/phase", 2.0 if self.joint else 1.0, on_step=True, on_epoch=False, batch_size=size)
        return result

    def validation_loss(self, batch: Batch, output: Tensor, target: Tensor) -> Tensor:
        """Return the joint loss, of exposed output and reference, in either phase."""
        loss: Tensor = self.loss(output, target)
        return loss

    def configure_optimizers(self) -> dict[str, Any]:  # type: ignore[override]
        """Return the optimiser, with its schedule if there is one, and find the first joint step."""
        steps = self.trainer.estimated_stepping_batches
        self.joint_step = self._first_joint_step(steps)
        optimizer = self.make_optimizer(self.net.parameters())
        return scheduled(optimizer, self.make_lr_scheduler, steps, "Branches")

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: Any,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        """Take a step; those of the joint phase at its learning rate, the first without old moments."""
        if self.joint_step and self.trainer.global_step == self.joint_step:
            optimizer.state.clear()
        with self._rates(optimizer):
            super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)

    def _first_joint_step(self, steps: float) -> int:
        """Return the number of steps of the separate phase.

        Raises:
            ValueError: It depends on the length of the training, which is unknown.
        """
        if self.joint_after == 0:
            return 0
        if isinstance(self.joint_after, int):
            batches: float = self.trainer.num_training_batches
            count = (
                math.ceil(batches / self.trainer.accumulate_grad_batches) if batches < math.inf else math.inf
            )
            first = self.joint_after * count
        else:
            first = self.joint_after * steps
        if not 0 <= first < math.inf:
            raise ValueError(
                f"joint_after {self.joint_after} needs the length of the training; give --trainer.max_epochs "
                "or --trainer.max_steps"
            )
        return math.ceil(first)

    @contextmanager
    def _rates(self, optimizer: Optimizer) -> Iterator[None]:
        """Scale the learning rates for a joint step; schedules see their own again afterwards."""
        before = [group["lr"] for group in optimizer.param_groups]
        if self.joint and self.joint_lr is not None:
            for group in optimizer.param_groups:
                group["lr"] *= self.joint_lr / group.get("initial_lr", optimizer.defaults["lr"])
        try:
            yield
        finally:
            for group, rate in zip(optimizer.param_groups, before, strict=True):
                group["lr"] = rate
