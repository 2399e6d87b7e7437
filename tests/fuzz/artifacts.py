"""Altered exported files, ONNX and TorchScript: each is opened and run, or refused with a ValueError.

    python -m tests.fuzz.artifacts 20000        the figure of `make fuzz`
    python -m tests.fuzz.artifacts 1 SEED 1234  one input, in this process, with its traceback

Exported files are programs (`trainer.export.artifact`), so these inputs are damage as disks and networks do
it: bytes turned, cut, inserted and doubled, and metadata of other values. They are opened and not run.
"""

from __future__ import annotations

import io
import json
import random
import sys
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import onnx
import torch

from models import WSKP
from tests.fuzz import batches
from tests.fuzz.bytewise import Files, turned
from tests.fuzz.shards import _altered, _dump
from trainer.export import export, load_artifact
from trainer.export.description import KEY

BOUND = 256 << 20
NAMES = ("net.onnx", "net.ts")


def extra(folder: Path) -> int:
    """Return the bytes that reading may take beside `BOUND`: 16 times the file."""
    return 16 * sum(path.stat().st_size for path in folder.iterdir())


@cache
def bases() -> list[Files]:
    """Return the files that are altered."""
    torch.manual_seed(1)
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for name, format in zip(NAMES, ("onnx", "torchscript"), strict=True):
            path = Path(folder) / name
            export(WSKP(layers=2, width=4, kernel_sizes=(3, 5)).eval(), path, format)  # type: ignore[arg-type]
            made.append({name: path.read_bytes()})
    return made


def mutated(made: list[Files], seed: int, number: int) -> Files:
    """Return input `number`: one of the files, damaged or with other metadata."""
    chance = random.Random(f"{seed} {number}")
    [(name, data)] = chance.choice(made).items()
    if name == NAMES[0] and chance.random() < 0.3:
        model = onnx.load_model_from_string(data)
        values = _altered(chance, json.loads(model.metadata_props[0].value))
        model.metadata_props[0].value = _dump(values).decode()
        return {name: model.SerializeToString()}
    if name == NAMES[1] and chance.random() < 0.3:
        return {name: _described(chance, data)}
    for _ in range(chance.choice((1, 1, 2, 4))):
        data = turned(chance, data)
    return {name: data}


def _described(chance: random.Random, data: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w") as new:
        for member in old.namelist():
            content = old.read(member)
            if member.endswith(f"{KEY}.json"):
                content = _dump(_altered(chance, json.loads(content)))
            new.writestr(member, content)
    return stream.getvalue()


def read_all(folder: Path) -> None:
    """Open the file as `--model` does.

    Raises:
        ValueError: It is refused.
        OSError: It is refused.
    """
    for path in folder.iterdir():
        load_artifact(path)


def run(count: int, seed: int = 1) -> dict[str, int]:
    """Read `count` altered files; see `batches.run`."""
    return batches.run("artifacts", count, seed)


def main(words: list[str]) -> None:
    """Run from the command line; see above."""
    numbers = [int(word) for word in words] or [20_000]
    if len(numbers) == 3:
        read_all(batches.keep("artifacts", *numbers[1:]))
    else:
        print(json.dumps(run(*numbers)))


if __name__ == "__main__":
    main(sys.argv[1:])
