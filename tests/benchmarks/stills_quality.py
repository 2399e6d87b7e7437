"""Figure 4 of the still-image denoisers: quality on the held-out sample still at 32 samples per pixel.

Trains the small forms of KPCN, ACFM and AFGSA (`configs/*_sample.yaml`), the last without and with the
adversarial loss, unless the current directory has runs of them (`runs/stills_<method>`), and compares their
best checkpoints with the noisy input and with the filters without parameters. Times are those of trainings
done here; four trainings take the better part of an hour on two idle cores.

    python -m tests.benchmarks.stills_quality [--picture FILE] [--readme FILE] [--train METHOD …]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple, cast

import torch
from PIL import Image
from torch import Tensor

import models
from data import Shards
from models.denoiser import Denoiser, select
from tests.benchmarks.timing import Row, print_table, row
from trainer.loading import load_model
from trainer.metrics.collection import METRICS, SceneMetrics
from trainer.runs import find_checkpoint

METHODS: dict[str, tuple[str, ...]] = {
    "kpcn": ("kpcn",),
    "acfm": ("acfm",),
    "afgsa_l1": ("afgsa", "--model.init_args.adversarial_weight", "0"),
    "afgsa": ("afgsa",),
}
"""Method → its configurations, `<name>_tungsten.yaml` and `<name>_sample.yaml`, and further options."""

TITLES = {"kpcn": "KPCN", "acfm": "ACFM", "afgsa_l1": "AFGSA without adversarial loss", "afgsa": "AFGSA"}
FILTERS = {"JointBilateral": "joint bilateral", "NFOR": "NFOR"}
SHOWN = ("psnr_afgsa", "ssim_afgsa", "rel_mse_half_afgsa", "psnr_wskp", "ssim_wskp_range1", "relmse_layer")
LIMIT_MINUTES = 40.0
MARKERS = ("<!-- stills -->", "<!-- /stills -->")


class Scored(NamedTuple):
    """Method → metric → mean over the held-out frames, and the exposed images of the last frame."""

    scores: dict[str, dict[str, float]]
    images: dict[str, Tensor]


def train(method: str) -> tuple[Path, float | None]:
    """Return the best checkpoint of a method, and the minutes of training where it was trained now."""
    experiment = f"stills_{method}"
    try:
        return find_checkpoint("best", Path("runs"), experiment), None
    except ValueError:
        name, *options = METHODS[method]
        files = ("--config", f"{name}_tungsten.yaml", "--config", f"{name}_sample.yaml")
        named = ("--trainer.logger.init_args.experiment", experiment)
        model = ("--trainer.logger.init_args.registered_model", experiment.replace("_", "-"))
        began = time.monotonic()
        command = [sys.executable, "-m", "trainer", "fit", *files, *named, *model, *options]
        subprocess.run(command, check=True)
        return find_checkpoint("best", Path("runs"), experiment), (time.monotonic() - began) / 60


@torch.inference_mode()
def score(nets: dict[str, Denoiser]) -> Scored:
    """Denoise and score the test frames of the sample, and the noisy input beside them."""
    names = tuple(dict.fromkeys(("color", *(name for net in nets.values() for name in net.inputs))))
    data = Shards("sample:stills", workers=0, buffers=names, temporal=False, recipe="afgsa", patch_size=64)
    data.prepare_data()
    totals = {name: SceneMetrics(data.scenes("test")) for name in ("noisy", *nets)}
    images: dict[str, Tensor] = {}
    for batch in data.test_dataloader():
        exposure = batch["exposure"].reshape(-1, 1, 1, 1)
        images = {"noisy": batch["color"] * exposure}
        images |= {name: net(select(net, batch)).color * exposure for name, net in nets.items()}
        reference = batch["reference"] * exposure
        for name, image in images.items():
            totals[name].update(image, reference, batch["scene"])
        images["reference"] = reference
    return Scored({name: total.compute()["average"] for name, total in totals.items()}, images)


def picture(images: dict[str, Tensor], path: Path) -> None:
    """Write the exposed images of one frame in two rows, with names and PSNR."""
    from trainer.reports.pictures import Panel, grid, tone_map

    panels = []
    for name, image in images.items():
        tile = tone_map(image[0].permute(1, 2, 0).numpy())
        score = METRICS["psnr_afgsa"].function(image, images["reference"])
        caption = "" if name == "reference" else f"PSNR {float(score):.2f} dB"
        tile = tile.resize((2 * tile.width, 2 * tile.height), Image.Resampling.NEAREST)
        panels.append(Panel(tile, name, caption))
    half = -(-len(panels) // 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    grid([panels[:half], panels[half:]]).save(path)


def write_readme(scores: dict[str, dict[str, float]], readme: Path) -> None:
    """Put the table of scores between the README's two markers."""
    lines = ["| | " + " | ".join(SHOWN) + " |", "|---" * (len(SHOWN) + 1) + "|"]
    for name, values in scores.items():
        cells = [METRICS[metric].format.format(values[metric]) for metric in SHOWN]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    before, rest = readme.read_text().split(MARKERS[0])
    after = rest.split(MARKERS[1])[1]
    readme.write_text(before + MARKERS[0] + "\n" + "\n".join(lines) + "\n" + MARKERS[1] + after)


def run(target: Path | None = None, readme: Path | None = None) -> list[Row]:
    """Return the rows of figure 4: every method and metric, and the time of what was trained now."""
    nets: dict[str, Denoiser] = {
        title: getattr(models, name)().eval() for name, title in FILTERS.items() if name in models.__all__
    }
    rows: list[Row] = []
    for method in METHODS:
        checkpoint, minutes = train(method)
        nets[TITLES[method]] = cast(Denoiser, load_model(str(checkpoint)))
        if minutes is not None:
            met = minutes <= LIMIT_MINUTES
            rows.append(
                row(f"{TITLES[method]}: training", minutes, "min", f"<= {LIMIT_MINUTES:.0f} min", met)
            )
    scores, images = score(nets)
    if target:
        picture(images, target)
    if readme:
        write_readme(scores, readme)
    for name, values in scores.items():
        rows += [
            row(f"{name}: {metric}", values[metric], "dB" if "dB" in METRICS[metric].format else "")
            for metric in SHOWN
        ]
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path, help="write the images of the held-out frame side by side")
    parser.add_argument("--readme", type=Path, help="write the scores into this file")
    parser.add_argument("--train", nargs="+", choices=tuple(METHODS), help="train these and nothing else")
    options = parser.parse_args()
    if options.train:
        for wanted in options.train:
            print(*train(wanted))
    else:
        print_table(run(options.picture, options.readme))
