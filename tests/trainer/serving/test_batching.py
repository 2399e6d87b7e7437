"""The model's thread: which tiles are one batch, and what stops one."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from models.denoiser import Denoised
from models.pace import tick
from tests.trainer.serving.running import wait_until
from trainer.serving.batching import Batcher, Batching
from trainer.serving.limits import Over, Ticket


def test_a_tile_that_fails_does_not_fail_those_in_its_batch():
    calls = []

    def call(buffers):
        calls.append(len(buffers["color"]))
        if (buffers["color"] < 0).any():
            raise ValueError("negative")
        return Denoised(buffers["color"] + 1)

    entered, gate = threading.Event(), threading.Event()

    def first(buffers):
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(4) as pool:
        held = pool.submit(batcher.run, ticket, first, {"color": torch.zeros(1, 3, 16, 16)})
        assert entered.wait(60)
        values = [torch.full((1, 3, 16, 16), float(v)) for v in (1, -1, 2)]
        waiting = [pool.submit(batcher.run, ticket, call, {"color": value}) for value in values]
        wait_until(lambda: len(batcher._waiting) == 3)
        gate.set()
        held.result()
        assert waiting[0].result().color.max() == 2
        with pytest.raises(ValueError, match="negative"):
            waiting[1].result()
        assert waiting[2].result().color.max() == 3
    batcher.close()
    assert calls == [3, 1, 1, 1]


def test_tiles_of_other_shapes_or_beyond_the_memory_are_batches_of_their_own():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    class Net:
        bytes_per_pixel = 100

        def __call__(self, buffers):
            sizes.append(tuple(buffers["color"].shape))
            entered.set()
            gate.wait(60)
            return Denoised(buffers["color"])

    net = Net()
    batcher = Batcher(Batching(most=8, memory=100 * 16 * 16 * 2, threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(6) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for size in (16, 16, 16, 20):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
        wait_until(lambda: len(batcher._waiting) == 4)
        gate.set()
    batcher.close()
    assert sorted(sizes[1:]) == [(1, 3, 16, 16), (1, 3, 20, 20), (2, 3, 16, 16)]


def test_a_tile_is_taken_from_behind_others_of_another_shape():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    def net(buffers):
        sizes.append(tuple(buffers["color"].shape))
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(threads=1))
    ticket, gone = Ticket(time.monotonic() + 60), Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(8) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for number, size in enumerate((16, 20, 16, 20), 1):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
            wait_until(lambda number=number: len(batcher._waiting) == number)
        dropped = pool.submit(batcher.run, gone, net, {"color": torch.zeros(1, 3, 16, 16)})
        wait_until(lambda: len(batcher._waiting) == 5)
        gone.cancel()
        gate.set()
        with pytest.raises(Over):
            dropped.result()
    assert batcher.alive
    batcher.close()
    assert sizes[1:] == [(2, 3, 16, 16), (2, 3, 20, 20)]


def test_each_tile_of_a_batch_gets_its_own_state_and_layers():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    def net(buffers):
        sizes.append(len(buffers["color"]))
        entered.set()
        gate.wait(60)
        color = buffers["color"]
        return Denoised(color, {"hidden": color[:, :1] + 10}, {"layer": color[:, :1] + 20})

    batcher = Batcher(Batching(threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(3) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        values = [torch.full((1, 3, 16, 16), float(v)) for v in (1, 2)]
        waiting = [pool.submit(batcher.run, ticket, net, {"color": value}) for value in values]
        wait_until(lambda: len(batcher._waiting) == 2)
        gate.set()
        made = [one.result() for one in waiting]
    batcher.close()
    assert sizes == [1, 2]
    for result, value in zip(made, values, strict=True):
        assert torch.equal(result.color, value)
        assert torch.equal(result.state["hidden"], value[:, :1] + 10)
        assert torch.equal(result.aux["layer"], value[:, :1] + 20)


def test_large_tiles_are_not_joined_where_that_gains_nothing():
    sizes = []
    entered, gate = threading.Event(), threading.Event()

    def net(buffers):
        sizes.append(len(buffers["color"]))
        entered.set()
        gate.wait(60)
        return Denoised(buffers["color"])

    batcher = Batcher(Batching(most=8, pixels=3 * 16 * 16, threads=1))
    ticket = Ticket(time.monotonic() + 60)
    with ThreadPoolExecutor(8) as pool:
        pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, 8, 8)})
        assert entered.wait(60)
        for size in (16, 16, 16, 16, 32, 32):
            pool.submit(batcher.run, ticket, net, {"color": torch.zeros(1, 3, size, size)})
        wait_until(lambda: len(batcher._waiting) == 6)
        gate.set()
    batcher.close()
    assert sorted(sizes[1:]) == [1, 1, 1, 3]


def test_steps_of_a_classical_method_stop_when_nobody_waits():
    steps = []
    ticket = Ticket(time.monotonic() + 60)

    def call(buffers):
        for step in range(100):
            steps.append(step)
            if step == 3:
                ticket.cancel()
            tick(0.01)

    batcher = Batcher(Batching(threads=1))
    with pytest.raises(Over):
        batcher.run(ticket, call, {"color": torch.zeros(1, 3, 8, 8)})
    batcher.close()
    assert steps == [0, 1, 2, 3]
