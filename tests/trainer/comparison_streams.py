"""The decoder of the comparison page's pictures, pixel by pixel and in Python, as decode.js has it."""

import numpy as np

from trainer.reports.comparison.coding import ALPHABET, CONTEXTS, ESCAPE, LANES, LIMITS, MEAN


def bytes_of(text):
    """Return the bytes of letters."""
    number = {letter: i for i, letter in enumerate(ALPHABET)}
    values = [number[a] * 91 + number[b] for a, b in zip(text[::2], text[1::2], strict=True)]
    bits = ((np.array(values)[:, None] >> np.arange(13)) & 1).astype(np.uint8).ravel()
    return np.packbits(bits[: len(bits) // 8 * 8], bitorder="little").tobytes()


def tables_of(packed, count):
    """Return frequencies (count, 256)."""
    found, at, i = np.zeros(count * 256, np.int64), 0, 0
    while i < len(packed):
        if packed[i] == 0:
            at += packed[i + 1]
            i += 2
            continue
        wide = packed[i] >= 192
        found[at] = (packed[i] - 192) * 256 + packed[i + 1] if wide else packed[i]
        at, i = at + 1, i + 1 + wide
    return found.reshape(count, 256)


class Symbols:
    """Reads symbols of a stream in turn."""

    def __init__(self, tables, states, words):
        self.tables, self.starts = tables, tables.cumsum(1) - tables
        self.states, self.words, self.lane = [int(s) for s in states], iter(words.tolist()), 0

    def read(self, table):
        state = self.states[self.lane]
        slot = state & 4095
        symbol = int(np.searchsorted(self.starts[table] + self.tables[table], slot, side="right"))
        state = int(self.tables[table, symbol]) * (state >> 12) + slot - int(self.starts[table, symbol])
        self.states[self.lane] = state if state >= 65536 else state << 16 | next(self.words)
        self.lane = (self.lane + 1) % LANES
        return symbol


def planes_of(data):
    """Return the planes of a stream."""
    width, height, count, predictor, packed, escaped, coded = np.frombuffer(data, "<u4", 7).tolist()
    tables = tables_of(data[28 : 28 + packed], count * CONTEXTS)
    assert set(tables.sum(1).tolist()) <= {0, 4096}
    ends = np.cumsum([28 + packed, 4 * escaped, 4 * LANES, 2 * coded])
    escapes = iter(np.frombuffer(data[ends[0] : ends[1]], "<i4").tolist())
    symbols = Symbols(
        tables, np.frombuffer(data[ends[1] : ends[2]], "<u4"), np.frombuffer(data[ends[2] : ends[3]], "<u2")
    )
    before, planes = np.zeros((height, width), np.int64), []
    for p in range(count):
        plane = np.zeros((height + 1, width + 2), np.int64)
        for y, x in np.ndindex(height, width):
            if x == 0:
                plane[y + 1, 0], plane[y, -1] = plane[y, 1], plane[y, -2]
            left, above, corner, right = plane[y + 1, x], plane[y, x + 1], plane[y, x], plane[y, x + 2]
            activity = abs(left - corner) + abs(above - corner) + abs(right - above) + 2 * before[y, x]
            symbol = symbols.read(p * CONTEXTS + int(np.searchsorted(LIMITS, activity)))
            difference = (
                next(escapes) if symbol == ESCAPE else (symbol + 1) // 2 if symbol % 2 else -(symbol // 2)
            )
            low, high = min(left, above), max(left, above)
            guess = (left + above) >> 1 if predictor == MEAN else min(max(left + above - corner, low), high)
            plane[y + 1, x + 1] = guess + difference
            before[y, x] += abs(difference)
        planes.append(plane[1:, 1:-1])
    return planes
