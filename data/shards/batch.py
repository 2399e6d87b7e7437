"""Makes batches of samples: raw bytes of the mapped shards to float32 (B, C, H, W), turned on the way.

Of clips a batch has (B, N, C, H, W): all frames of a clip are turned alike, and may come in another order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, get_worker_info

from data import augment_samples
from data.augment import IMAGE_PLANE, UNCHANGED, Augmentation, Change, Turn, reordered, turn_vectors, turned
from data.buffers import SAMPLES
from data.shards.packed import Packed, allocate, nothing
from data.shards.read import CorruptSampleError, Sample, ShardReader
from data.shards.shapes import frames_of, kept_text, shape_of


class Order(NamedTuple):
    """What a worker is told to read.

    Attributes:
        epoch: For augmentation.
        samples: Of one batch.
        ahead: Shards in the order in which this batch and the next ones need them, where they lie at a URL.
    """

    epoch: int
    samples: tuple[int, ...]
    ahead: tuple[int, ...] = ()


class Batches(Dataset[Packed]):
    """Maps an `Order` to a batch.

    Args:
        reader: The split.
        names: Buffers to deliver.
        temporal: `irradiance` as it is stored, accumulated over preceding frames; and `color`, where it is
            one of the network's `inputs`, made of it. Otherwise that of the frame alone, color / albedo.
        inputs: What the network reads, of `names`.
        augmentation: What happens to training samples; None for evaluation.
        on_corrupt: `raise`, or `skip`: in training the next sample takes the place of a damaged one, in
            evaluation it is left out.

    Raises:
        ValueError: Clips are to run backward, and motion vectors are to be delivered.
    """

    def __init__(
        self,
        reader: ShardReader,
        names: Iterable[str],
        temporal: bool,
        inputs: Iterable[str] = (),
        augmentation: Augmentation | None = None,
        on_corrupt: str = "raise",
    ) -> None:
        self.reader, self.temporal = reader, temporal
        self.names = tuple(dict.fromkeys(names))
        self.inputs = frozenset(inputs)
        self.augmentation, self.on_corrupt = augmentation, on_corrupt
        moving = ", ".join(name for name in self.names if name in IMAGE_PLANE)
        if moving and augmentation is not None and augmentation.reverse > 0:
            raise ValueError(
                f"{moving} is wrong in a clip that runs backward; use --data.reverse 0, or a network that "
                "does not read it"
            )

    def __len__(self) -> int:
        return len(self.reader)

    def __getitem__(self, order: Order) -> Packed:
        try:
            return self.read(order)
        except (ValueError, OSError) as error:
            if get_worker_info() is None:
                raise
            return nothing(error=error)

    def read(self, order: Order) -> Packed:
        """Return the samples of an order; `[]` does the same, and in a worker packs errors.

        Raises:
            CorruptSampleError: A sample is damaged and is not to be skipped.
            ValueError: A buffer is missing, or samples of different size would be in one batch.
            OSError: A shard at a URL cannot be read.
        """
        self.reader.begin(order.ahead)
        numbers, corrupt = self._readable(order.samples)
        samples = [self.reader.sample(number) for number in numbers]
        if not samples:
            return nothing(corrupt)
        kept = self._sample_count(order.epoch, numbers, samples) if SAMPLES in self.names else 0
        frames = frames_of(samples)
        shapes = tuple((name, (len(samples), *shape_of(samples, name, kept))) for name in self.names)
        pixels = allocate(sum(math.prod(shape) for _, shape in shapes))
        changes = [self._change(order.epoch, number) for number in numbers]
        clips = [self._frame_order(order.epoch, number, frames) for number in numbers]
        start = 0
        for name, shape in shapes:
            size = math.prod(shape)
            target = pixels[start : start + size].view(shape)
            for row, number in enumerate(numbers):
                if name == SAMPLES:
                    self._fill_samples(target[row], number, order.epoch, changes[row])
                else:
                    self._fill(target[row], number, name, changes[row], clips[row])
            start += size
        return Packed(
            pixels,
            shapes,
            tuple(self._numbers(order.epoch, *each) for each in zip(numbers, samples, clips, strict=True)),
            tuple((sample.scene, sample.frame, sample.key) for sample in samples),
            corrupt,
            channels=samples[0].sample_channels if SAMPLES in self.names else (),
            read=sum(self.reader.bytes_of(number) for number in numbers),
            downloaded=0 if self.reader.cache is None else self.reader.cache.take_count(),
            frames=frames,
        )

    def _readable(self, numbers: Iterable[int]) -> tuple[list[int], tuple[tuple[str, str], ...]]:
        found, corrupt = [], {}
        for number in numbers:
            for candidate in self._candidates(number):
                try:
                    self.reader.sample(candidate)
                except CorruptSampleError as error:
                    if self.on_corrupt != "skip":
                        raise
                    corrupt[error.sample] = str(error)
                else:
                    found.append(candidate)
                    break
        if not found and self.augmentation is not None:
            raise ValueError(f"no training sample can be read: {next(iter(corrupt.values()))}")
        return found, tuple(corrupt.items())

    def _candidates(self, number: int) -> Iterable[int]:
        if self.augmentation is None:
            return (number,)
        total = len(self.reader)
        return ((number + step) % total for step in range(total))

    def _change(self, epoch: int, number: int) -> Change:
        return UNCHANGED if self.augmentation is None else self.augmentation.change(epoch, number)

    def _frame_order(self, epoch: int, number: int, frames: int) -> tuple[int, ...]:
        """Return which frame of a clip comes at each place; of a single frame nothing."""
        if frames == 1:
            return ()
        if self.augmentation is None:
            return tuple(range(frames))
        return self.augmentation.frame_order(epoch, number, frames)

    def _numbers(self, epoch: int, number: int, sample: Sample, clip: tuple[int, ...]) -> tuple[float, ...]:
        factor = 1.0 if self.augmentation is None else self.augmentation.exposure_factor(epoch, number)
        depths = [sample.depth_range[2 * frame + end] for frame in clip or (0,) for end in (0, 1)]
        return (sample.exposure * factor, *depths, *sample.thin_lens)

    def _fill(self, target: Tensor, number: int, name: str, change: Change, clip: tuple[int, ...]) -> None:
        """Write a buffer of a sample as it is delivered; `clip`: as `_frame_order` returns it."""
        source = self._source(number, name, change.alone)
        if not clip:
            _write(target, source, name, change)
        for place, frame in enumerate(clip):
            if name in IMAGE_PLANE and frame in clip[:place]:
                target[place] = 0  # nothing moves where a frame is repeated
            else:
                _write(target[place], source[frame], name, change)

    def _sample_count(self, epoch: int, numbers: list[int], samples: list[Sample]) -> int:
        """Return how many samples per pixel all patches of a batch get."""
        held = {sample.buffers[SAMPLES].shape[0] for sample in samples if SAMPLES in sample.buffers}
        if not held:
            raise ValueError(
                f"sample {samples[0].key} has no samples of each pixel; prepare frames that keep them"
            )
        chosen = self.augmentation is not None and self.augmentation.samples is not None
        if len({sample.sample_channels for sample in samples}) > 1 or (len(held) > 1 and not chosen):
            kinds = {kept_text(s): f"{s.scene}/frame {s.frame} has {kept_text(s)}" for s in samples}
            listed = ", ".join(kinds.values())
            raise ValueError(
                f"one batch with different samples per pixel ({listed}); expected the same number and "
                "channels: use a batch size of 1, or for training a number that all have: "
                "--data.sample_counts"
            )
        if self.augmentation is None:
            return held.pop()
        return self.augmentation.sample_count(epoch, numbers[0], min(held))

    def _fill_samples(self, target: Tensor, number: int, epoch: int, change: Change) -> None:
        source, channels = self.reader.array(number, SAMPLES), self.reader.sample(number).sample_channels
        if self.augmentation is not None and self.augmentation.samples is not None:
            seed = self.augmentation.seed
            source = source[augment_samples.subset(len(source), len(target), seed, epoch, number)]
        if change[:4] == UNCHANGED[:4]:
            target.copy_(source)
        else:
            augment_samples.changed(source.to(torch.float32).numpy(), channels, change, target.numpy())

    def _source(self, number: int, name: str, alone: bool = False) -> Tensor:
        """Return a buffer (C, H, W) of a sample, (N, C, H, W) of a clip, stored or computed; `alone`: without
        history."""
        sample, reader = self.reader.sample(number), self.reader
        stored = sample.buffers
        if alone and sample.accumulated and {"color", "albedo"} <= stored.keys():
            if name == "irradiance":
                return self._demodulated(number)
            if name == "color":
                return reader.array(number, "color")
            if name == "history":
                return torch.ones_like(reader.array(number, "history"))
        accumulated_color = self.temporal and sample.accumulated and "color" in self.inputs
        if name == "color" and (name not in stored or accumulated_color):
            return reader.array(number, "irradiance").float() * reader.array(number, "albedo").float()
        if name == "irradiance" and (name not in stored or (sample.accumulated and not self.temporal)):
            return self._demodulated(number)
        return reader.array(number, name)

    def _demodulated(self, number: int) -> Tensor:
        """Return color / albedo, and 0 where a published albedo is 0: multiplied back that is 0 as well."""
        color, albedo = (self.reader.array(number, name).float() for name in ("color", "albedo"))
        return torch.where(albedo > 0, color / albedo.clamp_min(torch.finfo(torch.float32).tiny), 0.0)


def _write(target: Tensor, source: Tensor, name: str, change: Change) -> None:
    """Write an image (C, H, W) after a change into a target of the same shape."""
    if change[:4] == UNCHANGED[:4]:
        target.copy_(source)
        return
    # Converting first and turning then is several times faster than both in one strided pass.
    plain = reordered(source.to(torch.float32).numpy(), name, change)
    if change.turn == Turn.NONE:
        np.copyto(target.numpy(), plain)
        return
    np.copyto(target.numpy(), turned(plain, change.turn))
    if name in IMAGE_PLANE:
        turn_vectors(target.numpy(), change.turn, name)
