"""Threads that download the shards that come next, while batches are made of those that are here."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterable, Sequence

from data.shards.cache import ShardCache
from data.shards.index import ShardRecord

THREADS = 2
"""Downloads of one process at one time."""


class Prefetcher:
    """Downloads shards in the order in which they are expected; for one process.

    What fails is left to who reads the shard, and not tried again.

    Args:
        cache: Where to.
        shards: All shards of a split.
    """

    def __init__(self, cache: ShardCache, shards: Sequence[ShardRecord]) -> None:
        self.cache, self.shards = cache, shards
        self._failed: set[int] = set()
        self._closed = False
        self._wanted: deque[int] = deque()
        self._change = threading.Condition()
        for number in range(THREADS):
            # Daemons: a process that ends does not wait for them, and what they began is removed later.
            threading.Thread(target=self._work, name=f"prefetch-{number}", daemon=True).start()

    def expect(self, numbers: Iterable[int]) -> None:
        """Say which shards come next, the first one first; what was said before is forgotten."""
        with self._change:
            self._wanted = deque(number for number in numbers if number not in self._failed)
            self._change.notify_all()

    def close(self) -> None:
        """End the threads, each after the download that it is at."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _work(self) -> None:
        while True:
            with self._change:
                while not (self._wanted or self._closed):
                    self._change.wait()
                if self._closed:
                    return
                number = self._wanted.popleft()
            try:
                self.cache.add(self.shards[number])
            except ValueError as error:
                print(f"warning: {error}; its samples are read and verified one by one", file=sys.stderr)
                self._failed.add(number)
            except OSError:
                self._failed.add(number)
