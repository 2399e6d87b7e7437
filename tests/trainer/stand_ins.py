"""Small denoisers and a critic for tests of adversarial training."""

from functools import partial

import torch
from lightning.pytorch import Trainer, seed_everything
from torch import nn
from torch.utils.checkpoint import checkpoint

from models.denoiser import Denoised, Denoiser, Pair
from tests.synthetic import Synthetic
from trainer.modules import Adversarial


class LogNet(Denoiser):
    """Adds a correction to log(1 + radiance): two convolutions in two parameter groups."""

    inputs = ("color",)
    halo = 2

    def __init__(self, width=4, checkpointed=False):
        super().__init__()
        self.base = nn.Conv2d(3, width, 3, padding=1)
        self.modulation = nn.Conv2d(width, 3, 3, padding=1)
        self.checkpointed = checkpointed

    def log_radiance(self, color):
        noisy = torch.log1p(color.float().clamp(0, 1e6))
        if self.checkpointed:
            return noisy + checkpoint(self._correction, noisy, use_reentrant=False)
        return noisy + self._correction(noisy)

    def _correction(self, noisy):
        return self.modulation(torch.tanh(self.base(noisy))).float()

    def forward(self, buffers):
        return Denoised(torch.expm1(self.log_radiance(buffers["color"]).clamp(0, 20)))

    def training_pairs(self, batch):
        return {"color": Pair(self.log_radiance(batch["color"]), torch.log1p(batch["reference"]))}

    def parameter_groups(self):
        return {"base": list(self.base.parameters()), "modulation": list(self.modulation.parameters())}


class SplitNet(LogNet):
    """Compared in two pairs, as ACFM is."""

    compared = ("diffuse", "specular")

    def training_pairs(self, batch):
        whole = super().training_pairs(batch)["color"]
        half = Pair(whole.output / 2, whole.target / 2)
        return {"diffuse": whole, "specular": half}


class SmoothCritic(nn.Module):
    """Sees 32x32 pixels; smooth everywhere, so that gradients can be compared."""

    def __init__(self, width=3, size=32):
        super().__init__()
        self.size = size
        self.first = nn.Conv2d(3, width, 4, stride=4)
        self.last = nn.Linear(width * (size // 4) ** 2, 1)

    def forward(self, image):
        return self.last(torch.tanh(self.first(image)).flatten(1))[:, 0]


class BrokenCritic(SmoothCritic):
    """Scores nan, or far too high, from a given call on."""

    def __init__(self, after=6, factor=float("nan")):
        super().__init__()
        self.calls, self.after, self.factor = 0, after, factor

    def forward(self, image):
        self.calls += 1
        return super().forward(image) * (self.factor if self.calls > self.after else 1)


def module(net=LogNet, critic=SmoothCritic, **options):
    """An adversarial training with the same weights each time."""
    seed_everything(3, verbose=False)
    options.setdefault("optimizer", partial(torch.optim.Adam, lr=1e-3))
    return Adversarial(net(), critic, **options)


def trainer(folder=".", callbacks=(), **options):
    defaults = {
        "max_epochs": 1, "logger": False, "limit_val_batches": 0, "enable_checkpointing": bool(callbacks),
        "log_every_n_steps": 1, "enable_progress_bar": False,
    }  # fmt: skip
    return Trainer(
        default_root_dir=folder, callbacks=list(callbacks), accelerator="cpu", enable_model_summary=False,
        num_sanity_val_steps=0, **(defaults | options),
    )  # fmt: skip


def fit(adversarial, batch_size=2, count=8, **options):
    """Train on `count` patches; returns the trainer."""
    made = trainer(**options)
    made.fit(adversarial, datamodule=Synthetic(batch_size=batch_size, count=count))
    return made
