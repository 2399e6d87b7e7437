"""Trainings on a cluster of two nodes."""

import os
import signal
import time

import pytest
import torch

from trainer.runs import RunRecord
from trainer.tracking import open_client

pytestmark = pytest.mark.slow

OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "2", "--trainer.limit_train_batches", "6",
    "--trainer.limit_val_batches", "1", "--data.init_args.batch_size", "1",
    "--data.init_args.train_patches", "80",
    "--config", "callbacks.yaml",
)  # fmt: skip
CALLBACKS = """
trainer:
  callbacks:
    - class_path: trainer.callbacks.TrainingProgress
    - class_path: trainer.callbacks.BestCheckpoint
    - class_path: trainer.callbacks.LastCheckpoint
      init_args: {every_n_train_steps: 2}
    - class_path: tests.trainer.cluster.slow_steps.SlowSteps
"""


def weights(place):
    return torch.load(place.runs[0] / "checkpoints" / "last.ckpt", weights_only=True)


def equal(one, other):
    assert one["global_step"] == other["global_step"] == 12
    for name, tensor in one["state_dict"].items():
        assert torch.equal(tensor, other["state_dict"][name]), name


@pytest.fixture(scope="session")
def with_torchrun(tmp_path_factory, cluster_cache):
    """The final checkpoint of the same training by Lightning's own two processes."""
    from tests.end_to_end.conftest import Workplace

    place = Workplace(tmp_path_factory.mktemp("alone"), cluster_cache)
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    place.trainer(
        "fit", *OPTIONS, "--trainer.devices", "2", "--trainer.strategy", "ddp", "--trainer.accelerator", "cpu"
    )
    return weights(place)


def test_two_nodes_end_with_the_weights_of_two_processes_to_the_bit(submitting, with_torchrun):
    place, submit = submitting("two")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    printed = place.trainer(*submit, *OPTIONS, "--storage", str(place.folder / "shared"))
    equal(weights(place), with_torchrun)
    assert "epoch 1: validation PSNR" in printed
    assert "trained 12 steps" in printed
    assert "Traceback" not in printed
    mirrored = place.folder / "shared" / "wskp_bmfr" / place.runs[0].name / "checkpoints" / "last.ckpt"
    equal(torch.load(mirrored, weights_only=True), with_torchrun)


@pytest.mark.parametrize("rank", [0, 1])
def test_killed_worker_is_replaced_and_the_run_ends_as_if_nothing_had_happened(
    submitting, with_torchrun, rank
):
    place, submit = submitting(f"killed{rank}")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    process = place.start(*submit, *OPTIONS)
    kill_at(place, process, 4, rank)
    output, _ = process.communicate(timeout=400)
    assert process.returncode == 0, output
    assert "its process died" in output
    assert "restarted: the run" in output
    equal(weights(place), with_torchrun)
    assert len(place.runs) == 1
    record = RunRecord.load(place.runs[0])
    client = open_client(record.tracking_uri)
    assert client.get_run(record.run_id).info.status == "FINISHED"
    assert len(client.search_runs([client.get_run(record.run_id).info.experiment_id])) == 1
    steps = [metric.step for metric in client.get_metric_history(record.run_id, "val/psnr_wskp")]
    assert steps == sorted(set(steps))
    assert len(steps) == 2


def kill_at(place, process, step, rank):
    """Kill the process of a rank when a checkpoint of at least this step lies on the disk."""
    deadline = time.monotonic() + 240
    while process.poll() is None and time.monotonic() < deadline:
        for run in place.runs:
            path = run / "checkpoints" / "last.ckpt"
            if path.is_file() and step <= torch.load(path, weights_only=True)["global_step"] < 12:
                os.kill(int((place.folder / f"rank-{rank}.pid").read_text()), signal.SIGKILL)
                return
        time.sleep(0.02)
    raise AssertionError(f"no checkpoint of step {step}: {process.communicate()[0]}")


def test_wrong_data_ends_the_job_at_once_with_its_message(submitting):
    place, submit = submitting("wrong")
    output = place.trainer(*submit, "--config", "wskp_bmfr.yaml", "--data.root", "nowhere", code=1)
    assert "nowhere" in output.splitlines()[-1]
    assert "attempt" not in output
    assert "Traceback" not in output


def test_interrupt_cancels_the_job_and_leaves_a_run_that_can_be_continued(submitting):
    place, submit = submitting("cancelled")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    process = place.start(*submit, *OPTIONS, "--trainer.max_epochs", "50")
    deadline = time.monotonic() + 240
    while not [*place.folder.glob("runs/*/*/checkpoints/last.ckpt")]:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert "continue with --ckpt_path last" in output
