"""`trainer denoise` and exported files with recurrent methods: the state goes from frame to frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from data.exr import read_frame
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from models import RAE, SVGF
from models.denoiser import State
from tests.trainer.test_denoise_classical import frame, run, write
from trainer.export import SUFFIXES, export, load_artifact
from trainer.export.register import log_and_register, using_store

pytestmark = pytest.mark.usefixtures("one_thread")

INPUTS = ("irradiance", "albedo", "normal", "depth")
SIZE = (20, 24)
COUNT = 3


@pytest.fixture(scope="module")
def network() -> RAE:
    torch.manual_seed(2)
    return RAE(stages=(4, 5), tail=(6, 5)).eval()


@pytest.fixture(scope="module")
def files(network: RAE, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    paths = {format: folder / f"rae{suffix}" for format, suffix in SUFFIXES.items()}
    for format, path in paths.items():
        export(network, path, format)  # type: ignore[arg-type]
    return paths


def clip(folder: Path, indices: range | tuple[int, ...] = range(COUNT), size: tuple[int, int] = SIZE) -> Path:
    for index in indices:
        write(folder / f"f{index:03d}.exr", frame(*INPUTS, size=size, seed=index, index=index))
    return folder


def expected(network: RAE, folder: Path, starts: tuple[int, ...] = (0,)) -> np.ndarray:
    """Denoise the frames of a folder in order; sequences begin at the places `starts`."""
    colors, state = [], None
    for place, path in enumerate(sorted(folder.glob("*.exr"))):
        read = read_frame(path).buffers
        buffers: dict[str, Tensor] = {
            n: torch.from_numpy(read[n].transpose(2, 0, 1).copy())[None] for n in INPUTS
        }
        with torch.no_grad():
            color, state, _ = network(buffers, None if place in starts else state)
        colors.append(color[0].permute(1, 2, 0).numpy())
    return np.stack(colors)


def denoised(source: Path, output: Path, model: Path, *arguments: str) -> np.ndarray:
    assert run(source, "--model", model, "--output", output, "--exposure", "1", *arguments) == 0
    return np.stack([read_frame(path).buffers["color"] for path in sorted(output.rglob("*.exr"))])


def close(found: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=1e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("format", sorted(SUFFIXES))
def test_the_state_goes_from_frame_to_frame(
    network: RAE, files: dict[str, Path], tmp_path: Path, format: str
) -> None:
    source = clip(tmp_path / "in")
    whole, alone = expected(network, source), expected(network, source, tuple(range(COUNT)))
    assert np.abs(whole[-1] - alone[-1]).max() > 0.02 * np.abs(whole[-1]).max()
    close(denoised(source, tmp_path / "out", files[format]), whole)


def test_the_state_is_cut_into_tiles(network: RAE, files: dict[str, Path], tmp_path: Path) -> None:
    source = clip(tmp_path / "in", size=(150, 140))
    # Too little for one piece: what a pixel takes is in the file.
    found = denoised(source, tmp_path / "out", files["onnx"], "--memory", "50M")
    close(found, expected(network, source))


def test_a_missing_frame_starts_a_sequence_which_is_said(
    network: RAE, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = clip(tmp_path / "in", (0, 1, 4, 5))
    close(denoised(source, tmp_path / "out", files["onnx"]), expected(network, source, (0, 2)))
    told = "".join(capsys.readouterr())
    assert told.count("starts a new sequence there") == 1
    assert "frame 4 does not go on from the frame before" in told


def test_frames_after_those_that_are_finished_are_not_denoised_without_their_state(
    files: dict[str, Path], tmp_path: Path
) -> None:
    source = clip(tmp_path / "in")
    whole = denoised(source, tmp_path / "out", files["onnx"])
    (tmp_path / "out" / "f002.exr").unlink()
    again = (source, "--model", files["onnx"], "--output", tmp_path / "out", "--exposure", "1")
    with pytest.raises(ValueError, match=r"already there \(2 in all\); --force replaces them"):
        run(*again)
    assert not (tmp_path / "out" / "f002.exr").exists()
    np.testing.assert_array_equal(denoised(source, tmp_path / "out", files["onnx"], "--force"), whole)


def test_a_single_frame_is_told_to_be_the_first_of_a_sequence(
    network: RAE, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = clip(tmp_path / "in", (4,))
    close(denoised(source, tmp_path / "out", files["onnx"]), expected(network, source))
    assert "a single frame: " in (told := "".join(capsys.readouterr()))
    assert "denoises it as the first of a sequence" in told


def test_frames_of_another_size_start_a_sequence(
    network: RAE, files: dict[str, Path], tmp_path: Path
) -> None:
    source = clip(tmp_path / "in", (0, 1))
    clip(source, (2, 3), size=(16, 28))
    assert run(source, "--model", files["onnx"], "--output", tmp_path / "out", "--exposure", "1") == 0
    small = clip(tmp_path / "small", (2, 3), size=(16, 28))
    found = [read_frame(tmp_path / "out" / f"f{index:03d}.exr").buffers["color"] for index in (2, 3)]
    close(np.stack(found), expected(network, small))


def test_nothing_has_moved_in_the_first_frame_of_a_sequence(tmp_path: Path) -> None:
    names = tuple(name for name in SVGF.inputs if name != "motion")
    for index in range(3):
        made = frame(*names, size=SIZE, seed=index, index=index)
        if index:
            made.buffers["motion"] = np.full((*SIZE, 2), 0.25, np.float32)
        write(tmp_path / "in" / f"f{index:03d}.exr", made)
    found = denoised(tmp_path / "in", tmp_path / "out", Path("SVGF"))
    method, state, colors = SVGF(), None, []
    for path in sorted((tmp_path / "in").glob("*.exr")):
        read = read_frame(path).buffers
        read.setdefault("motion", np.zeros((*SIZE, 2), np.float32))
        buffers = {n: torch.from_numpy(read[n].transpose(2, 0, 1).copy())[None] for n in method.inputs}
        color, state, _ = method(buffers, state)
        colors.append(color[0].permute(1, 2, 0).numpy())
    close(found, np.stack(colors))


def test_a_later_frame_without_motion_is_refused(tmp_path: Path) -> None:
    names = tuple(name for name in SVGF.inputs if name != "motion")
    for index in range(2):
        write(tmp_path / "in" / f"f{index:03d}.exr", frame(*names, size=SIZE, seed=index, index=index))
    with pytest.raises(
        ValueError,
        match=r"missing buffer 'motion'.*; SVGF works on sequences: `trainer render sequences` writes",
    ):
        run(tmp_path / "in", "--model", "SVGF", "--output", tmp_path / "out")


def path_of_two_levels(root: Path, sequence: bool = True) -> list[dict[str, Tensor]]:
    """Write a camera path whose views have 4 and 8 samples per pixel; returns what SVGF reads of all."""
    records, given = [], []
    for index in range(6):
        made = replace(
            frame(*INPUTS, "reference", size=SIZE, seed=index, index=index), spp=4 + 4 * (index % 2)
        )
        made.buffers["motion"] = np.full((*SIZE, 2), 0.25, np.float32)
        made.notes["view"] = index // 2
        records.append(write_record(made, root))
        read = read_frame(root / records[-1].file).buffers
        given.append({n: torch.from_numpy(read[n].transpose(2, 0, 1).copy())[None] for n in SVGF.inputs})
    scenes = {"surface": SceneRecord(tuple(records), sequence)}
    Manifest("set", "render", "euclidean", {"train": [], "validation": [], "test": ["surface"]}, scenes).save(
        root
    )
    return given


def test_a_path_with_several_numbers_of_samples_is_a_sequence_for_each(tmp_path: Path) -> None:
    given = path_of_two_levels(tmp_path / "in")
    assert run(tmp_path / "in", "--model", "SVGF", "--output", tmp_path / "out", "--exposure", "1") == 0
    for level in (0, 1):
        state: State | None = None
        for index in range(level, 6, 2):
            color, state, _ = SVGF()(given[index], state)
            found = read_frame(tmp_path / "out" / "surface" / f"f{index:03d}.exr").buffers["color"]
            close(found, color[0].permute(1, 2, 0).numpy())


def test_files_of_a_set_of_independent_views_are_no_sequence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = path_of_two_levels(tmp_path / "in", sequence=False)
    files = sorted((tmp_path / "in" / "surface").glob("*.exr"))[::2]
    assert run(*files, "--model", "SVGF", "--output", tmp_path / "out", "--exposure", "1") == 0
    assert "the frames are independent views" in capsys.readouterr().err
    for place, path in enumerate(files):
        color = SVGF()(given[2 * place]).color
        found = read_frame(tmp_path / "out" / path.name).buffers["color"]
        close(found, color[0].permute(1, 2, 0).numpy())


def test_files_of_one_view_with_several_numbers_of_samples_are_no_sequence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = path_of_two_levels(tmp_path / "in")
    files = sorted((tmp_path / "in" / "surface").glob("*.exr"))[:2]
    assert run(*files, "--model", "SVGF", "--output", tmp_path / "out", "--exposure", "1") == 0
    assert "the frames are independent views" in capsys.readouterr().err
    color = SVGF()(given[1]).color
    close(read_frame(tmp_path / "out" / "f001.exr").buffers["color"], color[0].permute(1, 2, 0).numpy())


def test_files_name_their_state_and_how_a_sequence_starts(files: dict[str, Path]) -> None:
    model = onnx.load(files["onnx"])
    assert [i.name for i in model.graph.input][-3:] == ["hidden0", "hidden1", "hidden2"]
    assert [o.name for o in model.graph.output] == ["color", "next_hidden0", "next_hidden1", "next_hidden2"]
    assert "Zeros start a sequence" in model.doc_string
    assert load_artifact(files["onnx"]).state_maps == {
        "hidden0": (4, 1),
        "hidden1": (5, 2),
        "hidden2": (5, 4),
    }


@pytest.mark.slow
def test_a_registered_model_takes_and_returns_its_state_through_pyfunc(
    network: RAE, files: dict[str, Path], tmp_path: Path
) -> None:
    import mlflow
    from mlflow.tracking import MlflowClient

    uri = f"sqlite:///{tmp_path}/mlflow.db"
    client = MlflowClient(uri, uri)
    place = client.create_experiment("test", artifact_location=(tmp_path / "artifacts").as_uri())
    version = log_and_register(client.create_run(place).info.run_id, files["onnx"], "rae", uri)
    with using_store(uri):
        model = mlflow.pyfunc.load_model(f"models:/rae/{version}")
    maps = {
        name: np.zeros((1, c, 20 // s, 24 // s), np.float32) for name, (c, s) in network.state_maps.items()
    }
    state: State | None = None
    for seed in range(2):
        buffers = {n: b.transpose(2, 0, 1)[None].copy() for n, b in frame(*INPUTS, seed=seed).buffers.items()}
        made = model.predict({**buffers, "exposure": np.ones(1, np.float32), **maps})
        maps = {name: made[f"next_{name}"] for name in maps}
        with torch.no_grad():
            given = {name: torch.from_numpy(array) for name, array in buffers.items()}
            wanted, state, _ = network(given, state)
        close(made["color"], wanted.numpy())


def test_torchscript_carries_the_state_without_penumbra(network: RAE, files: dict[str, Path]) -> None:
    module = torch.jit.load(files["torchscript"])
    frames = [
        {
            n: torch.from_numpy(b.transpose(2, 0, 1).copy())[None]
            for n, b in frame(*INPUTS, seed=s).buffers.items()
        }
        for s in range(2)
    ]
    before = {
        name: torch.zeros(1, c, 20 // side, 24 // side) for name, (c, side) in network.state_maps.items()
    }
    color, *maps = module({**frames[0], **before})
    color, *maps = module({**frames[1], **dict(zip(before, maps, strict=True))})
    state: State | None = None
    with torch.no_grad():
        for given in frames:
            wanted, state, _ = network(given, state)
    close(color.detach().numpy(), wanted.numpy())
    with pytest.raises(torch.jit.Error, match="missing state hidden0; zeros start a sequence"):
        module(frames[0])
