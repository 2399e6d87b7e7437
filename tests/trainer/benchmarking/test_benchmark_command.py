import argparse
import json
import sys

import pytest
import torch

from tests.trainer.benchmarking.stand_ins import Stand
from trainer import cli
from trainer.benchmarking import measuring, pairing
from trainer.commands import benchmark


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["trainer", "benchmark", *map(str, arguments)])
    try:
        code = cli.main()
    except SystemExit as stopped:  # argparse
        code = stopped.code
    return code, capsys.readouterr()


@pytest.fixture
def stand(monkeypatch):
    monkeypatch.setattr(Stand, "seconds", {"WSKP": 0.04, "NFOR": 1.5, "AFGSA": 0.08})
    monkeypatch.setattr(Stand, "failing", {"SBMC": "out of memory"})
    for module in (measuring, pairing):
        monkeypatch.setattr(module, "Measuring", Stand)
    return Stand


def test_a_method_and_one_that_cannot_run_make_a_table_json_and_plots(monkeypatch, capsys, tmp_path):
    device = ["--device", "cpu", "cuda"] if not torch.cuda.is_available() else ["--device", "cpu", "cuda:99"]
    code, printed = run(
        monkeypatch, capsys, "--model", "JointBilateral", "--option", "radius=1", "--size", "48x32",
        *device, "--repeat", 3, "--warmup", 1, "--output", tmp_path / "out",
    )  # fmt: skip
    assert code == 0
    assert "device" in printed.out
    assert max(map(len, printed.out.splitlines())) <= 100
    content = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert content["machine"]["versions"]["torch"] == torch.__version__
    good, bad = content["cases"]
    assert (good["status"], good["options"], len(good["seconds"])) == ("done", ["radius=1"], 3)
    assert bad["status"] == "failed"
    assert "CUDA" in bad["reason"] or "no such device" in bad["reason"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "benchmark.json",
        "time.svg",
        "memory.svg",
    }


def test_options_belong_to_the_model_before_them(monkeypatch, capsys, tmp_path, stand):
    code, _ = run(
        monkeypatch, capsys, "--model", "NFOR", "--option", "a=1", "--option", "b=2", "--model", "WSKP",
        "--output", tmp_path,
    )  # fmt: skip
    cases = json.loads((tmp_path / "benchmark.json").read_text())["cases"]
    assert code == 0
    assert [case["options"] for case in cases] == [["a=1", "b=2"], []]


def test_all_failed_is_an_exit_code_of_1_and_some_failed_is_not(monkeypatch, capsys, stand):
    assert run(monkeypatch, capsys, "--model", "SBMC")[0] == 1
    code, printed = run(monkeypatch, capsys, "--model", "SBMC", "--model", "WSKP")
    assert code == 0
    assert "SBMC: out of memory" in printed.out


def test_interrupted_prints_and_writes_what_is_done(monkeypatch, capsys, tmp_path, stand):
    monkeypatch.setitem(stand.seconds, "AFGSA", KeyboardInterrupt())
    code, printed = run(monkeypatch, capsys, "--model", "WSKP", "--model", "AFGSA", "--output", tmp_path)
    assert code == 130
    assert "interrupted: 1 of 2 cases measured" in printed.err
    assert "40.0 ms" in printed.out
    assert len(json.loads((tmp_path / "benchmark.json").read_text())["cases"]) == 1


def test_two_models_are_compared(monkeypatch, capsys, tmp_path, stand):
    models = ("--model", "WSKP", "--model", "AFGSA", "--pair", "--size", "64x64", "32x32")
    code, printed = run(monkeypatch, capsys, *models, "--output", tmp_path)
    assert code == 0
    assert printed.out.count("AFGSA takes 2.000 times as long as WSKP") == 2
    comparisons = json.loads((tmp_path / "benchmark.json").read_text())["comparisons"]
    assert [row["significant"] for row in comparisons] == [True, True]


def test_results_are_not_replaced_unasked(monkeypatch, capsys, tmp_path, stand):
    (tmp_path / "benchmark.json").write_text("old")
    code, printed = run(monkeypatch, capsys, "--model", "WSKP", "--output", tmp_path)
    assert code == 1
    assert "--force" in printed.err
    assert run(monkeypatch, capsys, "--model", "WSKP", "--output", tmp_path, "--force")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--option", "a=1", "--model", "WSKP"], "expected after the --model"),
        (["--model", "WSKP", "--pair"], "expected two different --model, got 1"),
        (["--model", "WSKP", "--model", "WSKP", "--pair"], "two different"),
        (["--model", "A", "--model", "B", "--revisions", "x", "y"], "expected one --model, got 2"),
        (["--model", "A", "--revisions", "x", "x"], "two different revisions"),
        (["--model", "A", "--pair", "--revisions", "x", "y"], "use one of them"),
        (["--model", "A", "--size", "1280"], "such as 1280x720"),
        (["--model", "A", "--size", "8x8"], "at least 16x16"),
        (["--model", "A", "--batch", "1,0"], "'0' is no whole number above 0"),
        (["--model", "A", "--seconds", "nan"], "no number of seconds"),
        (["--model", "A", "--processes", "2"], "expected 3 to 20"),
        (["--model", "A", "--mode", "jit"], "invalid choice"),
    ],
)
def test_wrong_usage_is_told_in_a_line_with_exit_code_2(monkeypatch, capsys, arguments, told):
    code, printed = run(monkeypatch, capsys, *arguments)
    assert code == 2
    assert told in printed.err
    assert "Traceback" not in printed.err


def test_help_imports_nothing_heavy():
    import subprocess

    script = (
        "import sys; sys.argv = ['trainer', 'benchmark', '--help']\nfrom trainer.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print(sorted({'torch', 'lightning', 'mlflow', 'numpy', 'OpenEXR'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_option_has_a_help():
    parser = argparse.ArgumentParser()
    benchmark.add_arguments(parser)
    assert all(action.help for action in parser._actions)
