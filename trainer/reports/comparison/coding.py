"""Planes of integers as text: prediction from neighbours, contexts, range ANS, 13 bits in two letters.

Each integer is predicted from those to the left and above, either by the median edge detector of LOCO-I
(Weinberger, Seroussi, Sapiro 2000, doi:10.1109/83.855427) or, which suits noise, by the mean of two. The
difference is a symbol of one of `CONTEXTS` tables, chosen by how much the neighbours and the planes before
differ. Symbols are coded by asymmetric numeral systems (Duda 2013, arXiv:1311.2540) with 12-bit frequencies
and 32-bit states, `LANES` of them in turn, so that NumPy can work on a whole group at once.

The stream is little endian: seven uint32 (width, height, planes, predictor, bytes of the tables, escapes,
words), the tables, then int32 escapes, uint32 states, uint16 words. `decode.js` reads it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trainer.reports.comparison.levels import Integers

LANES = 512
BITS = 12
ESCAPE = 255
"""Symbol of a difference that has no symbol of its own."""

LIMITS = (0, 1, 2, 3, 5, 7, 10, 15, 22, 34, 60)
"""Activity up to which each context goes; the last one takes the rest."""
CONTEXTS = len(LIMITS) + 1
_CONTEXT = np.searchsorted(LIMITS, np.arange(LIMITS[-1] + 2))

MEDIAN, MEAN = 0, 1

ALPHABET = "".join(chr(c) for c in range(33, 127) if chr(c) not in '<\\"')
"""91 printable letters: two hold 13 bits. Without those that end a script or need an escape."""


def encode(planes: Sequence[Integers]) -> bytes:
    """Return the stream of planes (H, W) of one size."""
    height, width = planes[0].shape
    chosen = min(
        (MEDIAN, MEAN),
        key=lambda p: sum(int(np.abs(plane - _predicted(plane, p)[0]).sum()) for plane in planes),
    )
    symbols, tables, escapes = _symbols(planes, chosen)
    frequencies = _frequencies(np.bincount(tables * 256 + symbols, minlength=len(planes) * CONTEXTS * 256))
    packed = _packed(frequencies)
    states, words = _coded(symbols, tables, frequencies)
    head = np.array([width, height, len(planes), chosen, len(packed), len(escapes), len(words)], "<u4")
    parts = (packed, escapes.astype("<i4"), states.astype("<u4"), words.astype("<u2"))
    return head.tobytes() + b"".join(part.tobytes() for part in parts)


def bits_of(planes: Sequence[Integers]) -> float:
    """Return the bits that `encode` needs for the integers, without its tables."""
    best = np.inf
    for predictor in (MEDIAN, MEAN):
        symbols, tables, escapes = _symbols(planes, predictor)
        counts = np.bincount(tables * 256 + symbols, minlength=len(planes) * CONTEXTS * 256).reshape(-1, 256)
        totals = np.repeat(counts.sum(1, keepdims=True), 256, 1)[counts > 0]
        used = counts[counts > 0]
        best = min(best, float((used * np.log2(totals / used)).sum()) + 32 * len(escapes))
    return best


def to_text(data: bytes) -> str:
    """Return bytes as letters of `ALPHABET`, 13 bits in two; the last bits are filled with zeros."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    groups = np.concatenate([bits, np.zeros(-len(bits) % 13, np.uint8)]).reshape(-1, 13)
    values = groups @ (1 << np.arange(13, dtype=np.int32))
    letters = np.frombuffer(ALPHABET.encode(), np.uint8)
    return letters[np.stack([values // 91, values % 91], -1)].tobytes().decode("ascii")


def _predicted(plane: Integers, predictor: int) -> tuple[Integers, Integers]:
    """Return what neighbours predict, and how much they differ."""
    height, width = plane.shape
    padded = np.zeros((height + 1, width + 2), np.int32)
    padded[1:, 1:-1] = plane
    padded[1:, 0] = padded[:-1, 1]
    padded[:, -1] = padded[:, -2]
    left, above = padded[1:, :-2], padded[:-1, 1:-1]
    corner, right = padded[:-1, :-2], padded[:-1, 2:]
    activity = np.abs(left - corner) + np.abs(above - corner) + np.abs(right - above)
    if predictor == MEAN:
        return (left + above) >> 1, activity
    low, high = np.minimum(left, above), np.maximum(left, above)
    return np.clip(left + above - corner, low, high), activity


def _symbols(planes: Sequence[Integers], predictor: int) -> tuple[Integers, NDArray[np.int64], Integers]:
    """Return symbols, the table of each, and differences that have none."""
    found, tables, escapes = [], [], []
    before = np.zeros(planes[0].shape, np.int32)
    for number, plane in enumerate(planes):
        predicted, activity = _predicted(plane, predictor)
        difference = plane - predicted
        symbol = np.where(difference > 0, 2 * difference - 1, -2 * difference)
        escapes.append(difference[symbol >= ESCAPE])
        found.append(np.minimum(symbol, ESCAPE).ravel())
        tables.append(number * CONTEXTS + _CONTEXT[np.minimum(activity + 2 * before, LIMITS[-1] + 1).ravel()])
        before = before + np.abs(difference)
    return np.concatenate(found), np.concatenate(tables), np.concatenate(escapes)


def _frequencies(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return tables (T, 256) that sum to `1 << BITS`, or to 0; every symbol that occurs has at least 1."""
    tables = counts.reshape(-1, 256)
    totals = np.maximum(tables.sum(1, keepdims=True), 1)
    scaled = np.where(tables > 0, np.maximum((tables << BITS) // totals, 1), 0)
    for index in np.flatnonzero(tables.any(1)):
        scaled[index] = _balanced(scaled[index])
    return scaled


def _balanced(row: NDArray[np.int64]) -> NDArray[np.int64]:
    row = row.copy()
    while excess := int(row.sum()) - (1 << BITS):
        largest = int(row.argmax())
        row[largest] -= min(excess, int(row[largest]) // 2)
    return row


def _packed(tables: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return tables as bytes: 0 and how many zeros, 1 to 191, or 192 + high bits and low bits."""
    out: list[int] = []
    zeros = 0
    for value in [*tables.ravel().tolist(), 1]:
        if value == 0 and zeros < 255:
            zeros += 1
            continue
        if zeros:
            out += [0, zeros]
            zeros = 0
        if value == 0:
            zeros = 1
        elif value < 192:
            out.append(value)
        else:
            out += [192 + (value >> 8), value & 255]
    return np.array(out[:-1], np.uint8)


def _coded(
    symbols: Integers, tables: NDArray[np.int64], frequencies: NDArray[np.int64]
) -> tuple[NDArray[np.uint64], NDArray[np.uint16]]:
    """Return the states with which a decoder begins, and the words that it reads."""
    index = tables * 256 + symbols
    share = frequencies.astype(np.uint64).ravel()[index]
    start = (frequencies.cumsum(1) - frequencies).astype(np.uint64).ravel()[index]
    states = np.full(LANES, 1 << 16, np.uint64)
    words: list[NDArray[np.uint16]] = []
    shift, full = np.uint64(32 - BITS), np.uint64(16)
    for first in range((len(symbols) - 1) // LANES * LANES, -1, -LANES):
        f, c = share[first : first + LANES], start[first : first + LANES]
        x = states[: len(f)]
        over = x >= (f << shift)
        words.append(x[over].astype(np.uint16))
        x = np.where(over, x >> full, x)
        whole = x // f
        states[: len(f)] = (whole << np.uint64(BITS)) + (x - whole * f) + c
    return states, np.concatenate(words[::-1])
