"""`trainer denoise`: files, folders, sequences and data sets in; EXR and pictures out."""

from __future__ import annotations

import argparse
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

import models
from data.buffers import buffer
from data.camera import Camera
from data.derive import automatic_exposure, derive
from data.exr import read_frame, write_frame
from data.frame import Frame
from data.manifest import FrameRecord, Manifest, SceneRecord, file_sha256
from data.temporal import accumulate
from models import WSKP
from models.denoiser import Buffers, Denoised, Denoiser
from models.tiling import denoise_tiled
from trainer.clips import Item, find_clips
from trainer.commands import denoise as command
from trainer.export import export, load_artifact
from trainer.export.entry import example
from trainer.loading import load_model
from trainer.reports.pictures import tone_map

HEIGHT, WIDTH = 26, 38


class Radiance(Denoiser):
    """Returns irradiance times albedo, so that what went in can be seen in what comes out."""

    inputs: tuple[str, ...] = ("irradiance", "albedo", "normal", "depth")
    temporal = True

    def forward(self, buffers: Buffers) -> Denoised:
        self.check(buffers)
        return Denoised(buffers["irradiance"] * buffers["albedo"])


class Exposed(Radiance):
    """Returns the exposure that it was given."""

    inputs = ("color",)
    frame_numbers = ("exposure",)
    temporal = False

    def forward(self, buffers: Buffers) -> Denoised:
        return Denoised(torch.ones_like(buffers["color"]) * self.exposure(buffers))


class Broken(Exposed):
    """Returns NaN."""

    def forward(self, buffers: Buffers) -> Denoised:
        return Denoised(buffers["color"] * float("nan"))


def frame(index: int, seed: int = 0, scene: str = "wall") -> Frame:
    """A textured wall five units away, seen by a camera that moves one pixel to the right per frame."""
    rng = np.random.default_rng(1000 * seed + index)
    focal, distance = 40.0, 5.0
    left = index * distance / focal
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    position = np.stack([(x - WIDTH / 2) / focal * distance + left, (y - HEIGHT / 2) / focal * distance,
                         np.full_like(x, distance)], -1).astype(np.float32)  # fmt: skip
    albedo = (0.4 + 0.3 * np.sin(3 * position[..., :1] + np.arange(3))).astype(np.float32)
    noise = rng.exponential(1.0, (HEIGHT, WIDTH, 1)).astype(np.float32)
    matrix = np.array(
        [[focal, 0, WIDTH / 2, -focal * left], [0, focal, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]]
    )
    buffers = {
        "color": albedo * noise * 4,
        "diffuse_albedo": albedo,
        "normal": np.broadcast_to(np.array([0, 0, -1], np.float32), (HEIGHT, WIDTH, 3)).copy(),
        "position": position,
        "reference": albedo * 4,
    }
    return Frame(buffers, scene, index, Camera(matrix, np.array([left, 0.0, 0.0])), exposure=0.25, spp=1)


def folder_of(path: Path, *frames: Frame) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    for item in frames:
        write_frame(item, path / f"f{item.index:03d}.exr")
    return path


def data_set(root: Path) -> Path:
    """Two scenes of two frames; `door` is the test scene."""
    scenes = {}
    for seed, scene in enumerate(("wall", "door")):
        frames = [derive(frame(i, seed, scene), ["depth"]) for i in range(2)]
        folder_of(root / scene, *frames)
        records = []
        for item in frames:
            path = root / scene / f"f{item.index:03d}.exr"
            file = f"{scene}/{path.name}"
            records.append(
                FrameRecord(item.index, file, path.stat().st_size, file_sha256(path), WIDTH, HEIGHT, 0.5, 1)
            )
        scenes[scene] = SceneRecord(tuple(records))
    splits = {"train": ["wall"], "validation": [], "test": ["door"]}
    Manifest("walls", "penumbra", "euclidean", splits, scenes).save(root)
    return root


@pytest.fixture(autouse=True)
def methods(monkeypatch: pytest.MonkeyPatch) -> None:
    for cls in (Radiance, Exposed, Broken):
        monkeypatch.setattr(models, cls.__name__, cls, raising=False)
    monkeypatch.setattr(models, "__all__", [*models.__all__, "Radiance", "Exposed", "Broken"])


def run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(a) for a in arguments]))


def color(path: Path) -> np.ndarray:
    return read_frame(path).buffers["color"]


def close_to_half(found: np.ndarray, expected: np.ndarray) -> bool:
    return bool(np.allclose(found, expected, rtol=1e-3, atol=1e-4))


def test_a_single_file_is_denoised_in_its_own_units(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder_of(tmp_path / "in", frame(3))
    assert run("--model", "Radiance", tmp_path / "in" / "f003.exr", "--output", tmp_path / "out") == 0
    assert close_to_half(color(tmp_path / "out" / "f003.exr"), frame(3).buffers["color"])
    printed = capsys.readouterr().err
    assert "1/1 f003 (" in printed
    assert "frames/s" in printed
    assert printed.count("a single frame: denoised without temporal accumulation") == 1


def test_the_result_says_where_it_came_from(tmp_path: Path) -> None:
    folder_of(tmp_path / "in", frame(3))
    run("--model", "Exposed", tmp_path / "in", "--output", tmp_path / "out")
    result = read_frame(tmp_path / "out" / "f003.exr")
    said = result.notes["denoised"]
    assert (said["model"], said["class"], said["exposure"]) == ("Exposed", "Exposed", 0.25)
    assert "penumbra-denoise" in said
    assert (result.scene, result.index, result.exposure, list(result.buffers)) == ("wall", 3, 0.25, ["color"])
    with OpenEXR.File(str(tmp_path / "out" / "f003.exr"), separate_channels=True) as file:
        assert sorted(file.channels()) == ["color.B", "color.G", "color.R"]


def test_a_sequence_is_accumulated_as_in_training(tmp_path: Path) -> None:
    frames = [frame(i) for i in range(8, 12)]
    run("--model", "Radiance", folder_of(tmp_path / "in", *frames), "--output", tmp_path / "out")
    stored = [read_frame(tmp_path / "in" / f"f{f.index:03d}.exr") for f in frames]
    for expected in accumulate(stored):
        wanted = expected.buffers["irradiance"] * expected.buffers["albedo"]
        assert close_to_half(color(tmp_path / "out" / f"f{expected.index:03d}.exr"), wanted)
    last = color(tmp_path / "out" / "f011.exr")
    reference = frames[-1].buffers["reference"]
    assert (
        np.square(last - reference).mean() < 0.5 * np.square(frames[-1].buffers["color"] - reference).mean()
    )


def test_files_are_taken_in_order_of_their_numbers_whatever_the_order_given(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for index in (9, 10):
        write_frame(frame(index), folder / f"f{index}.exr")
    run("--model", "Radiance", folder / "f10.exr", folder / "f9.exr", "--output", tmp_path / "out")
    assert close_to_half(color(tmp_path / "out" / "f9.exr"), frame(9).buffers["color"])
    assert not close_to_half(color(tmp_path / "out" / "f10.exr"), frame(10).buffers["color"])


def test_accumulation_can_be_turned_off(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1))
    run("--model", "Radiance", folder, "--output", tmp_path / "out", "--no-accumulate")
    assert close_to_half(color(tmp_path / "out" / "f001.exr"), frame(1).buffers["color"])


def test_frames_without_camera_are_denoised_alone_and_it_is_said_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = []
    for index in range(3):
        whole = derive(frame(index), ["depth"])
        whole.buffers.pop("position")
        frames.append(replace(whole, camera=None))
    run("--model", "Radiance", folder_of(tmp_path / "in", *frames), "--output", tmp_path / "out")
    assert capsys.readouterr().err.count("neither motion nor position and camera") == 1
    assert close_to_half(color(tmp_path / "out" / "f002.exr"), frame(2).buffers["color"])


def test_the_exposure_is_the_frames_own_a_given_one_or_measured(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1))
    stored = read_frame(folder / "f000.exr").buffers["color"]
    for option, expected in (
        ((), 0.25),
        (("--exposure", "3"), 3.0),
        (("--exposure", "auto"), automatic_exposure(stored)),
    ):
        run("--model", "Exposed", folder, "--output", tmp_path / "out", "--force", *option)
        for index in (0, 1):  # measured on the first frame, then kept: it would flicker
            assert color(tmp_path / "out" / f"f{index:03d}.exr")[0, 0, 0] == pytest.approx(expected, rel=1e-3)


def test_an_ingested_set_keeps_its_scenes_and_a_split_can_be_chosen(tmp_path: Path) -> None:
    root = data_set(tmp_path / "set")
    run("--model", "Exposed", root, "--output", tmp_path / "all")
    found = sorted(str(p.relative_to(tmp_path / "all")) for p in (tmp_path / "all").rglob("*.exr"))
    assert found == ["door/f000.exr", "door/f001.exr", "wall/f000.exr", "wall/f001.exr"]
    assert color(tmp_path / "all" / "wall" / "f001.exr")[0, 0, 0] == 0.5
    run("--model", "Exposed", root, "--output", tmp_path / "test", "--split", "test")
    assert {p.name for p in (tmp_path / "test").iterdir()} == {"door"}
    with pytest.raises(ValueError, match="no scene in the split 'validation'"):
        run("--model", "Exposed", root, "--output", tmp_path / "v", "--split", "validation")
    with pytest.raises(ValueError, match="needs an ingested data set"):
        run("--model", "Exposed", root / "wall", "--output", tmp_path / "v", "--split", "test")


def test_pictures_show_the_result_and_a_comparison_where_there_is_a_reference(tmp_path: Path) -> None:
    without = replace(frame(1), buffers={n: b for n, b in frame(1).buffers.items() if n != "reference"})
    run(
        "--model",
        "Radiance",
        folder_of(tmp_path / "in", frame(0), without),
        "--output",
        tmp_path / "out",
        "--png",
    )
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "f000.exr", "f000.png", "f000_comparison.png", "f001.exr", "f001.png",
    }  # fmt: skip
    shown = np.asarray(Image.open(tmp_path / "out" / "f000.png")).astype(int)
    expected = np.asarray(tone_map(frame(0).buffers["color"], 0.25)).astype(int)
    assert np.abs(shown - expected).max() <= 1


def test_results_are_not_overwritten_and_nothing_is_done_before_saying_so(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1))
    folder_of(tmp_path / "out", replace(frame(1), scene="old"))
    with pytest.raises(ValueError, match=r"f001\.exr already there.*--force"):
        run("--model", "Radiance", folder, "--output", tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["f001.exr"]
    run("--model", "Radiance", folder, "--output", tmp_path / "out", "--force")
    assert read_frame(tmp_path / "out" / "f001.exr").scene == "wall"


def test_inputs_are_never_overwritten_even_by_force(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    before = (folder / "f000.exr").read_bytes()
    with pytest.raises(ValueError, match="is an input"):
        run("--model", "Radiance", folder, "--output", folder, "--force")
    assert (folder / "f000.exr").read_bytes() == before


def test_two_files_of_one_name_are_kept_apart_by_their_folders(tmp_path: Path) -> None:
    first, second = folder_of(tmp_path / "a", frame(0)), folder_of(tmp_path / "b", frame(0, 1))
    run("--model", "Exposed", first / "f000.exr", second / "f000.exr", "--output", tmp_path / "out")
    assert sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*.exr")) == [
        "a/f000.exr",
        "b/f000.exr",
    ]
    with pytest.raises(ValueError, match=r"would both be written as f000\.exr"):
        run("--model", "Exposed", first, second, "--output", tmp_path / "out2")


def test_a_missing_buffer_names_frame_and_buffer(tmp_path: Path) -> None:
    bare = frame(0)
    bare.buffers.pop("normal")
    with pytest.raises(ValueError, match=r"in/f000\.exr: wall/frame 0: missing buffer normal"):
        run("--model", "Radiance", folder_of(tmp_path / "in", bare), "--output", tmp_path / "out")
    assert list((tmp_path / "out").rglob("*.*")) == []


def test_a_damaged_frame_is_named_and_the_finished_ones_stay(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1), frame(2))
    content = (folder / "f001.exr").read_bytes()
    (folder / "f001.exr").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"f001\.exr.*truncated"):
        run("--model", "Exposed", folder, "--output", tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["f000.exr"]


def test_a_model_that_returns_nan_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the model returned NaN or Inf"):
        run("--model", "Broken", folder_of(tmp_path / "in", frame(0)), "--output", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_picture_given_as_radiance_is_a_note_not_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clipped = frame(0)
    clipped.buffers["color"] = np.minimum(clipped.buffers["color"], 1)
    write_raw(tmp_path / "in" / "f000.exr", clipped)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run("--model", "Exposed", tmp_path / "in", "--output", tmp_path / "out")
    assert "note: " in capsys.readouterr().err


def write_raw(path: Path, item: Frame, window: tuple[int, int] | None = None) -> Path:
    """Write buffers as they are, which `write_frame` refuses for NaN; `window`: the displayed size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {
        f"{name}.{letter}": np.ascontiguousarray(image[..., i])
        for name, image in item.buffers.items()
        for i, letter in enumerate(buffer(name).letters)
    }
    header: dict[str, object] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if window is not None:
        header["displayWindow"] = (np.array([0, 0], np.int32), np.array(window, np.int32) - 1)
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def test_replaced_pixels_are_told_per_file_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = frame(3)
    broken.buffers["color"][2, 3:5, 1] = np.nan
    broken.buffers["normal"][7, 8] = np.inf
    path = write_raw(tmp_path / "in" / "f003.exr", broken)
    write_raw(tmp_path / "in" / "f004.exr", frame(4))
    run("--model", "Exposed", tmp_path / "in", "--output", tmp_path / "out")
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert notes == [
        f"note: {path}: 2 pixels of color were NaN or Inf, replaced by the mean of their finite neighbours, "
        "0 where there are none; 1 pixel of normal was NaN or Inf, replaced by 0, the value of a pixel that "
        "hit nothing"
    ]


def test_pixels_outside_of_the_data_window_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = replace(frame(0), buffers={"color": frame(0).buffers["color"]})
    path = write_raw(tmp_path / "in" / "f000.exr", bare, (WIDTH + 2, HEIGHT))
    run("--model", "Exposed", path, "--output", tmp_path / "out")
    assert f"note: {path}: {2 * HEIGHT} pixels of color were outside of the data window, replaced by 0" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (json.JSONDecodeError("Expecting value", "{", 1), ValueError),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), ValueError),
        (FileNotFoundError(2, "No such file", "x"), OSError),
    ],
)
def test_errors_of_any_class_name_the_frame(error: Exception, kind: type[Exception]) -> None:
    def read() -> Frame:
        raise error

    item = Item(read, "in/f000.exr", "f000")
    with pytest.raises(kind) as caught, command._naming(item, print):
        item.read()
    assert str(caught.value) == f"in/f000.exr: {error}"
    assert caught.value.__cause__ is error


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("fridge", "expected cpu, cuda or cuda:NUMBER"),
        ("meta", "expected cpu, cuda or cuda:NUMBER"),
        ("mps", "no mps device"),
        ("xpu", "no xpu device"),
        ("cuda:9", "there is no such device, the last one here is cuda:1"),
        ("cpu:3", "there is no such device, the last one here is cpu:0"),
    ],
)
def test_a_device_that_is_not_there_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, message: str
) -> None:
    for backend, number in ((torch.cuda, 2), (torch.mps, 0), (torch.xpu, 0)):
        monkeypatch.setattr(backend, "is_available", lambda number=number: number > 0)
        monkeypatch.setattr(backend, "device_count", lambda number=number: number)
    folder = folder_of(tmp_path / "in", frame(0))
    with pytest.raises(ValueError, match=f"--device {device}: {message}"):
        run("--model", "Exposed", folder, "--output", tmp_path / "out", "--device", device)
    assert not (tmp_path / "out").exists()
    command.check_device("cuda:1")


@pytest.mark.parametrize("content", ["nothing", "shards"])
def test_a_folder_without_frames_says_what_was_looked_for(tmp_path: Path, content: str) -> None:
    if content == "shards":
        (tmp_path / "index.json").write_text("{}")
    with pytest.raises(ValueError, match=r"nothing to denoise|holds shards"):
        find_clips([str(tmp_path)])


def test_missing_paths_and_a_file_as_output_are_errors(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    with pytest.raises(FileNotFoundError, match="no such file"):
        run("--model", "Radiance", tmp_path / "nowhere", "--output", tmp_path / "out")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="is a file"):
        run("--model", "Radiance", folder, "--output", tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "size"), [("2GB", 2 * 10**9), ("1.5 gib", 3 * 2**29), ("500M", 5 * 10**8), ("4096", 4096)]
)
def test_memory_sizes_are_understood(text: str, size: int) -> None:
    assert command.size_in_bytes(text) == size


@pytest.mark.parametrize(
    "option", [("--memory", "much"), ("--memory", "0GB"), ("--exposure", "-1"), ("--exposure", "x")]
)
def test_wrong_numbers_are_usage_errors(option: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        run("a.exr", "--model", "Radiance", "--output", "out", *option)
    assert stopped.value.code == 2
    assert option[0] in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".onnx", ".ts"])
def test_tiles_of_an_exported_file_equal_the_whole_image(tmp_path: Path, suffix: str) -> None:
    torch.manual_seed(1)
    path = tmp_path / f"net{suffix}"
    export(WSKP(layers=2, width=6, kernel_sizes=(3, 5)), path, "onnx" if suffix == ".onnx" else "torchscript")
    artifact = load_artifact(path)
    buffers = example(artifact.inputs, 1, 75, 93)
    buffers["exposure"] = torch.tensor([0.4])
    whole = artifact(buffers).color
    tiled = denoise_tiled(artifact, buffers, tile=24)
    assert torch.allclose(tiled, whole, rtol=1e-5, atol=1e-5 * float(whole.median()))


def test_a_small_memory_budget_gives_the_same_picture(tmp_path: Path) -> None:
    torch.manual_seed(1)
    export(WSKP(layers=2, width=6, kernel_sizes=(3, 5)), tmp_path / "net.onnx")
    assert load_model(str(tmp_path / "net.onnx")).halo == 6
    folder = folder_of(tmp_path / "in", frame(0))
    run("--model", tmp_path / "net.onnx", folder, "--output", tmp_path / "whole")
    run("--model", tmp_path / "net.onnx", folder, "--output", tmp_path / "tiled", "--memory", "1.2MB")
    assert close_to_half(color(tmp_path / "tiled" / "f000.exr"), color(tmp_path / "whole" / "f000.exr"))
    with pytest.raises(ValueError, match=r"f000\.exr: a memory budget of 0\.0 MB is too small"):
        run("--model", tmp_path / "net.onnx", folder, "--output", tmp_path / "none", "--memory", "9KB")
