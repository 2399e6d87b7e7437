"""Make the sample that ships from rendered sequences: `python -m data.sample.build SOURCE [OUTPUT]`.

SOURCE is a folder in the layout `penumbra` with the scenes below. To stay under 20 MB the sample keeps what
cannot be computed: radiance, effective albedo, normal, position, reference; depth, irradiance and motion are
derived on reading. Positions are rounded (see `MANTISSA_BITS`), since ZIP cannot compress low mantissa bits.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data.derive import derive
from data.frame import Frame, Image
from data.ingestion import write_record
from data.layouts import penumbra
from data.manifest import Manifest, SceneRecord
from data.sample import SAMPLES

FRAMES = 9
TEST = "classroom"
LIMIT_BYTES = 20_000_000

MANTISSA_BITS = {"position": 10}
"""Explicit mantissa bits kept of buffers that are rounded further than in the source. The largest relative
error is 2^-(bits + 1): 0.05 % of a coordinate, a sixth of a pixel's footprint; ten bits fit half precision.
The effective albedo, being stored, divides and multiplies alike."""


@dataclass(frozen=True)
class Source:
    """Who made a scene, and under which terms it is passed on."""

    credit: str
    license: str
    changes: str


SOURCES = {
    "classroom": Source(
        "“Japanese Classroom” by NovaZeeke, from Benedikt Bitterli's Rendering Resources",
        "CC-BY-3.0",
        "sky and sun as separate emitters; rendered from own camera paths",
    ),
    "cbox-glossy": Source(
        "Cornell box as in Mitsuba 3's own data, with a glass sphere, a rough gold block and a plastic ball",
        "BSD-3-Clause (Mitsuba 3)",
        "objects and materials changed; rendered from own camera paths",
    ),
    "living-room-2": Source(
        "“The White Room” by Jay-Artist, from Benedikt Bitterli's Rendering Resources",
        "CC-BY-3.0",
        "one mesh left out; rendered from own camera paths",
    ),
}

NOTES = (
    "Sample of real path-traced frames: 320x180, 1 sample per pixel, box filter, consecutive frames of a "
    "moving camera. `albedo` is the effective albedo (diffuse + specular reflectance). Mantissas are "
    "rounded further than in the source: "
    + ", ".join(f"{name} {bits} bits" for name, bits in MANTISSA_BITS.items())
    + ". References are path traced too and still noisy. LICENSES.md lists authors and terms."
)


def round_mantissa(image: Image, bits: int, half: bool) -> Image:
    """Return the image with `bits` explicit mantissa bits, rounded half to even.

    Args:
        image: Any shape, finite; for half precision within ±65504.
        bits: Bits to keep, 1 to 10 (half) or 23.
        half: Round as half precision numbers.
    """
    kind, word, mantissa = (np.float16, np.uint16, 10) if half else (np.float32, np.uint32, 23)
    if not 1 <= bits <= mantissa:
        raise ValueError(f"bits is {bits}, expected 1 to {mantissa}")
    drop = mantissa - bits
    if drop == 0:
        return image.astype(kind).astype(np.float32)
    # int64 leaves room for the carry and for signed half precision words alike.
    numbers = image.astype(kind).view(word).astype(np.int64)
    rounded = (numbers + (1 << (drop - 1)) - 1 + ((numbers >> drop) & 1)) >> drop << drop
    return rounded.astype(word).view(kind).astype(np.float32)


def build(source: str | Path, output: str | Path, frames: int = FRAMES) -> Manifest:
    """Write the sample, whole or not at all.

    Args:
        source: Folder with the scenes of `SOURCES` in the layout `penumbra`.
        output: Folder to write; one that is there is replaced once the new one is complete.
        frames: Consecutive frames per scene, from frame 0.

    Raises:
        ValueError: A scene is missing or short, or the result is over 20 MB.
        OSError: Reading or writing failed.
    """
    scenes = {s.name: s for s in penumbra.describe(source)}
    missing = [name for name in SOURCES if name not in scenes]
    if missing:
        raise ValueError(f"{source} lacks the scene {missing[0]!r}; it has {', '.join(scenes)}")
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=".sample-") as folder:
        work = Path(folder) / "new"
        records = {}
        for name, origin in SOURCES.items():
            scene = scenes[name]
            if scene.indices[:frames] != tuple(range(frames)):
                raise ValueError(f"{source}: {name} has frames {scene.indices}, needed 0 to {frames - 1}")
            records[name] = SceneRecord(
                frames=tuple(write_record(_lean(scene.read(i)), work) for i in range(frames)),
                credit=origin.credit,
                license=origin.license,
                provenance=f"{scene.provenance}; {origin.changes}",
            )
        train = [name for name in SOURCES if name != TEST]
        splits = {"train": train, "validation": [], "test": [TEST]}
        manifest = Manifest("sample:bmfr", "penumbra", "euclidean", splits, records, NOTES)
        manifest.save(work)
        (work / "LICENSES.md").write_text(_licenses(), encoding="utf-8")
        size = sum(p.stat().st_size for p in work.rglob("*") if p.is_file())
        if size > LIMIT_BYTES:
            raise ValueError(f"the sample has {size / 1e6:.1f} MB, over {LIMIT_BYTES / 1e6:.0f} MB")
        if output.exists():
            output.rename(Path(folder) / "old")
        shutil.move(work, output)
    return manifest


def _lean(frame: Frame) -> Frame:
    frame = derive(frame, ["albedo"])
    kept = {}
    for name in ("color", "albedo", "normal", "position", "reference"):
        image = frame.buffers[name]
        bits = MANTISSA_BITS.get(name)
        kept[name] = image if bits is None else round_mantissa(image, bits, half=True)
    return Frame(kept, frame.scene, frame.index, frame.camera, frame.exposure, frame.spp)


def _licenses() -> str:
    lines = [
        "# Authors and terms of the sample frames",
        "",
        "The images in this folder were rendered for this project with Mitsuba 3 from the scenes below.",
        "",
        "| scene | author and source | licence | changes |",
        "|---|---|---|---|",
        *(f"| {name} | {s.credit} | {s.license} | {s.changes} |" for name, s in SOURCES.items()),
        "",
        "CC-BY-3.0: Creative Commons Attribution 3.0, <https://creativecommons.org/licenses/by/3.0/>.",
        "Benedikt Bitterli's Rendering Resources: <https://benedikt-bitterli.me/resources/>.",
        "Mitsuba 3: <https://www.mitsuba-renderer.org>.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Build the sample from the command line."""
    parser = argparse.ArgumentParser(prog="python -m data.sample.build", description=build.__doc__)
    parser.add_argument("source", type=Path, help="folder with the scenes in the layout `penumbra`")
    parser.add_argument("output", type=Path, nargs="?", default=SAMPLES["bmfr"], help="folder to write")
    arguments = parser.parse_args()
    manifest = build(arguments.source, arguments.output)
    size = sum(f.bytes for s in manifest.scenes.values() for f in s.frames)
    print(
        f"{arguments.output}: {manifest.frame_count} frames, {size / 1e6:.2f} MB, hash {manifest.hash[:12]}"
    )


if __name__ == "__main__":
    main()
