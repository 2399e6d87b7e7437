import csv
import io
import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from trainer.evaluation.cells import Cell
from trainer.evaluation.layouts import tables_of
from trainer.evaluation.tables import Scored, average_of, cell_of, ranked


def rows(values, metric="psnr_wskp", spp=1):
    """Rows of (method, scene) → values of its frames."""
    made = []
    for (method, scene), column in values.items():
        for frame, value in enumerate(column):
            name = f"{scene}/f{frame:03d}"
            made.append(
                {"method": method, "scene": scene, "name": name, "spp": spp, "reference": True, metric: value}
            )
    return pd.DataFrame(made)


def test_a_scene_has_the_mean_of_its_frames_with_students_interval():
    values = [20.0, 21.0, 23.0, 26.0]
    cell = cell_of(np.array(values), 4, "{:.2f}")
    low, high = stats.t.interval(0.95, 3, loc=np.mean(values), scale=stats.sem(values))
    assert cell.mean == 22.5
    assert (cell.mean - cell.half, cell.mean + cell.half) == pytest.approx((low, high))
    assert math.isnan(cell_of(np.array([20.0]), 1, "{:.2f}").half)


def test_an_average_weighs_scenes_alike():
    cells = [Cell(10.0, 1.0, 30), Cell(20.0, 1.0, 3)]
    assert average_of(cells, "{:.2f}").mean == 15.0


def test_the_interval_of_an_average_covers_the_truth_as_often_as_it_says():
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(400):
        scenes = [generator.normal(mean, spread, 6) for mean, spread in ((20, 1), (25, 3), (30, 0.2))]
        cell = average_of([cell_of(scene, 6, "{:.2f}") for scene in scenes], "{:.2f}")
        inside += abs(cell.mean - 25) < cell.half
    assert 0.92 < inside / 400 < 0.98


def test_frames_without_a_value_are_counted_and_not_averaged_away():
    scored = Scored(
        rows({("a", "s"): [20.0, math.nan, 22.0], ("b", "s"): [19.0, 19.0, 19.0]}), ["a", "b"], ["psnr_wskp"]
    )
    (head, (first, second)), *_ = scored.by_scene("psnr_wskp").rows
    assert head == "s"
    assert first.text() == "21.00 (1 missing)"
    assert (first.rank, second.rank) == (2, 1)  # whoever lacks frames is behind those that have all


def test_equal_values_share_a_rank_and_the_input_takes_no_part():
    scored = Scored(
        rows({("input", "s"): [99.0], ("a", "s"): [20.001], ("b", "s"): [20.002], ("c", "s"): [19.0]}),
        ["input", "a", "b", "c"],
        ["psnr_wskp"],
    )
    assert [cell.rank for cell in scored.by_scene("psnr_wskp").rows[0][1]] == [0, 1, 1, 2]


def test_lower_is_better_where_the_metric_says_so():
    cells = [Cell(0.2, count=1), Cell(0.1, count=1), Cell(math.nan)]
    assert [cell.rank for cell in ranked(cells, False, [True] * 3)] == [2, 1, 0]


def test_metrics_of_successive_frames_miss_nothing_in_a_first_frame():
    made = rows({("a", "s"): [math.nan, 0.1], ("b", "s"): [math.nan, 0.2]}, "flicker_gamma")
    scored = Scored(made, ["a", "b"], ["flicker_gamma"])
    assert [cell.missing for cell in scored.by_scene("flicker_gamma").rows[0][1]] == [0, 0]


def test_every_text_form_marks_best_and_second():
    made = rows({("a_1", "s"): [20.0, 21.0], ("b", "s"): [22.0, 23.0], ("c", "s"): [10.0, 10.0]})
    table = Scored(made, ["a_1", "b", "c"], ["psnr_wskp"]).by_scene("psnr_wskp")
    markdown, latex = table.markdown(), table.latex()
    assert "| s | <u>20.50</u> ± 6.35 | **22.50** ± 6.35 | 10.00 ± 0.00 |" in markdown
    assert r"s & \underline{20.50} $\pm$ 6.35 & \textbf{22.50} $\pm$ 6.35 & 10.00 $\pm$ 0.00 \\" in latex
    assert r"a\_1" in latex
    found = list(csv.DictReader(io.StringIO(table.csv())))
    assert [(row["scene"], row["column"], row["rank"]) for row in found[:3]] == [
        ("s", "a_1", "2"), ("s", "b", "1"), ("s", "c", "3"),
    ]  # fmt: skip
    assert float(found[0]["mean"]) == 20.5


def test_there_is_a_table_per_samples_per_pixel_only_where_they_differ():
    low, high = rows({("a", "s"): [20.0]}, spp=4), rows({("a", "t"): [30.0]}, spp=32)
    assert "spp_psnr_wskp" not in [t.name for t in tables_of(Scored(low, ["a"], ["psnr_wskp"]))]
    both = Scored(pd.concat([low, high]), ["a"], ["psnr_wskp"])
    table = next(t for t in tables_of(both) if t.name == "spp_psnr_wskp")
    assert [(head, cells[0].mean) for head, cells in table.rows] == [("4 spp", 20.0), ("32 spp", 30.0)]


def test_only_scenes_with_all_counts_are_compared_over_samples():
    parts = [({("a", "easy"): [30.0], ("a", "hard"): [20.0]}, 4), ({("a", "hard"): [24.0]}, 64)]
    made = pd.concat([rows(values, spp=spp) for values, spp in parts], ignore_index=True)
    made["name"] = [f"{scene}/{spp}" for scene, spp in zip(made["scene"], made["spp"], strict=True)]
    table = Scored(made, ["a"], ["psnr_wskp"]).by_spp("psnr_wskp")
    assert [(head, cells[0].mean) for head, cells in table.rows] == [("4 spp", 20.0), ("64 spp", 24.0)]


def test_small_errors_are_told_apart():
    made = rows({("a", "s"): [1.4e-5], ("b", "s"): [3.6e-5]}, "relmse_rousselle")
    first, second = Scored(made, ["a", "b"], ["relmse_rousselle"]).by_scene("relmse_rousselle").rows[0][1]
    assert (first.rank, second.rank) == (1, 2)
    assert (first.text(), second.text()) == ("1.4e-05", "3.6e-05")


def test_latex_has_no_letter_with_a_meaning_left():
    name = "a^2 ~ {x} $5 \\n"
    latex = Scored(rows({(name, "s"): [20.0]}), [name], ["psnr_wskp"]).by_scene("psnr_wskp").latex()
    assert r"a\textasciicircum{}2 \textasciitilde{} \{x\} \$5 \textbackslash{}n" in latex


def test_frames_without_reference_are_in_no_table():
    made = rows({("a", "s"): [20.0]})
    made.loc[1] = {**made.loc[0], "scene": "t", "name": "t/f000", "reference": False, "psnr_wskp": math.nan}
    assert Scored(made, ["a"], ["psnr_wskp"]).scenes == ["s"]
