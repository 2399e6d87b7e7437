"""Altered shards and indices: each must be read, or refused with a ValueError, whatever they say.

    python -m tests.fuzz.shards 20000        the figure of `make fuzz`
    python -m tests.fuzz.shards 1 SEED 1234  one input, in this process, with its traceback

Inputs are made from small sets: an index and the tar files that it names. Values of the index and of the
descriptions in the tar files are replaced by others, bytes are turned, cut, doubled; most often the checksums
are made to fit afterwards, so that readers see what was altered. Each input goes through what training,
validation and `trainer inspect` do with shards. That happens in processes that may take `BOUND` bytes more
memory than they have at their start and `SECONDS` for an input; their end by a signal, another exception than
ValueError, and running out of either is a violation.
"""

from __future__ import annotations

import copy
import json
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

BOUND = 256 << 20
"""Bytes; the sets of the inputs have about 30 kB, and no number in them may cost more memory than that."""
SECONDS = 20
BATCH = 2500
BLOCK = 512

VALUES: list[Any] = [
    *(
        None,
        True,
        False,
        [],
        {},
        [[]],
        [{}],
        "",
        "x",
        "color",
        "samples",
        "<f4",
        "<f8",
        "|O",
        "train",
        "test",
    ),
    *(-1, 0, 1, 2, 3, 7, 255, 511, 512, 1 << 16, 1 << 31, (1 << 31) - 1, 1 << 32, 1 << 53, 1 << 62, 1 << 63),
    *(-(1 << 63), 1 << 64, -(1 << 64), 10**30, 10**400, 0.5, -1.5, 1e38, 1e39, 1e308, math.nan, math.inf),
    *(
        "../train-00000.tar",
        "/dev/zero",
        "/etc/passwd",
        "s3://bucket/x",
        "a/b",
        "..",
        ".",
        "\0",
        "index.json",
    ),
    *("é" * 300, "9" * 5000, "\ud800", [1] * 40, [1 << 40, 1 << 40, 1 << 40], [0, 0, 0], [-1, -1, -1]),
]

Files = dict[str, bytes]


def bases() -> list[Files]:
    """Return the sets that are altered: name of a file → content."""
    import numpy as np

    from data.shards.write import ShardWriter

    made = []
    for apart, frames in ((False, 1), (True, 1), (False, 3)):
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            generator = np.random.default_rng(1)
            shards = []
            for file, split, count in (("train-00000", "train", 2), ("test-00000", "test", 1)):
                with ShardWriter(root / f"{file}.tar", split, "hall") as writer:
                    for number in range(count):
                        clip = 1 if split == "test" else frames
                        writer.add_stored(_meta(number, apart, clip), _arrays(generator, apart, clip))
                    if apart:
                        writer.per_sample = (2, tuple(_meta(0, apart)["sample_channels"]))
                    shards.append(writer.finish().to_dict())
            files = {path.name: path.read_bytes() for path in root.iterdir()}
        about = {"format": "penumbra-shards", "manifest_hash": "ab", "manifest": {}, "skipped": 0}
        version = 1 if frames == 1 else 2
        index = {**about, "version": version, "options": {"frames": frames}, "pruned": 0, "shards": shards}
        made.append({**files, "index.json": json.dumps(index).encode()})
    return made


def _meta(number: int, apart: bool, frames: int = 1) -> dict[str, Any]:
    meta = {"scene": "hall", "frame": number, "x": 0, "y": 0, "width": 8, "height": 8, "exposure": 1.0,
            "depth_range": [0.5, 2.0], "accumulated": True}  # fmt: skip
    if apart:
        channels = [f"{name}.{letter}" for name in ("radiance", "normal") for letter in "RGB"]
        channels[3:] = ["normal.X", "normal.Y", "normal.Z"]
        meta |= {"sample_channels": channels, "thin_lens": [0.0, 1.0, 0.5]}
    if frames > 1:
        meta |= {"frames": frames, "depth_range": [[0.5, 2.0 + frame] for frame in range(frames)]}
    return meta


def _arrays(generator: Any, apart: bool, frames: int = 1) -> dict[str, Any]:
    sizes = {"color": 3, "irradiance": 3, "albedo": 3, "normal": 3, "history": 1, "reference": 3}
    arrays = {n: generator.random((c, 8, 8)).astype("<f2") for n, c in sizes.items()}
    arrays["depth"] = generator.random((1, 8, 8)).astype("<f4")
    if frames > 1:
        arrays = {n: array[None].repeat(frames, 0) for n, array in arrays.items()}
    if apart:
        arrays["samples"] = generator.random((2, 6, 8, 8)).astype("<f2")
    return arrays


def mutated(made: list[Files], seed: int, number: int) -> Files:
    """Return input `number`: one of the sets, altered in one to three places."""
    chance = random.Random(f"{seed} {number}")
    files = dict(chance.choice(made))
    index = json.loads(files["index.json"])
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        what = chance.random()
        if what < 0.4:
            index = _altered(chance, index)
        elif what < 0.75:
            _alter_description(chance, files, index)
        else:
            name = chance.choice([name for name in files if name.endswith(".tar")])
            files[name] = _turned(chance, files[name])
    if chance.random() < 0.8:
        _fit(files, index)
    files["index.json"] = _dump(index)
    if chance.random() < 0.1:
        files["index.json"] = _turned(chance, files["index.json"])
    if chance.random() < 0.005:
        files["index.json"] = chance.choice((b"[", b'{"a":')) * chance.choice((50, 5000, 200_000))
    return files


def _dump(values: Any) -> bytes:
    try:
        return json.dumps(values).encode()
    except ValueError:  # a number of very many digits
        return b'{"format": "penumbra-shards", "version": 1, "shards": ' + b"9" * 5000 + b"}"


def _altered(chance: random.Random, values: Any) -> Any:
    """Return plain data with one value, key or length changed."""
    values = copy.deepcopy(values)
    places = list(_places(values))
    if not places:
        return chance.choice(VALUES)
    # Few values, as file names and sizes of shards, are as likely as all places of all samples together.
    if chance.random() < 0.5:
        places = [place for place in places if place[2] < 4] or places
    holder, key, _ = chance.choice(places)
    old = holder[key]
    ways: list[Callable[[], Any]] = [lambda: copy.deepcopy(chance.choice(VALUES))] * 3
    if isinstance(old, int | float) and not isinstance(old, bool) and abs(old) < 1e300:
        steps = (-1, 1, 2, -2, 64, -64, 512, -512, 1 << 20, -old, old)
        ways += [lambda: old + chance.choice(steps)] * 5
    if isinstance(old, list) and old:
        ways += [lambda: old[:-1], lambda: [*old, copy.deepcopy(old[0])], lambda: old[::-1]]
    if isinstance(holder, dict) and chance.random() < 0.1:
        del holder[key]
        if chance.random() < 0.5:
            holder[chance.choice(("x", "", str(key).upper()))] = old
    else:
        holder[key] = chance.choice(ways)()
    return values


def _places(values: Any, depth: int = 0) -> Any:
    """Yield holder, key and depth of every value."""
    if isinstance(values, dict | list):
        for key in values if isinstance(values, dict) else range(len(values)):
            yield values, key, depth
            yield from _places(values[key], depth + 1)


def _alter_description(chance: random.Random, files: Files, index: Any) -> None:
    """Change the JSON of a sample, its length kept within the blocks that it has."""
    try:
        shard = chance.choice([s for s in index["shards"] if s["file"] in files])
        start = chance.choice(shard["samples"])["offset"]
        data = bytearray(files[shard["file"]])
        length = int(bytes(data[start + 124 : start + 135]), 8)
        meta = json.loads(bytes(data[start + BLOCK : start + BLOCK + length]))
    except (ValueError, KeyError, TypeError, IndexError):
        return
    text = _dump(_altered(chance, meta))
    room = length + -length % BLOCK
    if len(text) > room:
        text = text[:room]
    data[start + 124 : start + 136] = b"%011o\0" % len(text)
    data[start + BLOCK : start + BLOCK + room] = text + bytes(room - len(text))
    files[shard["file"]] = bytes(data)


def _turned(chance: random.Random, data: bytes) -> bytes:
    """Return bytes with some changed, cut off, inserted or doubled."""
    changed = bytearray(data)
    if not changed:
        return data
    # Headers and descriptions are where bytes mean something.
    place = chance.randrange(min(len(changed), chance.choice((160, 1600, len(changed)))))
    way = chance.random()
    if way < 0.5:
        for offset in range(place, min(place + chance.choice((1, 1, 2, 8)), len(changed))):
            changed[offset] = chance.choice(
                (0, 255, 0x2D, 0x37, changed[offset] ^ (1 << chance.randrange(8)))
            )
    elif way < 0.7:
        del changed[place : place + chance.choice((1, 7, 512, len(changed)))]
    elif way < 0.85:
        changed[place:place] = bytes(chance.randrange(256) for _ in range(chance.choice((1, 3, 512))))
    else:
        changed[place:place] = changed[place : place + 2048]
    return bytes(changed)


def _fit(files: Files, index: Any) -> None:
    """Make sizes and checksums of the index fit to the files, as far as it still says what is where."""
    try:
        for shard in index["shards"]:
            data = files[shard["file"]]
            shard["bytes"] = len(data)
            for sample in shard["samples"]:
                sample["crc32"] = zlib.crc32(data[sample["offset"] : sample["offset"] + sample["size"]])
    except (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError):
        return


def read_all(root: Path) -> None:
    """Do with a folder what training, validation and `trainer inspect` do.

    Raises:
        ValueError: It is refused.
    """
    from data.augment import Augmentation
    from data.inspection import inspect_path
    from data.shards.batch import Batches, Order
    from data.shards.index import Index
    from data.shards.read import ShardReader
    from data.shards.shapes import available

    index = Index.read(root)
    for split in ("train", "test"):
        reader = ShardReader(index, split)
        for number in range(len(reader)):
            names = available(reader.sample(number))
            changes: dict[str, Any] = {"permute": True, "samples": (1, 2), "reverse": 0.5, "freeze": 0.5}
            for augmentation in (None, Augmentation("dihedral", seed=number, **changes)):
                batch = Batches(reader, names, temporal=bool(number), augmentation=augmentation)
                float(
                    sum(
                        t.sum()
                        for t in batch[Order(number, (number,))].unpack().values()
                        if hasattr(t, "sum")
                    )
                )
        if len(reader) > 1:
            names = available(reader.sample(0))
            Batches(reader, names, True)[Order(0, tuple(range(min(len(reader), 8))))].unpack()
    inspect_path(root)


def run(count: int, seed: int = 1) -> dict[str, int]:
    """Read `count` altered sets in processes of their own.

    Returns:
        Number of inputs that were read, and that were refused.

    Raises:
        AssertionError: An input was neither; says what happened and where it is kept.
    """
    total: Counter[str] = Counter()
    for first in range(0, count, BATCH):
        last = min(first + BATCH, count)
        with tempfile.TemporaryDirectory(prefix="penumbra-fuzz-") as folder:
            command = [
                sys.executable,
                "-m",
                "tests.fuzz.shards",
                "--batch",
                *map(str, (first, last, seed)),
                folder,
            ]
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                number = int((Path(folder) / "number").read_text() or -1)
                kept = keep(seed, number)
                how = f"signal {-done.returncode}" if done.returncode < 0 else done.stderr[-3000:]
                raise AssertionError(f"input {number} of seed {seed}, kept in {kept}: {how}")
            total.update(json.loads((Path(folder) / "outcomes").read_text()))
    return dict(total)


def keep(seed: int, number: int) -> Path:
    """Write an input where it can be looked at, and return the folder."""
    folder = Path(tempfile.gettempdir()) / "penumbra-fuzz" / f"shards-{seed}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    write(mutated(bases(), seed, number), folder)
    return folder


def write(files: Files, folder: Path) -> None:
    """Write a set; names are those of the base, so they stay in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)


def one(root: Path) -> str:
    """Read one folder; returns what came of it."""
    try:
        read_all(root)
    except ValueError:
        return "refused"
    return "read"


def batch(first: int, last: int, seed: int, folder: Path) -> None:
    """Read inputs `first` to `last` in this process, within bounds; `folder` takes number and outcomes."""
    import torch

    torch.set_num_threads(1)
    made = bases()
    root = folder / "set"
    for base in made:
        write(base, root)
        assert one(root) == "read", "the sets that are altered cannot be read"
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + BOUND, in_use + BOUND))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    outcomes: Counter[str] = Counter()
    with (folder / "number").open("w") as current:
        for number in range(first, last):
            current.seek(0)
            current.write(f"{number:<12}")
            current.flush()
            signal.alarm(SECONDS)
            write(mutated(made, seed, number), root)
            outcomes[one(root)] += 1
    (folder / "outcomes").write_text(json.dumps(outcomes))


def main(words: list[str]) -> None:
    """Run from the command line; see above."""
    if words[:1] == ["--batch"]:
        batch(*map(int, words[1:4]), Path(words[4]))
        return
    numbers = [int(word) for word in words] or [20_000]
    if len(numbers) == 3:
        read_all(keep(numbers[1], numbers[2]))
    else:
        print(run(*numbers))


if __name__ == "__main__":
    main(sys.argv[1:])
