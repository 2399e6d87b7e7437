"""Attention pictures: a crop gives what the whole frame gives, and shows it at the right places."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from data.derive import derive
from data.exr import read_frame
from models import AFGSA, WSKP
from tests.models.frames import split_buffers
from tests.trainer.test_denoise import folder_of, frame, run
from trainer.attention import Attention, attention_of
from trainer.cli import main
from trainer.export import export
from trainer.reports.attention import PATCH, attention_map, attention_picture, heat

LEFT, TOP = 12, 82  # where the image begins in the picture
YELLOW, RED = (255, 214, 10), (230, 20, 20)


def network(**arguments: object) -> AFGSA:
    torch.manual_seed(2)
    return AFGSA(width=16, blocks=2, heads=2, **arguments).eval()  # type: ignore[arg-type]


def whole_maps(net: AFGSA, buffers: dict[str, torch.Tensor], query: tuple[int, int]) -> np.ndarray:
    return net.attention({**buffers, **net.measure(buffers)}, query[1], query[0]).numpy()


@pytest.mark.parametrize(
    ("arguments", "query"),
    [({}, (0, 0)), ({}, (50, 41)), ({"mask_halo": True}, (65, 60)), ({"block": 16, "halo": 5}, (3, 60)),
     ({"attention": "local", "window": 9}, (33, 2))],
)  # fmt: skip
def test_the_maps_of_a_crop_are_those_of_the_whole_frame(
    arguments: dict[str, object], query: tuple[int, int]
) -> None:
    net = network(**arguments)
    buffers = {name: split_buffers(1, 61, 66)[name] for name in net.inputs}
    buffers["exposure"] = torch.tensor([0.3])
    found, expected = attention_of(net, buffers, query), whole_maps(net, buffers, query)
    (x, y), (height, width) = found.corner, found.maps.shape[-2:]
    assert x <= query[0] < x + width
    assert y <= query[1] < y + height
    inner = expected[..., y : y + height, x : x + width]
    assert np.allclose(found.maps, inner, rtol=1e-4, atol=1e-6)
    assert expected.sum() == pytest.approx(inner.sum(), rel=1e-6)  # nothing was cut away


def test_maps_are_shown_over_the_window_of_the_query() -> None:
    net = network()
    buffers = {name: split_buffers(1, 48, 64)[name] for name in net.inputs}
    assert attention_of(net, buffers, (20, 33)).corner == (13, 29)  # its block starts at 16, 32; halo 3
    assert attention_of(net, buffers, (20, 33)).maps.shape == (2, 2, 14, 14)
    assert attention_of(net, buffers, (63, 0)).corner == (53, 0)
    assert attention_of(net, buffers, (63, 0)).maps.shape == (2, 2, 11, 11)


def test_a_query_outside_of_the_image_is_refused_with_the_allowed_range() -> None:
    net = network()
    buffers = {name: split_buffers(1, 24, 32)[name] for name in net.inputs}
    with pytest.raises(ValueError, match=r"32,3 lies outside.*32x24.*X from 0 to 31 and Y from 0 to 23"):
        attention_of(net, buffers, (32, 3))


def test_colours_run_from_blue_to_red_and_the_largest_weight_gets_the_last() -> None:
    first, last = heat()[0].astype(int), heat()[255].astype(int)
    assert first[2] > first[0] + 60
    assert last[0] > last[2] + 60
    picture = np.asarray(attention_map(np.array([[0.0, 0.01], [0.02, 0.04]], np.float32)))
    assert (picture[0, 0] == heat()[0]).all()
    assert (picture[1, 0] == heat()[128]).all()
    assert (picture[1, 1] == heat()[255]).all()
    assert (np.asarray(attention_map(np.zeros((2, 2), np.float32))) == heat()[0]).all()


def places(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return np.argwhere((picture == color).all(-1))


@pytest.mark.parametrize(
    ("size", "query"), [((90, 160), (140, 20)), ((720, 1280), (3, 700)), ((20, 17), (8, 9))]
)
def test_the_picture_marks_the_patch_in_the_image_and_the_query_in_the_patch(
    size: tuple[int, int], query: tuple[int, int]
) -> None:
    grey = np.full((*size, 3), 0.2, np.float32)
    corner = (max(0, query[0] - 7), max(0, query[1] - 7))
    extent = (min(size[0], query[1] + 7) - corner[1], min(size[1], query[0] + 7) - corner[0])
    maps = np.full((3, 2, *extent), 1 / 250, np.float32)
    picture = np.asarray(attention_picture(grey, 1.0, Attention(query, corner, maps), "wall"))
    gray = tuple(picture[TOP + 3, LEFT + 3])
    assert gray[0] == pytest.approx(255 * 0.2**0.454545, abs=1)
    row = picture[TOP + 3, LEFT:]
    width = int(np.flatnonzero((row != gray).any(-1) & (row != YELLOW).any(-1) & (row != 0).any(-1))[0])
    marks = places(picture[:, : LEFT + width], YELLOW)
    factor = width / size[1]
    center = (marks.min(0) + marks.max(0) + 1) / 2 - (TOP, LEFT)
    patch = [min(PATCH, side) / 2 for side in size]
    wanted = [
        np.clip(query[1], patch[0], size[0] - patch[0]),
        np.clip(query[0], patch[1], size[1] - patch[1]),
    ]
    assert np.abs(center / factor - wanted).max() < 2 / factor + 2
    reds = places(picture, RED)
    assert len(reds) > 50  # in the patch and in the window
    assert reds[:, 1].max() > LEFT + width


def test_every_block_has_a_map_and_weight_outside_of_the_image_needs_a_line_more() -> None:
    grey = np.full((40, 40, 3), 0.2, np.float32)
    sizes = []
    for blocks, share in ((4, 1.0), (6, 1.0), (4, 0.9)):
        maps = np.full((blocks, 1, 14, 14), share / 196, np.float32)
        sizes.append(attention_picture(grey, 1.0, Attention((9, 9), (5, 5), maps)).size)
    assert sizes[1][0] - sizes[0][0] == 2 * (168 + 12)
    assert sizes[0][1] == sizes[1][1] < sizes[2][1]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    net, path = network(), tmp_path_factory.mktemp("model") / "afgsa.ckpt"
    tree = {"class_path": "models.AFGSA", "init_args": {"width": 16, "blocks": 2, "heads": 2}}
    weights = {f"net.{name}": value for name, value in net.state_dict().items()}
    torch.save({"hyper_parameters": {"net": tree}, "state_dict": weights}, path)
    return path


def test_denoise_writes_the_picture_beside_the_others(checkpoint: Path, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1))
    options = ("--model", checkpoint, folder, "--png", "--attention", "30,7")
    assert run(*options, "--output", tmp_path / "out") == 0
    assert {p.name for p in (tmp_path / "out").glob("*_attention.png")} == {
        "f000_attention.png",
        "f001_attention.png",
    }
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"f000.exr", "f000.png", "f000_comparison.png"}
    net = network()
    stored = derive(read_frame(folder / "f001.exr"), net.inputs)
    images = {name: torch.from_numpy(stored.buffers[name]).permute(2, 0, 1)[None] for name in net.inputs}
    attention = attention_of(net, {**images, "exposure": torch.tensor([0.25])}, (30, 7))
    denoised = read_frame(tmp_path / "out" / "f001.exr").buffers["color"]
    expected = np.asarray(attention_picture(denoised, 0.25, attention, "wall/frame 1")).astype(int)
    found = np.asarray(Image.open(tmp_path / "out" / "f001_attention.png")).astype(int)
    assert found.shape == expected.shape
    assert (np.abs(found - expected).max(-1) > 2).mean() < 1e-3  # one step of a colour where 16 bits round
    with pytest.raises(ValueError, match=r"already there"):
        run(*options, "--output", tmp_path / "out")


def test_a_pixel_outside_of_a_frame_stops_before_the_frame_is_denoised(
    checkpoint: Path, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    for wrong in ("38,0", "0,26"):
        with pytest.raises(ValueError, match=rf"f000\.exr: --attention {wrong} lies outside .* 38x26 pixels"):
            run("--model", checkpoint, folder, "--output", tmp_path / "o", "--png", "--attention", wrong)
    assert not list((tmp_path / "o").iterdir())


@pytest.mark.parametrize("text", ["3", "3,4,5", "a,b", "1.5,2", "", "3;4"])
def test_what_is_not_two_whole_numbers_is_wrong_usage(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        run("--model", "x.ckpt", "a.exr", "--output", "out", "--png", f"--attention={text}")
    assert stopped.value.code == 2
    assert "expected its column and row, such as 120,64" in capsys.readouterr().err


def test_attention_without_png_is_wrong_usage(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "trainer",
        "denoise",
        "--model",
        str(checkpoint),
        str(tmp_path),
        "--output",
        str(tmp_path / "o"),
    ]
    monkeypatch.setattr(sys, "argv", [*command, "--attention", "1,2"])
    assert main() == 2
    assert "--attention draws a picture: expected --png with it" in capsys.readouterr().err


def test_models_without_attention_say_what_is_needed(checkpoint: Path, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    options = (folder, "--output", tmp_path / "out", "--png", "--attention", "1,2")
    with pytest.raises(
        ValueError, match=r"such as AFGSA; JointBilateral holds JointBilateral, which has none"
    ):
        run("--model", "JointBilateral", *options)
    net = WSKP(layers=2, width=6, kernel_sizes=(3, 5))
    export(net, tmp_path / "net.ts", "torchscript")
    with pytest.raises(ValueError, match=r"net\.ts is an exported file.*the checkpoint it was made from"):
        run("--model", tmp_path / "net.ts", *options)
    assert not list((tmp_path / "out").iterdir())
