"""The stills that the training-free methods are compared on, at 4 and 32 samples per pixel.

Frames of the sample that ships and, where the folder `../shared/dataset/stills` exists, of that data set. At
32 samples both hold two halves of 16 and the variance of the mean. At 4 samples the sample's scenes are
rendered here once, with halves and variances, below `bench/classical`; the data set has one buffer of 4
samples without halves or variance, so its noise is estimated from that buffer (`color_noise` = `estimated`),
and its features are those of the 32 samples. The data set's features have no halves: their mean stands for
both (`feature_noise` = `variance`).

RHF reads histograms of samples, which neither has. The sample's scenes are rendered for them with the recipe
and the seeds of the sample, at 32 samples too, so that colour and histogram are of the same samples. Where
the rendered colour is not that of the sample, as in the one scene whose lamps had another order when the
sample was made, all noisy buffers are those of the new rendering, for all methods.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from data.buffers import HISTOGRAM
from data.derive import derive
from data.exr import read_frame
from data.frame import Frame
from data.frames import FrameSet
from data.layouts import penumbra
from data.sample import SAMPLES
from models.ops.fireflies import limited_halves
from models.ops.halves import Halves

SHARED = Path("..") / "shared" / "dataset" / "stills"
RENDERED = Path("bench") / "classical"
FEATURES = ("normal", "albedo", "depth")
SPP = (4, 32)

ROUNDING = 2.0**-8
"""Twice the relative error of the sample's radiance, which has 8 bits of mantissa: the rest is for machines
that round the last bit of a path differently."""


@dataclass(frozen=True)
class Still:
    """A frame with everything that some method reads.

    Attributes:
        name: Scene and number of the frame.
        spp: Samples per pixel of `color`.
        buffers: Tensors (1, C, H, W) and `exposure` (1,).
        reference: Radiance (1, 3, H, W).
        reference_error: Unbiased estimate of the reference's squared error (1, 3, H, W), noisy and of either
            sign: see `reference_error`.
        noise: The options `color_noise` and `feature_noise` that the buffers need.
    """

    name: str
    spp: int
    buffers: dict[str, Tensor]
    reference: Tensor
    reference_error: Tensor
    noise: dict[str, str] = field(default_factory=dict)

    @property
    def exposure(self) -> float:
        """Factor that brings radiance to a displayable level."""
        return float(self.buffers["exposure"])


def stills(spp: int, limit: int | None = None) -> Iterator[Still]:
    """Yield all stills of a number of samples per pixel; `limit` bounds the frames of each data set."""
    yield from _limited(_sample(spp), limit)
    if SHARED.is_dir():
        yield from _limited(_shared(spp), limit)


def limited(still: Still) -> Still | None:
    """Return the still with fireflies limited by `models.ops.fireflies`, None where there are no halves."""
    if "color_a" not in still.buffers:
        return None
    parts = Halves(*(still.buffers[f"color_{part}"] for part in ("a", "b", "variance")))
    a, b, variance = limited_halves(parts)
    color = 0.5 * (a + b)
    changed = {"color": color, "color_a": a, "color_b": b, "color_variance": variance}
    changed["irradiance"] = color / still.buffers["albedo"]
    return replace(still, buffers={**still.buffers, **changed})


def left_out() -> list[str]:
    """Return a sentence for each data set that this machine lacks."""
    said = []
    if SHARED.is_dir():
        said.append(f"left out: RHF on the stills of {SHARED}, which have no histograms")
    else:
        said.append(f"left out: the stills of {SHARED}, which is not there")
    if _rendered(4) is None:
        said.append(
            "left out: the sample's scenes at 4 samples per pixel; rendering needs the extra `render`"
        )
    if _rendered(32) is None:
        said.append("left out: RHF on the sample at 32 samples per pixel; rendering needs the extra `render`")
    return said


def with_histogram(stored: Frame, rendered: Frame) -> Frame:
    """Return the stored frame with the histogram of a rendering, or the rendering if it is of other samples.

    Args:
        stored: A frame of the sample.
        rendered: The same scene, rendered with the same recipe and seed, with its histogram.
    """
    parts = [(rendered.buffers[name], stored.buffers[name]) for name in ("color_a", "color_b")]
    same = all(np.allclose(new, old, rtol=ROUNDING, atol=1e-6) for new, old in parts)
    return stored.with_buffers(**{HISTOGRAM: rendered.buffers[HISTOGRAM]}) if same else rendered


def reference_error(half_a: Tensor, half_b: Tensor, reference: Tensor) -> Tensor:
    """Return (a - r)(b - r): its mean given r is (t - r)^2, since a, b and r are independent means of t."""
    return (half_a - reference) * (half_b - reference)


def _limited(frames: Iterator[Still], limit: int | None) -> Iterator[Still]:
    for count, still in enumerate(frames):
        if count == limit:
            return
        yield still


def _sample(spp: int) -> Iterator[Still]:
    frames = FrameSet(SAMPLES["stills"])
    rendered = _rendered(spp)
    for scene in frames.scenes():
        for record in frames.frames(scene):
            high = frames.read(scene, record.index)
            frame = None if rendered is None else rendered.read(scene, record.index)
            if spp == 32:
                yield _still(high if frame is None else with_histogram(high, frame), high)
            elif frame is not None:
                yield _still(frame, high)


def _rendered(spp: int) -> FrameSet | None:
    """Return the sample's scenes with histograms, rendered unless they were; None if that failed.

    A reference is not needed and has two samples per pixel, the fewest: too few for `trainer render` to judge
    the noisy mean by it, so that its exit code is not asked.
    """
    root = RENDERED / f"histograms_{spp}"
    if not (root / "manifest.json").is_file():
        count = len(FrameSet(SAMPLES["stills"]).scenes())
        options = f"--random {count} --seed 1 --size 160x160 --spp {spp} --reference-spp 2 --histogram"
        render("stills", root, options)
    return FrameSet(root) if (root / "manifest.json").is_file() else None


def render(kind: str, root: Path, options: str) -> bool:
    """Run `trainer render`; return whether it could."""
    root.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "trainer", "render", kind, *options.split(), "--output", str(root)]
    return subprocess.run(command, check=False).returncode == 0


def _shared(spp: int) -> Iterator[Still]:
    for scene in penumbra.describe(SHARED):
        for index in scene.indices:
            high = scene.read(index)
            still = _still(high, high)
            if spp == 4:
                low = read_frame(SHARED / scene.name / f"f{index:03d}_low.exr")
                color = _tensor(low.buffers["color"])
                albedo = still.buffers["albedo"]
                kept = {n: t for n, t in still.buffers.items() if n not in ("color_a", "color_b")}
                kept.pop("color_variance")
                buffers = {**kept, "color": color, "irradiance": color / albedo}
                still = replace(
                    still, spp=4, buffers=buffers, noise={**still.noise, "color_noise": "estimated"}
                )
            yield still


def _still(frame: Frame, high: Frame) -> Still:
    """Return a frame as tensors; `high` has the reference and halves that judge it."""
    names = ["color", "color_a", "color_b", "color_variance", "irradiance", *FEATURES]
    names += [f"{name}_variance" for name in FEATURES]
    halves = [f"{name}_{half}" for name in FEATURES for half in "ab"]
    split = "normal_a" in frame.buffers
    frame = derive(frame, names + halves if split else names)
    names += [HISTOGRAM] if HISTOGRAM in frame.buffers else []
    buffers = {name: _tensor(frame.buffers[name]) for name in (names + halves if split else names)}
    buffers["exposure"] = torch.tensor([high.exposure or 1.0])
    reference = _tensor(high.buffers["reference"])
    parts = [_tensor(high.buffers[name]) for name in ("color_a", "color_b")]
    return Still(
        f"{high.scene}/{high.index}",
        frame.spp or 0,
        buffers,
        reference,
        reference_error(parts[0], parts[1], reference),
        {"color_noise": "measured", "feature_noise": "measured" if split else "variance"},
    )


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None]
