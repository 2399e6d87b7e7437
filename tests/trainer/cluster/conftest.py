"""One cluster of two nodes for all tests of a session, and workplaces that submit to it."""

import subprocess
import sys

import pytest

from tests.end_to_end.conftest import Workplace


@pytest.fixture(scope="session")
def cluster_cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def nodes(tmp_path_factory, cluster_cache):
    """Two nodes whose processes share the prepared samples: their address, and what loses one of them."""
    place = Workplace(tmp_path_factory.mktemp("nodes"), cluster_cache)
    process = subprocess.Popen(  # its input ends with this process too
        [sys.executable, "-m", "tests.trainer.cluster.two_nodes"], env=place.environment,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    address = process.stdout.readline().strip()
    try:
        assert address, "the cluster did not start"
        yield address, lambda: print(file=process.stdin, flush=True)
    finally:
        process.stdin.close()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


@pytest.fixture(scope="session")
def submitting(tmp_path_factory, cluster_cache, nodes):
    """Make a workplace, and the beginning of a command line that runs on both nodes."""

    def make(name):
        place = Workplace(tmp_path_factory.mktemp(name), cluster_cache)
        return place, ("submit", "--address", nodes[0], "--workers", "2")

    return make
