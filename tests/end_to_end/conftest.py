import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest


class Workplace:
    """An empty folder in which a newcomer runs the `trainer` command."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder = folder
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PENUMBRA_"))}
        # One thread for each process: results do not depend on the load of the machine either way, and
        # tests that run several processes do not fight for cores.
        self.environment = environment | {"OMP_NUM_THREADS": "1", "PENUMBRA_CACHE": str(cache)}

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", module, *arguments], cwd=self.folder, env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip

    def torchrun(self, *arguments: str) -> subprocess.Popen[str]:
        """Start the command on two ranks that are started again when one ends."""
        launcher = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--max-restarts", "9")
        return self._start(*launcher, "-m", "trainer", *arguments, "--trainer.devices", "2",
                           "--trainer.strategy", "ddp", "--trainer.accelerator", "cpu")  # fmt: skip

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return self._start("trainer", *arguments)

    def trainer(self, *arguments: str, code: int = 0) -> str:
        process = self.start(*arguments)
        try:
            output, _ = process.communicate(timeout=500)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # it leads a session of its own
            raise
        assert process.returncode == code, output
        return output

    @property
    def runs(self) -> list[Path]:
        return sorted(p.parent for p in self.folder.glob("runs/*/*/run.json"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Shards of the shipped sample are prepared once for all tests."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def workplace(tmp_path, cache):
    return Workplace(tmp_path, cache)


@pytest.fixture(scope="session")
def trained(tmp_path_factory, cache):
    """A workplace in which the smoke configuration was trained, with what the command printed."""
    place = Workplace(tmp_path_factory.mktemp("trained"), cache)
    place.alive = tmp_path_factory.mktemp("health") / "alive"
    place.environment["PENUMBRA_ALIVE"] = str(place.alive)
    place.printed = place.trainer("fit", "--config", "wskp_bmfr.yaml", "--config", "smoke.yaml")
    return place
