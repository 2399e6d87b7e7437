"""Adversarial training through the command line: two processes, killed and continued, exported, denoised."""

import os
import signal

import pytest
import torch

from models.critic import Critic
from tests.end_to_end.test_ddp import global_batches
from tests.end_to_end.test_resume import assert_equal_trees, final, wait_for_step
from trainer.loading import resolve
from trainer.modules.penalty import mixing
from trainer.runs import RunRecord

MODEL = """
model:
  class_path: trainer.modules.Adversarial
  init_args:
    net: {class_path: models.WSKP, init_args: {layers: 3}}
    critic: {class_path: models.critic.Critic, init_args: {width: 2, norm: none, init: kaiming}}
    adversarial_weight: 0.1
    optimizer: {class_path: torch.optim.SGD, init_args: {lr: 0.01, momentum: 0.9}}
    lr_scheduler: {class_path: trainer.schedules.Halving, init_args: {milestones: [4], per: step}}
data:
  class_path: data.Shards
  init_args: {root: sample:bmfr, batch_size: 2, augment: false, train_patches: 80}
trainer:
  limit_val_batches: 1
  accelerator: cpu
  callbacks:
    - class_path: trainer.callbacks.TrainingProgress
    - class_path: trainer.callbacks.LastCheckpoint
      init_args: {every_n_train_steps: 2}
    - class_path: trainer.callbacks.FiniteGuard
"""


def options(place, epochs, batches):
    path = place.folder / "adversarial.yaml"
    path.write_text(MODEL)
    return (
        "fit", "--config", str(path), "--trainer.max_epochs", str(epochs),
        "--trainer.limit_train_batches", str(batches),
    )  # fmt: skip


def one_process(batches):
    """Train on the joint batches of two ranks; returns the weights."""
    from lightning.pytorch import seed_everything

    from models import WSKP

    seed_everything(1)
    net = WSKP(layers=3)
    critic = Critic(norm="none", width=2, init="kaiming")
    sides = [torch.optim.SGD(part.parameters(), lr=0.01, momentum=0.9) for part in (critic, net)]
    for number, batch in enumerate(batches):
        pair = net.training_pairs(batch)["color"]
        real, fake = pair.target, pair.output.detach()
        u = mixing((1, 0, number, 0, 0), real)
        between = (u * fake + (1 - u) * real).requires_grad_()
        slope = torch.autograd.grad(critic(between).sum(), between, create_graph=True)[0]
        penalty = ((slope.square().sum((1, 2, 3)) + 1e-12).sqrt() - 1).square().mean()
        loss = (critic(fake).mean() - critic(real).mean()) / 2 + 10 * penalty
        sides[0].zero_grad()
        loss.backward()
        sides[0].step()
        loss = (pair.output - pair.target).abs().mean() - 0.1 * critic(pair.output).mean()
        sides[1].zero_grad()
        loss.backward()
        sides[1].step()
    weights = {f"net.{name}": value for name, value in net.state_dict().items()}
    return weights | {f"critics.color.{name}": value for name, value in critic.state_dict().items()}


@pytest.mark.slow
def test_two_gloo_processes_end_with_the_weights_of_one_on_the_joint_batches(workplace, cache):
    workplace.trainer(*options(workplace, 1, 3), "--trainer.devices", "2", "--trainer.strategy", "ddp")
    saved = final(workplace)
    assert saved["global_step"] == 3
    for name, tensor in one_process(global_batches(cache, 3)).items():
        assert torch.allclose(saved["state_dict"][name], tensor, rtol=1e-4, atol=1e-5), name


ADAM = ("--model.init_args.optimizer", "torch.optim.Adam", "--model.init_args.optimizer.init_args.lr", "1e-3")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, cache):
    from tests.end_to_end.conftest import Workplace

    place = Workplace(tmp_path_factory.mktemp("whole"), cache)
    place.trainer(*options(place, 2, 7), *ADAM)
    return final(place)


@pytest.mark.slow
def test_killed_run_continues_in_its_run_with_identical_denoiser_and_critic(workplace, uninterrupted):
    process = workplace.start(*options(workplace, 2, 7), *ADAM)
    step = wait_for_step(workplace, 4, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert step < 14, "the run ended before it was killed"
    before = RunRecord.load(workplace.runs[0])
    workplace.trainer(*options(workplace, 2, 7), *ADAM, "--ckpt_path", "last")
    assert len(workplace.runs) == 1
    assert before.run_id in (None, RunRecord.load(workplace.runs[0]).run_id)
    resumed = final(workplace)
    assert resumed["global_step"] == uninterrupted["global_step"] == 14
    for key in ("state_dict", "optimizer_states", "lr_schedulers"):
        assert_equal_trees(dict(uninterrupted)[key], resumed[key])
    # The critic is left out where the denoiser is used.
    path = workplace.runs[0] / "checkpoints" / "last.ckpt"
    loaded = resolve(str(path)).model.state_dict()
    assert set(loaded) == {k.removeprefix("net.") for k in resumed["state_dict"] if k.startswith("net.")}
