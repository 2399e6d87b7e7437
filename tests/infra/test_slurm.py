"""The Slurm script, with stand-ins for Slurm's own programs: real tasks, real gloo, one node."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.stack.compose import ROOT

SCRIPT = ROOT / "infra" / "slurm" / "train.sbatch"

# Starts the tasks of one node with the variables that Slurm gives them.
SRUN = """#!/bin/bash
[ "$1" = --kill-on-bad-exit=1 ] && shift
for task in $(seq 0 $((SLURM_NTASKS - 1))); do
    SLURM_PROCID=$task SLURM_LOCALID=$task SLURM_NODEID=0 "$@" &
    tasks+=($!)
done
for task in "${tasks[@]}"; do wait "$task" || code=$?; done
exit "${code:-0}"
"""


def program(folder, name, text):
    path = folder / name
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def slurm(tmp_path):
    """Environment of a batch script on one node with two tasks."""
    bin = tmp_path / "bin"
    bin.mkdir()
    program(bin, "srun", SRUN)
    program(bin, "scontrol", f'#!/bin/sh\necho "$@" >> {tmp_path}/scontrol\n')
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(("SLURM_", "MLFLOW_", "PENUMBRA_"))
    }
    return environment | {
        "PATH": f"{bin}:{Path(sys.executable).parent}:{os.environ['PATH']}",
        "VENV": str(Path(sys.executable).parents[1]),
        "SLURM_JOB_ID": str(os.getpid()),
        "SLURM_JOB_NAME": "penumbra",
        "SLURM_JOB_NUM_NODES": "1",
        "SLURM_NNODES": "1",
        "SLURM_NODELIST": "127.0.0.1",
        "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "2",
        "SLURM_CPUS_PER_TASK": "1",
        "PENUMBRA_CACHE": str(tmp_path / "cache"),
    }


def test_job_asks_for_a_requeue_before_its_time_is_up(slurm, tmp_path):
    program(tmp_path / "bin", "trainer", "#!/bin/sh\ntouch started\nsleep 3\n")
    slurm["VENV"] = str(tmp_path)
    (tmp_path / "bin" / "activate").touch()
    process = subprocess.Popen(["bash", SCRIPT], cwd=tmp_path, env=slurm)
    while not (tmp_path / "started").exists() and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGUSR1)
    process.wait(30)
    assert (tmp_path / "scontrol").read_text() == f"requeue {slurm['SLURM_JOB_ID']}\n"


def test_failed_task_fails_the_job(slurm, tmp_path):
    program(tmp_path / "bin", "trainer", "#!/bin/sh\nexit 3\n")
    slurm["VENV"] = str(tmp_path)
    (tmp_path / "bin" / "activate").touch()
    assert subprocess.run(["bash", SCRIPT], cwd=tmp_path, env=slurm).returncode == 3


@pytest.mark.slow
def test_two_tasks_train_one_run(slurm, tmp_path):
    options = ("--config", "wskp_bmfr.yaml", "--config", "smoke.yaml", "--data.batch_size", "2")
    done = subprocess.run(
        ["bash", SCRIPT, *options], cwd=tmp_path, env=slurm, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stdout + done.stderr
    # Two tasks that knew nothing of each other would make two.
    (run,) = (path.parent for path in tmp_path.glob("runs/*/*/run.json"))
    launch = json.loads((run / "launch.json").read_text())["launch"]
    assert launch.startswith(f"slurm {slurm['SLURM_JOB_ID']} ")
    assert (run / "export" / "wskp.onnx").is_file()
