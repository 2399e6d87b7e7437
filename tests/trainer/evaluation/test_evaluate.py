"""`trainer evaluate` on a miniature: what it writes, what it says where parts fail, that it goes on."""

import json
import pickle
import sys

import numpy as np
import OpenEXR
import pandas as pd
import pytest
import torch

from data.exr import write_frame
from data.frame import Frame
from data.jobs import run_elsewhere
from models.denoiser import Denoised
from tests.models.frames import split_buffers
from trainer.cli import main
from trainer.evaluation.noisy import Noisy
from trainer.metrics.functional import psnr_wskp
from trainer.metrics.measures import SCORES

SIZE = (24, 32)


class Halved(Noisy):
    """Returns half of the input."""

    def forward(self, buffers):
        return Denoised(buffers["color"] / 2)


class Dies(Noisy):
    """Ends its process at the second frame."""

    seen = 0

    def forward(self, buffers):
        Dies.seen += 1
        if Dies.seen > 1:
            import os

            os._exit(9)
        return Denoised(buffers["color"])


class Holes(Noisy):
    """Returns NaN in one pixel of the frames that are brighter at their corner."""

    def forward(self, buffers):
        color = buffers["color"].clone()
        if float(color[0, 0, 0, 0]) > float(color[0, 0, -1, -1]):
            color[0, :, 3, 4] = float("nan")
        return Denoised(color)


class Greedy(Noisy):
    """Reads what no frame of the miniature has."""

    inputs = ("color", "specular")


HERE = __name__


@pytest.fixture
def frames(tmp_path):
    """Three frames of 32x24, the last without a reference."""
    folder = tmp_path / "frames"
    for index in range(3):
        made = split_buffers(1, *SIZE, seed=index)
        names = ["color", "albedo", "normal", *(["reference"] if index < 2 else [])]
        buffers = {n: np.ascontiguousarray(made[n][0].permute(1, 2, 0).numpy()) for n in names}
        write_frame(Frame(buffers, "room", index, exposure=1.0, spp=4), folder / f"f{index}.exr", single=True)
    return folder


def evaluate(monkeypatch, frames, output, *arguments):
    where = ("--data", str(frames), "--output", str(output), "--no-track")
    monkeypatch.setattr(sys, "argv", ["trainer", "evaluate", *where, *arguments])
    return main()


def test_rows_tables_and_pictures_are_written(monkeypatch, frames, tmp_path, capsys):
    output = tmp_path / "out"
    models = ("--model", f"half={HERE}.Halved", "--model", f"same={HERE}.Noisy")
    assert (
        evaluate(monkeypatch, frames, output, *models, "--metric", "psnr_wskp", "--metric", "smape_wskp") == 0
    )
    rows = pd.read_parquet(output / "rows.parquet")
    assert list(rows["method"]) == ["input"] * 3 + ["half"] * 3 + ["same"] * 3
    made = split_buffers(1, *SIZE, seed=1)
    expected = float(psnr_wskp(made["color"] / 2, made["reference"]))
    half = rows[rows["method"] == "half"].set_index("name")
    assert half.loc["f1", "psnr_wskp"] == pytest.approx(expected, abs=1e-4)
    assert rows.loc[~rows["reference"], "psnr_wskp"].isna().all()
    assert (output / "images/half/f2.exr").is_file()
    assert "| half |" in (output / "tables/overview_wskp.md").read_text()
    record = json.loads((output / "evaluation.json").read_text())
    assert [m["status"] for m in record["methods"]] == ["done", "done"]
    assert [m["name"] for m in record["metrics"]] == ["psnr_wskp", "smape_wskp"]
    assert "1 frame has no reference" in capsys.readouterr().err


@pytest.mark.slow
def test_what_fails_is_said_and_the_others_finish(monkeypatch, frames, tmp_path, capsys):
    output = tmp_path / "out"
    models = [
        part
        for name in ("Dies", "Greedy", "Holes", "Halved")
        for part in ("--model", f"{name}={HERE}.{name}")
    ]
    (tmp_path / "torn.ckpt").write_bytes(b"PK")
    arguments = (*models, "--model", f"torn={tmp_path / 'torn.ckpt'}", "--metric", "psnr_wskp")
    assert evaluate(monkeypatch, frames, output, *arguments) == 0
    record = json.loads((output / "evaluation.json").read_text())
    told = {m["label"]: (m["status"], m["reason"]) for m in record["methods"]}
    assert told["Halved"] == ("done", None)
    assert told["Dies"][0] == "failed"
    assert "ended with 9" in told["Dies"][1]
    assert told["Greedy"][0] == "skipped"
    assert "specular" in told["Greedy"][1]
    assert told["torn"][0] == "skipped"
    assert "torn.ckpt" in told["torn"][1]
    rows = pd.read_csv(output / "rows.csv").set_index(["method", "name"])
    holes = rows.loc["Holes"]
    assert set(holes["status"]) == {"done", "nonfinite"}
    assert (holes.loc[holes["status"] == "nonfinite", "nonfinite"] == 1).all()
    assert holes.loc[holes["status"] == "nonfinite", "psnr_wskp"].isna().all()
    assert rows.loc[("Dies", "f2"), "status"] == "failed"
    assert evaluate(monkeypatch, frames, output, *arguments, "--strict") == 1
    assert "specular" in capsys.readouterr().err


class FailsFirst(Noisy):
    """Returns the input, but fails at the brightest frame."""

    def forward(self, buffers):
        if float(buffers["color"].mean()) > 20:
            raise ValueError("too bright")
        return Denoised(buffers["color"])


def test_one_frame_that_fails_changes_nothing_for_the_others(monkeypatch, tmp_path, capsys):
    """Its sequence has one exposure, chosen by its first frame, which is the one that fails."""
    folder = tmp_path / "frames"
    for index in range(3):
        made = split_buffers(1, *SIZE, seed=index)
        names = ["color", "albedo", "normal", "reference"]
        buffers = {n: np.ascontiguousarray(made[n][0].permute(1, 2, 0).numpy()) for n in names}
        if index == 0:
            buffers["color"] = buffers["color"] * 100
        write_frame(Frame(buffers, "room", index), folder / f"f{index}.exr", single=True)
    with OpenEXR.File(str(folder / "f1.exr"), separate_channels=True) as file:
        file.parts[0].channels["reference.R"].pixels[2, 3:5] = np.nan
        file.write(str(folder / "f1.exr"))
    output = tmp_path / "out"
    models = ("--model", f"first={HERE}.FailsFirst", "--metric", "psnr_wskp", "--no-costs")
    assert evaluate(monkeypatch, folder, output, *models) == 0
    rows = pd.read_parquet(output / "rows.parquet").set_index(["method", "name"])
    assert list(rows.loc["first"]["status"]) == ["failed", "done", "done"]
    for name in ("f1", "f2"):
        for column in ("exposure", "psnr_wskp"):
            assert rows.loc[("first", name), column] == rows.loc[("input", name), column]
    assert list(rows.loc["input"]["repaired"]) == [0, 2, 0]
    said = capsys.readouterr().err
    assert "1 of 3 frames: " in said
    assert "1 references have NaN or Inf pixels" in said


@pytest.mark.slow
def test_it_goes_on_where_it_was_and_adds_methods(monkeypatch, frames, tmp_path):
    output = tmp_path / "out"
    first = ("--model", f"half={HERE}.Halved", "--metric", "psnr_wskp")
    assert evaluate(monkeypatch, frames, output, *first) == 0
    kept = (output / "rows.jsonl").read_text()
    (output / "rows.jsonl").write_text(kept + '{"method": "half", "cut')
    image = output / "images/half/f1.exr"
    before = image.stat().st_mtime_ns
    assert evaluate(monkeypatch, frames, output, *first, "--model", f"same={HERE}.Noisy") == 0
    assert image.stat().st_mtime_ns == before
    assert (output / "rows.jsonl").read_text().startswith(kept)
    assert list(pd.read_parquet(output / "rows.parquet")["method"].unique()) == ["input", "half", "same"]


@pytest.mark.slow
def test_other_metrics_are_taken_anew(monkeypatch, frames, tmp_path):
    output = tmp_path / "out"
    model = ("--model", f"half={HERE}.Halved")
    assert evaluate(monkeypatch, frames, output, *model, "--metric", "psnr_wskp") == 0
    assert evaluate(monkeypatch, frames, output, *model, "--metric", "smape_wskp") == 0
    rows = pd.read_parquet(output / "rows.parquet")
    assert rows.loc[rows["reference"], "smape_wskp"].notna().all()


class Runner:
    """Does jobs one after the other, in this process, as if each were on another machine."""

    workers = cores = 1

    def __init__(self, fails=""):
        self.fails, self.names = fails, []

    def __call__(self, jobs, done):
        failed = []
        for job in jobs:
            function, arguments = pickle.loads(pickle.dumps((job.function, job.arguments)))
            assert all(path.exists() for path in job.sees)
            self.names.append(job.name)
            if self.fails and job.name.startswith(self.fails):
                failed.append(job.name)
            else:
                done(job, function(*arguments))
        if failed:
            raise ValueError(f"{len(failed)} jobs failed ({', '.join(failed)}: the node was lost)")


def test_jobs_elsewhere_give_the_same_rows(monkeypatch, frames, tmp_path, capsys):
    models = ("--model", f"half={HERE}.Halved", "--model", f"same={HERE}.Noisy", "--metric", "psnr_wskp")
    assert evaluate(monkeypatch, frames, tmp_path / "here", *models, "--no-costs") == 0
    runner = Runner(fails="same")
    with run_elsewhere(runner):
        assert evaluate(monkeypatch, frames, tmp_path / "there", *models) == 0
        assert "node was lost" in capsys.readouterr().err
        runner.fails, runner.names = "", []
        assert evaluate(monkeypatch, frames, tmp_path / "there", *models) == 0
    assert [name.partition(",")[0] for name in runner.names] == ["same"]  # the rest was there
    here, there = (
        pd.read_parquet(tmp_path / kind / "rows.parquet").drop(columns="seconds")
        for kind in ("here", "there")
    )
    pd.testing.assert_frame_equal(here, there)


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (("--model", "NLM", "--metric", "psnr"), 2, "did you mean"),
        (("--model", "NLM", "--metric", "lpips"), 2, "left out"),
        (("--option", "a=b", "--model", "NLM"), 2, "after the --model"),
        (("--model", "x=NLM", "--model", "x=NFOR"), 1, "another column"),
        (("--model", "NLM", "--device", "cuda:9"), 1, "device"),
        (("--model", "NFORR"), 1, "did you mean NFOR"),
        (("--model", "runs/none/best.ckpt"), 1, "no such file"),
        (("--model", "CrossBilateral", "--option", "noise=estimated"), 2, "has no option"),
    ],
)
def test_mistakes_are_told_before_any_work(monkeypatch, frames, tmp_path, capsys, arguments, code, told):
    assert ended(evaluate, monkeypatch, frames, tmp_path / "out", *arguments) == code
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out" / "rows.jsonl").exists()


def ended(command, *arguments):
    """Exit code of a command, also where argparse ends it."""
    try:
        return command(*arguments)
    except SystemExit as end:
        return end.code


def test_a_folder_with_something_else_is_left_alone(monkeypatch, frames, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("")
    assert evaluate(monkeypatch, frames, tmp_path / "out", "--model", "NLM") == 1
    assert "something else" in capsys.readouterr().err


@pytest.mark.parametrize("name", SCORES)
def test_every_metric_has_a_definition_and_its_direction(name):
    score = SCORES[name]
    assert len(score.doc) > 40
    if score.function is None:
        return
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(1, 3, 180, 180, generator=generator)
    noise = torch.randn(1, 3, 180, 180, generator=generator)
    better, worse = (score.function(reference * (1 + s * noise), reference).item() for s in (0.05, 0.4))
    assert (better > worse) == score.higher
