"""Figure 4 of the per-sample denoisers: quality on held-out frames after equal steps, and with fireflies.

Trains the small forms of PixelGather, SampleSplat and Layer, alpha and weighted (`configs/*_sample.yaml`) for
equal numbers of steps with equal seeds on random scenes, unless their trainings are finished below `--output`
(one that was cut off goes on), and compares their last weights with the mean of the samples: on other
random scenes and on six known scenes, at 2, 4 and 8 samples per pixel, and with one sample in a thousand
replaced by a firefly. Nothing is trained on any of these scenes.

    python -m tests.benchmarks.per_sample_quality [--data FRAMES] [--held-out FRAMES] [--output DIR]
        [--steps N] [--train METHOD …] [--picture FILE] [--readme FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch

from models.denoiser import Denoiser
from tests.benchmarks.per_sample_frames import (
    SHARED,
    SPP,
    View,
    known_scenes,
    prepared,
    random_scenes,
    rendered,
)
from tests.benchmarks.timing import Row, print_table, row
from trainer.loading import load_model
from trainer.metrics.collection import METRICS, SceneMetrics
from trainer.runs import find_checkpoint

FOLDER = Path("bench") / "per_sample"
STEPS = 600
LIMIT_MINUTES = 40.0
WEIGHTED = ("--model.init_args.net.init_args.compositing", "weighted")
METHODS: dict[str, tuple[str, ...]] = {
    "pixelgather": ("pixelgather_random", "pixelgather_sample"),
    "samplesplat": ("samplesplat_random", "samplesplat_sample"),
    "layers_alpha": ("layers_random", "layers_sample"),
    "layers_weighted": ("layers_random", "layers_sample", *WEIGHTED),
    "optimized": ("layers_optimized", "layers_optimized_sample"),
}
"""Method → its two configurations, and further options."""

TITLES = {
    "noisy": "mean of the samples",
    "pixelgather": "PixelGather",
    "samplesplat": "SampleSplat",
    "layers_alpha": "Layer, alpha",
    "layers_weighted": "Layer, weighted",
    "optimized": "Optimized",
}
MEDIAN = "relmse_median"
SHOWN = {
    "relmse_layer": "relMSE",
    MEDIAN: "relMSE, median",
    "smape_wskp": "SMAPE",
    "ssim_layer": "SSIM",
    "psnr_layer": "PSNR",
}
"""Metric → its title. Means over frames, as in the paper, and the median of relMSE, whose mean is what
one or two frames with lamps beside black have."""
FIREFLIES = (MEDIAN, "smape_wskp", "psnr_layer")
"""What is compared with fireflies and without."""
SETS = {"random": "random scenes", "known": "known scenes"}
MARKERS = ("<!-- samples -->", "<!-- /samples -->")

Scores = dict[str, dict[str, float]]
"""Method → metric → mean over the frames of a set."""


def train(method: str, shards: Path, steps: int, folder: Path) -> Path:
    """Train a method until it has done so many steps, below `folder/METHOD`; return its last checkpoint."""
    home, experiment = folder / method, f"per_sample_{method}"
    whole, small, *options = METHODS[method]
    arguments = ["--config", f"{whole}.yaml", "--config", f"{small}.yaml", *options]
    arguments += ["--data.root", str(shards.resolve()), "--trainer.logger.init_args.experiment", experiment]
    arguments += ["--trainer.max_steps", str(steps), "--trainer.max_epochs", "-1"]
    arguments += ["--trainer.check_val_every_n_epoch", "1"]
    home.mkdir(parents=True, exist_ok=True)
    done = _steps_done(home, experiment)
    if done < steps:
        began = time.monotonic()
        resumed = ["--ckpt_path", "last"] if done else []
        command = [sys.executable, "-m", "trainer", "fit", *arguments, *resumed]
        subprocess.run(command, check=True, cwd=home)
        spent = _minutes(home) + (time.monotonic() - began) / 60
        (home / "minutes.json").write_text(json.dumps(spent) + "\n")
    return find_checkpoint("last", home / "runs", experiment)


def _steps_done(home: Path, experiment: str) -> int:
    try:
        path = find_checkpoint("last", home / "runs", experiment)
    except ValueError:
        return 0
    return int(torch.load(path, map_location="cpu", weights_only=True)["global_step"])


def _minutes(home: Path) -> float:
    path = home / "minutes.json"
    return float(json.loads(path.read_text())) if path.is_file() else 0.0


@torch.inference_mode()
def score(views: Sequence[View], nets: dict[str, Denoiser], spp: int, outliers: bool = False) -> Scores:
    """Denoise and score frames, and the mean of their samples."""
    totals = {name: SceneMetrics([view.scene for view in views]) for name in ("noisy", *nets)}
    for view in views:
        for name, total in totals.items():
            image = view.denoised(nets[name], spp, outliers) if name in nets else view.noisy(spp, outliers)
            total.update(image * view.exposure, view.reference * view.exposure, [view.scene])
    return {name: _summary(total.compute()) for name, total in totals.items()}


def _summary(table: dict[str, dict[str, float]]) -> dict[str, float]:
    mean = table.pop("average")
    return {**mean, MEDIAN: statistics.median(frame["relmse_layer"] for frame in table.values())}


@torch.inference_mode()
def picture(
    shown: Sequence[tuple[View, bool]], nets: dict[str, Denoiser], path: Path, side: int = 64
) -> None:
    """Write crops of frames, with fireflies where that is said: samples' mean, every method, reference."""
    from trainer.reports.pictures import Panel, grid, sized, tone_map

    rows = []
    for view, outliers in shown:
        images = {"noisy": view.noisy(SPP[-1], outliers)}
        images |= {name: view.denoised(net, SPP[-1], outliers) for name, net in nets.items()}
        images["reference"] = view.reference
        top, left = _busiest(view, side)
        panels = []
        for name, image in images.items():
            psnr = METRICS["psnr_layer"].function(image * view.exposure, view.reference * view.exposure)
            said = "with fireflies" if outliers else view.scene
            caption = said if name == "reference" else f"frame: PSNR {float(psnr):.2f} dB"
            crop = image[0, :, top : top + side, left : left + side].permute(1, 2, 0).numpy()
            panels.append(Panel(sized(tone_map(crop, view.exposure)), TITLES.get(name, name), caption))
        rows.append(panels)
    path.parent.mkdir(parents=True, exist_ok=True)
    grid(rows).save(path)


def _busiest(view: View, side: int) -> tuple[int, int]:
    """Return row and column of the crop whose reference varies most."""
    shown = (view.reference * view.exposure).clamp(0, 1).sqrt().mean(1)
    windows = shown.unfold(1, side, 8).unfold(2, side, 8)
    best = int(windows.flatten(-2).std(-1).argmax())
    return 8 * (best // windows.shape[2]), 8 * (best % windows.shape[2])


def write_readme(tables: dict[str, dict[str, Scores]], readme: Path) -> None:
    """Put the scores at 8 samples per pixel, and relMSE with fireflies, between the README's two markers."""
    lines = []
    for kind, tables_of in tables.items():
        clean, hit = tables_of[f"{SPP[-1]} spp"], tables_of["fireflies"]
        heads = [SETS[kind], *SHOWN.values(), *(f"{SHOWN[metric]}, fireflies" for metric in FIREFLIES)]
        lines += ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
        for name in clean:
            cells = [_text(metric, clean[name][metric]) for metric in SHOWN]
            cells += [_text(metric, hit[name][metric]) for metric in FIREFLIES]
            lines.append(f"| {TITLES[name]} | " + " | ".join(cells) + " |")
        lines.append("")
    before, rest = readme.read_text().split(MARKERS[0])
    after = rest.split(MARKERS[1])[1]
    readme.write_text(before + MARKERS[0] + "\n" + "\n".join(lines[:-1]) + "\n" + MARKERS[1] + after)


def _text(metric: str, value: float) -> str:
    return f"{value:.2f} dB" if "psnr" in metric else f"{value:.3f}"


def _rows(tables: dict[str, dict[str, Scores]]) -> list[Row]:
    rows: list[Row] = []
    for kind, conditions in tables.items():
        for condition, scores in conditions.items():
            for name, values in scores.items():
                for metric, title in SHOWN.items():
                    unit = "dB" if "psnr" in metric else ""
                    rows.append(
                        row(f"{SETS[kind]}, {condition}: {TITLES[name]}: {title}", values[metric], unit)
                    )
        rows += _degradation(SETS[kind], conditions[f"{SPP[-1]} spp"], conditions["fireflies"])
    return rows


def _degradation(title: str, clean: Scores, hit: Scores) -> list[Row]:
    """Return what fireflies do to every method: ratios of errors, dB that are lost."""
    rows = []
    for name in clean:
        for metric in FIREFLIES:
            before, after = clean[name][metric], hit[name][metric]
            label = f"{title}, fireflies: {TITLES[name]}: {SHOWN[metric]}"
            if "psnr" in metric:
                rows.append(row(f"{label} lost", before - after, "dB"))
            else:
                rows.append(row(f"{label} with / without", after / before, "x"))
    return rows


def run(
    data: Path | None = None,
    held_out: Path | None = None,
    folder: Path = FOLDER,
    steps: int = STEPS,
    target: Path | None = None,
    readme: Path | None = None,
) -> list[Row]:
    """Return the rows of figure 4: every method, metric and condition, and the minutes of every training."""
    frames = data or rendered(folder, "frames")
    more = held_out or rendered(folder, "held_out")
    nets: dict[str, Denoiser] = {}
    rows: list[Row] = []
    for method in METHODS:
        checkpoint = train(method, prepared(frames, folder), steps, folder)
        nets[method] = cast(Denoiser, load_model(str(checkpoint))).eval()
        minutes = _minutes(folder / method)
        met = minutes <= LIMIT_MINUTES
        rows.append(row(f"{TITLES[method]}: training", minutes, "min", f"<= {LIMIT_MINUTES:.0f} min", met))
    sets = {"random": list(random_scenes(frames, more)), "known": list(known_scenes())}
    if not sets["known"]:
        print(f"left out: the known scenes of {SHARED}, which is not there")
    tables = {
        kind: {
            **{f"{spp} spp": score(views, nets, spp) for spp in SPP},
            "fireflies": score(views, nets, SPP[-1], outliers=True),
        }
        for kind, views in sets.items()
        if views
    }
    if target:
        first = [(view, False) for views in sets.values() for view in views[:1]]
        picture([*first, (first[-1][0], True)], nets, target)
    if readme:
        write_readme(tables, readme)
    return rows + _rows(tables)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="ingested frames instead of rendering them")
    parser.add_argument("--held-out", type=Path, help="more ingested frames, to compare on")
    parser.add_argument("--output", type=Path, default=FOLDER, help="for frames, shards and trainings")
    parser.add_argument("--steps", type=int, default=STEPS, help="of every training")
    parser.add_argument("--train", nargs="+", choices=tuple(METHODS), help="train these and nothing else")
    parser.add_argument("--picture", type=Path, help="write crops of some frames")
    parser.add_argument("--readme", type=Path, help="write the scores into this file")
    options = parser.parse_args()
    if options.train:
        shards = prepared(options.data or rendered(options.output, "frames"), options.output)
        for wanted in options.train:
            print(train(wanted, shards, options.steps, options.output))
    else:
        print_table(
            run(
                options.data, options.held_out, options.output, options.steps, options.picture, options.readme
            )
        )
