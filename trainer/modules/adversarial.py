"""Adversarial training of a denoiser: L1 and WGAN-GP, as ACFM (2019) and AFGSA (2021) are trained.

Ishaan Gulrajani, Faruk Ahmed, Martin Arjovsky, Vincent Dumoulin, Aaron Courville: "Improved Training of
Wasserstein GANs", Advances in Neural Information Processing Systems 30, 2017, arXiv:1704.00028.

A critic D scores images; it learns to score references y above what the denoiser G makes of x,

    L_D = (mean D(G(x)) - mean D(y)) / 2 + 10 * mean((||grad D(z)||_2 - 1)^2),
    z   = u * G(x) + (1 - u) * y,   u uniform in [0, 1) for each sample,

and the denoiser learns to be near the reference and to be scored high,

    L_G = 1 * mean |G(x) - y| - 0.005 * mean D(G(x)).

Images are compared where the method's paper compares them (`Denoiser.training_pairs`): log(1 + radiance), for
ACFM of the diffuse and the specular part, each with a critic of its own. One forward pass of the denoiser
serves both updates.

The papers print the loss without the factor 1/2, AFGSA's with the signs of the critic reversed and its
penalty at generated images; the authors' code is followed (`halved=False` gives the paper's factor). AFGSA's
code updates the critic before the denoiser, ACFM's after it (`critic_first`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from torch import Tensor, nn
from torch.nn import functional

from models.critic import Critic
from models.denoiser import Denoiser, Pair
from trainer.divergence import diverged
from trainer.modules.evaluation import Batch, Evaluated
from trainer.modules.penalty import gradient_penalty, mixing
from trainer.modules.updates import Side, Turn, advance, check_crops, check_groups, check_number, turn
from trainer.schedules import MakeOptimizer, MakeSchedule, scheduled


class Adversarial(Evaluated):
    """Train a denoiser against critics; see the module for the losses.

    `trainer.global_step` counts updates of the denoiser. Gradients are averaged over the processes of
    `--trainer.strategy ddp` here, so that the options of that strategy do not matter.

    Args:
        net: The denoiser to train.
        critic: Makes a critic, one for each pair that the denoiser is compared in; a class path in a
            configuration. None is made where `adversarial_weight` is 0.
        adversarial_weight: Of -mean D(G(x)) in the denoiser's loss; 0 trains without critics.
        l1_weight: Of the mean absolute difference.
        penalty_weight: Of the gradient penalty in the critic's loss.
        halved: Halve the difference of the scores in the critic's loss, as the authors do.
        critic_first: Update the critic before the denoiser (AFGSA) or after it (ACFM). With `accumulate` both
            gradients are those before either update.
        critic_steps: Updates of the critic per update of the denoiser.
        accumulate: Batches per update, whose gradients are averaged.
        gradient_clip: Largest norm of a network's gradient; None: no limit.
        optimizer: Makes the denoiser's optimiser from parameter groups; a class path in a configuration.
        critic_optimizer: Makes the critics' optimiser; by default as `optimizer`.
        lr_scheduler: Makes the schedule of the denoiser's learning rate, none by default. Those with
            `interval = "step"` (`trainer.schedules`) advance after each of its updates, others each epoch.
        critic_lr_scheduler: The same for the critics; by default as `lr_scheduler`.
        lr_scales: Factors of the learning rate, by name of `net.parameter_groups()`.
        frozen_steps: For so many updates of the denoiser these groups stay as they were initialised.
        divergence_limit: Training stops where a gradient's norm or the critic's gap exceeds it.
        seed: Of the numbers u.

    Raises:
        ValueError: A number is out of range, or the denoiser has no group of a name.
    """

    remedy = (
        "Try a critic that keeps images apart (--model.critic.init_args.norm none), gradient clipping "
        "(--model.gradient_clip 1), smaller learning rates, or precision 32-true; "
        "--model.divergence_limit sets the limit."
    )

    def __init__(
        self,
        net: Denoiser,
        critic: Callable[[], nn.Module] = Critic,
        adversarial_weight: float = 0.005,
        l1_weight: float = 1.0,
        penalty_weight: float = 10.0,
        halved: bool = True,
        critic_first: bool = True,
        critic_steps: int = 1,
        accumulate: int = 1,
        gradient_clip: float | None = None,
        optimizer: MakeOptimizer = torch.optim.Adam,
        critic_optimizer: MakeOptimizer | None = None,
        lr_scheduler: MakeSchedule | None = None,
        critic_lr_scheduler: MakeSchedule | None = None,
        lr_scales: dict[str, float] | None = None,
        frozen_steps: dict[str, int] | None = None,
        divergence_limit: float = 1e6,
        seed: int = 1,
    ) -> None:
        super().__init__(net)
        self.keep_arguments()
        self.automatic_optimization = False
        self.critics = nn.ModuleDict({name: critic() for name in net.compared if adversarial_weight})
        self.adversarial_weight, self.l1_weight = adversarial_weight, l1_weight
        self.penalty_weight, self.halved = penalty_weight, halved
        self.critic_first, self.critic_steps = critic_first, critic_steps if self.critics else 1
        self.accumulate, self.gradient_clip = accumulate, gradient_clip
        self.make_optimizer, self.make_lr_scheduler = optimizer, lr_scheduler
        self.make_critic_optimizer = critic_optimizer or optimizer
        self.make_critic_lr_scheduler = critic_lr_scheduler or lr_scheduler
        self.lr_scales, self.frozen_steps = dict(lr_scales or {}), dict(frozen_steps or {})
        self.divergence_limit, self.seed = divergence_limit, seed
        self._check_arguments()

    def setup(self, stage: str) -> None:
        """Check the trainer, and tell it how many batches one update takes.

        Raises:
            ValueError: Its strategy or precision cannot train two networks.
        """
        if stage != "fit":
            return
        if not isinstance(self.trainer.strategy, SingleDeviceStrategy | DDPStrategy):
            raise ValueError("Adversarial trains on one device or with --trainer.strategy ddp")
        if self.trainer.precision in ("16-mixed", "16-true", "bf16-true"):
            raise ValueError(
                f"Adversarial does not train with precision {self.trainer.precision}, whose range or "
                "resolution the gradient penalty exceeds; use --trainer.precision bf16-mixed or 32-true"
            )
        self.net_side, self.critic_side = Side("train"), Side("critic")
        # Steps, lengths of schedules and logs are derived from it; manual optimisation ignores it otherwise.
        self.trainer.accumulate_grad_batches = self.accumulate * self.critic_steps

    def teardown(self, stage: str) -> None:
        """Give the trainer back as it came."""
        if stage == "fit":
            self.trainer.accumulate_grad_batches = 1

    def configure_optimizers(self) -> list[dict[str, Any]]:  # type: ignore[override]
        """Return the denoiser's optimiser and, where there are critics, theirs, with their schedules."""
        groups = [
            {"params": parameters, "name": name} for name, parameters in self.net.parameter_groups().items()
        ]
        optimizer = self.make_optimizer(groups)
        for group in optimizer.param_groups:
            group["lr"] *= self.lr_scales.get(group["name"], 1.0)
        steps = self.trainer.estimated_stepping_batches
        made = [scheduled(optimizer, self.make_lr_scheduler, steps, "Adversarial")]
        if self.critics:
            optimizer = self.make_critic_optimizer(self.critics.parameters())
            updates = steps * self.critic_steps
            made.append(scheduled(optimizer, self.make_critic_lr_scheduler, updates, "Adversarial"))
        return made

    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Update critics and denoiser where that is due; returns the denoiser's loss and the critics' gap.

        Raises:
            ValueError: Crops do not fit the critic, or the training diverges; the batch is saved then, and
                the weights are those before the update.
        """
        batches = batch_idx + 1 if self.trainer.is_last_batch else self.trainer.num_training_batches
        now = turn(batch_idx, batches, self.accumulate, self.critic_steps)
        with torch.set_grad_enabled(now.net):
            pairs = self.net.training_pairs(batch)
        check_crops(self.critics, pairs)
        critic_first = self.critic_first and self.accumulate == 1
        result: dict[str, Tensor] = {}
        with self._unsynchronised():
            if critic_first:
                result |= self._train_critics(pairs, batch, batch_idx, now)
            if now.net:
                result |= self._learn(pairs)
            if not critic_first:
                result |= self._train_critics(pairs, batch, batch_idx, now)
        if now.net and now.ends:
            self._update_net(batch)
        if batch_idx + 1 >= batches:
            for optimizer in self.trainer.optimizers:
                advance(self.trainer, optimizer, "epoch")
        return result

    def validation_loss(self, batch: Batch, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean absolute difference of what training compares, without the critics' part."""
        pairs = self.net.training_pairs(batch).values()
        return torch.stack([functional.l1_loss(pair.output, pair.target) for pair in pairs]).sum()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Let a run be validated and tested without its critics, or with others."""
        super().on_load_checkpoint(checkpoint)
        if self._trainer is not None and self.trainer.state.fn != "fit":
            weights = checkpoint["state_dict"]
            foreign = [name for name in weights if name.startswith("critics.")]
            own = {f"critics.{name}": value for name, value in self.critics.state_dict().items()}
            checkpoint["state_dict"] = {k: v for k, v in weights.items() if k not in foreign} | own

    def _train_critics(
        self, pairs: dict[str, Pair], batch: Batch, batch_idx: int, now: Turn
    ) -> dict[str, Tensor]:
        """Add the critics' gradients, and update them where that is due; returns the gap of the scores."""
        if not self.critics:
            return {}
        numbers: dict[str, list[Tensor]] = {"loss": [], "gap": [], "penalty": []}
        for index, (name, critic) in enumerate(self.critics.items()):
            real, fake = pairs[name].target, pairs[name].output.detach()
            # The zero keeps the numbers of runs that began when ranks had keys of their own.
            mix = mixing((self.seed, self.current_epoch, batch_idx, 0, index), real, self.global_rank)
            gap = critic(real).float().mean() - critic(fake).float().mean()
            penalty = gradient_penalty(critic, real, fake, mix)
            loss = (-0.5 if self.halved else -1.0) * gap + self.penalty_weight * penalty
            self._backward(loss)
            for kind, value in (("loss", loss), ("gap", gap), ("penalty", penalty)):
                numbers[kind].append(value.detach())
        self.critic_side.count(numbers, names=tuple(self.critics))
        if now.ends:
            _, optimizer = self.trainer.optimizers
            self._settle(self.critic_side, list(self.critics.parameters()), batch)
            optimizer.step()  # past Lightning, which would count it as a step of the training
            optimizer.zero_grad()
            advance(self.trainer, optimizer, "step")
        return {"gap": torch.stack(numbers["gap"]).sum()}

    def _learn(self, pairs: dict[str, Pair]) -> dict[str, Tensor]:
        """Add the denoiser's gradients; returns its loss."""
        numbers: dict[str, list[Tensor]] = {"l1": [], "adversarial": []}
        for name, pair in pairs.items():
            numbers["l1"].append(functional.l1_loss(pair.output, pair.target))
            if self.critics:
                critic = self.critics[name].requires_grad_(False)
                numbers["adversarial"].append(-critic(pair.output).float().mean())
        loss = self.l1_weight * torch.stack(numbers["l1"]).sum()
        if self.critics:
            loss = loss + self.adversarial_weight * torch.stack(numbers["adversarial"]).sum()
        self._backward(loss)
        self.critics.requires_grad_(True)
        self.net_side.count({"loss": [loss], **numbers}, names=tuple(pairs))
        return {"loss": loss.detach()}

    def _update_net(self, batch: Batch) -> None:
        """Take a step of the denoiser, the one that the trainer counts, and log both sides."""
        for name, group in self.net.parameter_groups().items():
            if self.trainer.global_step < self.frozen_steps.get(name, 0):
                for parameter in group:
                    parameter.grad = None
        self._settle(self.net_side, list(self.net.parameters()), batch)
        optimizers = self.optimizers()
        optimizer = optimizers[0] if isinstance(optimizers, list) else optimizers
        optimizer.step()
        optimizer.zero_grad()
        advance(self.trainer, self.trainer.optimizers[0], "step")
        numbers = self.net_side.numbers | self.critic_side.numbers
        loss = numbers.pop("train/loss")
        self.count_loss(torch.as_tensor(loss))
        step = self.trainer.global_step
        if step % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            # Not by self.log, which would repeat the numbers after batches that update nothing.
            numbers |= {"train/loss_step": loss, "epoch": self.current_epoch}
            for logger in self.trainer.loggers:
                logger.log_metrics(numbers, step=step - 1)

    def _settle(self, side: Side, parameters: list[nn.Parameter], batch: Batch) -> None:
        """Average and clip the gradients of a side.

        Raises:
            ValueError: A number of it is not finite or beyond the limit; its weights are still the old ones.
        """
        side.settle(parameters, self.gradient_clip)
        watched = (f"{side.prefix}/gradient_norm", f"{side.prefix}/gap")
        for name, value in side.numbers.items():
            if not math.isfinite(value):
                raise diverged(self, batch, f"{name} became {value}")
            if name in watched and abs(value) > self.divergence_limit:
                limit = f"beyond divergence_limit {self.divergence_limit:g}"
                raise diverged(self, batch, f"{name} became {value:.4g}, {limit},")

    def _backward(self, loss: Tensor) -> None:
        """Add gradients, outside of the autocast that surrounds the training step."""
        with torch.autocast(self.device.type, enabled=False):
            self.manual_backward(loss)

    def _unsynchronised(self) -> AbstractContextManager[None]:
        """Return a context in which DDP sends no gradients."""
        context: AbstractContextManager[None]
        context = getattr(self.trainer.strategy, "block_backward_sync", nullcontext)()
        return context

    def _check_arguments(self) -> None:
        for name in ("adversarial_weight", "l1_weight", "penalty_weight", "seed"):
            check_number(name, getattr(self, name), zero=True)
        for name in ("critic_steps", "accumulate", "divergence_limit", "gradient_clip"):
            check_number(name, getattr(self, name))
        check_groups(self.net, "lr_scales", self.lr_scales)
        check_groups(self.net, "frozen_steps", self.frozen_steps, zero=True)
