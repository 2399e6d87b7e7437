"""Trains shipped configurations on two ranks, or in one process on the joint batches; run by torchrun.

    python -m tests.end_to_end.ddp_modules OUTPUT JOBS.json joint
    torchrun --nproc-per-node 2 -m tests.end_to_end.ddp_modules OUTPUT JOBS.json ranks

JOBS.json: name → arguments of `trainer fit`. Writes `<name>.pt`: weights before and after, validation scores.
"""

import json
import sys
from pathlib import Path

import torch

from data import Shards
from trainer import configs
from trainer.modules import Regression
from trainer.training import TrainingCLI, quiet_libraries

RANKS = 2


class HalvedGradients(Regression):
    """Halves the gradients of two batches as two ranks do, behind the backward pass and not before it.

    Lightning halves the loss of accumulated batches. In the backward pass of WSKP's exponentials some numbers
    are so small that float32 rounds their halves, of which a bit of a gradient comes in one step of forty; at
    a high learning rate that grows to other weights.
    """

    def training_step(self, batch, batch_idx):
        return RANKS * super().training_step(batch, batch_idx)

    def on_before_optimizer_step(self, optimizer):
        for parameter in self.net.parameters():
            if parameter.grad is not None:
                parameter.grad /= RANKS


class Joint(Shards):
    """Delivers in one process the batches of all ranks, joined."""

    def train_dataloader(self):
        loaders = []
        for rank in range(RANKS):
            self._place = lambda rank=rank: (rank, RANKS)
            loaders.append(super().train_dataloader())
        del self._place
        return JointLoader(loaders)


class Interleaved(Shards):
    """Delivers in one process the batches of all ranks in turn.

    With as many batches per step as there are ranks, one process adds up the gradients that two ranks send
    each other, halved on both sides, so that it ends with the same weights to the bit.
    """

    def train_dataloader(self):
        loaders = []
        for rank in range(RANKS):
            self._place = lambda rank=rank: (rank, RANKS)
            loaders.append(super().train_dataloader())
        del self._place
        for loader in loaders:
            loader._done = lambda: 0  # a run of this kind is not resumed
        return InterleavedLoader(loaders)


class InterleavedLoader:
    """Batches of all ranks in turn."""

    def __init__(self, loaders):
        self.loaders = loaders

    @property
    def batch_sampler(self):
        return self.loaders[0].batch_sampler._replace(sampler=self)

    def set_epoch(self, epoch):
        for loader in self.loaders:
            loader.set_epoch(epoch)

    def __len__(self):
        return RANKS * len(self.loaders[0])

    def __iter__(self):
        for parts in zip(*self.loaders, strict=True):
            yield from parts


class JointLoader:
    """Batches of all ranks, joined."""

    def __init__(self, loaders):
        self.loaders = loaders

    def __len__(self):
        return len(self.loaders[0])

    def __iter__(self):
        return map(joined, zip(*self.loaders, strict=True))


def joined(parts):
    """Return one batch of several."""
    whole = dict(parts[0])
    for key, value in parts[0].items():
        if isinstance(value, torch.Tensor):
            whole[key] = torch.cat([part[key] for part in parts])
        elif key != "sample_channels":
            whole[key] = [item for part in parts for item in part[key]]
    return whole


def weights(cli):
    return {name: value.detach().clone() for name, value in cli.model.state_dict().items()}


class Recorded(TrainingCLI):
    """Keeps the weights before training."""

    def before_fit(self):
        super().before_fit()
        self.before = weights(self)


def main():
    output, jobs, how = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()), sys.argv[3]
    quiet_libraries()
    torch.set_num_threads(1)
    for name, arguments in jobs.items():
        if how == "joint":
            extra = ["--data", f"{__spec__.name}.Joint", "--trainer.limit_val_batches", str(2 * RANKS)]
        else:
            extra = ["--trainer.devices", str(RANKS), "--trainer.strategy", "ddp"]
            extra += ["--trainer.limit_val_batches", "2"]
        sys.argv = ["trainer", *configs.resolve_arguments(arguments), *extra]
        cli = Recorded()
        if cli.trainer.is_global_zero:
            scores = {key: float(value) for key, value in cli.trainer.callback_metrics.items()}
            saved = {"before": cli.before, "after": weights(cli), "scores": scores}
            torch.save(saved, output / f"{how}-{name}.pt")


if __name__ == "__main__":
    main()
