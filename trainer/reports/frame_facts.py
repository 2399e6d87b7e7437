"""What the data report needs to know of one frame; frames are read once, one at a time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from data.buffers import buffer
from data.derive import derive
from data.dropped import mean
from data.duplicates import Fingerprint, fingerprint
from data.exr import RadianceWarning, looks_encoded, read_frame
from data.frame import Frame
from data.frames import FrameSet
from data.importance import CANDIDATES, importance_map, importance_positions
from data.inspection import describe_frame
from data.manifest import MANIFEST, FrameRecord
from data.patches import patch_count, uniform_positions
from data.repair import repair
from data.shards.cut import PrepareOptions
from data.statistics import (
    Histogram,
    energy,
    firefly_mask,
    histograms,
    no_hit_share,
    outside_share,
)
from trainer.reports.svg import percent
from trainer.reports.thumbnails import (
    Array,
    Thumbnail,
    buffer_thumbnail,
    density_picture,
    expected_coverage,
    in_order,
    picture_of,
    thumbnail,
    window,
    with_dots,
)

Pictures = Literal["all", "main", "none"]

MAIN = ("color", "reference", "albedo", "diffuse_albedo", "normal", "depth")
"""Buffers that are shown of every scene where there are too many scenes to show all."""

SMALL = 144
"""Largest side of a picture in a row of frames."""

CONSTANT = ("albedo", "diffuse_albedo", "normal", "depth", "position", "color", "reference")
"""Buffers that say nothing if all pixels are equal."""


@dataclass(frozen=True)
class FrameJob:
    """One frame to be looked at.

    Attributes:
        root: The data set.
        scene: Name of the scene.
        record: What the manifest says of the frame.
        pictures: Which thumbnails to make beside the small one of `color`.
        limit: Largest side of a thumbnail in pixels.
        column: Show the middle of the frame in full size, beside other numbers of samples of the same view.
        before: File of the preceding frame, where the motion is to be shown: the second frame of a sequence
            stands in for the first one, which has none.
    """

    root: str
    scene: str
    record: FrameRecord
    pictures: Pictures
    limit: int
    column: bool = False
    before: str = ""


@dataclass(eq=False)
class FrameFacts:
    """What was found in a frame.

    Attributes:
        scene: Name of the scene.
        record: What the manifest says of the frame.
        problem: Why it could not be read; everything else is then empty.
        scores: Metric → value of `color` against `reference`, at the frame's exposure.
        fireflies: Share of pixels that are fireflies, None without a reference.
        energy_ratio: Mean input divided by mean reference.
        energy_z: Deviation of the means in standard errors, None where unknown.
        no_hit: Share of samples that left the scene.
        outside: Buffer → share of values outside of the legal range, where there are any.
        encoded: Radiance buffer → why it looks 8-bit or tone-mapped.
        constant: Buffers whose pixels are all equal.
        normal: Why normals are none, empty where they are fine.
        buffers: All buffers, derived ones included.
        histograms: See `data.statistics.histograms`.
        print: Fingerprint of the view.
        thumbnails: Buffer → picture, in the order to be shown.
        strip: Small picture of `color`.
        columns: Middle of `color` and `reference` in full size.
        density: `uniform`, `importance` → picture of where patches fall.
        patch: Width of the patches in `density`.
        details: `describe_frame`, where all buffers are shown.
    """

    scene: str
    record: FrameRecord
    problem: str = ""
    scores: dict[str, float] = field(default_factory=dict)
    fireflies: float | None = None
    energy_ratio: float | None = None
    energy_z: float | None = None
    no_hit: float | None = None
    outside: dict[str, float] = field(default_factory=dict)
    encoded: dict[str, str] = field(default_factory=dict)
    constant: tuple[str, ...] = ()
    normal: str = ""
    buffers: tuple[str, ...] = ()
    histograms: dict[str, Histogram] = field(default_factory=dict)
    print: Fingerprint | None = None
    thumbnails: dict[str, Thumbnail] = field(default_factory=dict)
    strip: Thumbnail | None = None
    columns: dict[str, Thumbnail] = field(default_factory=dict)
    density: dict[str, Thumbnail] = field(default_factory=dict)
    patch: int = 0
    details: dict[str, Any] = field(default_factory=dict)


def look_at(job: FrameJob) -> FrameFacts:
    """Read a frame and return what was found; a frame that cannot be read is a problem, not an error."""
    facts = FrameFacts(job.scene, job.record)
    try:
        with warnings.catch_warnings():
            # Said in the report instead, of which `looks_encoded` is asked below.
            warnings.simplefilter("ignore", RadianceWarning)
            frame = _frames(job.root, (Path(job.root) / MANIFEST).stat().st_mtime_ns).read(
                job.scene, job.record.index
            )
    except (OSError, ValueError) as error:
        facts.problem = str(error)
        return facts
    if job.pictures == "all":
        facts.details = describe_frame(frame)
    frame = _with_color(frame)
    facts.buffers = tuple(frame.buffers)
    if job.before and "motion" not in frame.buffers:
        frame = _with_motion(frame, Path(job.root) / job.before)
    _measure(facts, frame)
    _judge(facts, frame)
    _draw(facts, frame, job)
    return facts


@lru_cache(maxsize=1)
def _frames(root: str, changed: int) -> FrameSet:
    """Return the data set; its manifest is read once by each process."""
    return FrameSet(root)


def one_thread() -> None:
    """Keep PyTorch to one thread, in processes that work side by side."""
    import torch

    torch.set_num_threads(1)


def _with_color(frame: Frame) -> Frame:
    """Return the frame with the mean of its samples as `color`, where it has no other."""
    samples = frame.samples
    if samples is None or "color" in frame.buffers or "radiance" not in samples.names:
        return frame
    repaired, _ = repair({"color": mean(samples.get("radiance"))})
    frame = frame.with_buffers(**repaired)
    return derive(frame, ["irradiance"]) if "albedo" in frame.buffers else frame


def _with_motion(frame: Frame, before: Path) -> Frame:
    """Return the frame with the motion that follows from its positions and the camera of the frame before."""
    try:
        return derive(frame, ["motion"], previous=read_frame(before).camera)
    except (OSError, ValueError):
        return frame


def _measure(facts: FrameFacts, frame: Frame) -> None:
    b = frame.buffers
    exposure = frame.exposure or 1.0
    if {"color", "reference"} <= b.keys():
        facts.scores = scores(b["color"] * np.float32(exposure), b["reference"] * np.float32(exposure))
        facts.fireflies = float(firefly_mask(b["color"], b["reference"]).mean())
    found = energy(frame, facts.record.reference_spp)
    if found is not None:
        facts.energy_ratio, facts.energy_z = found
    if "energy_z" in facts.record.checks:
        facts.energy_z = facts.record.checks["energy_z"]
    facts.no_hit = no_hit_share(frame)
    facts.histograms = histograms(frame)
    facts.print = fingerprint(frame)


def scores(color: Array, reference: Array) -> dict[str, float]:
    """Return the noise level of exposed radiance (H, W, 3): `psnr_wskp` and `relmse_layer`."""
    import torch

    from trainer.metrics.functional import psnr_wskp, relmse_layer

    output, target = (
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None] for image in (color, reference)
    )
    return {
        "psnr_wskp": float(psnr_wskp(output, target)),
        "relmse_layer": float(relmse_layer(output, target)),
    }


def _judge(facts: FrameFacts, frame: Frame) -> None:
    for name, image in frame.buffers.items():
        share = outside_share(name, image)
        if share > 0:
            facts.outside[name] = share
        if buffer(name).kind == "radiance":
            reason = looks_encoded(image)
            if reason:
                facts.encoded[name] = reason
    facts.constant = tuple(
        n for n in CONSTANT if n in frame.buffers and not np.ptp(frame.buffers[n], axis=(0, 1)).any()
    )
    if "normal" in frame.buffers and "normal" not in facts.constant:
        facts.normal = _wrong_normals(frame.buffers["normal"])


def _wrong_normals(normal: Array) -> str:
    """Return why normals are not unit vectors; means over a pixel may be shorter than 1, never longer."""
    length = np.linalg.norm(normal, axis=-1)
    hit = length > 0
    typical = float(np.median(length[hit])) if hit.any() else 1.0
    decoded = float(np.median(np.linalg.norm(2 * normal - 1, axis=-1)))
    if abs(decoded - 1) < 0.01 < abs(typical - 1):
        return "they look like unit vectors mapped to [0, 1] for display"
    share = float((length > 1.01).mean())
    if share > 0:
        return f"{100 * share:.2g} % of the pixels have normals longer than 1, up to {length.max():.3g}"
    if typical < 0.9:
        return f"half of the normals are shorter than {typical:.2g}"
    return ""


def _draw(facts: FrameFacts, frame: Frame, job: FrameJob) -> None:
    exposure, b = frame.exposure or 1.0, frame.buffers
    color = b.get("color", b.get("reference"))
    if color is not None:
        facts.strip = thumbnail(picture_of("color", color, exposure)[0], SMALL)
    if job.column:
        shown = {n: window(b[n], job.limit) for n in ("color", "reference") if n in b}
        facts.columns = {n: buffer_thumbnail(n, image, exposure, job.limit) for n, image in shown.items()}
    if job.before and "motion" in b:
        facts.thumbnails["motion"] = buffer_thumbnail("motion", b["motion"], exposure, job.limit)
    if job.pictures == "none":
        return
    for name in in_order(b):
        if job.pictures == "all" or name in MAIN:
            facts.thumbnails[name] = buffer_thumbnail(name, b[name], exposure, job.limit)
    if color is not None:
        facts.patch, facts.density = densities(frame, color, job.limit)


def densities(frame: Frame, color: Array, limit: int) -> tuple[int, dict[str, Thumbnail]]:
    """Return the patch size, and for uniform and importance sampling where patches fall, on one scale.

    The density is the expected one; dots are the centres of the patches of one draw as large as that of
    `trainer prepare`. Frames that are smaller than a patch are shown with patches of half their shorter side.

    Args:
        frame: The frame.
        color: What to draw over, and what importance is computed from (H, W, 3).
        limit: Largest side of a picture.
    """
    size = (frame.width, frame.height)
    options = PrepareOptions()
    patch = options.patch_size if min(size) >= options.patch_size else max(1, min(size) // 2)
    worth = importance_map(color, frame.buffers.get("normal"), patch)
    seed = (options.seed, "train", frame.scene, frame.index)
    uniform = patch_count(options.train_patches, *size, 0)
    candidates = patch_count(CANDIDATES, *size, 0)
    drawn = {
        "uniform": uniform_positions(uniform, size, patch, seed, frame.label),
        "importance": importance_positions(worth, candidates, patch, seed, frame.label),
    }
    corners = (frame.height - patch + 1, frame.width - patch + 1)
    middle = patch // 2
    weights = {
        "uniform": np.ones(corners, np.float32),
        "importance": worth[middle : middle + corners[0], middle : middle + corners[1]],
    }
    shares = {name: expected_coverage(w, patch) for name, w in weights.items()}
    highest = max(float(share.max()) for share in shares.values())
    found = {}
    for name, share in shares.items():
        picture = density_picture(color, frame.exposure or 1.0, share / highest, limit)
        centres = [((x + patch / 2) / size[0], (y + patch / 2) / size[1]) for x, y in drawn[name]]
        low, high = percent(float(share.min())), percent(float(share.max()))
        note = f"{len(centres)} patches of this frame; on average {low} to {high} of them hold a pixel"
        found[name] = thumbnail(with_dots(picture, centres), limit, note, flat=True)
    return patch, found
