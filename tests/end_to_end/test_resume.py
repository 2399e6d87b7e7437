"""A run that is killed continues where it was and ends with the same weights to the bit."""

import os
import signal
import time

import pytest
import torch

from trainer.runs import RunRecord
from trainer.tracking import open_client

# Epochs are short, so that both the middle of an epoch and its end are passed.
OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "3", "--trainer.limit_train_batches", "7",
    "--trainer.limit_val_batches", "1", "--data.init_args.batch_size", "2",
    "--trainer.log_every_n_steps", "1",
)  # fmt: skip
CALLBACKS = """
trainer:
  callbacks:
    - class_path: trainer.callbacks.TrainingProgress
    - class_path: trainer.callbacks.BestCheckpoint
    - class_path: trainer.callbacks.LastCheckpoint
      init_args: {every_n_train_steps: 2}
    - class_path: trainer.callbacks.FiniteGuard
"""


def options(place):
    overlay = place.folder / "callbacks.yaml"
    overlay.write_text(CALLBACKS)
    return (*OPTIONS, "--config", str(overlay))


def final(place):
    return torch.load(place.runs[0] / "checkpoints" / "last.ckpt", weights_only=True)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, cache):
    from tests.end_to_end.conftest import Workplace

    place = Workplace(tmp_path_factory.mktemp("whole"), cache)
    place.trainer("fit", *options(place))
    return place


@pytest.mark.parametrize("kill_at", [4, 8], ids=["middle of an epoch", "after an epoch"])
def test_killed_run_continues_in_its_mlflow_run_with_identical_weights(workplace, uninterrupted, kill_at):
    process = workplace.start("fit", *options(workplace))
    step = wait_for_step(workplace, kill_at, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert step < 21, "the run ended before it was killed"
    before = RunRecord.load(workplace.runs[0])

    workplace.trainer("fit", *options(workplace), "--ckpt_path", "last")

    assert len(workplace.runs) == 1
    after = RunRecord.load(workplace.runs[0])
    assert before.run_id in (None, after.run_id)  # a very early kill comes before the store's first answer
    resumed, whole = final(workplace), final(uninterrupted)
    assert resumed["global_step"] == whole["global_step"] == 21
    for name, tensor in whole["state_dict"].items():
        assert torch.equal(tensor, resumed["state_dict"][name]), name
    assert_equal_trees(whole["optimizer_states"], resumed["optimizer_states"])
    client = open_client(after.tracking_uri)
    run = client.get_run(after.run_id)
    assert run.info.status == "FINISHED"
    assert len(client.search_runs([run.info.experiment_id])) == 1
    for key, steps in (("train/loss_step", range(21)), ("val/psnr_wskp", (6, 13, 20))):
        history = client.get_metric_history(after.run_id, key)
        assert sorted(metric.step for metric in history) == list(steps), key
    for key in ("train/loss_step", "train/loss_epoch", "val/psnr_wskp", "val/loss"):
        assert recorded(workplace, key) == recorded(uninterrupted, key), key


def recorded(place, key):
    """Return the history of a metric in the store, steps and values."""
    record = RunRecord.load(place.runs[0])
    history = open_client(record.tracking_uri).get_metric_history(record.run_id, key)
    return sorted((metric.step, metric.value) for metric in history)


def wait_for_step(place, step, process):
    """Wait until a checkpoint of at least this step lies on the disk, and return its step."""
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and process.poll() is None:
        for run in place.runs:
            path = run / "checkpoints" / "last.ckpt"
            if path.is_file():
                saved = torch.load(path, weights_only=True)["global_step"]
                if saved >= step:
                    return saved
        time.sleep(0.02)
    raise AssertionError(f"no checkpoint of step {step}: {process.communicate()[0]}")


def assert_equal_trees(one, other):
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal_trees(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal_trees(a, b)
    else:
        assert one == other
