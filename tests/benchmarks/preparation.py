"""Figure: `trainer prepare` on 1280x720 frames against merely decoding the same EXR files.

    python -m tests.benchmarks.preparation

Both run in two processes, one scene each, and both include the start of the processes. Decoding opens each
file with the OpenEXR library and takes its pixels as they are. Preparing reads and verifies the same files,
derives, accumulates where that is on, chooses and cuts patches, and writes shards with their checksums.

The frames are made here: a floor and a wall with textured albedo and bumpy normals, seen by a camera that
moves, lit with the noise of one sample per pixel. `sequence` frames hold what the BMFR data set has (color,
albedo, normal, position, reference); `stills` hold what `trainer render` writes for AFGSA and KPCN: halves
and variances of color, diffuse, albedo, normal and depth too.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

from data.camera import Camera
from data.frame import Frame
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.shards.options import PrepareOptions, recipe_options
from data.shards.prepare import prepare
from data.shards.processes import in_processes
from tests.benchmarks.timing import Row, print_table, row

WIDTH, HEIGHT, FRAMES, PROCESSES, REPEATS = 1280, 720, 4, 2, 3
SCENES = ("hall", "roof")
HALVES = ("color", "diffuse", "albedo", "normal", "depth")

Image = np.ndarray


def sequence_frame(scene: str, index: int) -> Frame:
    """Return a frame of a camera that moves along a floor towards a wall."""
    generator = np.random.default_rng([SCENES.index(scene), index])
    position, camera = _geometry(index)
    normal = np.where(position[..., 1:2] > 1e-3, [[[0, 0, -1]]], [[[0, 1, 0]]]) + _ripples(position, 0.2)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = 0.5 + 0.4 * _ripples(position, 1.0)
    light = 1 / (1 + np.abs(position[..., :1]))
    lit = generator.random((HEIGHT, WIDTH, 1)) < 0.3
    noisy = light * np.where(lit, generator.exponential(1 / 0.3, (HEIGHT, WIDTH, 1)), 0)
    converged = light * generator.normal(1, 0.01, (HEIGHT, WIDTH, 3))
    images = {
        "color": _half(albedo * noisy),
        "albedo": _half(albedo),
        "normal": _half(normal),
        "position": position,
        "reference": _half(albedo * converged),
    }
    images = {name: image.astype(np.float32) for name, image in images.items()}
    return Frame(images, scene, index, camera, exposure=1.0, spp=1)


def stills_frame(scene: str, index: int) -> Frame:
    """Return the same frame with halves and variances, as `trainer render` writes them for stills."""
    frame = sequence_frame(scene, index)
    generator = np.random.default_rng([SCENES.index(scene), index, 1])
    images = dict(frame.buffers)
    images["diffuse"] = images["color"] * np.float32(0.5)
    images["depth"] = np.linalg.norm(images.pop("position"), axis=-1, keepdims=True).astype(np.float32)
    for name in HALVES:
        spread = generator.normal(0, 0.05, images[name].shape) * images[name]
        half = (images[name] + spread, images[name] - spread)
        images |= {
            f"{name}_{letter}": _half(i).astype(np.float32) for letter, i in zip("ab", half, strict=True)
        }
        images[f"{name}_variance"] = (spread * spread).astype(np.float32)
    return Frame(images, scene, index, frame.camera, exposure=1.0, spp=32)


def _geometry(index: int) -> tuple[Image, Camera]:
    scale, origin = 1100.0, np.array([0.02 * index, 1.5, 0.0])
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(x - WIDTH / 2) / scale, (HEIGHT / 2 - y) / scale, np.ones_like(x)], -1)
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] < 0, -origin[1] / rays[..., 1], np.inf)
    position = origin + rays * np.minimum(floor, 12)[..., None]
    matrix = np.array(
        [[scale, 0, WIDTH / 2, 0], [0, -scale, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]], np.float64
    )
    matrix[:, 3] = -matrix[:, :3] @ origin
    return position.astype(np.float32), Camera(matrix, origin)


def _ripples(position: Image, size: float) -> Image:
    phases = position[..., None, :] * np.array([[7.0, 11, 5], [13, 3, 17], [5, 19, 23]])
    return size * np.sin(phases.sum(-1)) * np.sin(31 * position.sum(-1, keepdims=True))


def _half(image: Image) -> Image:
    return image.astype(np.float16)


def write_set(root: Path, make: Callable[[str, int], Frame], sequence: bool) -> list[str]:
    """Write a data set of two scenes and return its files."""
    scenes = {
        name: SceneRecord(tuple(write_record(make(name, i), root) for i in range(FRAMES)), sequence)
        for name in SCENES
    }
    splits: dict[str, list[str]] = {"train": list(SCENES), "validation": [], "test": []}
    Manifest("benchmark", "penumbra", "euclidean", splits, scenes).save(root)
    return [str(root / frame.file) for scene in scenes.values() for frame in scene.frames]


def decode(files: list[str]) -> None:
    """Decode files and drop what they hold."""
    for file in files:
        with OpenEXR.File(file, separate_channels=True, num_threads=0) as opened:
            assert all(channel.pixels.size for part in opened.parts for channel in part.channels.values())


def decode_all(files: list[str]) -> None:
    """Decode files in as many processes as prepare them, one scene each."""
    jobs = [(files[i * FRAMES : (i + 1) * FRAMES],) for i in range(len(SCENES))]
    in_processes(decode, jobs, PROCESSES, lambda: None)


def prepare_all(root: Path, options: PrepareOptions) -> int:
    """Prepare the set and return how many patches were made."""
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:
        index = prepare(root, Path(folder) / "shards", options, processes=PROCESSES)
        return index.count("train") + index.count("validation")


def run() -> list[Row]:
    """Measure in turn and return the medians."""
    cases = {
        "uniform, accumulated": ("sequence", recipe_options("bmfr", {})),
        "uniform, not accumulated": ("sequence", recipe_options("bmfr", {"accumulate": False})),
        "uniform, stills": ("stills", recipe_options("bmfr", {})),
        "importance, stills": ("stills", recipe_options("afgsa", {})),
        "importance, sequence frames": ("sequence", recipe_options("afgsa", {})),
    }
    with tempfile.TemporaryDirectory() as name:
        roots = {kind: Path(name) / kind for kind in ("sequence", "stills")}
        files = {
            "sequence": write_set(roots["sequence"], sequence_frame, True),
            "stills": write_set(roots["stills"], stills_frame, False),
        }
        times: dict[str, list[float]] = {}
        patches: dict[str, int] = {}
        for _ in range(REPEATS):
            for kind in roots:
                times.setdefault(kind, []).append(_seconds(lambda kind=kind: decode_all(files[kind])))
            for case, (kind, options) in cases.items():
                start = time.perf_counter()
                patches[case] = prepare_all(roots[kind], options)
                times.setdefault(case, []).append(time.perf_counter() - start)
    frames = len(SCENES) * FRAMES
    rows = [
        row(f"decoding {kind} frames 1280x720", frames / statistics.median(times[kind]), "fps")
        for kind in roots
    ]
    for case, (kind, _) in cases.items():
        ratio = statistics.median(d / t for d, t in zip(times[kind], times[case], strict=True))
        rows += [
            row(f"prepare / decode, {case}", ratio, "x", ">= 0.6", ratio >= 0.6),
            row(f"prepare, {case}: patches per frame", patches[case] / frames, ""),
        ]
    return rows


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


if __name__ == "__main__":
    print_table(run())
