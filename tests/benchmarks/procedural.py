"""Figure 4 of rendering: a data set from random scenes, and what WSKP learns from it.

Renders 24 stills, 5 sequences of 8 frames and 8 frames of samples below `bench/procedural` (what is there is
kept, so a second run only tests), trains WSKP on the sequences and on the real sample for equally many steps,
and tests both on the real held-out scene.

    python -m tests.benchmarks.procedural
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, cast

from models.denoiser import Denoiser
from tests.benchmarks.quality import score
from tests.benchmarks.timing import Row, row
from trainer.loading import load_model
from trainer.runs import find_checkpoint

FOLDER = Path("bench") / "procedural"
SETS = {
    "stills": "--random 24 --seed 1001 --size 128x128 --spp 4 8 16 32 --reference-spp 128",
    "sequences": "--random 5 --seed 2001 --frames 8 --size 256x144 --reference-spp 128 --test outdoor-002005",
    "samples": "--random 8 --seed 3001 --size 96x96 --reference-spp 256",
}
STEPS = 1080
"""Steps of `wskp_bmfr.yaml` on the sample."""


def render() -> dict[str, float]:
    """Render what is missing and return the minutes that each set took, those of the first complete run."""
    times = FOLDER / "minutes.json"
    minutes: dict[str, float] = json.loads(times.read_text()) if times.is_file() else {}
    for kind, options in SETS.items():
        began = time.monotonic()
        _trainer("render", kind, *options.split(), "--output", str(FOLDER / kind))
        minutes.setdefault(kind, (time.monotonic() - began) / 60)
        times.write_text(json.dumps(minutes))
    return minutes


def train(name: str, *data: str) -> Path:
    """Return the best checkpoint of WSKP trained on some data, trained now unless it was."""
    experiment = f"procedural_{name}"
    try:
        return find_checkpoint("best", Path("runs"), experiment)
    except ValueError:
        arguments = ("--trainer.logger.init_args.experiment", experiment, "--trainer.max_epochs", "-1")
        steps = ("--trainer.max_steps", str(STEPS))
        _trainer("fit", "--config", "wskp_bmfr.yaml", *arguments, *steps, *data)
        return find_checkpoint("best", Path("runs"), experiment)


def _trainer(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "trainer", *arguments], check=True)


def run() -> list[dict[str, Any]]:
    """Return the rows of figure 4."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    minutes = render()
    rows: list[Row] = [row(f"{kind}: rendering", took, "min") for kind, took in minutes.items()]
    total = sum(minutes.values())
    rows.append(row("the whole data set", total, "min", "<= 60", total <= 60))
    shards = FOLDER / "shards"
    if not (shards / "index.json").is_file():
        _trainer("prepare", str(FOLDER / "sequences"), "--output", str(shards), "--train-patches", "320")
    trained = {
        "procedural sequences": train("random", "--data.root", str(shards)),
        "real sequences": train("real"),
    }
    scores = {name: score(cast(Denoiser, load_model(str(path))))[0] for name, path in trained.items()}
    for name, table in scores.items():
        for metric in ("psnr_wskp", "ssim_wskp", "relmse_layer"):
            value = table["WSKP"][metric]
            rows.append(row(f"WSKP trained on {name}: {metric}", value, "dB" if "psnr" in metric else ""))
    for method in ("noisy", "accumulated", "joint bilateral"):
        rows.append(row(f"{method}: psnr_wskp", scores["real sequences"][method]["psnr_wskp"], "dB"))
    return rows


if __name__ == "__main__":
    from tests.benchmarks.timing import print_table

    print_table(run())
