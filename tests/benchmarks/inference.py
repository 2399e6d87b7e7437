"""Figure 4: how fast the command answers, and what denoising a 1280x720 frame takes.

`trainer --help`: wall time of new processes, after one that fills the file cache; the least and the median
are shown and the least is compared with the target, since other work on the machine only ever adds.

Whole frames: every runtime gets a process of its own, which denoises one 1280x720 frame with six-layer WSKP,
untiled. Memory is that process's peak resident set during the calls (`VmHWM`, reset before them through
/proc/self/clear_refs) less its resident set before the first call: everything the call needs beside the
loaded runtime, the weights and the input.

    python -m tests.benchmarks.inference
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HELP_TARGET_S = 0.6
SIZE = (720, 1280)
RUNTIMES = ("eager, training form", "eager, deployed", "ONNX Runtime", "TorchScript")


def run() -> list[dict[str, Any]]:
    """Return the rows of the table."""
    return [*help_rows(), *inference_rows()]


def help_rows(starts: int = 9) -> list[dict[str, Any]]:
    """Time `trainer --help`."""
    command = [sys.executable, "-m", "trainer", "--help"]
    subprocess.run(command, capture_output=True, check=True)
    times = []
    for _ in range(starts):
        began = time.perf_counter()
        subprocess.run(command, capture_output=True, check=True)
        times.append(time.perf_counter() - began)
    target = f"<= {HELP_TARGET_S} s"
    return [
        row("trainer --help, least", min(times), "s", target, min(times) <= HELP_TARGET_S),
        row("trainer --help, median", statistics.median(times), "s"),
    ]


def inference_rows(calls: int = 5) -> list[dict[str, Any]]:
    """Time and memory of each runtime, each in a process of its own."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for runtime in RUNTIMES:
            command = [sys.executable, "-m", "tests.benchmarks.inference", runtime, folder, str(calls)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise RuntimeError(f"{runtime}: {done.stderr.strip()[-500:]}")
            found = json.loads(done.stdout.splitlines()[-1])
            rows.append(row(f"1280x720, {runtime}: time, least of {calls}", min(found["times"]), "s"))
            rows.append(row(f"1280x720, {runtime}: time, median", statistics.median(found["times"]), "s"))
            rows.append(row(f"1280x720, {runtime}: extra memory", found["memory"] / 2**20, "MiB"))
            rows.append(row(f"1280x720, {runtime}: differs from eager", found["error"], "relative"))
    return rows


def row(name: str, value: float, unit: str, target: str = "", meets: bool | None = None) -> dict[str, Any]:
    """Return one row of the table."""
    return {"name": name, "value": float(value), "unit": unit, "target": target, "meets": meets}


def child(runtime: str, folder: Path, calls: int) -> dict[str, Any]:
    """Denoise a frame `calls` times with one runtime and measure; runs in its own process."""
    import torch

    from models import WSKP
    from trainer.benchmarking.memory import reset_peak, status
    from trainer.export import SUFFIXES, export, load_artifact
    from trainer.export.entry import example
    from trainer.export.parity import relative_error

    torch.manual_seed(0)
    net = WSKP().eval().requires_grad_(False)
    formats = {"ONNX Runtime": "onnx", "TorchScript": "torchscript"}
    model: Any = net.deploy() if runtime == "eager, deployed" else net
    if runtime in formats:
        path = folder / f"wskp{SUFFIXES[formats[runtime]]}"
        export(net, path, formats[runtime])  # type: ignore[arg-type]
        model = load_artifact(path)
    buffers = example(net.inputs, 1, *SIZE)
    small = example(net.inputs, 1, 64, 64)
    with torch.inference_mode():
        model(small)  # threads and code are loaded; the frame's memory is not
        before = reset_peak()
        times = []
        for _ in range(calls):
            began = time.perf_counter()
            color = model(buffers).color
            times.append(time.perf_counter() - began)
        memory = status("VmHWM") - before
        error = relative_error(color, net.deploy()(buffers).color)
    return {"times": times, "memory": memory, "error": error}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(child(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))))
    else:
        for entry in run():
            note = (
                f"  (target {entry['target']}: {'met' if entry['meets'] else 'MISSED'})"
                if entry["target"]
                else ""
            )
            print(f"{entry['name']:<55} {entry['value']:10.4g} {entry['unit']}{note}")
