"""`trainer render` with the real renderer, on tiny images and one simple scene each."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from data.camera import motion
from data.frames import FrameSet
from data.manifest import FrameRecord, Manifest, SceneRecord
from data.render.references import ENERGY_LIMIT
from data.shards.index import Index
from data.shards.read import ShardReader
from trainer.cli import main
from trainer.commands.render import _resumable, _summary
from trainer.progress import SampleRate

SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0, 1, 4" target="0, 0.5, 0" up="0, 1, 0"/></transform>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.4, 0.2"/></bsdf>
  </shape>
  <shape type="sphere">
    <point name="center" x="0" y="0.6" z="0"/><float name="radius" value="0.6"/>
    <bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.2, 0.5, 0.7"/></bsdf>
  </shape>
  <emitter type="constant"><rgb name="radiance" value="0.8, 0.9, 1"/></emitter>
</scene>
"""


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "ball"
    folder.mkdir()
    (folder / "scene.xml").write_text(SCENE)
    (folder / "LICENSE").write_text("CC0-1.0\n")
    return folder / "scene.xml"


def command(kind, scene, output, *more):
    size = ("--size", "24x16", "--reference-spp", "16", "--processes", "1")
    return [str(a) for a in ("render", kind, "--scene", scene, "--output", output, *size, *more)]


def run(monkeypatch, arguments):
    monkeypatch.setattr(sys, "argv", ["trainer", *arguments])
    return main()


def test_stills_of_a_file_become_a_data_set_whose_energy_agrees(scene, tmp_path, monkeypatch, capsys):
    output = tmp_path / "set"
    assert run(monkeypatch, command("stills", scene, output, "--spp", 4, 8, "--frames", 2)) == 0
    frames = FrameSet(output)
    assert frames.check() == []
    records = frames.frames("ball")
    assert [(r.index, r.view, r.spp) for r in records] == [(0, 0, 4), (1, 0, 8), (2, 1, 4), (3, 1, 8)]
    assert all(abs(r.checks["energy_z"]) < ENERGY_LIMIT for r in records)
    frame = frames.read("ball", 1)
    assert {
        "color",
        "color_a",
        "albedo",
        "irradiance",
        "reference",
        "reference_diffuse",
    } <= frame.buffers.keys()
    assert np.allclose(np.median(frame.buffers["normal"][-1], 0), (0, 1, 0), atol=1e-3)
    assert not frames.manifest.scenes["ball"].sequence
    assert "CC0-1.0" in frames.manifest.scenes["ball"].license
    out = capsys.readouterr().out
    assert "standard errors" in out
    assert "next: trainer inspect" in out


def test_additions_to_stills_are_written_read_and_prepared_and_change_nothing_else(
    scene, tmp_path, monkeypatch, capsys
):
    plain, added = tmp_path / "plain", tmp_path / "added"
    assert run(monkeypatch, command("stills", scene, plain, "--spp", 4, "--size", "32x32")) == 0
    more = ("--spp", 4, "--size", "32x32", "--second-hit", "--histogram")
    assert run(monkeypatch, command("stills", scene, added, *more)) == 0
    before, after = (FrameSet(root).read("ball", 0).buffers for root in (plain, added))
    assert all(np.array_equal(after[name], image) for name, image in before.items())
    second = {f"second_albedo{part}" for part in ("", "_a", "_b", "_variance")}
    position = {f"position{part}" for part in ("_a", "_b", "_variance")}
    assert after.keys() - before.keys() == {"histogram", *second, *position}
    # The ball reflects the floor; both are the scene's only reflectances.
    assert 0 < after["second_albedo"].max() <= 0.74
    capsys.readouterr()
    assert run(monkeypatch, ["inspect", str(added)]) == 0
    assert "second_albedo" in capsys.readouterr().out
    names = {"second_albedo", "second_albedo_variance", "position", "position_variance"}
    shards = tmp_path / "shards"
    patches = ("--patch-size", "16", "--train-patches", "10000", "--processes", "1")
    prepared = ["prepare", str(added), "--output", str(shards), "--buffers", ",".join(names), *patches]
    assert run(monkeypatch, prepared) == 0
    patch = ShardReader(Index.read(shards), "train").sample(0)
    assert names <= patch.buffers.keys()


def test_a_sequence_reprojects_onto_its_preceding_frame(scene, tmp_path, monkeypatch):
    output = tmp_path / "set"
    assert run(monkeypatch, command("sequences", scene, output, "--frames", 3)) == 0
    frames = FrameSet(output)
    assert frames.manifest.scenes["ball"].sequence
    assert frames.manifest.depth == "euclidean"
    stored = [frames.read("ball", i) for i in range(3)]
    assert (stored[0].buffers["motion"] == 0).all()
    derived = list(frames.sequence("ball", ["color", "position", "motion"]))
    for previous, frame in itertools.pairwise(derived):
        exact = motion(frame.buffers["position"], frame.camera, previous.camera)
        hit = frame.buffers["hit"][..., 0] == 1
        assert np.abs(exact - frame.buffers["motion"])[hit].max() < 0.02
        assert np.abs(frame.buffers["motion"][hit]).max() > 0.05


def test_samples_are_kept_apart_with_twenty_numbers(scene, tmp_path, monkeypatch):
    output = tmp_path / "set"
    assert run(monkeypatch, command("samples", scene, output, "--spp", 4)) == 0
    frame = FrameSet(output).read("ball", 0)
    assert (frame.samples.count, len(frame.samples.channels)) == (4, 20)
    assert frame.spp == 4


def test_a_finer_reference_is_added_to_what_is_there(scene, tmp_path, monkeypatch):
    output = tmp_path / "set"
    arguments = command("sequences", scene, output, "--frames", 1)
    run(monkeypatch, arguments)
    before = FrameSet(output).read("ball", 0)
    run(monkeypatch, [*arguments, "--reference-spp", "48"])
    after = FrameSet(output).read("ball", 0)
    assert np.array_equal(before.buffers["color"], after.buffers["color"])
    assert not np.array_equal(before.buffers["reference"], after.buffers["reference"])
    assert FrameSet(output).frames("ball")[0].reference_spp == 48


def test_another_recipe_in_the_same_folder_is_refused_and_loses_nothing(scene, tmp_path, monkeypatch, capsys):
    output = tmp_path / "set"
    run(monkeypatch, command("sequences", scene, output, "--frames", 1))
    before = FrameSet(output).manifest.hash
    assert run(monkeypatch, command("stills", scene, output, "--spp", 4)) == 1
    assert "another recipe" in capsys.readouterr().err
    assert run(monkeypatch, command("sequences", scene, output, "--frames", 2)) == 1
    assert "--force" in capsys.readouterr().err
    assert FrameSet(output).manifest.hash == before
    assert FrameSet(output).check() == []


def test_a_dry_run_says_what_would_be_rendered_and_writes_nothing(scene, tmp_path, monkeypatch, capsys):
    output = tmp_path / "set"
    assert run(monkeypatch, [*command("stills", scene, output, "--spp", 4), "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert "1 scenes, 1 views, 1 frames of 24x16" in out
    assert "samples per second" in out
    assert not output.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give --random N or --scene FILE"),
        (["--random", "1", "--size", "24"], "columns x rows"),
        (["--random", "1", "--size", "0x5"], "--size 0x5: expected at least 16x16"),
        (["--random", "1", "--spp", "3"], "must be even"),
        (["--random", "1", "--defocus", "2"], "from 0 to 1"),
        (["--random", "1", "--memory", "0.1"], "at least 0.5 GB"),
        (["--random", "1", "--max-depth", "1"], "--max-depth 1: expected at least 2"),
        (["--random", "1", "--seed", "-1"], "--seed -1: expected 0 or more"),
        (["--random", "1", "--processes", "0"], "--processes 0: expected at least 1"),
        (["--random", "1", "--camera", "fixed"], "--camera is for Mitsuba files"),
        (["--scene", "a.xml", "--meshes", "."], "--meshes is for random scenes"),
    ],
)
def test_wrong_options_are_named_before_anything_is_rendered(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, ["render", "stills", "--output", "set", *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("kind", ["sequences", "samples"])
def test_histograms_are_for_stills(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, ["render", kind, "--random", "1", "--output", "set", "--histogram"]) == 2
    assert f"--histogram is for stills, not {kind}" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["sequences", "samples"])
def test_second_hits_are_for_stills(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, ["render", kind, "--random", "1", "--output", "set", "--second-hit"]) == 2
    assert f"--second-hit is for stills, not {kind}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("stills", ["--scene", "missing.xml"], "missing.xml does not exist"),
        ("stills", ["--random", "1", "--test", "sea"], "no scene 'sea' to hold out"),
        ("stills", ["--random", "1", "--output", "file"], "file is a file"),
        (
            "stills",
            ["--scene", "a.xml", "--camera", "orbt"],
            "--camera orbt: neither fixed, jitter, orbit nor",
        ),
        ("sequences", ["--scene", "a.xml", "--camera", "jitter"], "views that are no sequence"),
    ],
)
def test_a_dry_run_finds_what_the_run_would_find(tmp_path, monkeypatch, capsys, kind, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert run(monkeypatch, ["render", kind, "--output", "set", *options, "--dry-run"]) in (1, 2)
    assert message in capsys.readouterr().err


def test_ended_by_a_batch_system_it_cleans_up_and_says_how_to_go_on(capsys):
    def ended():
        with _resumable():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit, match="143"):
        ended()
    assert "the same command goes on" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_progress_of_small_work_is_told_in_thousands():
    assert SampleRate().text(1500, 4000).startswith("1.5/4.0 k samples")
    assert SampleRate().text(1_500_000, 4_000_000).startswith("1.5/4.0 M samples")


def test_a_broken_scene_is_one_line_with_the_file(scene, tmp_path, monkeypatch, capsys):
    scene.write_text(SCENE.replace("roughplastic", "plasticine"))
    assert run(monkeypatch, command("stills", scene, tmp_path / "set", "--spp", 4)) == 1
    err = capsys.readouterr().err
    assert "scene.xml" in err
    assert "plasticine" in err


def test_the_summary_names_own_files_that_were_passed_over(tmp_path, capsys):
    checks = {"energy_z": 0.5, "reference_relmse": 0.01}
    record = FrameRecord(
        0, "a/f000.exr", bytes=9, sha256="0" * 64, width=24, height=16, exposure=1.0, checks=checks
    )
    origin = {"assets": {"skipped": ["a.obj: holds no triangles"]}}
    scenes = {name: SceneRecord((record,), origin=origin) for name in ("a", "b")}
    splits = {"train": ["a", "b"]}
    manifest = Manifest("set", "render", "euclidean", splits, scenes)
    assert _summary(tmp_path, manifest) == 0
    assert "1 of your files cannot be used and were passed over: a.obj: holds" in capsys.readouterr().out


def children(pid):
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_killed_it_goes_on_to_the_same_data_set_and_its_processes_end(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", os.environ.get("PENUMBRA_CACHE", str(tmp_path / "cache")))
    arguments = command("stills", scene, tmp_path / "killed", "--spp", 4, "--frames", 4)
    process = subprocess.Popen([sys.executable, "-m", "trainer", *arguments], stderr=subprocess.DEVNULL)
    views = tmp_path / "killed" / ".render" / "views"
    deadline = time.monotonic() + 120
    while not (views.is_dir() and len(list(views.glob("*.json"))) >= 2):
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    below = children(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed" / "manifest.json").exists()
    assert run(monkeypatch, arguments) == 0
    run(monkeypatch, command("stills", scene, tmp_path / "whole", "--spp", 4, "--frames", 4))
    a, b = FrameSet(tmp_path / "killed").manifest, FrameSet(tmp_path / "whole").manifest
    assert [r.sha256 for r in a.scenes["ball"].frames] == [r.sha256 for r in b.scenes["ball"].frames]
    while any(running(pid) for pid in below):
        assert time.monotonic() < deadline, "a process of the killed command still runs"
        time.sleep(0.05)


def test_the_manifest_says_how_to_make_the_set_again(scene, tmp_path, monkeypatch):
    run(monkeypatch, command("samples", scene, tmp_path / "set", "--spp", 2))
    manifest = json.loads((tmp_path / "set" / "manifest.json").read_text())
    recipe = manifest["recipe"]["recipe"]
    assert (recipe["kind"], recipe["spp"], recipe["reference_spp"]) == ("samples", [2], 16)
    assert manifest["scenes"]["ball"]["origin"]
    assert "Mitsuba" in manifest["scenes"]["ball"]["provenance"]
