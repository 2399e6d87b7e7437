import argparse
import contextlib
import io
import json
import os
import sys

import pytest
import torch

from tests.trainer.benchmarking.stand_ins import Stand
from trainer import cli
from trainer.benchmarking import files, measuring, pairing
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
        monkeypatch, capsys, "--model", "NFOR", "--option", "window=9", "--option", "patch=1",
        "--model", "WSKP", "--output", tmp_path,
    )  # fmt: skip
    cases = json.loads((tmp_path / "benchmark.json").read_text())["cases"]
    assert code == 0
    assert [case["options"] for case in cases] == [["window=9", "patch=1"], []]


def test_all_failed_is_an_exit_code_of_1_and_some_failed_is_not(monkeypatch, capsys, stand):
    assert run(monkeypatch, capsys, "--model", "SBMC")[0] == 1
    code, printed = run(monkeypatch, capsys, "--model", "SBMC", "--model", "WSKP")
    assert code == 0
    assert "SBMC: out of memory" in printed.out


def test_with_strict_a_failed_case_is_an_exit_code_of_1(monkeypatch, capsys, stand):
    assert run(monkeypatch, capsys, "--model", "WSKP", "--strict")[0] == 0
    assert run(monkeypatch, capsys, "--model", "SBMC", "--model", "WSKP", "--strict")[0] == 1


def test_every_case_is_in_the_file_before_the_next_begins(monkeypatch, capsys, tmp_path, stand):
    seen, times = [], stand.times

    def looking(self, calls):
        path = tmp_path / "benchmark.json"
        seen.append(len(json.loads(path.read_text())["cases"]) if path.exists() else 0)
        return times(self, calls)

    monkeypatch.setattr(stand, "times", looking)
    models = ("--model", "WSKP", "--model", "NFOR", "--model", "AFGSA")
    assert run(monkeypatch, capsys, *models, "--output", tmp_path, "--repeat", 1)[0] == 0
    assert seen == [0, 1, 2]


def test_plots_of_replaced_results_do_not_outlive_them(monkeypatch, capsys, tmp_path, stand):
    run(monkeypatch, capsys, "--model", "WSKP", "--output", tmp_path)
    run(monkeypatch, capsys, "--model", "SBMC", "--output", tmp_path, "--force")
    assert [path.name for path in tmp_path.iterdir()] == ["benchmark.json"]


def closed_pipe():
    reading, writing = os.pipe()
    os.close(reading)
    return os.fdopen(writing, "w")


@pytest.mark.parametrize("closed", [("stdout",), ("stdout", "stderr")])
def test_a_closed_pipe_loses_nothing(monkeypatch, tmp_path, stand, closed):
    arguments = ("--model", "WSKP", "--model", "NFOR", "--output", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["trainer", "benchmark", *arguments])
    with contextlib.ExitStack() as stack:
        for name in closed:
            stream = closed_pipe()
            monkeypatch.setattr(sys, name, stream)
            stack.callback(discarded, stream)
        with contextlib.suppress(SystemExit):
            cli.main()
    assert len(json.loads((tmp_path / "benchmark.json").read_text())["cases"]) == 2
    assert {path.name for path in tmp_path.iterdir()} == set(files.NAMES)


def discarded(stream):
    """Close a stream whose rest nobody takes."""
    with contextlib.suppress(BrokenPipeError):
        stream.close()


def test_an_output_that_lacks_characters_shows_others_and_loses_nothing(monkeypatch, tmp_path, stand):
    stand.seconds["NFOR"] = 5e-5  # µs
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "argv", ["trainer", "benchmark", "--model", "NFOR", "--output", str(tmp_path)])
    assert cli.main() == 0
    stream.seek(0)
    assert "50.0?50.0 ?s" in stream.read()
    assert "50.0 µs" in (tmp_path / "time.svg").read_text(encoding="utf-8")


@pytest.mark.parametrize("terminal", [False, True])
def test_a_path_with_brackets_is_told_as_it_is(monkeypatch, capsys, tmp_path, stand, terminal):
    model = "runs[/old]/best.ckpt"
    path = tmp_path / model
    path.parent.mkdir(parents=True)
    path.touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(stand.seconds, model, 0.04)
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("COLUMNS", "200")
    code, printed = run(monkeypatch, capsys, "--model", model, "--output", "out")
    assert code == 0
    assert model in printed.out
    assert model in printed.err
    assert (tmp_path / "out" / "time.svg").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["--model", "WSPK"], 1, "did you mean WSKP"),
        (["--model", "models.Nothing"], 1, "unknown class"),
        (["--model", "WSKP", "--option", "kernels=21"], 2, "has no option"),
        (["--model", "runs/none/best.ckpt"], 1, "no such file"),
        (["--model", "none.onnx", "--revisions", "HEAD~1", "HEAD"], 1, "no such file"),
        (["--model", "WSPK", "--revisions", "HEAD", "."], 1, "did you mean WSKP"),
    ],
)
def test_a_mistaken_model_is_told_before_any_is_measured(
    monkeypatch, capsys, tmp_path, stand, arguments, code, told
):
    first = [] if "--revisions" in arguments else ["--model", "WSKP"]
    monkeypatch.setattr(stand, "calls", [])
    found, printed = run(monkeypatch, capsys, *first, *arguments, "--output", tmp_path / "out")
    assert found == code
    assert told in printed.err
    assert stand.calls == []
    assert not (tmp_path / "out").exists()


def test_a_class_that_only_other_revisions_have_is_looked_for_there(monkeypatch, capsys, stand):
    code, printed = run(monkeypatch, capsys, "--model", "Former", "--revisions", "no-such", "HEAD")
    assert code == 1
    assert "has no such revision" in printed.err


def test_the_reason_of_a_failed_side_is_told_once(monkeypatch, capsys, stand):
    code, printed = run(monkeypatch, capsys, "--model", "WSKP", "--model", "SBMC", "--pair")
    assert code == 1
    assert printed.out.count("out of memory") == 1
    assert printed.out.count("not without the other") == 1


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
