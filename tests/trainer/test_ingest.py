import argparse
import json
import os
import shutil

import h5py
import numpy as np
import pytest

from data.derive import automatic_exposure
from data.exr import read_frame
from data.frames import FrameSet
from data.ingestion import PARTIAL, IngestOptions, ingest
from data.inspection import inspect_path
from data.layouts import LAYOUTS
from data.manifest import MANIFEST
from tests.data import layout_samples as layer_samples
from tests.data.miniature import (
    BMFR_FILES,
    Crop,
    bmfr_scene,
    camera_header,
    penumbra_scene,
    sample_crop,
    write_rgb,
)
from trainer.commands import ingest as command
from trainer.commands import inspect


@pytest.fixture
def bmfr(tmp_path):
    for scene in ("classroom", "living-room-2"):
        bmfr_scene(tmp_path / "bmfr", scene)
    return tmp_path / "bmfr"


@pytest.fixture
def penumbra(tmp_path):
    for scene in ("cbox-glossy", "classroom", "living-room-2"):
        penumbra_scene(tmp_path / "penumbra", scene)
    return tmp_path / "penumbra"


def call(*arguments):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(a) for a in arguments]))


def test_bmfr_becomes_a_data_set_with_exposure_one_and_z_depth(bmfr, tmp_path, capsys):
    assert call(bmfr, "--layout", "bmfr", "--output", tmp_path / "set", "--processes", 1) == 0
    frames = FrameSet(tmp_path / "set")
    assert frames.check() == []
    assert frames.manifest.depth == "z"
    assert frames.scenes("test") == ["living-room-2"]
    frame = frames.read("classroom", 1)
    original = sample_crop("classroom", 1)
    assert frame.exposure == 1.0
    matrix = original.camera.world_to_pixel
    expected = original.buffers["position"] @ matrix[3, :3] + matrix[3, 3]
    assert np.allclose(frame.buffers["depth"][..., 0], expected, atol=1e-4)
    assert np.allclose(frame.buffers["color"], original.buffers["color"], rtol=2e-3, atol=1e-4)
    assert frames.manifest.scenes["classroom"].thresholds["position_limit_squared"] == 0.01
    text = capsys.readouterr()
    assert "derived on reading: depth = w of the projected position" in text.out
    assert "next: trainer prepare" in text.out
    assert "frames: 4 of 4" in text.err


def test_penumbra_takes_exposure_from_the_sidecar_and_splits_as_told(penumbra, tmp_path):
    call(
        *(penumbra, "--layout", "penumbra", "--output", tmp_path / "set", "--processes", 1),
        *("--test", "classroom", "--validation", "cbox-glossy"),
    )
    frames = FrameSet(tmp_path / "set")
    assert frames.manifest.splits == {
        "train": ["living-room-2"],
        "validation": ["cbox-glossy"],
        "test": ["classroom"],
    }
    for index in (0, 1):
        assert frames.read("classroom", index).exposure == sample_crop("classroom", index).exposure


def test_exposure_can_be_a_number_or_measured(penumbra, tmp_path):
    ingest("penumbra", penumbra, tmp_path / "a", IngestOptions(exposure="2.5"))
    ingest("penumbra", penumbra, tmp_path / "b", IngestOptions(exposure="auto"))
    assert FrameSet(tmp_path / "a").read("classroom", 0).exposure == 2.5
    measured = FrameSet(tmp_path / "b").read("classroom", 0)
    assert measured.exposure == pytest.approx(automatic_exposure(measured.buffers["color"]))


def test_a_frame_that_states_no_exposure_is_measured(penumbra, tmp_path):
    path = penumbra / "classroom" / "sequence.json"
    sidecar = json.loads(path.read_text())
    for frame in sidecar["frames"]:
        del frame["reference"]
    path.write_text(json.dumps(sidecar))
    ingest("penumbra", penumbra, tmp_path / "set")
    frame = FrameSet(tmp_path / "set").read("classroom", 0)
    assert frame.exposure == pytest.approx(automatic_exposure(frame.buffers["color"]))


def test_only_the_named_buffers_are_stored(penumbra, tmp_path):
    ingest("penumbra", penumbra, tmp_path / "set", IngestOptions(buffers=("color", "normal")))
    stored = read_frame(tmp_path / "set" / "classroom" / "f000.exr")
    assert list(stored.buffers) == ["color", "normal"]


def test_several_processes_write_the_same_data_set(penumbra, tmp_path):
    one = ingest("penumbra", penumbra, tmp_path / "a")
    two = ingest("penumbra", penumbra, tmp_path / "b", IngestOptions(processes=2))
    assert one.hash == two.hash


def test_stills_are_kept_apart_from_sequences(tmp_path):
    penumbra_scene(tmp_path / "source", "classroom", kind="stills")
    ingest("penumbra", tmp_path / "source", tmp_path / "set")
    frames = FrameSet(tmp_path / "set")
    assert frames.read("classroom", 1).notes["sequence"] is False
    assert np.allclose(
        frames.read("classroom", 0).buffers["color"],
        sample_crop("classroom", 0).buffers["color"] * 0.75,
        rtol=2e-3,
    )


def test_an_interrupted_ingestion_goes_on_where_it_stopped(penumbra, tmp_path):
    seen = []

    def stop(done, total, label):
        seen.append(label)
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest("penumbra", penumbra, tmp_path / "set", progress=stop)
    assert not (tmp_path / "set" / MANIFEST).exists()
    finished = {p: p.stat().st_mtime_ns for p in (tmp_path / "set").rglob("f*.exr")}
    assert len(finished) == 3
    manifest = ingest("penumbra", penumbra, tmp_path / "set")
    assert all(p.stat().st_mtime_ns == t for p, t in finished.items())
    assert manifest.hash == ingest("penumbra", penumbra, tmp_path / "other").hash
    assert not (tmp_path / "set" / PARTIAL).exists()


def test_a_frame_damaged_in_between_is_written_again(penumbra, tmp_path):
    def stop(done, total, label):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest("penumbra", penumbra, tmp_path / "set", progress=stop)
    (tmp_path / "set" / "cbox-glossy" / "f000.exr").write_bytes(b"cut")
    ingest("penumbra", penumbra, tmp_path / "set")
    assert FrameSet(tmp_path / "set").check() == []


def test_unfinished_work_of_another_source_is_not_mixed_in(penumbra, bmfr, tmp_path):
    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest("penumbra", penumbra, tmp_path / "set", progress=stop)
    with pytest.raises(ValueError, match="unfinished work of another ingestion; --force discards it"):
        ingest("bmfr", bmfr, tmp_path / "set")
    ingest("bmfr", bmfr, tmp_path / "set", IngestOptions(force=True))
    assert FrameSet(tmp_path / "set").manifest.layout == "bmfr"


def test_a_finished_data_set_is_replaced_only_by_force(penumbra, tmp_path):
    ingest("penumbra", penumbra, tmp_path / "set")
    with pytest.raises(ValueError, match="already holds a data set; --force replaces it"):
        ingest("penumbra", penumbra, tmp_path / "set")
    (tmp_path / "set" / "notes.txt").write_text("mine")
    shutil.rmtree(penumbra / "living-room-2")
    ingest("penumbra", penumbra, tmp_path / "set", IngestOptions(force=True))
    names = {p.name for p in (tmp_path / "set").iterdir()}
    assert names == {"cbox-glossy", "classroom", MANIFEST, "notes.txt"}


def test_a_folder_with_other_files_is_left_alone(penumbra, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="is not empty and no data set"):
        ingest("penumbra", penumbra, tmp_path / "home", IngestOptions(force=True))
    assert [p.name for p in (tmp_path / "home").iterdir()] == ["letter.txt"]


def test_a_wrong_root_names_the_layout_that_it_looks_like(penumbra, bmfr, tmp_path):
    with pytest.raises(ValueError, match="looks like the layout `penumbra`: use --layout penumbra"):
        ingest("bmfr", penumbra, tmp_path / "set")
    with pytest.raises(ValueError, match="looks like the layout `bmfr`: use --layout bmfr"):
        ingest("penumbra", bmfr, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--layout", "exrs"], "unknown layout 'exrs'; known: acfm, afgsa"),
        (["--layout", "bmfr", "--test", "attic"], "there is no scene 'attic' to hold out; scenes: classroom"),
        (["--layout", "bmfr", "--buffers", "colour"], "unknown buffer 'colour'"),
        (
            ["--layout", "bmfr", "--exposure", "-2"],
            "exposure '-2': expected layout, auto or a positive number",
        ),
        (["--layout", "bmfr", "--exposure", "high"], "exposure 'high'"),
        (["--layout", "bmfr", "--processes", "0"], "--processes is 0"),
    ],
)
def test_wrong_options_are_named_before_anything_is_written(bmfr, tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        call(bmfr, "--output", tmp_path / "set", *arguments)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("make", [lambda p: p.mkdir(), lambda p: None])
def test_an_empty_or_absent_root_is_named(tmp_path, make):
    make(tmp_path / "root")
    with pytest.raises((ValueError, OSError), match=r"root (is empty|does not exist)"):
        ingest("bmfr", tmp_path / "root", tmp_path / "set")


def test_a_missing_buffer_is_named_with_its_frame(penumbra, tmp_path):
    with pytest.raises(ValueError, match="cbox-glossy/frame 0: missing buffer visibility"):
        ingest("penumbra", penumbra, tmp_path / "set", IngestOptions(buffers=("visibility",)))
    assert not (tmp_path / "set" / MANIFEST).exists()


def test_frames_of_one_sequence_must_have_one_size(bmfr, tmp_path):
    small = sample_crop("classroom", 1, Crop(width=32, height=32))
    for role, buffer in BMFR_FILES.items():
        write_rgb(bmfr / "classroom" / "inputs" / f"{role}1.exr", small.buffers[buffer])
    with pytest.raises(ValueError, match=r"different sizes: 48x32 \(frame 0\), 32x32 \(frame 1\)"):
        ingest("bmfr", bmfr, tmp_path / "set")
    assert not (tmp_path / "set" / MANIFEST).exists()


def test_repaired_pixels_are_counted_and_reported(bmfr, tmp_path, capsys):
    color = sample_crop("classroom", 0).buffers["irradiance"].copy()
    color[3, 4:7] = np.nan
    write_rgb(bmfr / "classroom" / "inputs" / "color0.exr", color)
    call(bmfr, "--layout", "bmfr", "--output", tmp_path / "set", "--processes", 1)
    assert "repaired: 3 pixels of irradiance were NaN or Inf" in capsys.readouterr().out
    records = FrameSet(tmp_path / "set").frames("classroom")
    assert [r.repaired for r in records] == [{"irradiance": 3}, {}]
    assert np.isfinite(FrameSet(tmp_path / "set").read("classroom", 0).buffers["irradiance"]).all()


def test_a_full_disk_stops_with_a_clear_error_and_no_manifest(penumbra, tmp_path, monkeypatch):
    replace, calls = os.replace, []

    def full(source, target):
        calls.append(target)
        if len(calls) > 4:
            raise OSError(28, os.strerror(28))
        replace(source, target)

    monkeypatch.setattr("data.exr_image.os.replace", full)
    with pytest.raises(OSError, match="No space left on device; check permissions and free space"):
        ingest("penumbra", penumbra, tmp_path / "set")
    monkeypatch.undo()
    assert not (tmp_path / "set" / MANIFEST).exists()
    assert not list((tmp_path / "set").rglob("*.tmp"))
    ingest("penumbra", penumbra, tmp_path / "set")
    assert FrameSet(tmp_path / "set").check() == []


def test_an_output_that_cannot_be_a_folder_is_refused(penumbra, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="is a file; --output must name a folder"):
        ingest("penumbra", penumbra, tmp_path / "file")
    with pytest.raises(OSError, match=r"cannot write to .*choose another --output"):
        ingest("penumbra", penumbra, tmp_path / "file" / "below")


def test_two_scenes_of_one_name_are_refused(penumbra, tmp_path):
    shutil.copytree(penumbra / "classroom", penumbra / "classroom-copy")
    with pytest.raises(ValueError, match="two scenes are called 'classroom'"):
        ingest("penumbra", penumbra, tmp_path / "set")


def test_a_scene_name_that_leaves_the_folder_is_refused(penumbra, tmp_path):
    path = penumbra / "classroom" / "sequence.json"
    path.write_text(path.read_text().replace('"scene": "classroom"', '"scene": "../classroom"'))
    with pytest.raises(ValueError, match="cannot be the name of a folder"):
        ingest("penumbra", penumbra, tmp_path / "set")


def test_limits_of_the_camera_file_reach_the_manifest(bmfr, tmp_path):
    text = camera_header([np.eye(4)] * 2, (0.5, 2.0))
    (bmfr / "classroom" / "inputs" / "camera_matrices.h").write_text(text)
    manifest = ingest("bmfr", bmfr, tmp_path / "set")
    assert manifest.scenes["classroom"].thresholds == {
        "position_limit_squared": 0.5,
        "normal_limit_squared": 2.0,
    }


def test_the_layout_is_recognised_where_none_is_named(penumbra, tmp_path, capsys):
    assert call(penumbra, "--output", tmp_path / "set", "--processes", 1) == 0
    assert FrameSet(tmp_path / "set").manifest.layout == "penumbra"
    assert "layout penumbra" in capsys.readouterr().out


def test_a_folder_that_resembles_no_layout_is_refused_with_the_layouts(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "notes.txt").write_text("nothing")
    with pytest.raises(ValueError, match=r"resembles none of the layouts .*oidn.*--layout"):
        call(tmp_path / "x", "--output", tmp_path / "set")


def test_a_folder_of_several_data_sets_is_told_what_its_subfolders_are(penumbra, bmfr, tmp_path):
    (tmp_path / "both").mkdir()
    penumbra.rename(tmp_path / "both" / "a")
    bmfr.rename(tmp_path / "both" / "b")
    with pytest.raises(ValueError, match=r"resembles none .*; in it, a/ is penumbra, b/ is bmfr: name one"):
        call(tmp_path / "both", "--output", tmp_path / "set")


def test_the_help_names_every_layout():
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    text = " ".join(parser.format_help().split())
    assert "arranged: bmfr (BMFR, WSKP), nbgd, " in text
    assert all(name in command.KNOWN for name in LAYOUTS)


def test_one_view_is_not_called_views():
    assert [command.frames_text(n, s) for n, s in ((1, False), (2, False), (8, True))] == [
        "1 view",
        "2 views",
        "8",
    ]


def test_what_a_layout_assumed_and_normalised_is_in_the_record_and_the_report(tmp_path, capsys):
    layer_samples.layerdenoise(tmp_path / "source")
    assert call(tmp_path / "source", "--output", tmp_path / "set", "--processes", 1) == 0
    manifest = FrameSet(tmp_path / "set").manifest
    record = next(iter(manifest.scenes.values())).frames[0]
    assert record.remarks["normalised"] == ["depth"]
    assert record.remarks["assumed"]
    out = capsys.readouterr().out
    assert "normalised by the source, no scene units: depth" in out
    assert "assumed: " in out
    assert "stored per sample: radiance, " in out


def test_dropped_samples_are_in_the_record_the_report_and_what_inspect_says(tmp_path, capsys):
    arrays = layer_samples.layer_pair(tmp_path / "source", "clip")
    with h5py.File(tmp_path / "source" / "clip_input.h5", "r+") as file:
        file["color"][0, 1, :, 2, 3] = np.nan
        file["albedo"][1, :, 0, 1, 1] = np.inf
    call(tmp_path / "source", "--layout", "layerdenoise", "--output", tmp_path / "set", "--processes", 1)
    count = arrays["color"].shape[1]
    told = f"{1 + count} samples with NaN or Inf in 2 pixels were dropped; 1 pixel had no other"
    assert f"samples: {told}" in capsys.readouterr().out
    frames = FrameSet(tmp_path / "set")
    assert [f.remarks["dropped"] for f in frames.frames("clip")] == [[1, 1, 0], [count, 1, 1]]
    frame = frames.read("clip", 1)
    assert np.isnan(frame.samples.values[:, 1, 1]).all()
    assert np.isfinite(frame.buffers["color"]).all()
    found = inspect_path(tmp_path / "set")
    assert found["scenes"]["clip"]["dropped"] == {"samples": 1 + count, "pixels": 2, "empty": 1}
    assert found["first_frames"]["clip"]["samples"]["dropped"] == {"samples": 1, "pixels": 1, "empty": 0}
    parser = argparse.ArgumentParser()
    inspect.add_arguments(parser)
    assert inspect.run(parser.parse_args([str(tmp_path / "set")])) == 0
    out = capsys.readouterr().out
    assert f"clip: samples: {told}" in out
    assert "\nsamples: 1 sample with NaN or Inf in 1 pixel was dropped\n" in out


def test_a_normal_that_was_decoded_is_in_the_report(tmp_path, capsys):
    layer_samples.oidn_view(tmp_path / "source", "view", ("4spp", "64spp"), encoded=True)
    assert call(tmp_path / "source", "--layout", "oidn", "--output", tmp_path / "set", "--processes", 1) == 0
    assert "decoded: normal, 2 n - 1" in capsys.readouterr().out
