"""Make the procedural samples that ship: `python -m data.sample.rendered [OUTPUT]`; needs the extra `render`.

`stills` and `layers` are what `trainer render stills` and `trainer render samples` make of random scenes,
with mantissas rounded so that ZIP can do something for them, and without `trainer render`'s working files.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from data.exr import read_frame
from data.frame import Image, Samples
from data.ingestion import write_record
from data.manifest import FrameRecord, Manifest
from data.render.recipe import Recipe
from data.render.rendering import RenderOptions, render
from data.render.sources import RandomSource, Source
from data.render.spec import Shot
from data.render.variant import choose
from data.sample import FOLDER
from data.sample.build import round_mantissa

LIMIT_BYTES = 20_000_000
TEST = {"stills": ("indoor-000006",), "layers": ("indoor-000104",)}

RECIPES = {
    "stills": Recipe("stills", 160, 160, (32,), 256),
    "layers": Recipe("samples", 64, 64, (8,), 512),
}
SEEDS = {"stills": range(1, 7), "layers": range(101, 105)}
"""Odd seeds are outdoor scenes, even ones indoor."""

LEFT_OUT = ("visibility_a", "visibility_b", "visibility_variance", "diffuse_a", "diffuse_b")
"""Buffers that no shipped configuration needs and that would take a tenth of the space."""

BITS = {"variance": 4, "distance": 10, "radiance": 8, "samples": 6}
"""Explicit mantissa bits kept of the noisy side; references and the other guides keep all ten."""


def build(output: Path) -> dict[str, Manifest]:
    """Render both samples below a folder; what is there is replaced when all is done.

    Raises:
        ValueError: They are over 20 MB, or the renderer failed.
        OSError: Reading or writing failed.
    """
    made = {}
    with tempfile.TemporaryDirectory(dir=output, prefix=".rendered") as folder:
        for name, recipe in RECIPES.items():
            root = Path(folder) / name
            made[name] = _lean(render(_sources(name), recipe, root, _options(name)), root)
        size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
        if size > LIMIT_BYTES:
            raise ValueError(f"the samples have {size / 1e6:.1f} MB, over {LIMIT_BYTES / 1e6:.0f} MB")
        for name in RECIPES:
            if (output / name).exists():
                shutil.rmtree(output / name)
            (Path(folder) / name).rename(output / name)
    return made


def _sources(name: str) -> list[Source]:
    recipe = RECIPES[name]
    shot = Shot(recipe.width, recipe.height)
    return [RandomSource(seed, "outdoor" if seed % 2 else "indoor", shot) for seed in SEEDS[name]]


def _options(name: str) -> RenderOptions:
    cores = len(os.sched_getaffinity(0))
    processes = max(min(cores, 2), cores // 2)
    return RenderOptions(choose(), processes, max(1, cores // processes), test=TEST[name])


def _lean(manifest: Manifest, root: Path) -> Manifest:
    """Write all frames again, rounded, and the manifest with their new checksums."""
    scenes = {
        name: replace(scene, frames=tuple(_rounded(record, root) for record in scene.frames))
        for name, scene in manifest.scenes.items()
    }
    bits = ", ".join(f"{what} {number} bits" for what, number in BITS.items())
    lean = replace(
        manifest,
        scenes=scenes,
        notes=f"{manifest.notes} Mantissas of the noisy side are rounded ({bits}); "
        f"left out: {', '.join(LEFT_OUT)}.",
    )
    shutil.rmtree(root / ".render")
    lean.save(root)
    return lean


def _rounded(record: FrameRecord, root: Path) -> FrameRecord:
    frame = read_frame(root / record.file)
    notes = {"view": record.view, "reference_spp": record.reference_spp, "checks": record.checks}
    buffers = {n: _kept(n, image) for n, image in frame.buffers.items() if n not in LEFT_OUT}
    samples = frame.samples
    if samples is not None:
        samples = Samples(_round(samples.values, BITS["samples"]), samples.channels)
    return write_record(replace(frame, buffers=buffers, samples=samples, notes=notes), root)


def _kept(name: str, array: Image) -> Image:
    if name.endswith("_variance"):
        return _round(array, BITS["variance"])
    if name.startswith(("depth", "position")):
        return _round(array, BITS["distance"])
    if name.startswith(("color", "diffuse", "specular")) and "albedo" not in name:
        return _round(array, BITS["radiance"])
    return array


def _round(array: Image, bits: int) -> Image:
    """Round to half precision with fewer bits; values too large or too small for it stay as they are."""
    if array.size and float(np.abs(array).max()) > 65504:
        return array
    return round_mantissa(array, bits, half=True)


def main() -> None:
    """Render the samples from the command line."""
    parser = argparse.ArgumentParser(prog="python -m data.sample.rendered", description=build.__doc__)
    parser.add_argument("output", type=Path, nargs="?", default=FOLDER, help="folder to write into")
    for name, manifest in build(parser.parse_args().output).items():
        size = sum(f.bytes for s in manifest.scenes.values() for f in s.frames)
        print(f"{name}: {manifest.frame_count} frames, {size / 1e6:.2f} MB, hash {manifest.hash[:12]}")


if __name__ == "__main__":
    main()
