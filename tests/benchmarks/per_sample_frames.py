"""The frames that the per-sample denoisers learn from and are compared on, with 2, 4 or 8 samples per pixel.

Rendered below `bench/per_sample`: five random scenes of three views, of which four are trained on, and three
more of one view. Compared on: all random scenes not trained on, of these, of `sample:layers` and
of the benchmark `procedural`; and, where the folder `../shared/dataset/layers` exists, its six known scenes.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from data.derive import automatic_exposure
from data.frame import Frame
from data.frames import FrameSet
from data.layouts import penumbra
from data.sample import SAMPLES
from models.denoiser import Denoiser
from models.ops.per_sample import arranged
from models.tiling import denoise_in_tiles
from tests.benchmarks import procedural

SHARED = Path("..") / "shared" / "dataset" / "layers"
RENDERED = {
    "frames": "--random 5 --frames 3 --seed 5001 --size 128x128 --spp 8 --reference-spp 128",
    "held_out": "--random 3 --seed 5006 --places indoor outdoor --size 128x128 --spp 8 --reference-spp 256",
}
"""Folder → how it is rendered; the last of the scenes in `frames` is held out."""
PREPARED = "--recipe layers --patch-size 48 --train-patches 3600 --validation-patches 240"
"""64 crops of each frame of 128x128 to train on, 4 to watch the training."""
SPP = (2, 4, 8)
OUTLIERS, BRIGHTNESS = 1e-3, 50.0
"""Share of the samples that become fireflies, and their exposed radiance."""


@dataclass(frozen=True)
class View:
    """A frame to denoise.

    Attributes:
        scene: Whose it is.
        samples: Radiance and guides (S, C, H, W) in the order of `channels`.
        channels: What the C channels are.
        exposure: Factor that brings radiance to a displayable level.
        reference: Radiance (1, 3, H, W).
    """

    scene: str
    samples: Tensor
    channels: tuple[str, ...]
    exposure: float
    reference: Tensor

    def noisy(self, spp: int, outliers: bool = False) -> Tensor:
        """Return the mean of the first samples, (1, 3, H, W)."""
        return self._samples(spp, outliers)[:, self._radiance()].mean(0, keepdim=True)

    def denoised(self, net: Denoiser, spp: int, outliers: bool = False) -> Tensor:
        """Return what a network makes of the first samples, as `trainer denoise` does, (1, 3, H, W)."""
        samples = arranged(self._samples(spp, outliers)[None], self.channels, net.samples, net.fill)
        buffers = {"samples": samples, "exposure": torch.tensor([self.exposure])}
        return denoise_in_tiles(net, buffers).color

    def _samples(self, spp: int, outliers: bool) -> Tensor:
        samples = self.samples[:spp].clone()
        if outliers:
            hit = torch.rand(self.samples.shape[0], *samples.shape[2:], generator=_generator(self.scene))
            for channel in self._radiance():
                samples[:, channel][hit[:spp] < OUTLIERS] = BRIGHTNESS / self.exposure
        return samples

    def _radiance(self) -> list[int]:
        return [self.channels.index(f"radiance.{letter}") for letter in "RGB"]


def random_scenes(trained: Path, held_out: Path) -> Iterator[View]:
    """Yield the frames of random scenes that are not trained on, each scene from the first set that has it.

    Args:
        trained: Ingested frames that the trainings saw the training split of.
        held_out: More of them.
    """
    sets = [trained, held_out, SAMPLES["layers"], _rendered(procedural.FOLDER / "samples", procedural.SETS)]
    seen = set(FrameSet(trained).manifest.splits["train"])
    for frames in map(FrameSet, sets):
        for scene in frames.scenes():
            if scene not in seen:
                for record in frames.frames(scene):
                    yield _view(frames.read(scene, record.index))
        seen.update(frames.scenes())


def known_scenes() -> Iterator[View]:
    """Yield the six frames of `SHARED`, nothing where it is not there."""
    if SHARED.is_dir():
        for scene in penumbra.describe(SHARED):
            for index in scene.indices:
                yield _view(scene.read(index))


def rendered(folder: Path, kind: str) -> Path:
    """Return a data set of `RENDERED` below a folder, rendered unless it is there."""
    return _rendered(folder / kind, RENDERED)


def prepared(frames: Path, folder: Path) -> Path:
    """Return the shards of a data set below a folder, made unless they are there."""
    shards = folder / "shards"
    if not (shards / "index.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _trainer("prepare", str(frames), *PREPARED.split(), "--output", str(shards))
    return shards


def _view(frame: Frame) -> View:
    assert frame.samples is not None
    color = frame.samples.values[..., [frame.samples.channels.index(f"radiance.{c}") for c in "RGB"]].mean(0)
    reference = torch.from_numpy(frame.buffers["reference"]).permute(2, 0, 1)[None].float()
    return View(
        f"{frame.scene}-{frame.index}",
        torch.from_numpy(frame.samples.values).permute(0, 3, 1, 2).contiguous(),
        tuple(frame.samples.channels),
        automatic_exposure(color) if frame.exposure is None else frame.exposure,
        reference,
    )


def _generator(name: str) -> torch.Generator:
    """Return a generator whose seed follows from a name."""
    return torch.Generator().manual_seed(int.from_bytes(name.encode()[-7:], "big"))


def _rendered(root: Path, sets: Mapping[str, str]) -> Path:
    """Render a data set as its entry says, unless it is there; a render that was cut off goes on."""
    if not (root / "manifest.json").is_file():
        root.parent.mkdir(parents=True, exist_ok=True)
        _trainer("render", "samples", *sets[root.name].split(), "--output", str(root))
    return root


def _trainer(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "trainer", *arguments], check=True)
