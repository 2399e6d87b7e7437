"""`make bench`: run the benchmarks, print one table, and write bench/results.json.

    python -m tests.benchmarks                all
    python -m tests.benchmarks quality …      some

Ratios are taken within one run, so they mean the same on a busy machine; absolute times do not.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

MODULES = (
    *("training_step", "reconstruction", "loader", "preparation", "importance", "inference", "quality"),
    *("rendering", "procedural"),
    *("afgsa", "afgsa_search", "afgsa_inference", "acfm", "kpcn", "kp", "nbgd", "realtime", "stills_quality"),
    *("splat", "per_sample", "stages", "per_sample_quality", "exported"),
    *("nfor", "nfor_growth", "nlm", "rdfc", "rhf", "lbf"),
    *("classical_quality", "sequence_quality", "flicker"),
    *("classical_cost", "classical_plain", "frame_limit"),
    *("scaling", "remote", "outage", "serve"),
    "evaluation",
)
RESULTS = Path("bench") / "results.json"


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    import torch

    return {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
        "load": os.getloadavg()[0],
        "time": time.strftime("%Y-%m-%d %H:%M:%S"),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """Return the rows as a table."""
    result = Table(title="Penumbra benchmarks", title_justify="left")
    for column in ("benchmark", "figure", "value", "target", ""):
        result.add_column(column, justify="right" if column == "value" else "left", overflow="fold")
    for row in rows:
        meets = {True: "met", False: "MISSED", None: ""}[row.get("meets")]
        value = f"{row['value']:.4g} {row['unit']}" if isinstance(row["value"], float) else str(row["value"])
        result.add_row(row["benchmark"], row["name"], value, str(row.get("target") or ""), meets)
    return result


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all; returns 1 if a target is missed."""
    unknown = set(names) - set(MODULES)
    if unknown:
        print(f"unknown benchmark {', '.join(sorted(unknown))}; known: {', '.join(MODULES)}", file=sys.stderr)
        return 2
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the trainer command does, before torch
    about, rows = machine(), []
    for name in names or MODULES:
        print(f"running {name} …", file=sys.stderr, flush=True)
        module = importlib.import_module(f"tests.benchmarks.{name}")
        rows += [{"benchmark": name, **row} for row in module.run()]
    Console(width=None if sys.stdout.isatty() else 120).print(table(rows))
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"machine": about, "rows": rows}, indent=1) + "\n")
    print(f"written to {RESULTS}")
    return 1 if any(row.get("meets") is False for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
