"""Tables and curves of an ablation, from rows that are made up."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from PIL import Image

from trainer.ablation.plan import CURVE, PAIRS, Ablation, Layout, Variant
from trainer.ablation.plots import curve_figure, write_plots
from trainer.ablation.tables import Measured, curve, overview, pairs, tables_of, write_tables
from trainer.evaluation.cells import Table

LAYOUTS = {
    "table5": Layout("table5", PAIRS, "Pairs"),
    "figure10": Layout("figure10", CURVE, "Curve", "kernels"),
    "empty": Layout("empty", CURVE, "Nothing", "x"),
}
VARIANTS = (
    Variant("six", ("x",), {}, {"table5": ("WSKP", "w/"), "figure10": 6.0}),
    Variant("six plain", ("x",), {}, {"table5": ("WSKP", "w/o")}),
    Variant("one", ("x",), {}, {"figure10": 1.0}),
    Variant("lost", ("x",), {}, {"table5": ("KP", "w/"), "figure10": 2.0}),
)
ABLATION = Ablation("ablation", "All of them", VARIANTS, LAYOUTS)
PSNR = {"input": 10.0, "six": 30.0, "six plain": 29.0, "one": 25.0}
SECONDS = {"six": 2.0, "one": 1.0}


def measured() -> Measured:
    """Two frames of 200x100 in each of two scenes: PSNR of the first is 0.5 lower, of the second higher."""
    rows = []
    for method, psnr in PSNR.items():
        for scene, more in (("room", 0.0), ("hall", 4.0)):
            rows += [
                {"method": method, "scene": scene, "name": f"{scene}/{i}", "reference": True, "spp": 1,
                 "width": 200, "height": 100, "psnr_wskp": psnr + more + i - 0.5, "ssim_wskp": psnr / 40}
                for i in range(2)
            ]  # fmt: skip
    methods: list[dict[str, Any]] = [
        {"label": name, "status": "done", "reason": None, "parameters": 1000 + len(name), "deployed": 500,
         "step": 30,
         "cost": None if name not in SECONDS else {
             "seconds_per_megapixel": SECONDS[name], "spread": [SECONDS[name] - 0.1, SECONDS[name] + 0.1],
             "device": "cpu", "threads": 2, "calls": 7, "others": 0.31 if name == "one" else 0.05}}
        for name in ("six", "six plain", "one")
    ]  # fmt: skip
    return Measured.of(
        pd.DataFrame(rows), {"methods": methods}, ABLATION.metrics, {"lost": "failed: no memory"}
    )


def texts(table: Table) -> dict[str, list[str]]:
    return {head: [cell.text() for cell in cells] for head, cells in table.rows}


def test_the_overview_has_every_variant_with_metrics_parameters_and_time_of_a_frame() -> None:
    table = overview(ABLATION, measured())
    assert table.columns == ("psnr_wskp ↑", "ssim_wskp ↑", "parameters", "deployed", "step", "ms per frame ↓")
    assert texts(table) == {
        "input": ["12.00", "0.2500", "-", "-", "-", "-"],
        "six": ["32.00", "0.7500", "1,003", "500", "30", "40.0"],  # 2 s per megapixel, 0.02 megapixels
        "six plain": ["31.00", "0.7250", "1,009", "500", "30", "-"],
        "one": ["27.00", "0.6250", "1,003", "500", "30", "20.0"],
        "lost": ["-", "-", "-", "-", "-", "-"],
    }
    ranks = {head: [cell.rank for cell in cells] for head, cells in table.rows}
    assert ranks["six"] == [1, 1, 0, 0, 0, 2]
    assert ranks["one"] == [3, 3, 0, 0, 0, 1]
    assert ranks["input"] == [0] * 6
    assert "lost: failed: no memory" in table.notes
    (timing,) = (note for note in table.notes if note.startswith("Time of a frame of 200x100 pixels"))
    assert "cpu, 2 threads" in timing
    assert timing.endswith("Other programs took up to 31% of all cores meanwhile.")


def test_what_broke_on_its_way_is_told_and_times_say_every_number_of_threads() -> None:
    facts = {"parameters": 2, "deployed": 1}
    cost = {"seconds_per_megapixel": 1.0, "spread": [1.0, 1.0], "device": "cpu", "others": 0.0}
    methods = [
        {"label": "six", "status": "failed", "reason": "SIGSEGV", "cost": {**cost, "threads": 1}, **facts},
        {"label": "six plain", "status": "done", "reason": "1 of 4 frames: NaN", "cost": None, **facts},
        {"label": "one", "status": "done", "reason": None, "cost": {**cost, "threads": 2}, **facts},
    ]
    found = Measured.of(measured().scored.rows, {"methods": methods}, ABLATION.metrics, {})
    assert found.failed == {"six": "SIGSEGV", "six plain": "1 of 4 frames: NaN"}
    assert "cpu, 1 thread or cpu, 2 threads, warm" in found.timing()


def test_pairs_stand_beside_each_other_for_every_scene_and_metric_as_in_table_5() -> None:
    table = pairs(ABLATION, LAYOUTS["table5"], measured())
    assert table.columns == ("psnr_wskp ↑ w/", "psnr_wskp ↑ w/o", "ssim_wskp ↑ w/", "ssim_wskp ↑ w/o")
    assert texts(table) == {
        "room (WSKP)": ["30.00", "29.00", "0.7500", "0.7250"],
        "hall (WSKP)": ["34.00", "33.00", "0.7500", "0.7250"],
        "average (WSKP)": ["32.00", "31.00", "0.7500", "0.7250"],
        "room (KP)": ["-", "-", "-", "-"],
        "hall (KP)": ["-", "-", "-", "-"],
        "average (KP)": ["-", "-", "-", "-"],
    }
    assert [cell.rank for cell in table.rows[0][1]] == [1, 2, 1, 2]


def test_a_curve_is_sorted_by_its_axis_and_lacks_what_failed() -> None:
    table = curve(ABLATION, LAYOUTS["figure10"], measured())
    assert (table.corner, table.columns) == ("kernels", ("psnr_wskp ↑", "ssim_wskp ↑", "ms per frame ↓"))
    assert texts(table) == {
        "1 (one)": ["27.00", "0.6250", "20.0"],
        "2 (lost)": ["-", "-", "-"],
        "6 (six)": ["32.00", "0.7500", "40.0"],
    }
    figure = curve_figure(ABLATION, LAYOUTS["figure10"], measured())
    left, right = (axes.lines[0].get_xydata().tolist() for axes in figure.axes)
    assert [len(axes.collections) for axes in figure.axes] == [0, 1]  # times have bars
    assert left == [[1.0, 27.0], [6.0, 32.0]]
    assert right == [[1.0, pytest.approx(20.0)], [6.0, pytest.approx(40.0)]]
    assert [axes.get_xlabel() for axes in figure.axes] == ["kernels"] * 2
    assert figure.axes[0].get_ylabel() == "psnr_wskp, higher is better"
    assert figure.axes[1].get_ylabel() == "ms per frame of 200x100"


def test_tables_and_plots_are_written_in_every_format(tmp_path: Path) -> None:
    tables = tables_of(ABLATION, measured())
    assert [table.name for table in tables] == ["variants", "table5", "figure10"]
    write_tables(tmp_path, tables)
    names = {path.name for path in (tmp_path / "tables").iterdir()}
    assert names == {f"{t}{s}" for t in ("variants", "table5", "figure10") for s in (".md", ".tex", ".csv")}
    assert "| six | **32.00**" in (tmp_path / "tables/variants.md").read_text()
    assert r"six & \textbf{32.00}" in (tmp_path / "tables/variants.tex").read_text()
    lines = csv.DictReader(io.StringIO((tmp_path / "tables/figure10.csv").read_text()))
    found = {line["kernels"]: float(line["mean"]) for line in lines if line["column"].startswith("psnr")}
    assert found["6 (six)"] == 32.0
    assert math.isnan(found["2 (lost)"])
    written = write_plots(tmp_path, ABLATION, measured())
    assert [path.name for path in written] == ["figure10.png", "figure10.pdf"]
    with Image.open(written[0]) as picture:
        assert picture.width > 2 * picture.height
    assert written[1].read_bytes().startswith(b"%PDF")
