"""The process in which uploaded files are decoded: `python -m trainer.serving.reader LIMITS`.

Decoders are compiled code that trusts what a header says. Of 19,000 mutated EXR files of 48x40 pixels one
made OpenEXR 3.5 take all memory of a machine with 24 GiB, and another took 1.6 GB and four seconds. So
decoding has a process of its own, whose memory is limited and which may be killed at any time. It reads a
line of JSON for each request from its standard input and answers on its standard output (`wire`); nothing but
NumPy and OpenEXR is loaded.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from data.exr import read_frame
from data.exr_image import COPIES, exr_extent
from trainer.serving.archive import is_zip, unpack, unpacked_size
from trainer.serving.limits import CHANNELS, Limits
from trainer.serving.room import is_full
from trainer.serving.wire import Parcel, pack

SCRATCH = 256 << 20
"""Bytes that it may take beside its libraries and `COPIES` times the frame."""

READY = b"ready\n"
"""What it says first."""

_HANDLES = 64


def main() -> int:
    """Answer requests until the standard input ends."""
    limits = Limits(**json.loads(sys.argv[1]))
    requests, answers = _streams()
    _limit(limits)
    answers.write(READY)
    answers.flush()
    for line in requests:
        try:
            parcel = _answer(json.loads(line), limits)
        except (ValueError, OSError) as error:
            parcel = Parcel({"error": str(error), "full": is_full(error)})
        except MemoryError:
            parcel = Parcel({"error": "the file needs more memory than a frame of the largest size does"})
        _send(answers, parcel)
        parcel = None  # type: ignore[assignment]  # a large frame is not held while waiting
    return 0


def command() -> list[str]:
    """Return the command line of the process, without the limits."""
    return [sys.executable, "-P", "-m", "trainer.serving.reader"]


def argument(limits: Limits) -> str:
    """Return the limits as the process is told them."""
    return json.dumps(asdict(limits))


def _streams() -> tuple[BinaryIO, BinaryIO]:
    """Return the pipes, out of reach of libraries that print."""
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nothing, number)
    return requests, answers


def _limit(limits: Limits) -> None:
    """Take no more disk and files than the largest request needs."""
    for kind, most in (
        (resource.RLIMIT_FSIZE, limits.unpacked),
        (resource.RLIMIT_NOFILE, _HANDLES),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def _limit_memory(frame: int) -> None:
    """Take no more memory for a request than its frame needs.

    Args:
        frame: Bytes of it.
    """
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + SCRATCH + COPIES * frame
    resource.setrlimit(
        resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
    )


def _answer(request: dict[str, Any], limits: Limits) -> Parcel:
    os.chdir(request["folder"])  # so that messages name the file and no folder of this machine
    name = request["name"]
    _limit_memory(0)
    if request["what"] == "room":
        return Parcel({"bytes": unpacked_size(Path(name), limits) if is_zip(Path(name)) else 0})
    if request["what"] == "list":
        return Parcel({"frames": _list(Path(name), limits)})
    _limit_memory(_size(Path(name), limits))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        frame = read_frame(name, layers=request.get("layers"))
    return pack(frame, [str(warning.message) for warning in caught])


def _list(path: Path, limits: Limits) -> list[dict[str, Any]]:
    """Return the frames of an EXR or ZIP file with the bytes that each takes; too large ones are refused."""
    if is_zip(path):
        (folder := Path("frames")).mkdir()
        names = [f"frames/{name}" for name in unpack(path, folder, limits)]
    else:
        names = [path.name]
    return [{"name": name, "bytes": _size(Path(name), limits)} for name in names]


def _size(path: Path, limits: Limits) -> int:
    rows, columns, channels = exr_extent(path)
    pixels = rows * columns
    if pixels * max(channels, CHANNELS) > CHANNELS * limits.pixels:
        most = limits.megapixels * CHANNELS / max(channels, CHANNELS)
        raise ValueError(
            f"{path.name} has {columns}x{rows} pixels with {channels} channels, at most {most:.3g} "
            "megapixels are taken; cut the frame or leave channels out"
        )
    return 4 * pixels * channels


def _send(answers: BinaryIO, parcel: Parcel) -> None:
    answers.write(parcel.line())
    for array in parcel.arrays:
        answers.write(array.data.cast("B"))
    answers.flush()


if __name__ == "__main__":
    sys.exit(main())
