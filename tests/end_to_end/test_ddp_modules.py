"""Every training module, with every network that ships, learns on two ranks as on their joint batches."""

import json
import os
import subprocess
import sys

import pytest
import torch

import trainer.modules
from tests.configs.test_configs import OVERLAYS, TRAINED, arguments
from trainer import configs

NAMES = [name for name in TRAINED if name not in OVERLAYS]
OVERLAY = """
model:
  init_args:
    optimizer: {class_path: torch.optim.SGD, init_args: {lr: 0.01}}
    lr_scheduler: null
trainer: {logger: false, callbacks: [], enable_checkpointing: false, accelerator: cpu}
"""


STEPS = {"nbgd7_bmfr.yaml": 1}
"""Steps of those that do not train three. Pixels change from one cell of a bilateral grid to the next: with
seven layers before it, rounding by 1/60,000 of a move in one step is 1/2,000 after two and 1/900 after three.
"""


def job(name, overlay):
    """Return arguments that train some steps of plain gradient descent, and validate."""
    return [
        *arguments(name), "--config", str(overlay), "--trainer.limit_train_batches", str(STEPS.get(name, 3)),
        "--trainer.logger", "false", "--trainer.callbacks", "[]",
        "--data.init_args.train_patches", "800", "--data.init_args.validation_patches", "450",
        "--data.init_args.sample_counts", "null",  # ranks may draw different numbers
    ]  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory, cache):
    """Name of the configuration → how it was trained → weights and scores."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "overlay.yaml").write_text(OVERLAY)
    jobs = folder / "jobs.json"
    jobs.write_text(json.dumps({name: job(name, folder / "overlay.yaml") for name in NAMES}))
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PENUMBRA_"))}
    environment |= {"OMP_NUM_THREADS": "1", "PENUMBRA_CACHE": str(cache)}
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = ["-m", "tests.end_to_end.ddp_modules", str(folder), str(jobs)]
    for command in ([sys.executable, *script, "joint"], [*torchrun, *script, "ranks"]):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=500)
        assert done.returncode == 0, done.stderr[-5000:]
    return {
        name: {how: torch.load(folder / f"{how}-{name}.pt", weights_only=True) for how in ("joint", "ranks")}
        for name in NAMES
    }


def moves(saved):
    """Return how far each weight moved in training."""
    before = {k: v for k, v in saved["before"].items() if v.is_floating_point()}
    return {key: (saved["after"][key] - value).double() for key, value in before.items()}


def test_every_training_module_is_trained():
    texts = [(configs.folder() / name).read_text() for name in NAMES]
    for module in trainer.modules.__all__:
        assert any(f"trainer.modules.{module}\n" in text for text in texts), module


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_two_ranks_learn_what_one_process_learns_from_their_joint_batches(name, trained):
    joint, ranks = trained[name]["joint"], trained[name]["ranks"]
    expected, found = moves(joint), moves(ranks)
    assert all(torch.equal(before, ranks["before"][key]) for key, before in joint["before"].items())
    assert sum(bool(move.any()) for move in expected.values()) > len(expected) / 2
    eps = torch.finfo(torch.float32).eps
    for key, move in expected.items():  # sums over pixels and small moves of large weights are rounded
        limit = 1e-2 * move.norm() + eps * joint["before"][key].norm()
        assert (found[key] - move).norm() <= limit, key
    whole, other = (torch.cat([v.flatten() for v in part.values()]) for part in (expected, found))
    assert (other - whole).norm() <= 1e-3 * whole.norm()
    for key, value in joint["scores"].items():
        if key.startswith("val/"):
            assert ranks["scores"][key] == pytest.approx(value, rel=1e-3), key
