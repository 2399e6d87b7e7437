"""Figures 1 and 2 of `trainer evaluate`: what the harness costs, and how exact its metrics are.

    python -m tests.benchmarks.evaluation

Six methods denoise 40 frames (the shipped ones, some several times) with all metrics, tables, plots, pictures
and the report: once what still images are denoised with offline, two networks of published size (their
weights are random, which takes as long) among it, once filters and OIDN on sequences of 320x180, which take
less time than their metrics. Overhead is the time of the whole command divided by the time that methods were
called for, less one. Metrics are compared with the authors' FLIP and with scikit-image on all shipped frames.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from data.frames import FrameSet
from data.root import resolve_root
from tests.benchmarks.timing import Row, print_table, row
from trainer.metrics import functional
from trainer.metrics.flip import flip_hdr, flip_ldr_srgb

FRAMES = 40
NOISE = ("color_noise=estimated", "feature_noise=none")
QUICK = {
    "NFOR": NOISE,
    "JointNLM": NOISE,
    "NLM": NOISE[:1],
    "CrossBilateral": (),
    "JointBilateral": (),
    "OIDN": (),
}
OFFLINE = {"NFOR": ("preset=paper",), "JointNLM": (), "MultiScaleNLM": (), "OIDN": ()}
NETWORKS = ("KPCN", "AFGSA")
"""Beside the offline ones."""
SETS = {"offline": ("sample:stills", OFFLINE, NETWORKS), "quick": ("sample:bmfr", QUICK, ())}

Image = NDArray[np.float32]


def frames(folder: Path, sample: str) -> Path:
    """Copy the shipped frames into a folder, as often as it takes."""
    shipped = FrameSet(resolve_root(sample).path)
    records = [record for scene in shipped.scenes() for record in shipped.frames(scene)]
    folder.mkdir()
    for number in range(FRAMES):
        shutil.copy(shipped.root / records[number % len(records)].file, folder / f"f{number:03d}.exr")
    return folder


def random_network(name: str, folder: Path) -> Path:
    """Write a checkpoint of a network of published size with random weights."""
    import models

    torch.manual_seed(0)
    net = getattr(models, name)()
    weights = {f"net.{key}": value for key, value in net.state_dict().items()}
    tree = {"net": {"class_path": f"models.{name}", "init_args": {}}}
    path = folder / f"{name}.ckpt"
    torch.save({"hyper_parameters": tree, "state_dict": weights}, path)
    return path


def overhead(kind: str) -> list[Row]:
    """Run the command on one set and return what it spent beside the methods."""
    sample, methods, networks = SETS[kind]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        root = frames(place / "frames", sample)
        command = [sys.executable, "-m", "trainer", "evaluate", "--data", str(root)]
        for model, options in methods.items():
            command += ["--model", model, *(part for option in options for part in ("--option", option))]
        for network in networks:
            command += ["--model", f"{network}={random_network(network, place)}"]
        command += ["--output", str(place / "out"), "--no-costs", "--no-track", "--strict"]
        began = time.perf_counter()
        subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
        wall = time.perf_counter() - began
        rows = pd.read_parquet(place / "out" / "rows.parquet")
    called = float(rows["seconds"].sum())
    share = wall / called - 1
    return [
        row(f"{kind}: frames and methods", float(len(rows)), ""),
        row(f"{kind}: methods were called for", called, "s"),
        row(f"{kind}: the whole command", wall, "s"),
        row(f"{kind}: overhead", share, "", "< 0.1", share < 0.1),
    ]


def exactness() -> list[Row]:
    """Return the largest differences from other programs over all shipped frames."""
    shipped = FrameSet(resolve_root("sample:bmfr").path)
    worst: dict[str, float] = {}
    for scene in shipped.scenes():
        for record in shipped.frames(scene):
            frame = shipped.read(scene, record.index, ["color"])
            pair = (frame.buffers["color"], frame.buffers["reference"])
            for name, (ours, theirs) in COMPARED.items():
                found = float(ours(*(torch.from_numpy(p.transpose(2, 0, 1).copy())[None] for p in pair)))
                worst[name] = max(worst.get(name, 0.0), abs(found - theirs(*pair)))
    return [row(f"{name} differs by", value, "", "< 1e-4", value < 1e-4) for name, value in worst.items()]


def _flip(kind: str) -> Callable[[Image, Image], float]:
    def call(output: Image, reference: Image) -> float:
        import flip_evaluator

        pair = [np.ascontiguousarray(np.clip(p, 0, 1) if kind == "LDR" else p) for p in (reference, output)]
        return float(flip_evaluator.evaluate(*pair, kind, inputsRGB=False, applyMagma=False)[1])

    return call


def _display(image: Image) -> NDArray[np.float64]:
    return np.clip(np.maximum(image.astype(np.float64), 0) ** functional.GAMMA, 0, 1)


def _levels(image: Image) -> NDArray[np.float64]:
    return np.floor(np.clip(np.maximum(image.astype(np.float64), 0) ** (1 / 2.2), 0, 1) * 255)


def _psnr_wskp(output: Image, reference: Image) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    return float(peak_signal_noise_ratio(_display(reference), _display(output), data_range=1))


def _psnr_afgsa(output: Image, reference: Image) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    return float(peak_signal_noise_ratio(_levels(reference), _levels(output), data_range=255))


def _ssim_wskp(output: Image, reference: Image) -> float:
    from skimage.metrics import structural_similarity

    pair = (_display(output), _display(reference))
    return float(structural_similarity(*pair, win_size=7, data_range=2, channel_axis=-1))


def _ssim_afgsa(output: Image, reference: Image) -> float:
    from skimage.metrics import structural_similarity

    found = structural_similarity(
        _levels(output), _levels(reference), data_range=255, channel_axis=-1,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    return float(found)


COMPARED: dict[
    str, tuple[Callable[[torch.Tensor, torch.Tensor], torch.Tensor], Callable[[Image, Image], float]]
] = {
    "flip_ldr_srgb": (flip_ldr_srgb, _flip("LDR")),
    "flip_hdr": (flip_hdr, _flip("HDR")),
    "psnr_wskp": (functional.psnr_wskp, _psnr_wskp),
    "ssim_wskp": (functional.ssim_wskp, _ssim_wskp),
    "psnr_afgsa": (functional.psnr_afgsa, _psnr_afgsa),
    "ssim_afgsa": (functional.ssim_afgsa, _ssim_afgsa),
}


def run() -> list[Row]:
    """Return both figures."""
    return [*exactness(), *overhead("offline"), *overhead("quick")]


if __name__ == "__main__":
    print_table(run())
