"""Joins the processes of a torchrun launch, also after a restart.

The workers of every attempt meet in one store that torchrun's agent keeps. With PyTorch 2.13 it still holds
what the workers of the attempt before wrote, so a worker that is early connects to one that was killed: the
restart fails, or waits for half an hour. Here all of an attempt agree on a name first, under which the store
is empty.

Before each batch the ranks of Lightning 2.6 tell each other of SIGTERM, and whatever fails meanwhile is
passed over. That the process of a data loader has died is raised by the handler of a signal, in the middle of
anything: there it would be lost, its rank would not have spoken, and all ranks would wait for ever.
"""

from __future__ import annotations

import contextlib
import os
import time
import uuid
from datetime import timedelta
from functools import partial

import torch
import torch.distributed as dist
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import ParallelStrategy
from lightning.pytorch.utilities.exceptions import SIGTERMException

PATIENCE = timedelta(minutes=10)
"""How long the ranks wait for each other to start; nodes may load at different speeds."""


def join_ranks(trainer: Trainer) -> None:
    """Initialise `torch.distributed` for this attempt; does nothing unless torchrun's agent keeps the store.

    Lightning takes a process group that exists as it is.

    Raises:
        TimeoutError: Some rank did not start in ten minutes.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    kept = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    strategy = trainer.strategy
    if not kept or world == 1 or dist.is_initialized() or not isinstance(strategy, ParallelStrategy):
        return
    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    store = dist.TCPStore(address, port, is_master=False, timeout=PATIENCE)
    rank = int(os.environ["RANK"])
    name = agree(store, rank, world, PATIENCE)
    backend = getattr(strategy, "process_group_backend", None)
    if backend is None:
        backend = "nccl" if strategy.root_device.type == "cuda" else "gloo"
    dist.init_process_group(backend, store=dist.PrefixStore(name, store), rank=rank, world_size=world)


def heed_failures(trainer: Trainer) -> None:
    """Let what fails while ranks tell each other of SIGTERM end the process, so that all start again."""
    if trainer.world_size > 1:
        trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = partial(tell_sigterm, trainer)  # type: ignore[method-assign]


def tell_sigterm(trainer: Trainer) -> None:
    """Find out whether the first rank was asked to end; then all end.

    Raises:
        SIGTERMException: It was.
    """
    told = torch.tensor([int(trainer.received_sigterm)], device=trainer.strategy.root_device)
    dist.broadcast(told, src=0)
    if told.item():
        with contextlib.suppress(Exception):
            dist.barrier()  # all have heard of it
        raise SIGTERMException


def agree(store: dist.Store, rank: int, world: int, patience: timedelta) -> str:
    """Return a name that all ranks of this attempt return, and no other attempt.

    Every rank asks with a word of its own and takes the answer to that word, so that what an earlier attempt
    left behind is never taken for an answer. The first rank answers until all have said that they know.

    Raises:
        TimeoutError: Not all ranks said so in time; names those that did not.
    """
    if rank > 0:
        word = uuid.uuid4().hex
        store.set(f"ask/{rank}", word)
        try:
            store.wait([f"answer/{word}"], patience)
        except dist.DistStoreError as error:
            raise TimeoutError(f"rank {rank} waited {patience} for the first rank, in vain") from error
        name = store.get(f"answer/{word}").decode()
        store.set(f"known/{name}/{rank}", "")
        return name
    name = uuid.uuid4().hex
    missing, answered = set(range(1, world)), set()
    deadline = time.monotonic() + patience.total_seconds()
    while missing:
        for other in sorted(missing):
            if store.check([f"known/{name}/{other}"]):
                missing.remove(other)
            elif store.check([f"ask/{other}"]):
                word = store.get(f"ask/{other}").decode()
                if word not in answered:
                    store.set(f"answer/{word}", name)
                    answered.add(word)
        if missing and time.monotonic() > deadline:
            raise TimeoutError(
                f"ranks {', '.join(map(str, sorted(missing)))} of {world} did not start within {patience}; "
                "see what they printed"
            )
        time.sleep(0.02)
    return name
