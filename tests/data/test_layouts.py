import os
import sys
from pathlib import Path

import numpy as np
import pytest

from data.frames import FrameSet
from data.ingestion import IngestOptions, ingest
from data.inspection import inspect_path
from data.layouts import LAYOUTS, layout, likeliest, likenesses
from data.layouts.walk import files_below
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_miniatures import MINIATURES, acfm, kpcn, nbgd, shot, tungsten, write_one
from tests.data.miniature import bmfr_scene, penumbra_scene
from trainer.cli import main

KNOWN = {
    **MINIATURES,
    "nbgd 64 spp": lambda root: nbgd(root, "64spp"),
    "nbgd positions": lambda root: nbgd(root, "positions"),
    "kpcn with halves": lambda root: kpcn(root, "RGB", halves=True),
    **{n: getattr(layout_samples, n) for n in ("oidn", "sbmc", "layerdenoise", "blender", "mitsuba")},
    "bmfr": lambda root: bmfr_scene(root, "classroom"),
    "penumbra": lambda root: penumbra_scene(root, "classroom"),
    "penumbra stills": lambda root: penumbra_scene(root, "classroom", kind="stills"),
}


@pytest.mark.parametrize("title", KNOWN)
def test_every_miniature_is_recognised_as_its_own_layout(tmp_path, title):
    KNOWN[title](tmp_path / "source")
    assert likeliest(tmp_path / "source") == title.split()[0], likenesses(tmp_path / "source")


@pytest.mark.parametrize("title", KNOWN)
def test_no_layout_fails_on_the_folder_of_another_but_with_a_plain_error(tmp_path, title):
    KNOWN[title](tmp_path / "source")
    for name in LAYOUTS:
        assert 0 <= layout(name).likeness(tmp_path / "source") <= 1
        assert described(name, tmp_path / "source")


def described(name, root):
    """Return the scenes, or the file or folder that the error names."""
    try:
        return layout(name).describe(root)
    except (ValueError, OSError) as error:
        return str(root) in str(error)


@pytest.mark.parametrize("name", LAYOUTS)
def test_likeness_to_an_empty_or_broken_or_absent_folder_is_no_error(tmp_path, name):
    module = layout(name)
    assert module.likeness(tmp_path / "none") == 0
    assert module.likeness(tmp_path) == 0
    (tmp_path / "s").mkdir()
    for file in (
        "a.exr",
        "s/b.exr",
        "s/color.exr",
        "train.h5",
        "x_input.h5",
        "x.bin",
        "s/x.bin",
        "s/y.hdr.exr",
    ):
        (tmp_path / file).write_bytes(b"broken")
    (tmp_path / "s" / "sequence.json").write_text("{")
    (tmp_path / "s" / "loop").symlink_to(tmp_path / "s")
    assert 0 <= module.likeness(tmp_path) <= 1


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_refuses_an_absent_and_an_empty_root(tmp_path, name):
    with pytest.raises(FileNotFoundError):
        layout(name).describe(tmp_path / "none")
    with pytest.raises(ValueError, match="empty"):
        layout(name).describe(tmp_path)


def test_an_unknown_layout_lists_the_known_ones():
    with pytest.raises(ValueError, match="unknown layout 'disney'; known: acfm, afgsa, blender, bmfr"):
        layout("disney")


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["trainer", *map(str, arguments)])
    return main()


@pytest.mark.parametrize("title", MINIATURES)
def test_every_miniature_is_ingested_from_the_command_line(tmp_path, monkeypatch, capsys, title):
    source, output = MINIATURES[title](tmp_path / "source"), tmp_path / "set"
    name = title.split()[0]
    arguments = ("ingest", source, "--layout", name, "--output", output, "--processes", 1)
    assert call(monkeypatch, *arguments) == 0, capsys.readouterr().err
    manifest = load_manifest(output)
    scenes = layout(name).describe(source)
    assert manifest.layout == name
    assert [*manifest.scenes] == [s.name for s in scenes]
    original, record = scenes[0].read(scenes[0].indices[0]), manifest.scenes[scenes[0].name].frames[0]
    assert (record.spp, record.reference_spp) == (original.spp, original.notes.get("reference_spp"))
    stored = FrameSet(output).read(scenes[0].name, record.index)
    assert {"color", "albedo", "irradiance", "reference", "normal"} <= stored.buffers.keys()
    for buffer, array in original.buffers.items():
        assert np.allclose(stored.buffers[buffer], array, rtol=1e-3, atol=1e-6), buffer


def test_two_processes_ingest_what_one_does(tmp_path, monkeypatch, capsys):
    source = acfm(tmp_path / "source", crops=1)
    for processes in (1, 2):
        output = tmp_path / str(processes)
        arguments = ("ingest", source, "--layout", "acfm", "--output", output, "--processes", processes)
        assert call(monkeypatch, *arguments) == 0, capsys.readouterr().err
    one, two = (load_manifest(tmp_path / n) for n in "12")
    assert [f.sha256 for f in one.scenes["house"].frames] == [f.sha256 for f in two.scenes["house"].frames]


def test_a_missing_buffer_ends_ingestion_with_one_line_and_writes_nothing(tmp_path, monkeypatch, capsys):
    source = tungsten(tmp_path / "source")
    for path in source.glob("kitchen/color*.exr"):
        path.unlink()
    assert call(monkeypatch, "ingest", source, "--layout", "tungsten", "--output", tmp_path / "set") == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert "missing buffer 'color'" in error
    assert not (tmp_path / "set").exists()


def test_the_wrong_layout_is_told_the_right_one(tmp_path, monkeypatch, capsys):
    source = kpcn(tmp_path / "source")
    assert call(monkeypatch, "ingest", source, "--layout", "tungsten", "--output", tmp_path / "set") == 1
    assert "looks like the layout `kpcn`: use --layout kpcn" in capsys.readouterr().err


@pytest.mark.parametrize("title", KNOWN)
def test_every_wrong_layout_is_told_the_right_one_once(tmp_path, title):
    source, right = tmp_path / "source", title.split()[0]
    KNOWN[title](source)
    for name in LAYOUTS:
        try:
            ingest(name, source, tmp_path / "set", IngestOptions(buffers=("none",)))
        except (ValueError, OSError) as error:
            text = str(error)
            told = text.count("looks like the layout") + text.count("use --layout")
            assert told == (0 if "unknown buffer" in text else 2), text
            assert told == 0 or text.endswith(f"looks like the layout `{right}`: use --layout {right}")


def test_a_list_of_tiles_is_recognised_inspected_and_ingested(tmp_path, monkeypatch, capsys):
    source = layout_samples.sbmc(tmp_path / "source")
    tiles = sorted(str(p.relative_to(source)) for p in source.rglob("*.bin"))
    (source / "list.txt").write_text("\n".join(tiles))
    assert likenesses(source / "list.txt") == {"sbmc": 1.0}
    assert inspect_path(source / "list.txt")["layout"] == "sbmc"
    assert call(monkeypatch, "ingest", source / "list.txt", "--output", tmp_path / "set") == 0
    assert "layout sbmc" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"list\.txt is a file.* looks like the layout `sbmc`"):
        ingest("oidn", source / "list.txt", tmp_path / "other")


def test_a_look_at_a_large_folder_passes_over_few_entries(tmp_path, monkeypatch):
    for number in range(12):
        folder = tmp_path / f"p{number:02d}" / "deep"
        folder.mkdir(parents=True)
        for name in range(5):
            (folder / f"{name}.bin").touch()
    opened = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: opened.append(folder) or scandir(folder))
    assert len(files_below(tmp_path, (".bin",), 30)) == 6
    assert len(opened) == 1 + 12 + 2
    assert len(files_below(tmp_path, (".bin",))) == 60
    for name in LAYOUTS:
        opened.clear()
        monkeypatch.setattr(f"data.layouts.{name}.LOOK", 30, raising=False)
        monkeypatch.setattr("data.layouts.walk.LOOK", 30)
        assert layout(name).likeness(tmp_path) == 0
        assert len(opened) <= 40, name


def test_hidden_files_and_links_to_folders_are_passed_over_and_links_in_a_circle_end(tmp_path):
    (tmp_path / "a" / ".cache").mkdir(parents=True)
    for name in ("a/0001.EXR", "a/.cache/0002.exr", "a/.0003.exr", "b.exr"):
        (tmp_path / name).touch()
    (tmp_path / "a" / "circle").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "broken.exr").symlink_to(tmp_path / "nowhere")
    found = [str(p.relative_to(tmp_path)) for p in files_below(tmp_path, (".exr",))]
    assert found == ["a/0001.EXR", "b.exr"]


def test_a_folder_that_cannot_be_read_resembles_nothing_but_is_not_left_out_unsaid(tmp_path, monkeypatch):
    source = layout_samples.blender(tmp_path / "source")
    locked = source / "locked"
    locked.mkdir()

    def refuse(of):
        def listed(folder):
            if Path(folder) == locked:
                raise PermissionError(13, "Permission denied", str(folder))
            return of(folder)

        return listed

    monkeypatch.setattr(os, "scandir", refuse(os.scandir))
    monkeypatch.setattr(Path, "iterdir", refuse(Path.iterdir))
    assert likeliest(source) == "blender"
    with pytest.raises(PermissionError, match="locked"):
        layout("blender").describe(source)


def test_hidden_folders_are_no_scenes(tmp_path):
    source = tungsten(tmp_path / "source", ("kitchen",))
    for name in ("..hidden", ".git"):
        write_one(source / name / "color.exr", shot(1)["color"])
    assert [scene.name for scene in layout("tungsten").describe(source)] == ["kitchen"]
