"""Temporal flicker of NFOR's space-time mode, beside NFOR frame by frame.

Renders a random room below `bench/classical` unless it is there: 8 frames of 96x64 at 16 samples per pixel
with halves and variances, other samples in every frame, once with a camera that stands still and once with
one that moves. (The published-layout videos have one sample per pixel and no halves.)

Flicker is the mean absolute difference of the errors of successive frames, |(x_t - r_t) - (x_t-1 - r_t-1)|,
of display values, clamp(max(e x, 0)^(1/2.2), 0, 1), and of exposed radiance. For the moving camera the
preceding error is fetched, from the nearest pixel, where the same surface point was; pixels that saw another
one are left out. For the camera at rest r is the mean of all references, whose noise then takes no part.

    python -m tests.benchmarks.flicker
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from data.camera import footprint
from data.derive import derive
from data.frame import Frame
from data.frames import FrameSet
from data.render.recipe import Recipe
from data.render.sources import RandomSource, Source
from data.render.spec import SceneSpec, Shot
from data.temporal import POSITION_LIMIT_FOOTPRINTS
from models import NFOR, NLM
from models.denoiser import Denoiser
from tests.benchmarks.classical_frames import FEATURES, RENDERED
from tests.benchmarks.timing import Row, print_table, row
from trainer.metrics.functional import gamma

SHOT = Shot(96, 64, 8, path=True, defocus=0.0, motion=0.0)
RECIPE = Recipe("stills", SHOT.width, SHOT.height, (16,), 512)
SEED = 12
METHODS: dict[str, Denoiser] = {
    "NLM": NLM(),
    "NFOR paper, frame by frame": NFOR("paper", FEATURES),
    "NFOR paper, frames=2": NFOR("paper", FEATURES, frames=2),
}


@dataclass(frozen=True)
class AtRest:
    """A scene seen by the first camera of its path in all frames."""

    moving: Source

    @property
    def name(self) -> str:
        """Of the scene."""
        return self.moving.name

    @property
    def shot(self) -> Shot:
        """Size and number of the views."""
        return self.moving.shot

    def identity(self) -> dict[str, Any]:
        """Return what tells this scene from others."""
        return {**self.moving.identity(), "camera": "at rest"}

    def build(self) -> SceneSpec:
        """Make the scene."""
        spec = self.moving.build()
        return replace(spec, views=(spec.views[0],) * len(spec.views))


@dataclass(frozen=True)
class Clip:
    """Frames of one camera.

    Attributes:
        buffers: What the methods read, (1, T, C, H, W), and `exposure` (1,).
        color: Noisy radiance (T, 3, H, W).
        reference: Radiance (T, 3, H, W).
        before: Row and column (T - 1, 2, H, W) where each pixel's point was in the preceding frame; -1 where
            it was not seen.
    """

    buffers: dict[str, Tensor]
    color: Tensor
    reference: Tensor
    before: Tensor


def render(moving: bool) -> Path | None:
    """Render the room unless it is there; None where there is no renderer."""
    root = RENDERED / ("moving" if moving else "at_rest")
    if (root / "manifest.json").is_file():
        return root
    try:
        from data.render.rendering import RenderOptions, render
        from data.render.variant import choose

        room = RandomSource(SEED, "indoor", SHOT)
        options = RenderOptions(choose(), 1, len(os.sched_getaffinity(0)))
        render([room if moving else AtRest(room)], RECIPE, root, options)
    except (ImportError, ValueError) as error:
        print(f"left out: flicker; rendering needs the extra `render` ({error})")
        return None
    return root


def clip(root: Path, moving: bool) -> Clip:
    """Read the frames of a camera."""
    frames = FrameSet(root)
    scene = frames.scenes()[0]
    parts = ("_a", "_b", "_variance")
    names = [name + part for name in ("color", *FEATURES) for part in parts]
    wanted = [*names, "color", "position", "reference"]
    read = [frames.read(scene, record.index, wanted) for record in frames.frames(scene)]
    stacked = {n: torch.stack([_planes(f, n) for f in read]) for n in wanted}
    reference = stacked["reference"]
    buffers: dict[str, Tensor] = {name: stacked[name][None] for name in names}
    buffers["exposure"] = torch.tensor([read[0].exposure or 1.0])
    if not moving:
        reference = reference.mean(0, keepdim=True).expand_as(reference)
    same = torch.from_numpy(np.indices((read[0].height, read[0].width)))
    places = [_before(now, then) if moving else same for then, now in pairwise(read)]
    return Clip(buffers, stacked["color"], reference, torch.stack(places))


def _planes(frame: Frame, name: str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(frame.buffers[name].transpose(2, 0, 1), np.float32))


def _before(now: Frame, then: Frame) -> Tensor:
    """Return row and column (2, H, W) in the preceding frame of what each pixel shows, -1 where not seen."""
    if now.camera is None or then.camera is None:
        raise ValueError(f"{now.label}: no camera")
    motion = derive(now, ["motion"], previous=then.camera).buffers["motion"]
    height, width = motion.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    row = np.rint(rows + motion[..., 1]).astype(int)
    column = np.rint(columns + motion[..., 0]).astype(int)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    there = then.buffers["position"][row.clip(0, height - 1), column.clip(0, width - 1)]
    size = footprint(now.camera, np.ascontiguousarray(now.buffers["position"]))
    limit = POSITION_LIMIT_FOOTPRINTS * np.median(size[size > 0])
    near = np.linalg.norm(there - now.buffers["position"], axis=-1) < limit
    return torch.from_numpy(np.where(inside & near, np.stack([row, column]), -1))


def flicker(error: Tensor, before: Tensor) -> float:
    """Return the mean absolute difference of an error (T, 3, H, W) from the preceding frame's."""
    changes = []
    for now, then, place in zip(error[1:], error[:-1], before, strict=True):
        seen = place[0] >= 0
        changes.append((now[:, seen] - then[:, place[0][seen], place[1][seen]]).abs().flatten())
    return float(torch.cat(changes).mean())


@torch.inference_mode()
def measure(frames: Clip) -> dict[str, dict[str, float]]:
    """Return method → figure → value."""
    images = {"input": frames.color}
    for name, net in METHODS.items():
        images[name] = _sequence(net, frames)
    exposure = float(frames.buffers["exposure"])
    reference = frames.reference * exposure
    result = {}
    for name, image in images.items():
        shown, radiance = gamma(image * exposure) - gamma(reference), image * exposure - reference
        result[name] = {
            "flicker of display values": flicker(shown, frames.before),
            "flicker of radiance": flicker(radiance, frames.before),
            "RMSE of display values": float(shown.square().mean().sqrt()),
        }
    return result


def _sequence(net: Denoiser, frames: Clip) -> Tensor:
    """Return all denoised frames (T, 3, H, W)."""
    numbers = {"exposure": frames.buffers["exposure"]}
    if net.frames:
        return net.sequence(frames.buffers)[0]
    count = len(frames.color)
    stills = ({**{n: frames.buffers[n][:, t] for n in net.inputs}, **numbers} for t in range(count))
    return torch.cat([net(still).color for still in stills])


def run() -> list[Row]:
    """Return the flicker of every method for both cameras."""
    rows: list[Row] = []
    for moving in (False, True):
        root = render(moving)
        if root is None:
            return rows
        camera = "moving camera" if moving else "camera at rest"
        found = measure(clip(root, moving))
        for name, figures in found.items():
            rows += [row(f"{camera}, {name}: {figure}", value, "") for figure, value in figures.items()]
        alone, together = (found[f"NFOR paper, {mode}"] for mode in ("frame by frame", "frames=2"))
        ratio = together["flicker of display values"] / alone["flicker of display values"]
        rows.append(row(f"{camera}: flicker, frames=2 / frame by frame", ratio, "", "< 1", ratio < 1))
    return rows


if __name__ == "__main__":
    print_table(run())
