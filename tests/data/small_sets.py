"""Small ingested data sets and shards with known content, for tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from data.buffers import sample_channels
from data.frame import Frame, Samples
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.shards.index import Index
from data.shards.options import PrepareOptions
from data.shards.prepare import prepare

SPLITS = {"train": ["hall", "roof"], "validation": [], "test": ["cave"]}


CHANNELS = sample_channels("radiance", "normal", "roughness")
"""Channels of the samples of `with_samples`, all of which half precision holds."""


def frame(
    scene: str, index: int, width: int = 48, height: int = 40, scale: float = 1.0, calm: bool = False
) -> Frame:
    """A static view (motion 0) whose depth numbers the pixels; light differs from frame to frame.

    `calm`: the left half has neither noise nor texture.
    """
    generator = np.random.default_rng([len(scene), index])
    shape = (height, width)
    albedo = generator.uniform(0.2, 0.9, (*shape, 3)).astype(np.float16).astype(np.float32)
    light = generator.exponential(scale, (*shape, 1)).astype(np.float32)
    normal = np.zeros((*shape, 3), np.float32)
    normal[..., 2] = 1
    if calm:
        albedo[:, : width // 2], light[:, : width // 2] = 0.5, scale
    color, reference = albedo * light, albedo * np.float32(scale)
    if scale < 1000:
        color, reference = (x.astype(np.float16).astype(np.float32) for x in (color, reference))
    return Frame(
        {
            "color": color,
            "albedo": albedo,
            "normal": normal,
            "depth": (1 + np.arange(height * width, dtype=np.float32)).reshape(*shape, 1),
            "motion": np.zeros((*shape, 2), np.float32),
            "reference": reference,
        },
        scene,
        index,
        exposure=0.5 + index,
        spp=1,
    )


def with_samples(made: Frame, count: int, depth: bool = False, bright: float = 0.0) -> Frame:
    """Return the frame with so many samples; `bright` is added to the radiance of the first."""
    generator = np.random.default_rng([made.index, count])
    shape = (count, made.height, made.width)
    parts = {
        "radiance": generator.exponential(1, (*shape, 3)).astype(np.float32),
        "normal": generator.uniform(-1, 1, (*shape, 3)).astype(np.float32),
        "roughness": generator.random((*shape, 1), np.float32),
    }
    parts["radiance"][0] += np.float32(bright)
    if depth:
        parts["depth"] = generator.uniform(1, 9, (*shape, 1)).astype(np.float32)
    return replace(made, samples=Samples.of(parts))


def write_stills(
    root: Path,
    views: int = 4,
    levels: tuple[int, ...] = (4, 8),
    samples: bool = False,
    path: bool = False,
) -> Path:
    """Write a set of stills: each view once for each number of samples per pixel, one frame after the other.

    Views of the training scenes `hall` and `roof`; with `samples`, they are kept apart; with `path`, they
    are those of a moving camera.
    """
    scenes = {}
    for scene in ("hall", "roof"):
        records = []
        for index in range(views * len(levels)):
            made = replace(frame(scene, index), spp=levels[index % len(levels)])
            made.notes["view"] = index // len(levels)
            if samples:
                made = with_samples(made, levels[index % len(levels)])
            records.append(write_record(made, root))
        scenes[scene] = SceneRecord(tuple(records), sequence=path)
    splits: dict[str, list[str]] = {"train": ["hall", "roof"], "validation": [], "test": []}
    Manifest("stills", "penumbra", "euclidean", splits, scenes).save(root)
    return root


def write_set(
    root: Path,
    splits: dict[str, list[str]] | None = None,
    frames: int = 3,
    size: tuple[int, int] = (48, 40),
    sequence: bool = True,
    black: tuple[str, int] | None = None,
    scale: float = 1.0,
    calm: bool = False,
) -> Path:
    """Write an ingested data set; `black` names a frame whose reference is black."""
    splits = splits or SPLITS
    scenes = {}
    for scene in (name for names in splits.values() for name in names):
        records = []
        for index in range(frames):
            made = frame(scene, index, *size, scale=scale, calm=calm)
            if black == (scene, index):
                made = made.with_buffers(reference=np.zeros_like(made.buffers["reference"]))
            records.append(write_record(made, root))
        scenes[scene] = SceneRecord(tuple(records), sequence)
    Manifest("miniature", "penumbra", "euclidean", splits, scenes).save(root)
    return root


OPTIONS = PrepareOptions(patch_size=16, train_patches=4000, validation_patches=1000, samples_per_shard=4)
"""48x40 frames give 8 or 9 training and 2 or 3 validation patches each."""


def write_shards(folder: Path, options: PrepareOptions = OPTIONS, frames: int = 3) -> Index:
    """Write a data set and its shards, `folder/frames` and `folder/shards`."""
    return prepare(write_set(folder / "frames", frames=frames), folder / "shards", options)
