"""Figure 4 of rendering: a data set from random scenes, and what WSKP learns from it.

Renders 24 stills, 5 sequences of 8 frames and 8 frames of samples below `bench/procedural` (what is there is
kept, so a second run only tests), trains WSKP on the sequences for as many steps as `wskp_bmfr.yaml` does on
the real sample, and tests both on the real held-out scene.

    python -m tests.benchmarks.procedural [--picture FILE]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image

from data.frames import FrameSet
from data.manifest import load_manifest
from data.render.recipe import Recipe
from data.render.rendering import remembered_speed
from models.denoiser import Denoiser
from tests.benchmarks.quality import checkpoint, score
from tests.benchmarks.timing import Row, print_table, row
from trainer.loading import load_model
from trainer.runs import find_checkpoint

FOLDER = Path("bench") / "procedural"
SETS = {
    "stills": "--random 24 --seed 1001 --size 128x128 --spp 4 8 16 32 --reference-spp 128",
    "sequences": "--random 5 --seed 2001 --frames 8 --size 192x128 --reference-spp 64 --test outdoor-002005",
    "samples": "--random 8 --seed 3001 --size 64x64 --reference-spp 256",
}
STEPS = 1080
"""Steps of `wskp_bmfr.yaml` on the sample."""


def render() -> dict[str, float]:
    """Render what is missing and return the minutes of each set, by the speed that its call recorded."""
    minutes = {}
    for kind, options in SETS.items():
        root = FOLDER / kind
        _trainer("render", kind, *options.split(), "--output", str(root))
        manifest = load_manifest(root)
        known = {name: value for name, value in manifest.recipe["recipe"].items() if name != "version"}
        recipe = Recipe(**{**known, "spp": tuple(known["spp"])})
        views = manifest.frame_count // (len(recipe.spp) if kind == "stills" else 1)
        minutes[kind] = views * recipe.samples_per_view() / (remembered_speed(root) or float("nan")) / 60
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
        "real sequences": checkpoint()[0],
    }
    scores = {name: score(cast(Denoiser, load_model(str(path))))[0] for name, path in trained.items()}
    for name, table in scores.items():
        for metric in ("psnr_wskp", "ssim_wskp", "relmse_layer"):
            value = table["WSKP"][metric]
            rows.append(row(f"WSKP trained on {name}: {metric}", value, "dB" if "psnr" in metric else ""))
    for method in ("noisy", "accumulated", "joint bilateral"):
        rows.append(row(f"{method}: psnr_wskp", scores["real sequences"][method]["psnr_wskp"], "dB"))
    return rows


def picture(path: Path, columns: int = 6) -> None:
    """Write the references of all stills side by side."""
    frames = FrameSet(FOLDER / "stills")
    tiles = [tone_mapped(frames, scene) for scene in frames.scenes()]
    rows = [np.concatenate(tiles[i : i + columns], 1) for i in range(0, len(tiles), columns)]
    Image.fromarray(np.concatenate(rows)).save(path, quality=90)


def tone_mapped(frames: FrameSet, scene: str) -> np.ndarray:
    """Return the reference of a scene's last frame, exposed and with gamma, uint8 (H, W, 3)."""
    frame = frames.read(scene, frames.frames(scene)[-1].index)
    exposed = np.clip(frame.buffers["reference"] * (frame.exposure or 1.0), 0, 1)
    return (255 * exposed ** (1 / 2.2)).astype(np.uint8)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path, help="write the stills' references and nothing else")
    options = parser.parse_args()
    if options.picture:
        picture(options.picture)
    else:
        print_table(run())
