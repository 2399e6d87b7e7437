"""Memory and size of exported per-sample networks: resident memory of ONNX Runtime and TorchScript.

    python -m tests.benchmarks.exported [--width 16] [--kernel 11] [--size 256] [--samples 8 32]

Every figure is the growth of a process's peak resident memory in one call, after a small one. It must stay
below what the file declares (`bytes_per_pixel`, `bytes_once`), from which tiles are cut, whatever the number
of samples. Needs Linux, which lets a process reset its peak.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.benchmarks.timing import Row, print_table, row
from trainer.benchmarking.memory import reset_peak, status

METHODS = ("Layer", "SampleSplat", "PixelGather", "Optimized", "SBMC")
SUFFIXES = {"onnx": ".onnx", "torchscript": ".ts"}


def network(name: str, width: int, kernel: int) -> Any:
    """Return a network; Optimized keeps its 5x5 kernels."""
    import torch

    import models
    from models.blocks.per_sample import PerSample

    torch.manual_seed(1)
    arguments: dict[str, Any] = (
        {"width": width} if name == "Optimized" else {"width": width, "kernel_size": kernel}
    )
    if name == "SBMC":
        arguments["features"] = PerSample.samples
    return getattr(models, name)(**arguments).eval()


def child(path: str, side: int, count: int) -> int:
    """Return by how many bytes resident memory grows while a file denoises one image."""
    import torch

    from trainer.export import load_artifact
    from trainer.export.entry import Sampled, example

    torch.set_num_threads(1)
    artifact = load_artifact(path)
    sampled = Sampled(artifact.samples, count)
    artifact(example(artifact.inputs, 1, 32, 32, samples=Sampled(artifact.samples, 2)))
    buffers = example(artifact.inputs, 1, side, side, samples=sampled)
    before = reset_peak()
    artifact(buffers)
    return status("VmHWM") - before


def measured(path: Path, side: int, count: int) -> int:
    """Return what `child` does, in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.exported", "--child", str(path)]
    command += ["--size", str(side), "--samples", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    if done.returncode:
        raise ValueError(f"{' '.join(command)} failed: {done.stderr[-400:]}")
    return int(done.stdout)


def run(width: int = 16, kernel: int = 11, side: int = 256, counts: tuple[int, ...] = (8, 32)) -> list[Row]:
    """Return memory per pixel and size of every method in both formats."""
    from trainer.export import export, load_artifact

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in METHODS:
            net = network(name, width, kernel)
            for format, suffix in SUFFIXES.items():
                path = Path(folder) / f"{name}{suffix}"
                export(net, path, format)  # type: ignore[arg-type]
                said = load_artifact(path)
                declared = said.bytes_per_pixel + said.bytes_once / side**2
                what = f"{name}, {format}, width {width}"
                for count in counts:
                    value = measured(path, side, count) / side**2
                    label = f"{what}, {side}x{side}, {count} samples: memory"
                    target = f"declared {declared:.0f}"
                    rows.append(row(label, value, "B/pixel", target, value <= declared))
                rows.append(row(f"{what}: file", path.stat().st_size / 1e6, "MB"))
    return rows


def main() -> int:
    """Print the table, or one figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--kernel", type=int, default=11)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, nargs="+", default=[8, 32])
    options = parser.parse_args()
    if options.child:
        print(child(options.child, options.size, options.samples[0]))
        return 0
    print_table(run(options.width, options.kernel, options.size, tuple(options.samples)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
