import sys

import numpy as np
import pytest

from data.frames import FrameSet
from data.layouts import LAYOUTS, layout, likeliest, likenesses
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


def test_hidden_folders_are_no_scenes(tmp_path):
    source = tungsten(tmp_path / "source", ("kitchen",))
    for name in ("..hidden", ".git"):
        write_one(source / name / "color.exr", shot(1)["color"])
    assert [scene.name for scene in layout("tungsten").describe(source)] == ["kitchen"]
