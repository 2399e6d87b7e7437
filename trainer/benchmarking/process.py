"""The parent's end of a process that measures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from trainer.benchmarking.cases import Case, Method

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
"""Where the packages of this process are."""

# These modules measure, whichever revision of the packages is measured.
_START = """
import importlib.util, sys
place = sys.argv[1]
spec = importlib.util.spec_from_file_location(
    "trainer.benchmarking", place + "/__init__.py", submodule_search_locations=[place])
sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from trainer.benchmarking.child import main
main()
"""

Tell = Callable[[str], None]


class MeasuringError(Exception):
    """A case cannot be measured; the text says why."""


class Measuring:
    """A fresh process for one case.

    Args:
        root: Folder with the packages `trainer`, `models`, `data` that are measured; None: these here.
        tell: Called with what the process is at.
        timeout: Seconds that one answer may take; None: as long as it wants.
    """

    def __init__(
        self, root: Path | None = None, tell: Tell = lambda stage: None, timeout: float | None = None
    ) -> None:
        self._tell, self._timeout = tell, timeout
        self._late = False
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        path = [str(root or ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {"OMP_WAIT_POLICY": "PASSIVE"} | os.environ | {"PYTHONPATH": os.pathsep.join(path)}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, str(FOLDER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
            start_new_session=True,  # Ctrl-C is for this process, which then ends that one
        )

    def __enter__(self) -> Measuring:
        """Return itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """End the process."""
        self.close()

    def prepare(self, case: Case, warmup: int, file: Path | None = None) -> dict[str, Any]:
        """Load, warm up, and return what the process says about itself.

        Raises:
            MeasuringError: It cannot.
        """
        said = {"case": asdict(case), "file": str(file) if file else None, "warmup": warmup}
        return dict(self._ask(said, "ready"))

    def times(self, calls: int) -> list[float]:
        """Return the seconds of so many calls; raises as `prepare`."""
        return list(self._ask({"calls": calls}, "seconds"))

    def finish(self) -> dict[str, Any]:
        """Return peak memory and the share of other programs, the last answer; raises as `prepare`."""
        return dict(self._ask({"end": True}, "end"))

    def export(self, method: Method, format: str, path: Path) -> None:
        """Write the method as a file; raises as `prepare`."""
        self._ask({"export": asdict(method), "format": format, "path": str(path)}, "exported")

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()
        streams: list[IO[Any] | None] = [self._process.stdin, self._process.stdout, self._errors]
        for stream in streams:
            if stream is not None:
                try:
                    stream.close()
                except BrokenPipeError:
                    continue

    def _ask(self, command: dict[str, Any], expected: str) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        watch = threading.Timer(self._timeout, self._give_up) if self._timeout else None
        if watch:
            watch.start()
        try:
            self._process.stdin.write(json.dumps(command) + "\n")
            self._process.stdin.flush()
            for line in self._process.stdout:
                answer = json.loads(line)
                if "stage" in answer:
                    self._tell(answer["stage"])
                elif "failed" in answer:
                    raise MeasuringError(answer["failed"])
                else:
                    return answer[expected]
        except BrokenPipeError:
            pass
        finally:
            if watch:
                watch.cancel()
        raise MeasuringError(self._death())

    def _give_up(self) -> None:
        self._late = True
        self._process.kill()

    def _death(self) -> str:
        """Return why the process ended without an answer."""
        code = self._process.wait()
        if self._late:
            return f"took more than {self._timeout:g} s"
        if code == -signal.SIGKILL:
            return "the system ended the process (SIGKILL), most likely because memory ran out"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        name = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"the process ended with {name}" + (f": {lines[-1].strip()}" if lines else "")
