"""The folder of an evaluation: what was compared, the rows, the tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from trainer.evaluation.cells import Table
from trainer.evaluation.layouts import tables_of
from trainer.evaluation.plan import INPUT, Setting
from trainer.evaluation.running import Outcome
from trainer.evaluation.tables import Scored
from trainer.export.description import DISTRIBUTION, installed_version
from trainer.metrics.measures import LEFT_OUT, SCORES
from trainer.outputs import replacing

RECORD = "evaluation.json"
FIRST = ("method", "scene", "frame", "name", "spp", "width", "height", "exposure", "reference", "seconds",
         "nonfinite", "repaired", "status", "reason")  # fmt: skip


def rows_of(outcomes: Sequence[Outcome], setting: Setting) -> pd.DataFrame:
    """Return one row per frame and method, in order; metrics that could not be taken are NaN."""
    known = {
        row["name"]: row for row in reversed([r for o in outcomes for r in o.rows.values()]) if "scene" in row
    }
    rows = []
    for outcome in outcomes:
        for name in setting.names:
            row = outcome.rows.get(name, {"status": "failed", "reason": outcome.reason or "not reached"})
            facts = {
                k: known.get(name, {}).get(k)
                for k in ("scene", "frame", "spp", "width", "height", "reference", "repaired")
            }
            judged = {"exposure": known.get(name, {}).get("exposure")}  # that of the input for all
            rows.append({**facts, **row, **judged, "method": outcome.method.label, "name": name})
    frame = pd.DataFrame(rows)
    for column in (*FIRST, *setting.metrics):
        if column not in frame:
            frame[column] = None
    frame[list(setting.metrics)] = frame[list(setting.metrics)].astype("float64")
    for column in ("seconds", "exposure"):
        frame[column] = frame[column].astype("float64")
    for column in ("frame", "spp", "width", "height", "nonfinite", "repaired"):
        frame[column] = frame[column].astype("Int64")
    frame["reference"] = frame["reference"].fillna(value=False).astype(bool)
    return frame[[*FIRST, *setting.metrics]]


def write_rows(rows: pd.DataFrame, folder: Path) -> None:
    """Write `rows.parquet` and `rows.csv`.

    Raises:
        OSError: They cannot be written.
    """
    with replacing(folder / "rows.parquet") as path:
        rows.to_parquet(path, index=False)
    with replacing(folder / "rows.csv") as path:
        rows.to_csv(path, index=False)


def write_record(
    outcomes: Sequence[Outcome],
    rows: pd.DataFrame,
    setting: Setting,
    costs: Mapping[str, Mapping[str, Any]],
    pages: Mapping[str, Mapping[str, str | None]],
) -> dict[str, Any]:
    """Write `evaluation.json` and return it.

    Args:
        outcomes: Of the input and of all methods.
        rows: From `rows_of`.
        setting: How they were made.
        costs: Label → time and memory per megapixel, of the methods whose were measured.
        pages: Label → `run_url` and `training_url`, pages of MLflow; the evaluation's under the empty label.

    Raises:
        OSError: It cannot be written.
    """
    frames = rows[rows["method"] == INPUT]
    record = {
        "penumbra": installed_version(DISTRIBUTION),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "data": {"root": setting.root, "split": setting.split, "identity": setting.data},
        "methods": [
            {
                "label": o.method.label,
                "folder": o.method.folder,
                "model": o.method.model,
                "class": o.facts.get("class"),
                "options": o.facts.get("options", {}),
                "sha256": o.facts.get("sha256"),
                "parameters": o.facts.get("parameters"),
                "deployed": o.facts.get("deployed"),
                "step": o.facts.get("step"),
                "status": o.status,
                "reason": o.told(),
                "cost": costs.get(o.method.label),
                "run_url": None,
                "training_url": None,
                **pages.get(o.method.label, {}),
            }
            for o in outcomes
            if o.method.label != INPUT
        ],
        "metrics": [
            {"name": name, "higher": score.higher, "format": score.format, "definition": score.doc}
            for name, score in SCORES.items()
            if name in setting.metrics
        ],
        "left_out": LEFT_OUT,
        "run_url": pages.get("", {}).get("run_url"),
        "frames": [
            {
                "scene": row.scene, "index": _number(row.frame), "name": row.name_, "spp": _number(row.spp),
                "width": _number(row.width), "height": _number(row.height),
                "exposure": None if pd.isna(row.exposure) else row.exposure,
                "reference": bool(row.reference),
            }
            for row in frames.rename(columns={"name": "name_"}).itertuples()
        ],
    }  # fmt: skip
    with replacing(setting.folder / RECORD) as path:
        path.write_text(json.dumps(record, indent=1, allow_nan=False))
    return record


def _number(value: Any) -> int | None:
    return None if pd.isna(value) else int(value)


def write_tables(
    rows: pd.DataFrame, methods: Sequence[str], setting: Setting, more: Sequence[Table] = ()
) -> list[Table]:
    """Write all tables below `tables/` and return them.

    Args:
        rows: One per frame and method.
        methods: Labels in order.
        setting: How they were made.
        more: Other tables, which come first.

    Raises:
        OSError: One cannot be written.
    """
    tables = [*more, *tables_of(Scored(rows, methods, setting.metrics))]
    folder = setting.folder / "tables"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        if old.suffix in (".md", ".tex", ".csv"):
            old.unlink()
    for table in tables:
        for suffix, text in ((".md", table.markdown()), (".tex", table.latex()), (".csv", table.csv())):
            with replacing(folder / f"{table.name}{suffix}") as path:
                path.write_text(text)
    return tables
