"""`report.html` of an evaluation: the folder is read, the page is written whole or not at all."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from trainer.evaluation.cells import Cell, Table
from trainer.evaluation.layouts import tables_of
from trainer.evaluation.plan import INPUT, REFERENCE
from trainer.evaluation.tables import Scored
from trainer.metrics.measures import SCORES
from trainer.outputs import replacing
from trainer.reports.comparison import coding, levels
from trainer.reports.comparison.gallery import BUDGET, NOISE, Column, Gallery, gallery_of
from trainer.reports.comparison.maps import FLIP_LEVELS
from trainer.reports.pictures import colors

PAGE = "report.html"
SCRIPTS = (
    "store.js",
    "shade.js",
    "viewer.js",
    "gestures.js",
    "crops.js",
    "tables.js",
    "plots.js",
    "start.js",
)

_HERE = Path(__file__).parent
_PICTURES = "%PICTURES%"


def write_page(folder: Path, budget: int = BUDGET) -> Path:
    """Write `report.html` of an evaluation and return its path.

    Args:
        folder: With `evaluation.json`, `rows.parquet` and `images`.
        budget: Bytes that the pictures may take; bounds and numbers of pictures follow from it.

    Raises:
        FileNotFoundError: The folder holds no evaluation.
        OSError: A file cannot be read or written.
        ValueError: A file is damaged.
    """
    folder = Path(folder)
    record, rows = _read(folder)
    columns = _columns(record, folder / "images")
    gallery = gallery_of(folder / "images", record["frames"], columns, budget)
    before, after = _filled(_facts(record, rows, columns, gallery)).split(_PICTURES)
    target = folder / PAGE
    with replacing(target) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        file.write(before)
        for key, text in gallery.texts(min(4, os.cpu_count() or 1)):
            file.write(f'<script type="text/plain" id="{key}">{text}</script>\n')
        file.write(after)
    return target


def _read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    path = folder / "evaluation.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} holds no evaluation (there is no {path.name}); make one with: "
            f"trainer evaluate --model MODEL --data ROOT --output {folder}"
        )
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: damaged: {error}; evaluate again") from error
    return record, pd.read_parquet(folder / "rows.parquet")


def _columns(record: Mapping[str, Any], images: Path) -> list[Column]:
    """Return what frames are shown by: input, the methods that made pictures, reference."""
    methods = [Column(m["label"], m["folder"]) for m in record["methods"]]
    every = [Column(INPUT, INPUT), *methods, Column(REFERENCE, REFERENCE)]
    return [column for column in every if (images / column.folder).is_dir()]


def _facts(
    record: Mapping[str, Any], rows: pd.DataFrame, columns: Sequence[Column], gallery: Gallery
) -> dict[str, Any]:
    """Return what the page knows beside its pictures."""
    metrics = [m for m in record["metrics"] if m["name"] in SCORES and m["name"] in rows]
    names = [m["name"] for m in metrics if rows[m["name"]].notna().any()]
    methods = [INPUT, *(m["label"] for m in record["methods"])]
    kinds = {INPUT: "input", REFERENCE: "reference"}
    return {
        "penumbra": record.get("penumbra"),
        "created": record.get("created"),
        "run_url": _address(record.get("run_url")),
        "data": record["data"],
        "frames": record["frames"],
        "pictures": {
            "frames": gallery.frames,
            "bound": gallery.quality.bound,
            "loose": gallery.quality.bound * NOISE,
            "block": gallery.quality.block,
            "floor": levels.FLOOR,
            "flip": FLIP_LEVELS,
            "keys": [picture.key for picture in gallery.pictures],
        },
        "columns": [
            {
                "label": c.label,
                "kind": kinds.get(c.folder, "method"),
                "bound": gallery.quality.bound * c.looseness,
            }
            for c in columns
        ],
        "methods": [_method(m, rows) for m in record["methods"]],
        "metrics": [_metric(m) for m in metrics if m["name"] in names],
        "left_out": record.get("left_out", {}),
        "scores": _scores(rows, methods, names, record["frames"]),
        "tables": [_table(t) for t in tables_of(Scored(rows, methods, names))],
        "colors": bytes(colors().ravel()).hex(),
    }


def _metric(metric: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": metric["name"],
        "higher": bool(metric["higher"]),
        "definition": metric.get("definition", ""),
        "digits": SCORES[metric["name"]].digits.removeprefix("{:.").removesuffix("}"),
    }


def _method(method: Mapping[str, Any], rows: pd.DataFrame) -> dict[str, Any]:
    """Return what is known of a method; its time is taken from its frames where it was not measured apart."""
    own = rows[rows["method"] == method["label"]]
    own = own[own["status"] != "failed"]
    pixels = (own["width"].astype(float) * own["height"].astype(float)) / 1e6
    per_megapixel = (own["seconds"].astype(float) / pixels).dropna()
    kept = ("label", "model", "class", "options", "status", "reason", "parameters", "cost")
    return {
        **{key: method.get(key) for key in kept},
        **{key: _address(method.get(key)) for key in ("run_url", "training_url")},
        "seconds": float(per_megapixel.median()) if len(per_megapixel) else None,
        "nonfinite": int(own["nonfinite"].fillna(0).sum()),
        "frames": len(own),
    }


def _address(url: str | None) -> str | None:
    """Return an address that a page may link to."""
    return url if url and url.startswith(("http://", "https://")) else None


def _scores(
    rows: pd.DataFrame, methods: Sequence[str], names: Sequence[str], frames: Sequence[Mapping[str, Any]]
) -> dict[str, list[list[float | None]]]:
    """Return method → for each metric the values of all frames."""
    found = {}
    for label in methods:
        own = rows[rows["method"] == label]
        own = own.set_index("name").reindex([f["name"] for f in frames])
        found[label] = [[_plain(value) for value in own[name]] for name in names]
    return found


def _table(table: Table) -> dict[str, Any]:
    return {
        "name": table.name,
        "title": table.title,
        "corner": table.corner,
        "columns": table.columns,
        "rows": [[head, [_cell(cell) for cell in cells]] for head, cells in table.rows],
        "notes": table.notes,
    }


def _cell(cell: Cell) -> list[Any]:
    half, rank = _plain(cell.half), cell.rank
    return [_plain(cell.mean), half, rank, cell.text(), cell.interval(), cell.count, cell.missing]


def _plain(value: Any) -> float | None:
    """Return a number as JSON has it: six digits, None for NaN; infinity is a word."""
    if pd.isna(value):
        return None
    number = float(value)
    return float(f"{number:.6g}") if math.isfinite(number) else ("inf" if number > 0 else "-inf")  # type: ignore[return-value]


def _finite(value: Any) -> Any:
    """Return what JSON can hold: None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@cache
def _template() -> str:
    def read(name: str) -> str:
        return (_HERE / name).read_text(encoding="utf-8")

    decoder = read("decode.js")
    for name, value in (
        ("ALPHABET", coding.ALPHABET), ("LIMITS", json.dumps(coding.LIMITS)), ("LANES", str(coding.LANES)),
    ):  # fmt: skip
        decoder = decoder.replace(f"%{name}%", value)
    page = read("page.html").replace("%STYLE%", read("page.css")).replace("%DECODER%", decoder)
    return page.replace("%SCRIPT%", "\n".join(map(read, SCRIPTS)))


def _filled(facts: Mapping[str, Any]) -> str:
    # A "<" in a name must not end the script; within JSON it can be written so.
    text = json.dumps(_finite(facts), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    before, after = _template().split("%FACTS%")
    return before + text + after
