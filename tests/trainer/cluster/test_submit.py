"""Trainings on a cluster of two nodes."""

import os
import random
import shutil
import signal
import time

import pytest
import torch

from tests.end_to_end.conftest import Workplace
from trainer.runs import RunRecord
from trainer.spool.sent import left
from trainer.tracking import open_client

pytestmark = pytest.mark.slow

OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "2", "--trainer.limit_train_batches", "6",
    "--trainer.limit_val_batches", "1", "--data.init_args.batch_size", "1",
    "--data.init_args.train_patches", "80", "--data.init_args.workers", "0",
    "--trainer.log_every_n_steps", "1",
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


def weights(place, name):
    return torch.load(place.runs[0] / "checkpoints" / f"{name}.ckpt", weights_only=True)


def histories(place):
    """Return the steps of all numbers of the one run in the tracking store, which has ended well."""
    (run,) = place.runs
    record = RunRecord.load(run)
    client = open_client(record.tracking_uri)
    found = client.get_run(record.run_id)
    assert found.info.status == "FINISHED"
    assert len(client.search_runs([found.info.experiment_id])) == 1
    keys = [key for key in found.data.metrics if not key.startswith("system/")]
    return {key: [metric.step for metric in client.get_metric_history(record.run_id, key)] for key in keys}


def equal(place, other):
    """Check that a training ended as another did: weights to the bit, numbers without gap or duplicate."""
    for kind in ("last", "best"):
        one, two = weights(place, kind), weights(other, kind)
        assert one["global_step"] == two["global_step"]
        for name, tensor in one["state_dict"].items():
            assert torch.equal(tensor, two["state_dict"][name]), (kind, name)
    assert weights(place, "last")["global_step"] == 12
    assert histories(place) == histories(other)


@pytest.fixture
def chance():
    """The moments at which processes are killed; `PENUMBRA_SEED` repeats those of a test that failed."""
    seed = int(os.environ.get("PENUMBRA_SEED", random.randrange(2**32)))
    print(f"PENUMBRA_SEED={seed}")
    return random.Random(seed)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, cluster_cache):
    """The same training by Lightning's own two processes."""
    place = Workplace(tmp_path_factory.mktemp("alone"), cluster_cache)
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    place.trainer(
        "fit", *OPTIONS, "--trainer.devices", "2", "--trainer.strategy", "ddp", "--trainer.accelerator", "cpu"
    )
    return place


def test_two_nodes_end_with_the_weights_of_two_processes_to_the_bit(submitting, undisturbed):
    place, submit = submitting("two")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    printed = place.trainer(*submit, *OPTIONS, "--storage", str(place.folder / "shared"))
    equal(place, undisturbed)
    assert "epoch 1: validation PSNR" in printed
    assert "trained 12 steps" in printed
    assert "Traceback" not in printed
    mirror = place.folder / "shared" / "wskp_bmfr" / place.runs[0].name
    assert (mirror / "checkpoints" / "last.ckpt").read_bytes() == (
        place.runs[0] / "checkpoints" / "last.ckpt"
    ).read_bytes()
    assert left(mirror) == 0


@pytest.mark.parametrize("rank", [0, 1])
def test_killed_worker_is_replaced_and_the_run_ends_as_if_nothing_had_happened(
    submitting, undisturbed, chance, rank
):
    place, submit = submitting(f"killed{rank}")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    process = place.start(*submit, *OPTIONS)
    kill_at(place, process, 4, rank, chance)
    output, _ = process.communicate(timeout=400)
    assert process.returncode == 0, output
    assert "its process died" in output
    assert "restarted: the run" in output
    equal(place, undisturbed)


def test_lost_node_is_replaced_from_the_storage_and_the_run_ends_as_if_nothing_had_happened(
    submitting, nodes, undisturbed, chance
):
    place, submit = submitting("lost")
    (place.folder / "callbacks.yaml").write_text(CALLBACKS)
    place.environment["MLFLOW_TRACKING_URI"] = f"sqlite:///{place.folder / 'mlflow.db'}"
    process = place.start(*submit, *OPTIONS, "--storage", str(place.folder / "shared"))
    kill_at(place, process, chance.choice([2, 4, 6]), 0, chance, "shared")
    nodes[1]()
    shutil.rmtree(place.folder / "runs")  # which was on the disk of that node
    output, _ = process.communicate(timeout=400)
    assert process.returncode == 0, output
    assert "was fetched from file://" in output
    equal(place, undisturbed)


def kill_at(place, process, step, rank, chance, root="runs"):
    """Kill the process of a rank some moment after a checkpoint of at least this step was written."""
    deadline = time.monotonic() + 240
    while process.poll() is None and time.monotonic() < deadline:
        for path in place.folder.glob(f"{root}/*/*/checkpoints/last.ckpt"):
            if step <= torch.load(path, weights_only=True)["global_step"] < 12:
                time.sleep(chance.uniform(0, 0.6))
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
