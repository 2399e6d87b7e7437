"""`trainer ablate`: what it leaves, what it does again, what it refuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from trainer.ablation import fitting
from trainer.ablation.fitting import Fitted
from trainer.ablation.parent import alone
from trainer.ablation.variants import Training
from trainer.cli import main
from trainer.commands import evaluate
from trainer.runs import RUN_FILE, RunRecord
from trainer.spool.store import local_store, open_client

FILE = """
title: Sizes of kernels
config: wskp_bmfr.yaml
layouts:
  figure10: {kind: curve, title: Kernels, axis: fused kernels}
variants:
  - {name: one, options: {model.net.kernel_sizes: [3]}, places: {figure10: 1}}
  - {name: two, options: {model.net.kernel_sizes: [3, 5]}, places: {figure10: 2}}
"""


def ablate(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["trainer", "ablate", *arguments])
    return main()


@pytest.fixture
def stand_ins(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Trainings that are made up, of which those in `failing` fail, and an evaluation of them.

    Returns:
        `failing`, `lost` that leave no checkpoint, `skipped` by the evaluation, `tags` of the runs, and
        `words` that it was called with.
    """
    (workplace / "sizes.yaml").write_text(FILE)
    heard: dict[str, Any] = {"failing": set(), "skipped": set(), "lost": set()}

    def fit_all(
        trainings: Sequence[Training], identity: str, tags: Mapping[str, str], logs: Path, say: object
    ) -> list[Fitted]:
        heard["tags"] = dict(tags)
        found = []
        for training in trainings:
            name = training.variant.name
            run = workplace / "runs" / "sizes" / name
            (run / "checkpoints").mkdir(parents=True, exist_ok=True)
            if name not in heard["lost"]:
                (run / "checkpoints" / "best.ckpt").touch()
            failed = name in heard["failing"]
            found.append(Fitted(training, None if failed else run, "no memory" if failed else "", 1.0))
        return found

    def evaluation(args: Any) -> int:
        heard["words"] = args
        names = [text.partition("=")[0] for text, _ in args.models]
        place = {"scene": "room", "name": "f0", "reference": True, "spp": 1, "width": 100, "height": 50}
        scores = {name: 20.0 + number for number, name in enumerate(["input", *names])}
        rows = [{"method": m, "psnr_wskp": x, "ssim_wskp": x / 100, **place} for m, x in scores.items()]
        args.output.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_parquet(args.output / "rows.parquet")
        facts = {"reason": None, "parameters": 12, "deployed": 10, "cost": None}
        states = {name: "skipped" if name in heard["skipped"] else "done" for name in names}
        record = {"methods": [{"label": name, "status": states[name], **facts} for name in names]}
        (args.output / "evaluation.json").write_text(json.dumps(record))
        return 0

    monkeypatch.setattr(fitting, "fit_all", fit_all)
    monkeypatch.setattr(evaluate, "run", evaluation)
    return heard


def runs_of(workplace: Path) -> dict[str, Any]:
    client = open_client(local_store(workplace / "runs"))
    return {
        run.info.run_name: run
        for experiment in client.search_experiments()
        for run in client.search_runs([experiment.experiment_id])
    }


def test_variants_are_trained_below_one_run_evaluated_and_tabulated(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out", "--trainer.max_epochs", "2") == 0
    told = capsys.readouterr()
    assert "Sizes of kernels" in told.out
    words = stand_ins["words"]
    assert (words.data, words.split, words.metrics) == ("sample:bmfr", "test", ["psnr_wskp", "ssim_wskp"])
    models = [text for text, _ in words.models]
    assert models == [f"{n}={workplace}/runs/sizes/{n}/checkpoints/best.ckpt" for n in ("one", "two")]
    assert "| two | **22.00** | **0.2200** | 12 | 10 |" in (workplace / "out/tables/variants.md").read_text()
    assert {path.name for path in (workplace / "out/plots").iterdir()} == {"figure10.png", "figure10.pdf"}
    states = json.loads((workplace / "out/variants.json").read_text())
    assert [(state["name"], state["state"]) for state in states] == [("one", "trained"), ("two", "trained")]
    run = runs_of(workplace)["ablation out"]
    assert stand_ins["tags"] == {"mlflow.parentRunId": run.info.run_id}
    assert run.info.status == "FINISHED"
    assert run.data.tags["ablation"] == "sizes"
    assert (run.data.params["variants"], run.data.params["data"]) == ("2", "sample:bmfr")
    kept = {
        file.path for file in open_client(local_store(workplace / "runs")).list_artifacts(run.info.run_id)
    }
    assert kept == {"tables", "plots"}


def test_a_variant_that_failed_is_in_the_table_with_its_reason_and_the_exit_code_tells(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stand_ins["failing"] = {"one"}
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 1
    table = (workplace / "out/tables/variants.md").read_text()
    assert "| one | - | - | - | - | - |" in table
    assert "one: failed: no memory" in table
    assert "one: failed: no memory" in capsys.readouterr().err
    assert runs_of(workplace)["ablation out"].info.status == "FAILED"
    stand_ins["failing"] = set()
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 0  # again, in the same run
    assert runs_of(workplace)["ablation out"].info.status == "FINISHED"
    assert "failed" not in (workplace / "out/tables/variants.md").read_text()


def test_a_variant_that_the_evaluation_skips_makes_the_exit_code_1(
    stand_ins: dict[str, Any], workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_ins["skipped"] = {"two"}
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 1
    assert runs_of(workplace)["ablation out"].info.status == "FAILED"


def test_a_name_that_begins_with_a_hyphen_is_evaluated(
    stand_ins: dict[str, Any], workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (workplace / "sizes.yaml").write_text(FILE.replace("name: one", "name: -bn"))
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 0
    assert stand_ins["words"].models[0][0].startswith("-bn=")


def test_a_variant_whose_checkpoints_are_gone_does_not_keep_the_others_from_the_tables(
    stand_ins: dict[str, Any], workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_ins["lost"] = {"one"}
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 1
    table = (workplace / "out/tables/variants.md").read_text()
    assert "one: failed: " in table
    assert "holds no checkpoint; remove that folder to train again" in table
    assert "| two | **21.00**" in table


def test_nothing_is_evaluated_where_every_variant_failed(
    stand_ins: dict[str, Any], workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_ins["failing"] = {"one", "two"}
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 1
    assert "words" not in stand_ins
    assert not (workplace / "out/tables").exists()


def test_wrong_usage_ends_before_anything_is_made(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for words, code, said in (
        (("--config", "wskp_bmfr.yaml"), 2, "describes no ablation"),
        (
            ("--config", "none"),
            2,
            "ablations that ship: ablations/realtime.yaml, ablations/wskp_branches.yaml",
        ),
        (("--config", "sizes.yaml", "--trainr.max_epochs", "2"), 2, "variant 'one': unknown option"),
        (("--config", "sizes.yaml", "--config", "smke.yaml"), 2, "did you mean smoke.yaml"),
        (("--config", "sizes.yaml", "--frames", "nowhere"), 1, "name a data set with --frames ROOT"),
    ):
        assert ablate(monkeypatch, "--output", "out", *words) == code
        assert said in capsys.readouterr().err
        assert not (workplace / "out").exists()


def test_a_folder_of_something_else_is_left_alone(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (workplace / "full").mkdir()
    (workplace / "full" / "mine.txt").touch()
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "full") == 1
    assert "holds something else than an ablation" in capsys.readouterr().err
    assert [path.name for path in (workplace / "full").iterdir()] == ["mine.txt"]
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 0
    (workplace / "other.yaml").write_text(FILE)
    assert ablate(monkeypatch, "--config", "other.yaml", "--output", "out") == 1
    assert "holds the ablation sizes, not other" in capsys.readouterr().err


def test_other_frames_are_refused_before_anything_is_trained_and_taken_with_force(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("--config", "sizes.yaml", "--output", "out")
    assert ablate(monkeypatch, *words) == 0
    del stand_ins["tags"]
    assert ablate(monkeypatch, *words, "--frames", "sample:stills") == 1
    assert "whose frames are others" in capsys.readouterr().err
    assert "tags" not in stand_ins
    assert ablate(monkeypatch, *words, "--frames", "sample:stills", "--force") == 0
    assert stand_ins["words"].data == "sample:stills"


def test_a_folder_that_another_process_works_in_is_left_to_it(
    stand_ins: dict[str, Any],
    workplace: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with alone(workplace / "out"):
        assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 1
    assert "another process is at work in out" in capsys.readouterr().err
    assert not list((workplace / "out").iterdir())
    assert ablate(monkeypatch, "--config", "sizes.yaml", "--output", "out") == 0


TINY = (
    "--config", "smoke.yaml", "--trainer.max_epochs", "3", "--data.init_args.workers", "0",
    "--data.init_args.train_patches", "40",
)  # fmt: skip


@pytest.mark.slow
def test_a_killed_ablation_goes_on_where_it_was(workplace: Path) -> None:
    (workplace / "sizes.yaml").write_text(FILE)
    words = ["--config", "sizes.yaml", "--output", "out", *TINY]
    command = [sys.executable, "-m", "trainer", "ablate", *words]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PENUMBRA_"))}
    environment |= {"PYTHONPATH": str(fitting.ROOT), "PENUMBRA_CACHE": str(workplace / "cache")}
    runs = workplace / "runs" / "sizes"
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    while not list(runs.glob("*/checkpoints/last.ckpt")):
        assert process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "restarted: the run" in done.stderr
    assert len(list(runs.glob(f"*/{RUN_FILE}"))) == 2
    parent = RunRecord.load(workplace / "out").run_id
    nested = [run for run in runs_of(workplace).values() if run.data.tags.get("mlflow.parentRunId") == parent]
    assert {run.data.tags["ablation.variant"] for run in nested} == {"one", "two"}
    table = (workplace / "out" / "tables" / "figure10.md").read_text()
    assert "| 1 (one) |" in table
    assert "| 2 (two) |" in table
    before = {path: path.stat().st_mtime_ns for path in runs.glob("*/checkpoints/*.ckpt")}
    again = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    assert "2 of 2 variants are trained already" in again.stderr
    assert {path: path.stat().st_mtime_ns for path in runs.glob("*/checkpoints/*.ckpt")} == before
