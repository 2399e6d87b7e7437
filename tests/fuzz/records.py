"""Altered `run.json`, `launch.json` and `manifest.json`: each is read, or refused with a ValueError.

python -m tests.fuzz.records 20000        the figure of `make fuzz`
python -m tests.fuzz.records 1 SEED 1234  one input, in this process, with its traceback
"""

from __future__ import annotations

import json
import random
import sys
from dataclasses import asdict
from pathlib import Path

from data.manifest import FrameRecord, Manifest, SceneRecord, load_manifest
from tests.fuzz import batches
from tests.fuzz.bytewise import Files, turned
from tests.fuzz.shards import _altered, _dump
from trainer import runs

BOUND = 64 << 20
DEEP = (b"[" * 5000, b'{"a":' * 200_000, b'{"experiment": ' + b"9" * 5000 + b"}")


def extra(folder: Path) -> int:
    """Return the bytes that reading may take beside `BOUND`: 64 times the files."""
    return 64 * sum(path.stat().st_size for path in folder.rglob("*.json"))


def bases() -> list[Files]:
    """Return the files that are altered."""
    frame = FrameRecord(0, "hall/f000.exr", 10, "0" * 64, 20, 24, 1.0, 4, {"color": "half"}, view=1)
    scenes = {name: SceneRecord((frame,), thresholds={"a": 0.5}) for name in ("hall", "yard")}
    manifest = Manifest("small", "penumbra", "z", {"train": ["hall"], "test": ["yard"]}, scenes)
    record = runs.RunRecord("bmfr", "run", "sqlite:///runs/mlflow.db", "0" * 32)
    launch = {"launch": "job 7", "finished": False}
    values = {"run.json": asdict(record), "launch.json": launch, "manifest.json": manifest.to_json()}
    return [{name: json.dumps(value).encode() for name, value in values.items()}]


def mutated(made: list[Files], seed: int, number: int) -> Files:
    """Return input `number`: one of the three files altered."""
    chance = random.Random(f"{seed} {number}")
    files = dict(made[0])
    name = chance.choice(("run.json", "launch.json", *["manifest.json"] * 4))
    values = json.loads(files[name])
    for _ in range(chance.choice((1, 1, 2, 3))):
        values = _altered(chance, values)
    files[name] = _dump(values)
    if chance.random() < 0.15:
        files[name] = turned(chance, files[name])
    if chance.random() < 0.005:
        files[name] = chance.choice(DEEP)
    return files


def read_all(folder: Path) -> None:
    """Read the files as a restarted training and as `trainer prepare` do.

    Raises:
        ValueError: One is refused.
        OSError: One is refused.
    """
    refused: Exception | None = None
    root = folder / "runs" / "bmfr" / "run"
    root.mkdir(parents=True)
    for name in ("run.json", "launch.json"):
        (folder / name).rename(root / name)
    try:
        runs.RunRecord.load(root)
    except ValueError as error:
        refused = error
    runs.run_of_launch(runs.Launch("job 7", unfinished=True), folder / "runs", "bmfr")
    runs.end_launch(root)
    manifest = load_manifest(folder)
    assert len(manifest.hash) == 64
    assert all(manifest.split_of(scene) for scene in manifest.scenes)
    if refused:
        raise refused


def run(count: int, seed: int = 1) -> dict[str, int]:
    """Read `count` altered records; see `batches.run`."""
    return batches.run("records", count, seed)


def main(words: list[str]) -> None:
    """Run from the command line; see above."""
    numbers = [int(word) for word in words] or [20_000]
    if len(numbers) == 3:
        read_all(batches.keep("records", *numbers[1:]))
    else:
        print(json.dumps(run(*numbers)))


if __name__ == "__main__":
    main(sys.argv[1:])
