"""Bytes altered without knowledge of what they mean, and numbers that formats stumble over."""

from __future__ import annotations

import random

Files = dict[str, bytes]
"""One input: name of a file → content."""

NUMBERS = (0, 1, 2, 3, 7, 16, 255, 256, 4095, 65535, 65536, 1 << 20, 1 << 24, (1 << 30) - 1, 1 << 30,
           (1 << 31) - 1, 1 << 31, (1 << 32) - 1, (1 << 32) - 2, (1 << 32) - 256, 1 << 32, 1 << 40, 1 << 62,
           (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip


def turned(chance: random.Random, data: bytes, first: int = 0, last: int | None = None) -> bytes:
    """Return bytes of which some between two places are changed, cut off, inserted or doubled."""
    last = len(data) if last is None else last
    if last <= first:
        return data
    changed = bytearray(data)
    place = chance.randrange(first, last)
    way = chance.random()
    if way < 0.6:
        for offset in range(place, min(place + chance.choice((1, 1, 1, 2, 4, 16)), last)):
            changed[offset] = chance.choice(
                (0, 1, 127, 128, 255, changed[offset] ^ (1 << chance.randrange(8)))
            )
    elif way < 0.75:
        del changed[place : place + chance.choice((1, 2, 7, 64, len(changed)))]
    elif way < 0.85:
        changed[place:place] = chance.randbytes(chance.choice((1, 3, 16, 256)))
    elif way < 0.93:
        changed[place:place] = changed[place : place + chance.choice((4, 64, 1024))]
    else:
        start = chance.randrange(first, last)
        piece = changed[start : start + 64]
        changed[place : place + len(piece)] = piece
    return bytes(changed)


def numbered(chance: random.Random, data: bytes, place: int, size: int) -> bytes:
    """Return bytes whose little-endian number of `size` bytes at a place is another one."""
    old = int.from_bytes(data[place : place + size], "little")
    near = (
        old + 1,
        old - 1,
        old * 2,
        old // 2,
        old + 16,
        old - 16,
        -old,
        old ^ (1 << chance.randrange(8 * size)),
    )
    new = chance.choice(NUMBERS if chance.random() < 0.5 else near) % (1 << 8 * size)
    return data[:place] + new.to_bytes(size, "little") + data[place + size :]
