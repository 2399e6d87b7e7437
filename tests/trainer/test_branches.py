"""Separate, then joint training."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from torch.utils.data import DataLoader, Dataset

from models import KPCN, WSKP
from tests.models.frames import split_buffers
from tests.synthetic import Synthetic
from trainer.modules import Branches
from trainer.schedules import Halving, OneCycle

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
    pytest.mark.filterwarnings("ignore:.*your dataloader is not resumable"),
]


class Split(Dataset):
    """Twelve patches whose light is split. Batches of four are all the same, wherever a run resumes."""

    def __len__(self):
        return 12

    def __getitem__(self, index):
        one = {name: value[0] for name, value in split_buffers(1, 24, 24, index % 4).items()}
        scene = "plane" if index % 2 else "step"
        return {**one, "exposure": torch.tensor(1.0), "depth_range": torch.tensor([1.0, 6.0]), "scene": scene}


class SplitData(Synthetic):
    def train_dataloader(self):
        return DataLoader(Split(), self.batch_size)

    def val_dataloader(self):
        return DataLoader(Split(), 4)


class Log(Callback):
    """Notes what a step was: phase, losses, learning rate inside the step, gradients of the branches."""

    def __init__(self):
        self.rows, self.rates = [], []

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        self.rows.append({name: float(value) for name, value in trainer.callback_metrics.items()})

    def on_before_optimizer_step(self, trainer, module, optimizer):
        self.rates.append(optimizer.param_groups[0]["lr"])


def module(**options):
    torch.manual_seed(3)
    return Branches(KPCN(width=4, layers=2, kernel_size=3), **options)


def train(folder, trained, checkpoint=None, batch_size=4, **options):
    log = Log()
    trainer = Trainer(
        **{"max_epochs": 4, **options},
        default_root_dir=folder, logger=False, accelerator="cpu", devices=1, callbacks=[log],
        enable_model_summary=False, enable_progress_bar=False, enable_checkpointing=False,
        num_sanity_val_steps=0, log_every_n_steps=1,
    )  # fmt: skip
    trainer.fit(trained, SplitData(batch_size), ckpt_path=checkpoint, weights_only=True)
    return trainer, log


def phases(log):
    return [int(row["train/phase"]) for row in log.rows]


def test_the_phase_changes_after_whole_epochs_or_a_share_of_the_steps(tmp_path):
    assert phases(train(tmp_path, module(joint_after=1), max_epochs=2)[1]) == [1, 1, 1, 2, 2, 2]
    assert phases(train(tmp_path, module(joint_after=0.75))[1]) == [1] * 9 + [2] * 3
    assert phases(train(tmp_path, module(joint_after=0), max_epochs=1)[1]) == [2] * 3
    assert phases(train(tmp_path, module(joint_after=1.0), max_epochs=1)[1]) == [1] * 3


def test_each_phase_minimises_its_loss_and_both_are_logged(tmp_path):
    _, log = train(tmp_path, module(joint_after=0.5), max_epochs=2)
    for row in log.rows:
        assert row["train/separate"] == pytest.approx(row["train/diffuse"] + row["train/specular"])
        minimised = "train/separate" if row["train/phase"] == 1 else "train/joint"
        assert row["train/loss_step"] == pytest.approx(row[minimised])
    assert log.rows[-1]["val/loss"] > 0


def test_the_separate_phase_trains_each_branch_as_if_alone(tmp_path):
    both = module(joint_after=1.0)
    batch = {
        k: torch.stack([Split()[i][k] for i in range(2)]) for k in Split()[0] if k not in ("scene", "frame")
    }
    pairs = both.net.training_pairs(batch)
    losses = {name: both.loss(*pairs[name]) for name in both.names}
    parameters = both.net.parameter_groups()["diffuse"]
    alone = torch.autograd.grad(losses["diffuse"], parameters, retain_graph=True)
    together = torch.autograd.grad(losses["diffuse"] + losses["specular"], parameters)
    assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


def test_the_joint_phase_has_its_own_learning_rate_and_fresh_moments(tmp_path):
    trainer, log = train(tmp_path, module(joint_after=1), max_epochs=2)
    assert log.rates == pytest.approx([1e-4] * 3 + [1e-6] * 3)
    optimizer = trainer.optimizers[0]
    assert optimizer.param_groups[0]["lr"] == 1e-4
    assert {int(state["step"]) for state in optimizer.state.values()} == {3}


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        (partial(Halving, milestones=[1, 3]), [1, 1, 1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.25, 0.25, 0.25]),
        (partial(Halving, milestones=[2, 7], per="step"), [1, 1] + [0.5] * 5 + [0.25] * 5),
    ],
)
def test_a_schedule_goes_on_in_the_joint_phase(tmp_path, schedule, factors):
    _, log = train(tmp_path, module(joint_after=2, lr_scheduler=schedule))
    base = [1e-4] * 6 + [1e-6] * 6
    assert log.rates == pytest.approx([b * f for b, f in zip(base, factors, strict=True)])


def test_one_cycle_spans_both_phases(tmp_path):
    _, log = train(tmp_path, module(joint_after=0.5, lr_scheduler=OneCycle), max_epochs=2)
    cycle = OneCycle(torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0))
    cycle.span(6)
    base = [1e-4] * 3 + [1e-6] * 3
    assert log.rates == pytest.approx([b * cycle.factor(i) for i, b in enumerate(base)])


def test_accumulation_and_clipping_count_updates_not_batches(tmp_path):
    options = {"accumulate_grad_batches": 2, "gradient_clip_val": 0.1, "max_epochs": 2}
    _, log = train(tmp_path, module(joint_after=1), batch_size=2, **options)
    assert phases(log) == [1] * 6 + [2] * 6
    assert log.rates == pytest.approx([1e-4] * 3 + [1e-6] * 3)


@pytest.mark.parametrize("stop", [2, 6, 8])
def test_a_resumed_run_ends_with_the_same_weights(tmp_path, stop):
    def fresh():
        return module(joint_after=0.5, lr_scheduler=OneCycle)

    whole = fresh()
    train(tmp_path, whole)

    class Keep(Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            if trainer.global_step == stop:
                trainer.save_checkpoint(tmp_path / "kept.ckpt")

    trainer = Trainer(
        max_epochs=4, default_root_dir=tmp_path, logger=False, accelerator="cpu", callbacks=[Keep()],
        enable_model_summary=False, enable_progress_bar=False, enable_checkpointing=False,
        limit_val_batches=0, log_every_n_steps=1,
    )  # fmt: skip
    trainer.fit(fresh(), SplitData())
    resumed = fresh()
    train(tmp_path, resumed, checkpoint=tmp_path / "kept.ckpt")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_denoiser_without_branches_is_refused():
    with pytest.raises(ValueError, match="WSKP compares only color; use Regression"):
        Branches(WSKP())


@pytest.mark.parametrize("wrong", [{"joint_after": -1}, {"joint_after": 1.5}, {"joint_lr": 0.0}])
def test_numbers_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        module(**wrong)


def test_a_share_of_an_endless_training_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needs the length of the training"):
        train(tmp_path, module(joint_after=0.5), max_epochs=-1)
