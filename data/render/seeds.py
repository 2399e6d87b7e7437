"""Seeds of wavefronts."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np


@dataclass
class Seeds:
    """A sequence of seeds, one per wavefront: neighbours differ, so no two wavefronts of a call share one."""

    key: bytes
    count: int = 0

    def next(self) -> int:
        """Return the next 32-bit seed."""
        self.count += 1
        return (int.from_bytes(self.key[:4], "little") + self.count) % 2**32

    def generator(self) -> np.random.Generator:
        """Return a generator of its own for the wavefronts that come next."""
        return np.random.default_rng([*self.key[4:], self.count])


def seeds_of(seed: int, frame: int) -> Seeds:
    """Return the seeds of one call: the same for the same seed and frame."""
    return Seeds(hashlib.sha256(f"{seed} {frame}".encode()).digest())
