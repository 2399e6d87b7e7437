"""The trainings of an ablation, one after the other, each in a process of its own.

What was trained before is not trained again, and a training that was stopped goes on: `trainer fit` finds its
run by the launch that `PENUMBRA_TRAINING` names.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO

from data.progress import duration
from trainer.ablation.child import PARENT
from trainer.ablation.variants import Training
from trainer.evaluation.plan import folder_of
from trainer.runs import TRAINING_VARIABLE, finished_by_launch

ROOT = Path(__file__).resolve().parents[2]
"""Where the packages of this process are."""

COMMAND = (sys.executable, "-m", "trainer.ablation.child", "fit")

Say = Callable[[str], None]


@dataclass(frozen=True)
class Fitted:
    """What became of a variant.

    Attributes:
        training: What was to be trained.
        run: Folder of its run, None where it failed.
        reason: Why it failed, empty where it did not.
        seconds: That were spent on it now; 0 where it was trained before.
    """

    training: Training
    run: Path | None
    reason: str = ""
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.training.variant.name


def fit_all(
    trainings: Sequence[Training], identity: str, tags: Mapping[str, str], logs: Path, say: Say
) -> list[Fitted]:
    """Train what is not trained yet; one that fails does not stop the others.

    Args:
        trainings: All variants.
        identity: Of the ablation.
        tags: Of every run.
        logs: Folder for what the trainings print.
        say: Told what is going on.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM; the training that ran has ended, and goes on the next time.
        OSError: A log cannot be written.
    """
    done = {t.digest: Fitted(t, run) for t in trainings if (run := _finished(t, identity)) is not None}
    if done:
        say(f"{len(done)} of {len(trainings)} variants are trained already")
    waiting = [training for training in trainings if training.digest not in done]
    begun = time.monotonic()
    for number, training in enumerate(waiting):
        left = (time.monotonic() - begun) / number * (len(waiting) - number) if number else 0.0
        about = f", about {duration(left)} left" if number else ""
        say(f"variant {len(done) + 1}/{len(trainings)}, {training.variant.name}: training{about}")
        own = {**tags, "ablation.variant": training.variant.name}
        fitted = fit(training, identity, own, logs, say)
        done[training.digest] = fitted
        told = f"failed: {fitted.reason}" if fitted.run is None else f"trained in {duration(fitted.seconds)}"
        say(f"{training.variant.name}: {told}")
    return [done[training.digest] for training in trainings]


def fit(training: Training, identity: str, tags: Mapping[str, str], logs: Path, say: Say) -> Fitted:
    """Train one variant in a process, or go on with it; raises as `fit_all`."""
    launch, start = training.launch(identity), time.monotonic()
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path), PARENT: str(os.getpid())}
    environment[TRAINING_VARIABLE] = launch.identity
    log = logs / f"{folder_of(training.variant.name)}.txt"
    logs.mkdir(parents=True, exist_ok=True)
    with log.open("a") as kept, _passing_on() as hand_to:
        process = subprocess.Popen(
            [*COMMAND, *training.command(tags)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
            start_new_session=True,  # Ctrl-C is for this process, which passes it on once
        )
        hand_to(process)
        last = _heard(process, kept, say)
    seconds = time.monotonic() - start
    run = _finished(training, identity)
    if run is not None:
        return Fitted(training, run, "", seconds)
    return Fitted(training, None, f"{_reason(process.returncode, last)} ({log})", seconds)


def _finished(training: Training, identity: str) -> Path | None:
    return finished_by_launch(training.launch(identity), training.root, training.experiment)


def _heard(process: subprocess.Popen[str], kept: IO[str], say: Say) -> list[str]:
    """Pass on what a training prints until it ends; returns the last lines."""
    last: list[str] = []
    assert process.stdout is not None
    with process.stdout as printed:
        for line in printed:
            kept.write(line)
            kept.flush()
            if text := line.rstrip():
                say(f"  {text}")
                last = [*last[-20:], text]
    process.wait()
    return last


def _reason(code: int, last: Sequence[str]) -> str:
    """Return why a training failed, from its exit code and the last lines that it printed."""
    if code == -signal.SIGKILL:
        return "the system ended the process (SIGKILL), most likely because memory ran out"
    if code < 0:
        return f"the process ended with signal {signal.Signals(-code).name}"
    errors = [line.removeprefix("error: ") for line in last if re.match(r"error: ", line)]
    told = errors[-1] if errors else (last[-1] if last else "it printed nothing")
    return told if code else f"it left no finished run: {told}"


@contextmanager
def _passing_on() -> Iterator[Callable[[subprocess.Popen[str]], None]]:
    """Hand Ctrl-C and SIGTERM on to a process, once, and be interrupted when it has ended.

    Yields what must be told the process. It is started within this context: one that is started where Ctrl-C
    is ignored, as in the background of a script, would ignore it for ever.

    Raises:
        KeyboardInterrupt: One of both came.
    """
    asked, process = False, None

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if process is not None and asked:
            process.kill()
        elif process is not None and process.poll() is None:
            process.send_signal(signal.SIGINT)
        asked = True

    def hand_to(started: subprocess.Popen[str]) -> None:
        nonlocal process
        if asked:
            started.terminate()
        process = started

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    # Where a library has blocked them, the process would have them blocked too.
    mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, before)
    try:
        yield hand_to
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
        if process is not None and process.poll() is None:
            process.kill()
            process.wait()
    if asked:
        raise KeyboardInterrupt
