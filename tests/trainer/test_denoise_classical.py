"""`trainer denoise` with training-free methods: options, missing inputs, layers, kernels."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import trainer.kernels as kernels
from data.exr import read_exr, read_frame, write_frame
from data.frame import Frame
from models import NFOR, NLM
from tests.models.frames import split_buffers
from trainer.commands import denoise as command
from trainer.configs import UsageError
from trainer.progress import FrameProgress
from trainer.reports.layers import layer_sheet

SMALL = ("window=2", "patch=1", "prefilter_window=1", "final_window=1")
"""Options of NFOR that make it quick."""

COLOR = ("color", "color_a", "color_b", "color_variance")
NORMAL = ("normal", "normal_a", "normal_b", "normal_variance")


def frame(*names: str, size: tuple[int, int] = (20, 24), seed: int = 0, index: int = 0) -> Frame:
    """A frame with these buffers of a random surface."""
    made = split_buffers(1, *size, seed)
    buffers = {n: np.ascontiguousarray(made[n][0].permute(1, 2, 0).numpy()) for n in names}
    return Frame(buffers, "surface", index, exposure=1.0)


def write(path: Path, made: Frame) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_frame(made, path)
    return path


def run(*arguments: str | Path, options: tuple[str, ...] = ()) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    given = [str(a) for a in arguments]
    return command.run(parser.parse_args([*given, *(x for o in options for x in ("--option", o))]))


def nfor(source: Path, output: Path, *arguments: str, options: tuple[str, ...] = ()) -> int:
    given = ("--model", "NFOR", "--output", output, *arguments)
    return run(source, *given, options=("features=normal", *SMALL, *options))


def test_options_reach_the_constructor_and_are_kept_with_the_result(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out", options=("preset=paper", "fused=false")) == 0
    result = read_frame(tmp_path / "out" / "f000.exr")
    options = result.notes["denoised"]["options"]
    assert options == {"features": ["normal"], "preset": "paper", "fused": False, "window": 2, "patch": 1,
                       "prefilter_window": 1, "final_window": 1}  # fmt: skip
    method = NFOR("paper", ("normal",), window=2, patch=1, prefilter_window=1, final_window=1)
    made = read_frame(source).buffers
    planes = {n: torch.from_numpy(made[n].transpose(2, 0, 1).copy())[None] for n in method.inputs}
    with torch.inference_mode():
        expected = method(planes).color[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result.buffers["color"], expected, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("windw=3", r"NFOR has no option 'windw'; did you mean 'window'\? `trainer models NFOR` lists them"),
        ("window=wide", "window=wide: expected a whole number"),
        ("preset=papr", r"expected public or paper; did you mean paper\?"),
        ("window", "expected KEY=VALUE, such as preset=public"),
    ],
)
def test_a_wrong_option_is_a_usage_error_of_one_line(tmp_path: Path, option: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as error:
        run(write(tmp_path / "f0.exr", frame(*COLOR)), "--model", "NFOR", "--output", tmp_path / "out",
            options=(option,))  # fmt: skip
    assert "\n" not in str(error.value)


def test_an_option_twice_or_with_a_file_is_refused(tmp_path: Path) -> None:
    source = write(tmp_path / "f0.exr", frame(*COLOR))
    with pytest.raises(UsageError, match="window is given twice"):
        run(source, "--model", "NFOR", "--output", tmp_path / "out", options=("window=2", "window=3"))
    with pytest.raises(UsageError, match=r"options are for methods that are named by their class"):
        run(source, "--model", source, "--output", tmp_path / "out", options=("window=2",))


def test_a_value_that_the_method_refuses_is_its_own_error(tmp_path: Path) -> None:
    source = write(tmp_path / "f0.exr", frame(*COLOR))
    with pytest.raises(ValueError, match="radius must be at least 1"):
        run(source, "--model", "CrossBilateral", "--output", tmp_path / "out", options=("radius=0",))


def test_layers_are_written_for_common_viewers(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out", "--aux", "--png") == 0
    channels = read_exr(tmp_path / "out" / "f000_aux.exr").channels
    layers = {"error_k0_5", "error_k1", "selection"}
    wanted = {f"{layer}.{c}" for layer in layers for c in "RGB"} | {f"normal.{c}" for c in "XYZ"} | {*"RGB"}
    assert set(channels) == wanted
    assert all(name.count(".") <= 1 for name in channels)
    color = read_frame(tmp_path / "out" / "f000.exr").buffers["color"]
    np.testing.assert_allclose(np.stack([channels[c] for c in "RGB"], -1), color, rtol=1e-3, atol=1e-4)
    selection = np.stack([channels[f"selection.{c}"] for c in "RGB"])
    assert selection.min() >= 0
    assert selection.max() <= 1
    with Image.open(tmp_path / "out" / "f000_aux.png") as sheet:
        assert sheet.width > 3 * 240


def test_rdfc_writes_which_candidate_it_chose(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    narrow = ("features=normal", "window=2", "patches=0,1", "prefilter_window=1", "selection_window=1")
    assert run(source, "--model", "RDFC", "--output", tmp_path / "out", "--aux", "--png", options=narrow) == 0
    channels = read_exr(tmp_path / "out" / "f000_aux.exr").channels
    shares = np.stack([channels[f"shares.{c}"] for c in "RGB"])
    np.testing.assert_allclose(shares.sum(0), 1, atol=2e-3)
    assert {name.split(".")[0] for name in channels} >= {"error_first", "error_second", "error_third"}
    assert "normal.X" in channels
    with Image.open(tmp_path / "out" / "f000_aux.png") as sheet:
        pixels = np.asarray(sheet.convert("RGB"), np.float32)
    shown = np.abs(pixels.sum(-1) - 255) <= 2  # three shares of 255, whatever they are
    assert shown.sum() > 240 * 200


def test_shares_of_three_candidates_are_drawn_in_red_green_and_blue() -> None:
    shares = np.zeros((20, 24, 3), np.float32)
    shares[:10, :, 0], shares[10:, :12, 1], shares[10:, 12:, 2] = 1, 1, 1
    errors = {f"error_{name}": np.ones((20, 24, 1), np.float32) for name in ("first", "second", "third")}
    sheet = np.asarray(layer_sheet(np.ones((20, 24, 3), np.float32), 1.0, {"shares": shares, **errors}))
    counts = [
        int((sheet == np.array(color)).all(-1).sum()) for color in ((255, 0, 0), (0, 255, 0), (0, 0, 255))
    ]
    assert counts[0] == 2 * counts[1] == 2 * counts[2] > 0


def test_layers_are_not_written_unasked(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out", "--png") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["f000.exr", "f000.png"]


@pytest.mark.parametrize("model", ["JointBilateral", "CrossBilateral"])
def test_a_method_without_layers_says_so(tmp_path: Path, model: str) -> None:
    source = write(tmp_path / "f0.exr", frame(*COLOR))
    with pytest.raises(UsageError, match=f"--aux: {model} makes nothing on its way"):
        run(source, "--model", model, "--output", tmp_path / "out", "--aux")


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (("color_a", "color_b"), "no color_variance"),
        (("color", "color_variance"), "no color_a and no color_b"),
        (("color", "color_a"), "no color_variance"),
    ],
)
def test_what_stands_in_for_missing_inputs_is_a_warning_with_its_reason_shown_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: tuple[str, ...], reason: str
) -> None:
    for i in range(2):
        write(tmp_path / "in" / f"f{i}.exr", frame(*given, *NORMAL, seed=i, index=i))
    assert nfor(tmp_path / "in", tmp_path / "out") == 0
    lines = capsys.readouterr().err.splitlines()
    warnings = [line for line in lines if line.startswith("warning: ")]
    assert len(warnings) == 1
    assert warnings[0].startswith(f"warning: {reason}: ")
    notes = read_frame(tmp_path / "out" / "f1.exr").notes["denoised"]
    assert warnings == [f"warning: {text}" for text in notes["instead"]]


def test_complete_frames_give_no_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out") == 0
    assert "warning" not in capsys.readouterr().err
    assert "instead" not in read_frame(tmp_path / "out" / "f0.exr").notes["denoised"]


def test_a_half_follows_from_the_mean_and_the_other_half(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame("color", "color_a", "color_variance", *NORMAL))
    assert nfor(source, tmp_path / "out") == 0
    assert "warning" not in capsys.readouterr().err


def test_colour_alone_is_an_error_that_names_the_options(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame("color", "normal"))
    with pytest.raises(ValueError, match="missing buffer color_a") as error:
        nfor(source, tmp_path / "out")
    text = str(error.value)
    assert "--option color_noise=estimated estimates the noise of color from the image itself" in text
    assert "; `trainer render stills` writes halves and variances; " in text
    assert "--option feature_noise=none takes normal as free of noise" in text
    assert str(source) in text
    assert "\n" not in text
    assert nfor(source, tmp_path / "out", options=("color_noise=estimated", "feature_noise=none")) == 0


def test_an_absent_feature_is_an_error_that_names_the_option_without_it(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame(*COLOR, *NORMAL))
    given = ("--model", "NFOR", "--output", tmp_path / "out")
    with pytest.raises(ValueError, match="--option features=normal does without albedo, depth"):
        run(source, *given, options=SMALL)


def test_a_missing_histogram_is_an_error_that_names_the_commands_once(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame("color"))
    with pytest.raises(ValueError, match="missing buffer 'histogram'") as error:
        run(source, "--model", "RHF", "--output", tmp_path / "out")
    assert str(error.value).count("trainer render stills --histogram writes histograms") == 1


def test_what_has_a_variance_is_not_to_be_estimated(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f0.exr", frame("color", "color_variance", "normal", "normal_variance"))
    given = ("--model", "NFOR", "--output", tmp_path / "out")
    with pytest.raises(ValueError, match="--option features=normal does without albedo, depth") as error:
        run(source, *given, options=SMALL)
    assert "estimated" not in str(error.value)
    run(source, *given, options=("features=normal", *SMALL))


def test_halves_in_files_of_their_own_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = {"": "", "_a": "A", "_b": "B", "_variance": "Variance"}
    made = frame(*COLOR, *NORMAL)
    for name in ("color", "normal"):
        for part, suffix in parts.items():
            alone = Frame({name: made.buffers[f"{name}{part}"]}, "surface", 0)
            path = write(tmp_path / "tungsten" / f"{name}{suffix}.exr", alone)
            assert path.is_file()
    assert nfor(tmp_path / "tungsten", tmp_path / "out") == 0
    assert "warning" not in capsys.readouterr().err
    result = next((tmp_path / "out").rglob("*.exr"))
    source = write(tmp_path / "in" / "f000.exr", made)
    assert nfor(source, tmp_path / "one") == 0
    expected = read_frame(tmp_path / "one" / "f000.exr").buffers["color"]
    np.testing.assert_allclose(read_frame(result).buffers["color"], expected, rtol=5e-3, atol=5e-3)


def test_a_small_memory_budget_gives_the_same_picture_and_layers(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL, size=(70, 60)))
    small = ("window=1", "preset=public")
    given = ("--model", "NFOR", "--aux")
    options = ("features=normal", "patch=1", "prefilter_window=1", "final_window=1", *small)
    run(source, *given, "--output", tmp_path / "whole", options=options)
    method = NFOR(features=("normal",), window=1, patch=1, prefilter_window=1, final_window=1)
    budget = method.bytes_once + (2 * method.halo + 20) ** 2 * method.bytes_per_pixel
    run(source, *given, "--output", tmp_path / "tiled", "--memory", f"{budget}B", options=options)
    whole, tiled = (read_exr(tmp_path / n / "f000_aux.exr").channels for n in ("whole", "tiled"))
    for name, plane in whole.items():
        np.testing.assert_allclose(tiled[name], plane, rtol=1e-4, atol=1e-5 * np.abs(plane).max())


def test_without_numba_the_torch_form_runs_and_slow_frames_get_a_hint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("models.ops.nlm._has_numba", lambda: False)
    method = NFOR()
    hint = kernels.Kernels(method, "cpu").hint
    assert "pip install 'penumbra-denoise[fast]'" in hint
    assert kernels.Kernels(NFOR(fused=False), "cpu").hint == ""
    assert kernels.Kernels(NLM(preset="rkz12"), "cpu").hint == ""
    assert kernels.Kernels(method, "cuda").hint == ""
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out") == 0
    assert hint not in capsys.readouterr().err  # it was quick


def test_slow_frames_tell_the_hint_once_and_how_far_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.progress.SLOW", 0.0)
    with FrameProgress(4, "install it") as progress:
        progress.within(0.5)
        for _ in range(2):
            told = progress._told
            while progress._told == told:
                pass
    lines = capsys.readouterr().err.splitlines()
    assert lines.count("note: install it") == 1
    assert any(re.fullmatch(r"frame 1/4: 0:0\d so far, 12% done, about 0:0\d left", line) for line in lines)


def test_compilation_is_announced_once(capsys: pytest.CaptureFixture[str]) -> None:
    from numba import njit

    first, second = njit(lambda x: x + 1), njit(lambda x: x + 2)
    with FrameProgress(1) as progress, kernels.Kernels(NFOR(), "cpu").announced(progress.say):
        first(1)
        second(1)
    err = capsys.readouterr().err
    assert err.count("compiling kernels for this machine, once") == 1
    second(1.5)
    assert capsys.readouterr().err == ""


def test_the_options_of_a_result_are_plain_json(tmp_path: Path) -> None:
    source = write(tmp_path / "in" / "f000.exr", frame(*COLOR, *NORMAL))
    assert nfor(source, tmp_path / "out") == 0
    attributes = read_exr(tmp_path / "out" / "f000.exr").attributes
    assert json.loads(attributes["penumbra.notes"])["denoised"]["options"]["features"] == ["normal"]
