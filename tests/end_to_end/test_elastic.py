"""torchrun starts a training again when one of its processes is killed, and nothing of it is lost."""

import time

import pytest
import torch

from tests.end_to_end.processes import kill, ranks, readers
from tests.end_to_end.test_resume import assert_equal_trees, final, options, wait_for_step
from trainer.runs import RunRecord
from trainer.tracking import open_client

STEPS = 21


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, cache):
    from tests.end_to_end.conftest import Workplace

    place = Workplace(tmp_path_factory.mktemp("whole"), cache)
    finished(place, place.torchrun("fit", *options(place)))
    return final(place)


def finished(place, process):
    printed, _ = process.communicate(timeout=500)
    assert process.returncode == 0, printed
    return printed


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["first rank", "other rank", "reader"])
def test_killed_process_is_replaced_and_the_run_ends_as_if_nothing_had_happened(
    victim, workplace, uninterrupted
):
    process = workplace.torchrun("fit", *options(workplace))
    step = wait_for_step(workplace, 5, process)
    found = readers(process.pid) if victim == "reader" else ranks(process.pid)
    assert kill(found[0 if victim == "first rank" else -1])
    printed = finished(workplace, process)
    assert step < STEPS
    assert "Traceback" not in printed, printed
    assert "restarted: the run" in printed

    assert len(workplace.runs) == 1
    resumed = final(workplace)
    assert resumed["global_step"] == uninterrupted["global_step"] == STEPS
    for key in ("state_dict", "optimizer_states", "lr_schedulers"):
        assert_equal_trees(dict(uninterrupted)[key], resumed[key])
    record = RunRecord.load(workplace.runs[0])
    client = open_client(record.tracking_uri)
    assert client.get_run(record.run_id).info.status == "FINISHED"
    steps = [m.step for m in client.get_metric_history(record.run_id, "val/loss")]
    assert len(steps) == len(set(steps)) == 3


@pytest.mark.slow
def test_training_that_is_killed_before_its_first_checkpoint_starts_again_in_its_folder(workplace):
    process = workplace.torchrun("fit", *options(workplace), "--trainer.max_epochs", "1")
    deadline = time.monotonic() + 120
    while not list(workplace.folder.glob("runs/*/*/launch.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    while not workplace.runs and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not list(workplace.folder.glob("runs/*/*/checkpoints/last.ckpt"))
    assert kill(ranks(process.pid)[1])
    printed = finished(workplace, process)
    assert len(workplace.runs) == 1
    assert "from its beginning, it has no checkpoint yet" in printed
    assert torch.load(workplace.runs[0] / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 7
