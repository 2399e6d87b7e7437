"""Trainings of an ablation: what is skipped, continued, reported and ended. Stand-ins train nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from trainer.ablation import fitting
from trainer.ablation.fitting import fit_all
from trainer.ablation.plan import Variant
from trainer.ablation.variants import Training
from trainer.runs import Launch, RunRecord, begin_launch, end_launch

STAND_IN = """
import os, signal, sys, time
from pathlib import Path
from trainer.runs import Launch, RunRecord, begin_launch, end_launch, run_of_launch
name = sys.argv[1]
launch = Launch(os.environ["PENUMBRA_TRAINING"], unfinished=True)
folder = run_of_launch(launch, Path("runs"), "x")
print("goes on" if folder else "begins", flush=True)
folder = folder or Path("runs/x") / name
RunRecord("x", name).save(folder)
begin_launch(folder, launch)
if name == "wrong":
    print("error: there is no such thing\\nbye", flush=True)
    sys.exit(1)
if name == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
if name == "slow" and not Path("hurry").exists():
    Path("asleep").write_text(str(os.getpid()))
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        sys.exit(130)
end_launch(folder)
"""


@pytest.fixture(autouse=True)
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fitting, "COMMAND", (sys.executable, "-c", STAND_IN))


def training(name: str) -> Training:
    return Training(
        Variant(name, ("x.yaml",)), (name,), f"digest of {name}", Path("runs"), "x", None, "data", ()
    )


def run(*names: str, identity: str = "i") -> tuple[dict[str, str], list[str]]:
    """Return what became of each variant, and what was told."""
    told: list[str] = []
    found = fit_all([training(name) for name in names], identity, {}, Path("logs"), told.append)
    assert [one.name for one in found] == list(names)
    return {one.name: one.reason for one in found}, told


def test_what_fails_is_told_with_its_reason_and_does_not_stop_the_others() -> None:
    reasons, told = run("wrong", "killed", "good")
    assert reasons["good"] == ""
    assert reasons["wrong"] == "there is no such thing (logs/wrong.txt)"
    assert reasons["killed"].startswith("the system ended the process (SIGKILL), most likely")
    assert Path("logs/wrong.txt").read_text() == "begins\nerror: there is no such thing\nbye\n"
    assert told[0] == "variant 1/3, wrong: training"
    assert "  error: there is no such thing" in told
    assert any(line.startswith("variant 2/3, killed: training, about ") for line in told)
    assert "good: trained in 0:00" in told


def test_what_is_trained_is_not_trained_again_and_what_failed_goes_on_in_its_run() -> None:
    run("good", "wrong")
    reasons, told = run("good", "wrong", "new")
    assert told[0] == "1 of 3 variants are trained already"
    assert told[1:3] == ["variant 2/3, wrong: training", "  goes on"]
    assert reasons["new"] == ""
    assert len(list(Path("runs/x").iterdir())) == 3


def test_another_ablation_has_runs_of_its_own() -> None:
    run("good")
    assert "  begins" in run("good", identity="other")[1]


def test_a_training_that_ends_well_without_a_finished_run_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "COMMAND", (sys.executable, "-c", "print('nothing to do')"))
    assert run("good")[0]["good"] == "it left no finished run: nothing to do (logs/good.txt)"


@pytest.mark.parametrize(
    ("number", "of_ctrl_c", "blocked"),
    [
        (signal.SIGINT, signal.default_int_handler, False),
        (signal.SIGTERM, signal.default_int_handler, False),
        (signal.SIGTERM, signal.SIG_IGN, False),  # in the background of a script
        (signal.SIGTERM, signal.default_int_handler, True),
    ],
)
def test_an_interruption_is_handed_on_and_the_training_goes_on_later(
    number: signal.Signals, of_ctrl_c: Any, blocked: bool, request: pytest.FixtureRequest
) -> None:
    was = signal.signal(signal.SIGINT, of_ctrl_c)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, was))
    if blocked:
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        request.addfinalizer(lambda: signal.pthread_sigmask(signal.SIG_SETMASK, mask))
    signaller = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import os, sys, time\n"
            "while not os.path.exists('asleep'): time.sleep(0.05)\n"
            f"time.sleep(0.2); os.kill({os.getpid()}, {int(number)})",
        ]
    )
    before = signal.getsignal(number)
    try:
        with pytest.raises(KeyboardInterrupt):
            run("slow", "good")
    finally:
        signaller.kill()
        signaller.wait()
    assert signal.getsignal(number) is before
    assert not Path("runs/x/good").exists()
    Path("hurry").touch()
    reasons, told = run("slow", "good")
    assert reasons == {"slow": "", "good": ""}
    assert told[1] == "  goes on"


def test_a_training_ends_with_the_process_that_started_it() -> None:
    child = (
        "from trainer.ablation.child import end_with_parent; end_with_parent(); import time; "
        "open('up', 'w').write(str(__import__('os').getpid())); time.sleep(60)"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"],
        env={**os.environ, "PYTHONPATH": str(fitting.ROOT)},
    )
    until = time.monotonic() + 20
    while not Path("up").is_file() or not Path("up").read_text():
        assert time.monotonic() < until
        time.sleep(0.05)
    process = int(Path("up").read_text())
    parent.kill()
    parent.wait()
    while _runs(process):
        assert time.monotonic() < until
        time.sleep(0.05)


def _runs(process: int) -> bool:
    """Whether a process is there and is no zombie."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_a_run_of_another_launch_is_not_taken_for_that_of_a_variant() -> None:
    folder = Path("runs/x/other")
    RunRecord("x", "other").save(folder)
    begin_launch(folder, Launch("somebody"))
    end_launch(folder)
    assert "  begins" in run("good")[1]
