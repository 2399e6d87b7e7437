"""The comparison of training-free methods: who is compared where, what is kept, and that it runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from models import CrossBilateral, JointBilateral
from models.classical.sequence_filter import SequenceFilter
from models.denoiser import Denoised, Denoiser
from tests.benchmarks import classical_quality, figure10, sequence_quality
from tests.benchmarks.classical_frames import Still
from tests.benchmarks.classical_kept import Entry, Kept, described, identity
from tests.benchmarks.classical_quality import METHODS, Method, Runner, build, scores, trained
from tests.benchmarks.classical_tables import Result, complete, costs, means, report, rows_of
from tests.benchmarks.crops import SIDE, window
from tests.models.frames import random_buffers

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")


class Halved(Denoiser):
    """Half of the input, and a count of calls."""

    inputs = ("color",)
    calls = 0

    def forward(self, buffers):
        Halved.calls += 1
        return Denoised(0.5 * buffers["color"])


class Absent(Denoiser):
    """Reads what no still has."""

    inputs = ("visibility",)


def still(size: int = 24, name: str = "room/0", split: bool = True, seed: int = 0) -> Still:
    """Return a still of random buffers: with halves and variances of everything, or of nothing."""
    generator = torch.Generator().manual_seed(seed)

    def image(channels: int) -> torch.Tensor:
        return torch.rand(1, channels, size, size, generator=generator)

    buffers = {"exposure": torch.tensor([2.0])}
    for base, channels in {"color": 3, "normal": 3, "albedo": 3, "depth": 1}.items():
        a, b = image(channels), image(channels)
        buffers[base] = 0.5 * (a + b)
        if split:
            buffers |= {f"{base}_a": a, f"{base}_b": b}
        if split or base != "color":
            buffers[f"{base}_variance"] = 0.25 * (a - b).square()
    buffers["irradiance"] = buffers["color"] / buffers["albedo"].clamp_min(0.1)
    noise = {"color_noise": "measured", "feature_noise": "measured"}
    if not split:
        noise = {"color_noise": "estimated", "feature_noise": "variance"}
    reference = image(3)
    return Still(name, 32, buffers, reference, torch.zeros_like(reference), noise)


def result(name: str, spp: int, **values: float) -> Result:
    """Return a still in which every metric of a method has one value."""
    metrics = ("MSE", "relMSE", "PSNR", "SSIM")
    entries = {n: Entry(dict.fromkeys(metrics, v), 2 * v, 3_000_000) for n, v in values.items()}
    return Result(name, spp, 1_000_000, entries)


def test_every_distance_is_to_the_best_of_those_that_a_still_has():
    stills = [{"a": {"MSE": 1.0}, "b": {"MSE": 2.0}}, {"b": {"MSE": 4.0}, "c": {"MSE": 2.0}}]
    assert figure10.panel(stills, "MSE", ["a", "b", "c"]).values == {"a": [1], "b": [2, 2], "c": [1]}
    assert figure10.summary(stills, "MSE", ["b"])["b"].mean == 1


def test_figure_sets_methods_beside_each_other_on_the_same_stills():
    stills = [result("s", 4, a=1, b=2, c=3), result("t", 4, a=2, b=1)]
    listed = [{n: e.scores for n, e in r.entries.items()} for r in stills]
    rows = figure10.drawn({"as rendered": listed}, ["a", "b", "c", "never"])
    whole, common = ([list(panel.values.values()) for panel in panels] for panels in rows.values())
    assert whole[0] == [[1, 2], [2, 1]]
    assert common[0] == [[1], [2], [3]]
    assert list(figure10.drawn({"as rendered": listed[1:]}, ["a", "b"])) == ["as rendered"]


def test_means_and_costs_say_over_how_many_stills_they_go(capsys):
    results = [result("s", 4, input=8, a=1, b=2), result("t", 4, input=6, a=3)]
    assert means(results)["a"] == {"stills": 2, "MSE": 2, "relMSE": 2, "PSNR": 2, "SSIM": 2}
    assert means(results)["b"]["stills"] == 1
    assert [r.still for r in complete(results, ["a", "b"])] == ["s"]
    assert costs(results)["a"] == {"stills": 2, "seconds": 4, "MB": 3, "s per MP": 4, "MB per MP": 3}
    report("as rendered", results, ["a", "b", "c"], ["a"])
    printed = capsys.readouterr().out
    assert "c left out, since no still has its buffers" in printed
    assert printed.count("means") == 2
    assert "stills with all methods, 4 samples per pixel: means" in printed


def test_rows_compare_ours_with_methods_that_all_stills_have():
    results = [result("s", 4, ours=2, other=1, rare=0.5), result("t", 4, ours=3, other=4)]
    rows = {row["name"]: row for row in rows_of("x", results, ["ours", "other", "rare"], ["ours"])}
    assert "x, 4 spp, rare: PSNR (1 of 2 stills)" in rows
    entry = rows["x, relMSE: mean of ours's distance / least of the others"]
    assert (entry["value"], entry["meets"]) == (pytest.approx(1.5 / (7 / 6)), False)
    entry = rows["x, PSNR: mean of ours's distance / least of the others"]
    assert (entry["value"], entry["meets"]) == (1, True)


def test_other_that_is_the_best_everywhere_is_infinitely_closer():
    rows = {
        row["name"]: row
        for row in rows_of("x", [result("s", 4, ours=1, other=2)], ["ours", "other"], ["ours"])
    }
    entry = rows["x, PSNR: mean of ours's distance / least of the others"]
    assert (entry["value"], entry["meets"]) == (math.inf, False)


def test_run_that_was_cut_off_computes_what_is_missing_and_keeps_crops(tmp_path):
    first = Runner({"half": Method(Halved)}, tmp_path)
    seen = still(SIDE)
    Halved.calls = 0
    before = first.result("as rendered", seen)
    count = Halved.calls
    again = Runner({"half": Method(Halved), "half too": Method(Halved)}, tmp_path).result("as rendered", seen)
    assert list(again.entries) == ["input", "half", "half too"]
    assert Halved.calls == 2 * count
    assert again.entries["half"].scores == before.entries["half"].scores
    assert np.array_equal(again.entries["half"].crop, before.entries["half"].crop)
    assert np.allclose(2 * again.entries["half"].crop, again.entries["input"].crop)
    Runner({"half": Method(Halved)}, tmp_path).result("as rendered", still(SIDE, seed=1))
    assert Halved.calls == 3 * count


def test_entries_of_another_method_or_image_do_not_count(tmp_path):
    image = torch.ones(1, 3, 4, 4)
    told = {"a": identity("NLM window=1", image)}
    assert len({told["a"], identity("NLM window=2", image), identity("NLM window=1", 2 * image)}) == 3
    kept = Kept(tmp_path)
    kept.save("s", {"a": Entry({"MSE": 1.0}, 1.0, 2)}, told)
    assert kept.load("s", told) == {"a": Entry({"MSE": 1.0}, 1.0, 2)}
    assert kept.load("s", {"a": "other"}) == {}
    assert Kept(None).load("s", told) == {}


def test_method_without_its_buffers_is_left_out():
    assert build(Method(Absent), still()) is None
    found = Runner({"absent": Method(Absent), "RHF": METHODS["RHF"]}, None).result("as rendered", still(SIDE))
    assert list(found.entries) == ["input"]


def test_trained_method_is_loaded_from_its_checkpoint_and_told_by_its_content(tmp_path):
    path = tmp_path / "best.ckpt"
    tree = {"class_path": "models.JointBilateral", "init_args": {"temporal": False}}
    torch.save({"hyper_parameters": {"net": tree}, "state_dict": {}}, path)
    method, seen = trained(path), still()
    net = build(method, seen)
    assert isinstance(net, JointBilateral)
    assert not net.temporal
    before = described(method.denoiser, method.options)
    torch.save({"hyper_parameters": {"net": tree}, "state_dict": {}, "epoch": 3}, path)
    assert described(method.denoiser, method.options) != before


@pytest.mark.parametrize("split", [True, False])
@pytest.mark.parametrize("name", [name for name in METHODS if name != "RHF"])
def test_every_method_denoises_stills_with_and_without_halves(name, split):
    seen = still(16, split=split)
    net = build(METHODS[name], seen)
    assert net is not None
    assert torch.isfinite(net({n: seen.buffers[n] for n in (*net.inputs, "exposure")}).color).all()


def test_scores_of_the_reference_are_perfect_and_of_a_constant_error_known():
    seen = still()
    assert scores(seen.reference, seen)["relMSE"] == 0
    moved = scores(seen.reference + 0.25, seen)
    assert moved["MSE"] == pytest.approx(0.25)
    assert moved["relMSE"] == pytest.approx(float((0.0625 / (seen.reference**2 + 0.01)).mean()), rel=1e-5)


def test_crop_is_where_detail_is():
    image = torch.full((1, 3, 160, 240), 0.25)
    image[..., 80:140, 150:210] = torch.rand(60, 60)
    image[..., :, :40] = 0.0
    rows, columns = window(image)
    assert rows.start <= 80
    assert rows.stop >= 140
    assert columns.start <= 150
    assert columns.stop >= 210


def test_state_of_a_frame_is_handed_to_the_next():
    class Counting(SequenceFilter):
        inputs = ("irradiance",)

        def forward(self, buffers, state=None):
            count = (state["count"] if state else torch.zeros(1)) + 1
            return Denoised(buffers["irradiance"] * count, {"count": count})

    buffers = [random_buffers(1, 16, 16) for _ in range(3)]
    found = list(sequence_quality._carried(Counting(), sequence_quality.Clip([], buffers)))
    for number, (image, given) in enumerate(zip(found, buffers, strict=True), 1):
        assert torch.equal(image, number * given["irradiance"])


def test_sequences_are_scored_with_the_reference_at_the_top(monkeypatch, tmp_path):
    chosen = {n: sequence_quality.METHODS[n] for n in ("input", "accumulated", "SVGF", "reference")}
    monkeypatch.setattr(sequence_quality, "METHODS", chosen)
    monkeypatch.setattr(sequence_quality.FrameSet, "scenes", lambda self: ["classroom"])
    whole = sequence_quality.clip
    monkeypatch.setattr(
        sequence_quality, "clip", lambda *given: sequence_quality.Clip(*(part[:3] for part in whole(*given)))
    )
    rows = {row["name"]: row["value"] for row in sequence_quality.run(tmp_path / "page.png")}
    order = [rows[f"average, {name}: SSIM"] for name in chosen]
    assert order == sorted(order)
    assert order[-1] == 1
    assert rows["classroom, reference: flicker"] == 0
    assert rows["classroom, SVGF: flicker"] < rows["classroom, input: flicker"]
    assert (tmp_path / "page.png").is_file()


def test_comparison_runs_and_writes_its_pictures(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(classical_quality, "left_out", lambda: ["left out: nothing"])
    monkeypatch.setattr(
        classical_quality, "stills", lambda spp, limit: iter([still(SIDE)] if spp == 32 else [])
    )
    chosen = {"half": Method(Halved), "NFOR public": Method(CrossBilateral)}
    monkeypatch.setattr(classical_quality, "METHODS", chosen)
    rows = classical_quality.run(tmp_path / "figure.png", tmp_path / "page.png", kept=None)
    assert {"page_as_rendered_32.png", "page_fireflies_limited_32.png"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert (tmp_path / "figure.png").is_file()
    assert any("NFOR public's distance" in row["name"] for row in rows)
    assert not (tmp_path / "page_as_rendered_4.png").exists()
