import shutil
import subprocess

import pytest

from trainer.benchmarking.cases import Case, Effort, Method
from trainer.benchmarking.measuring import Watcher, exports
from trainer.benchmarking.pairing import Contestant, compare
from trainer.benchmarking.process import ROOT
from trainer.benchmarking.revisions import unpacked


def git(folder, *arguments):
    identity = ("-c", "user.name=tester", "-c", "user.email=tester@example.org")
    subprocess.run(["git", "-C", folder, *identity, *arguments], check=True, capture_output=True)


def commit(folder, message):
    git(folder, "add", "-A")
    git(folder, "commit", "-m", message)
    git(folder, "tag", message)


@pytest.fixture
def checkout(tmp_path):
    """A repository whose packages hold one file each, in two revisions."""
    folder = tmp_path / "checkout"
    for name in ("trainer", "models", "data"):
        (folder / name).mkdir(parents=True)
        (folder / name / "version").write_text("1")
    git(folder, "init")
    commit(folder, "one")
    (folder / "models" / "version").write_text("2")
    commit(folder, "two")
    (folder / "models" / "version").write_text("3")
    return folder


def test_each_revision_has_its_files_and_the_checkout_stays_as_it_is(checkout):
    with unpacked(["one", "two"], checkout) as places:
        assert [(places[name] / "models" / "version").read_text() for name in ("one", "two")] == ["1", "2"]
    assert not places["one"].exists()
    assert (checkout / "models" / "version").read_text() == "3"
    worktrees = subprocess.run(["git", "-C", checkout, "worktree", "list"], capture_output=True, text=True)
    assert len(worktrees.stdout.splitlines()) == 1


def test_a_point_stands_for_the_files_as_they_are(checkout):
    with unpacked([".", "two"], checkout) as places:
        assert places["."] == checkout


@pytest.mark.parametrize("name", ["three", "--all", "one:models"])
def test_what_names_no_commit_is_refused_by_name(checkout, name):
    with pytest.raises(ValueError, match="no such revision"), unpacked([name, "two"], checkout):
        pass


def test_an_installation_is_no_checkout(tmp_path):
    with pytest.raises(ValueError, match="is an installation"), unpacked(["HEAD", "."], tmp_path):
        pass


@pytest.mark.slow
def test_a_revision_that_waits_is_significantly_slower_and_not_measured_with_the_code_here(tmp_path):
    folder = tmp_path / "checkout"
    for name in ("trainer", "models", "data"):
        ignored = shutil.ignore_patterns("__pycache__", "sample", "benchmarking")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    git(folder, "init")
    commit(folder, "fast")
    place = folder / "models" / "classical" / "joint_bilateral.py"
    place.write_text(place.read_text().replace("        self.check(buffers)\n", SLOWER, 1))
    commit(folder, "slow")
    case, found = Case(Method("JointBilateral"), width=64, height=64), {}
    with (
        unpacked(["fast", "slow"], folder) as places,
        exports(places["fast"]) as one,
        exports(places["slow"]) as other,
    ):
        sides = (Contestant("fast", case, one), Contestant("slow", case, other))
        found = compare(*sides, Effort(3, 1, 30), 3, Watcher())
    assert found.done, found.sides
    assert found.significant
    assert found.ratio > 1.5


SLOWER = "        self.check(buffers)\n        import time\n        time.sleep(0.2)\n"
