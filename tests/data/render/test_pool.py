"""Tasks and reports of rendering processes. No renderer."""

import queue
import time
from concurrent.futures import Future

import pytest

from data.render import pool
from data.render.pool import tasks_of


class Silent:
    """A queue into which nothing is put."""

    def get(self, timeout):
        time.sleep(0.01)
        raise queue.Empty

    def get_nowait(self):
        raise queue.Empty


def test_a_long_pass_is_no_silence(monkeypatch):
    monkeypatch.setattr(pool, "HEARTBEAT", 0.02)
    future = Future()
    reports = pool._reports(Silent(), [future])
    assert [next(reports) for _ in range(2)] == [(0, "starting")] * 2
    future.set_result(None)
    assert all(count == 0 for count, _ in reports)


def test_an_error_of_a_task_ends_the_reports():
    future = Future()
    future.set_exception(ValueError("scene 'a': broken"))
    with pytest.raises(ValueError, match="scene 'a': broken"):
        list(pool._reports(Silent(), [future]))


def test_whole_scenes_are_tasks_and_few_scenes_are_parted():
    assert [task.works for task in tasks_of([("a", [1, 2]), ("b", [3])], 2)] == [[1, 2], [3]]
    assert [task.works for task in tasks_of([("a", [1, 2, 3])], 2)] == [[1], [2, 3]]
    assert [task.works for task in tasks_of([("a", [1])], 4)] == [[1]]
