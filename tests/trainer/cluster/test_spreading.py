"""Independent jobs on a cluster of two nodes give what the command gives alone."""

import json
import sys

import pytest

from data.jobs import Job, elsewhere, run_elsewhere
from trainer.cluster.spreading import RayJobs, Spread

PATCHES = ("--train-patches", "8", "--validation-patches", "2")


class FakeRay:
    """Does tasks at once, in this process."""

    class exceptions:  # noqa: N801
        RayError = WorkerCrashedError = type("RayError", (Exception,), {})

    def get(self, thing):
        return thing

    def wait(self, references, timeout):
        return references[:1], references[1:]


class Task:
    def __init__(self, function):
        self.function = function

    def remote(self, *arguments):
        return Answer(self.function(*arguments))


class Answer(tuple):
    __hash__ = object.__hash__

    def __new__(cls, values=()):
        return super().__new__(cls, values)


class Quiet:
    class cancelled:  # noqa: N801
        @staticmethod
        def remote():
            return False


@pytest.fixture
def fake_ray(monkeypatch):
    ray = FakeRay()
    ray.remote = lambda **options: Task
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr("time.sleep", lambda seconds: None)


tries: dict[str, int] = {}


def works_at(name, wanted, fails):
    tries[name] = tries.get(name, 0) + 1
    if tries[name] < wanted:
        raise ValueError(fails)
    return name.upper()


@pytest.fixture
def runner(tmp_path, fake_ray, monkeypatch):
    tries.clear()
    monkeypatch.chdir(tmp_path)
    return RayJobs(Spread(2, retries=2), str(tmp_path), {}, Quiet)


def test_failed_job_is_made_again(runner):
    results = {}
    runner([Job("a", works_at, ("a", 3, "no luck"))], lambda job, result: results.update({job.name: result}))
    assert results == {"a": "A"}
    assert tries == {"a": 3}


def test_hopeless_job_is_named_and_others_go_on(runner):
    results = {}
    jobs = [Job("a", works_at, ("a", 99, "no luck")), Job("b", works_at, ("b", 1, ""))]
    with pytest.raises(ValueError, match=r"1 of 2 jobs failed \(a: no luck\); the others are finished"):
        runner(jobs, lambda job, result: results.update({job.name: result}))
    assert results == {"b": "B"}


def test_folder_that_a_node_does_not_see_is_said(runner, tmp_path):
    with pytest.raises(ValueError, match="folders that all nodes share"):
        runner([Job("a", works_at, ("a", 1, ""), (tmp_path / "absent",))], lambda job, result: None)
    assert not tries


def test_runner_is_in_place_only_meanwhile(runner):
    with run_elsewhere(runner):
        assert elsewhere() is runner
    assert elsewhere() is None


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_shards_of_two_nodes_are_those_of_one_process(submitting):
    place, submit = submitting("shards")
    place.trainer(submit[0], "prepare", "sample:bmfr", "--output", "spread", *PATCHES, *submit[1:])
    place.trainer("prepare", "sample:bmfr", "--output", "alone", "--processes", "1", *PATCHES)
    assert tree(place.folder / "spread") == tree(place.folder / "alone")


@pytest.mark.slow
def test_frames_of_two_nodes_are_those_of_one_process(submitting):
    place, submit = submitting("frames")
    options = ("sequences", "--random", "2", "--frames", "2", "--size", "32x32", "--reference-spp", "4",
               "--variant", "scalar", "--output")  # fmt: skip
    printed = place.trainer(submit[0], "render", *options, "spread", *submit[1:])
    assert "4 frames of 2 scenes" in printed
    place.trainer("render", *options, "alone", "--processes", "1")
    one, two = tree(place.folder / "alone"), tree(place.folder / "spread")
    frames = [name for name in one if name.endswith(".exr")]
    assert len(frames) == 4
    assert {name: two[name] for name in frames} == {name: one[name] for name in frames}
    manifests = [json.loads(files["manifest.json"]) | {"name": ""} for files in (one, two)]
    assert manifests[0] == manifests[1]
