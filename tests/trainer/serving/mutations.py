"""EXR files, and what hostile or broken programs make of them."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import OpenEXR

from tests.trainer.serving.running import frame, zipped

KINDS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
HEADER = 600
"""Bytes at the beginning of a file, of which the header takes most."""

NUMBERS = (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 65536, 10_000, 1 << 24)


def seeds(folder: Path) -> list[bytes]:
    """Return small frames in every compression, in scan lines and tiles, and a ZIP file of some."""
    found = []
    buffers = frame(20, 24).buffers
    pixels = {
        f"{name}.{letter}": np.ascontiguousarray(buffers[name][..., i].astype(np.float16))
        for name, letters in (("color", "RGB"), ("albedo", "RGB"), ("normal", "XYZ"), ("depth", "Z"))
        for i, letter in enumerate(letters)
    }
    headers = [
        {"compression": getattr(OpenEXR, f"{kind}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        for kind in KINDS
    ]
    headers.append(
        {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.tiledimage,
            "tiles": OpenEXR.TileDescription(),
        }
    )
    for i, header in enumerate(headers):
        path = folder / f"seed{i}.exr"
        with OpenEXR.File(header, dict(pixels)) as file:
            file.write(str(path))
        found.append(path.read_bytes())
    found.append(zipped({"f0.exr": found[3], "f1.exr": found[0]}))
    return found


def mutated(content: bytes, choice: random.Random) -> bytes:
    """Return the file with some bytes flipped, numbers of its header changed, cut off, or bytes left out."""
    changed = bytearray(content)
    head = min(HEADER, len(changed))
    kind = choice.random()
    if kind < 0.35:
        for _ in range(choice.choice((1, 1, 2, 4, 8))):
            changed[choice.randrange(head)] = choice.choice((0, 1, 127, 128, 255, choice.randrange(256)))
    elif kind < 0.65:
        for _ in range(choice.choice((1, 2, 4, 16))):
            changed[choice.randrange(len(changed))] = choice.randrange(256)
    elif kind < 0.75:
        del changed[choice.randrange(len(changed)) :]
    elif kind < 0.9:
        place = choice.randrange(head - 4)
        changed[place : place + 4] = choice.choice(NUMBERS).to_bytes(4, "little")
    else:
        place = choice.randrange(len(changed))
        del changed[place : place + choice.randrange(1, 64)]
    return bytes(changed)
