"""A batch as it travels from a worker process to the training process."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from data.buffers import THIN_LENS

Batch = dict[str, Any]


class Packed(NamedTuple):
    """A batch as it travels from a worker: all images in one piece of shared memory.

    Attributes:
        pixels: float32, one after another each buffer's (B, C, H, W), (B, S, C, H, W) of `samples`,
            (B, N, C, H, W) of clips.
        shapes: Name and shape of each.
        numbers: Exposure, smallest and largest depth, of clips those of every frame, aperture, focus and
            field of view of each.
        samples: Scene, frame and key of each.
        channels: Channels of `samples`, where it is among the buffers.
        corrupt: Samples that were left out, with the reason.
        error: Why there is no batch. Raised in a worker it would arrive as another type, with a traceback for
            its message.
        read: Bytes of the samples in their shards.
        downloaded: Bytes that the process has downloaded since it made its last batch.
        frames: Frames of each sample, more than one of clips.
    """

    pixels: Tensor
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    numbers: tuple[tuple[float, ...], ...]
    samples: tuple[tuple[str, int, str], ...]
    corrupt: tuple[tuple[str, str], ...]
    error: Exception | None = None
    channels: tuple[str, ...] = ()
    read: int = 0
    downloaded: int = 0
    frames: int = 1

    def unpack(self) -> Batch:
        """Return the batch: views of `pixels`, frame numbers, scenes, frames, keys."""
        batch: Batch = {}
        start = 0
        for name, shape in self.shapes:
            size = math.prod(shape)
            batch[name] = self.pixels[start : start + size].view(shape)
            start += size
        numbers = torch.tensor(self.numbers, dtype=torch.float32)
        batch["exposure"] = numbers[:, 0].contiguous()
        depths = numbers[:, 1 : 1 + 2 * self.frames].contiguous()
        batch["depth_range"] = depths if self.frames == 1 else depths.view(-1, self.frames, 2)
        batch["scene"] = [scene for scene, _, _ in self.samples]
        batch["frame"] = torch.tensor([frame for _, frame, _ in self.samples], dtype=torch.int64)
        batch["key"] = [key for _, _, key in self.samples]
        if self.channels:
            batch["sample_channels"] = list(self.channels)
            batch[THIN_LENS] = numbers[:, -3:].contiguous()
        return batch


def nothing(corrupt: tuple[tuple[str, str], ...] = (), error: Exception | None = None) -> Packed:
    """Return a batch without samples."""
    return Packed(torch.empty(0), (), (), (), corrupt, error)


def allocate(count: int) -> Tensor:
    """Return uninitialised float32 memory, shared between processes when called in a worker.

    A worker that fills ordinary memory makes the queue copy the batch into shared memory; torch's own
    collation avoids that in the same way.
    """
    if get_worker_info() is None:
        return torch.empty(count)
    storage = torch.UntypedStorage._new_shared(4 * count)
    return torch.empty(0).set_(storage, 0, (count,), (1,))
