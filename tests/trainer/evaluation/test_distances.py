"""Distances to the best method, and the plots: what is drawn of which rows."""

import math
import statistics

import pytest

from tests.trainer.evaluation.test_tables import rows
from trainer.evaluation.distances import Distance, distance_table, distances, panel_of
from trainer.evaluation.plots import pareto, points_of, write_plots
from trainer.evaluation.tables import Scored


def test_ratios_where_less_is_better_and_differences_where_more_is():
    stills = [{"a": 2.0, "b": 3.0}, {"a": 8.0, "b": 4.0}, {"a": 1.0}, {"a": 1.0, "b": math.nan}]
    assert distances(stills, ["a", "b"], higher=False) == {"a": [1.0, 2.0], "b": [1.5, 1.0]}
    assert distances(stills, ["a", "b"], higher=True) == {"a": [1.0, 0.0], "b": [0.0, 4.0]}


def test_an_error_of_zero_is_infinitely_better_than_others():
    assert distances([{"a": 0.0, "b": 1.0, "c": 0.0}], ["a", "b", "c"], higher=False) == {
        "a": [1.0], "b": [math.inf], "c": [1.0],
    }  # fmt: skip


def scored(metric="psnr_wskp", **values):
    found = {
        (method, scene): frames
        for method, scenes in values.items()
        for scene, frames in scenes.items()
    }  # fmt: skip
    return Scored(rows(found, metric), list(values), [metric])


def test_what_is_infinitely_worse_is_in_the_table_and_not_in_the_plot():
    made = scored("relmse_layer", a={"s": [0.0], "t": [1.0]}, b={"s": [1.0], "t": [2.0]})
    assert [cell.mean for cell in distance_table(made, "relmse_layer").rows[-2][1]] == [1.0, math.inf]
    assert not panel_of(made, "relmse_layer").finite


def test_a_table_has_each_scene_then_mean_and_standard_deviation():
    table = distance_table(
        scored(input={"s": [1], "t": [1]}, a={"s": [20, 22], "t": [30]}, b={"s": [19, 21], "t": [34]}),
        "psnr_wskp",
    )
    assert table.columns == ("a", "b")
    found = {head: [cell.mean for cell in cells] for head, cells in table.rows}
    assert found == {"s": [0, 1], "t": [4, 0], "mean": [2, 0.5], "standard deviation": [2, 0.5]}
    assert [cell.rank for cell in table.rows[-2][1]] == [2, 1]
    assert Distance.of([0, 4]) == (2, statistics.pstdev([0, 4]))


def test_a_method_that_failed_everywhere_hides_no_scene_and_one_that_failed_in_a_scene_hides_that():
    everywhere = scored(a={"s": [20]}, b={"s": [21]}, c={"s": [math.nan]})
    assert list(panel_of(everywhere, "psnr_wskp").values) == ["a", "b"]
    once = scored(a={"s": [20], "t": [20]}, b={"s": [21], "t": [math.nan]})
    assert panel_of(once, "psnr_wskp").values == {"a": [1.0], "b": [0.0]}
    assert panel_of(scored(a={"s": [20]}), "psnr_wskp") is None


def test_the_pareto_front_has_what_nothing_beats_in_both():
    points = [(1.0, 20.0), (2.0, 19.0), (3.0, 25.0), (3.0, 24.0), (4.0, 25.0)]
    assert pareto(points, higher=True) == [(1.0, 20.0), (3.0, 25.0)]
    assert pareto(points, higher=False) == [(1.0, 20.0), (2.0, 19.0)]


def test_a_method_without_every_frame_or_time_is_no_point():
    table = scored(a={"s": [20, 22]}, b={"s": [20, math.nan]}, c={"s": [25, 26]})
    (point,) = points_of(table, "psnr_wskp", {"a": 2.0, "b": 1.0, "c": math.nan})
    assert (point.label, point.seconds, point.value) == ("a", 2.0, 21.0)


@pytest.mark.parametrize("metric", ["psnr_wskp", "relmse_rousselle"])
@pytest.mark.parametrize("counts", [(4,), (4, 16)])
def test_plots_are_written_for_papers_and_for_pages_and_old_ones_removed(tmp_path, counts, metric):
    import pandas as pd

    def of(spp):
        return rows({(m, "s"): [20.0 + i + spp] for i, m in enumerate(["input", "a", "b"])}, metric, spp)

    parts = [of(spp) for spp in counts]
    made = pd.concat(parts, ignore_index=True)
    made["name"] = [f"s/f{spp}" for spp in made["spp"]]
    made = made.assign(status="done", seconds=1.0, width=64, height=32)
    table = Scored(made, ["input", "a", "b"], [metric])
    (tmp_path / "plots").mkdir()
    (tmp_path / "plots" / "convergence_ssim_wskp.png").write_bytes(b"old")
    costs = {"a": {"seconds_per_megapixel": 0.5}}

    written = write_plots(tmp_path, made, table, costs)

    names = {path.stem for path in written}
    several = {f"convergence_{metric}"} if len(counts) > 1 else set()
    assert names == {"distance", f"time_{metric}"} | several
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {path.name for path in written}
    for path in written:
        assert path.read_bytes()[:4] in (b"\x89PNG", b"%PDF")


def test_an_evaluation_in_which_nothing_worked_has_no_plots(tmp_path):
    made = rows({("input", "s"): [20.0], ("a", "s"): [math.nan]})
    made = made.assign(status="failed", seconds=math.nan, width=64, height=32)
    assert write_plots(tmp_path, made, Scored(made, ["input", "a"], ["psnr_wskp"]), {}) == []
