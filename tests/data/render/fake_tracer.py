"""A tracer without renderer: exponential noise around a known image, in chunks like the real one's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data.buffers import BUFFERS, SAMPLE_BUFFERS
from data.camera import Camera
from data.render.spec import SceneSpec, View


@dataclass
class Part:
    rows: slice
    values: dict[str, np.ndarray]


def spec(name="fake", views=1, path=False):
    view = View(np.eye(4), 40.0, 24, 16)
    return SceneSpec(name, {}, (view,) * views, path=path, origin={"seed": 5}, license="CC0-1.0")


class FakeTracer:
    """Radiance is exponential with mean 1 + column; depth 2 on the left half, no hit on the right."""

    def __init__(self, scene=None, width=24, height=16, chunk=1024, scale=1.0):
        self.spec = scene or spec()
        self.width, self.height, self.chunk, self.scale = width, height, chunk, scale
        self.invalid = 0
        self.calls = []

    def trace(self, frame, spp, seed, names, motion="previous", static=False):
        self.calls.append((frame, spp, seed))
        rng = np.random.default_rng([seed, frame])
        step = max(1, self.chunk // (self.width * self.height))
        band = self.height if self.width * self.height <= self.chunk else self.height // 2
        for top in range(0, self.height, band):
            for first in range(0, spp, step):
                count = min(step, spp - first)
                values = {n: self._values(n, rng, (count, band, self.width)) for n in names}
                yield Part(slice(top, top + band), values)

    def _values(self, name, rng, shape):
        entry = SAMPLE_BUFFERS.get(name) or BUFFERS[name]
        channels = len(entry.letters)
        columns = np.arange(self.width, dtype=np.float32)
        left = np.broadcast_to(columns < self.width // 2, shape)[..., None]
        if name == "radiance":
            noise = rng.exponential(size=(*shape, channels)) * self.scale
            return (noise * (1 + columns)[:, None]).astype(np.float32)
        if name == "depth":
            return np.where(left, 2 + rng.uniform(-1, 1, (*shape, 1)), 0).astype(np.float32)
        if name == "hit":
            return left.astype(np.float32)
        low = 0.0 if entry.low is None else entry.low
        return rng.uniform(low, 1, (*shape, channels)).astype(np.float32)

    def pixel_camera(self, frame):
        matrix = np.array([[20.0, 0, 12, 0], [0, 20, 8, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
        return Camera(matrix, np.zeros(3))
