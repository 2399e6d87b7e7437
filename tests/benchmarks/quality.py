"""Figure 5: quality on the held-out scene of the shipped sample.

Denoises the test frames with the best checkpoint of the newest `wskp_bmfr` run below the current directory
(`make fit` leaves one; without one it is trained here, and timed) and with the joint bilateral filter, and
compares both with the temporally accumulated input. The picture of the README comes from here too.

    python -m tests.benchmarks.quality [--checkpoint FILE] [--picture FILE] [--readme README.md]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from data import Shards
from models import JointBilateral
from models.denoiser import Denoiser, select
from trainer.loading import load_model
from trainer.metrics.collection import METRICS, SceneMetrics
from trainer.modules.evaluation import noisy_input
from trainer.runs import RunRecord, find_checkpoint, folder_of_checkpoint
from trainer.tracking import open_client

NAMES = ("noisy", "accumulated", "joint bilateral", "WSKP")
SHOWN = tuple(name for name, measure in METRICS.items() if measure.source == "wskp")
MARKERS = ("<!-- quality -->", "<!-- /quality -->")
BY_ACCUMULATED_DB, BY_BILATERAL_DB = 4.0, 1.0


def checkpoint() -> tuple[Path, float | None]:
    """Return the best checkpoint of the newest run, and the seconds of training if it was trained here."""
    try:
        return find_checkpoint("best", Path("runs"), "wskp_bmfr"), None
    except ValueError:
        began = time.monotonic()
        subprocess.run([sys.executable, "-m", "trainer", "fit", "--config", "wskp_bmfr.yaml"], check=True)
        return find_checkpoint("best", Path("runs"), "wskp_bmfr"), time.monotonic() - began


@torch.inference_mode()
def score(net: Denoiser) -> tuple[dict[str, dict[str, float]], dict[str, Any]]:
    """Return method → metric → mean over the held-out frames, and the images of the last frame."""
    module = Shards(workers=0)  # the configuration's options, so the same shards
    module.prepare_data()
    scores = {name: SceneMetrics(module.scenes("test")) for name in NAMES}
    bilateral = JointBilateral()
    images: dict[str, Any] = {}
    for batch in module.test_dataloader():
        exposure = batch["exposure"].reshape(-1, 1, 1, 1)
        images = {
            "noisy": batch["color"],
            "accumulated": noisy_input(net, batch),
            "joint bilateral": bilateral(select(bilateral, batch)).color,
            "WSKP": net(select(net, batch)).color,
            "reference": batch["reference"],
            "exposure": batch["exposure"],
        }
        for name in NAMES:
            scores[name].update(images[name] * exposure, batch["reference"] * exposure, batch["scene"])
    return {name: scores[name].compute()["average"] for name in NAMES}, images


def picture(images: dict[str, Any], path: Path) -> None:
    """Write the comparison of one frame."""
    from trainer.reports.pictures import comparison

    arrays = {name: images[name][0].permute(1, 2, 0).numpy() for name in (*NAMES, "reference")}
    path.parent.mkdir(parents=True, exist_ok=True)
    comparison(
        arrays["noisy"],
        arrays["accumulated"],
        arrays["WSKP"],
        arrays["reference"],
        float(images["exposure"][0]),
    ).save(path)


def waiting(checkpoint: Path) -> list[dict[str, Any]]:
    """Return the share of time that the checkpoint's run waited for data after its first epoch (figure 3)."""
    folder = folder_of_checkpoint(checkpoint)
    if folder is None:
        return []
    record = RunRecord.load(folder)
    client = open_client(record.tracking_uri or "")
    history = client.get_metric_history(record.run_id, "throughput/waiting")
    epochs = client.get_metric_history(record.run_id, "train/loss_epoch")
    first_end = min(point.step for point in epochs)
    shares = [point.value for point in history if point.step > first_end]
    if not shares:
        return []
    mean = sum(shares) / len(shares)
    return [{"name": "make fit: waiting for data after epoch 0", "value": 100 * mean, "unit": "%",
             "target": "< 3 %", "meets": mean < 0.03}]  # fmt: skip


def write_readme(table: dict[str, dict[str, float]], readme: Path) -> None:
    """Put the table between the README's two markers."""
    lines = ["| | " + " | ".join(SHOWN) + " |", "|---" * (len(SHOWN) + 1) + "|"]
    for name in NAMES:
        cells = [
            f"{table[name][m]:.2f} dB" if m.startswith("psnr") else f"{table[name][m]:.4f}" for m in SHOWN
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    before, rest = readme.read_text().split(MARKERS[0])
    after = rest.split(MARKERS[1])[1]
    readme.write_text(before + MARKERS[0] + "\n" + "\n".join(lines) + "\n" + MARKERS[1] + after)


def run(
    given: Path | None = None, target: Path | None = None, readme: Path | None = None
) -> list[dict[str, Any]]:
    """Return the rows of figure 5."""
    path, seconds = (given, None) if given else checkpoint()
    table, images = score(load_model(str(path)))
    if target:
        picture(images, target)
    if readme:
        write_readme(table, readme)
    rows: list[dict[str, Any]] = []
    if seconds is not None:
        rows.append({"name": "trainer fit", "value": seconds / 60, "unit": "min", "target": None})
    rows += waiting(path)
    ours = table["WSKP"]["psnr_wskp"]
    for other, target_db in (("accumulated", BY_ACCUMULATED_DB), ("joint bilateral", BY_BILATERAL_DB)):
        gain = ours - table[other]["psnr_wskp"]
        rows.append({"name": f"WSKP above {other}, psnr_wskp", "value": gain, "unit": "dB",
                     "target": f">= {target_db} dB", "meets": gain >= target_db})  # fmt: skip
    for name in NAMES:
        for metric in SHOWN:
            unit = "dB" if metric.startswith("psnr") else ""
            rows.append({"name": f"{name} {metric}", "value": table[name][metric], "unit": unit})
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--readme", type=Path)
    options = parser.parse_args()
    for row in run(options.checkpoint, options.picture, options.readme):
        print(f"{row['name']:45} {row['value']:10.4f} {row['unit']:3} {row.get('target') or ''}")
