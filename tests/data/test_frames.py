import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data.derive import remodulate
from data.frames import FrameSet
from data.ingestion import IngestOptions, ingest, write_record
from data.manifest import MANIFEST
from tests.data.miniature import ingested, penumbra_scene


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return ingested(tmp_path_factory.mktemp("frames"), frames=3)


@pytest.fixture
def root(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "set"))


def test_scenes_are_listed_by_split(root):
    frames = FrameSet(root)
    assert frames.scenes() == ["cbox-glossy", "classroom"]
    assert frames.scenes("train") == ["cbox-glossy"]
    assert frames.scenes("test") == ["classroom"]
    assert frames.scenes("validation") == []


def test_reading_derives_albedo_irradiance_and_keeps_the_identity_of_the_frame(root):
    frame = FrameSet(root).read("classroom", 1)
    assert (frame.scene, frame.index, frame.spp) == ("classroom", 1, 1)
    assert frame.exposure == pytest.approx(2.2657, abs=1e-3)
    assert {
        "color",
        "albedo",
        "irradiance",
        "depth",
        "normal",
        "position",
        "reference",
    } <= frame.buffers.keys()
    back = remodulate(frame.buffers["irradiance"], frame.buffers["albedo"])
    assert np.allclose(back, frame.buffers["color"], rtol=2.5e-7, atol=0)


def test_named_buffers_are_there_or_an_error_says_why_not(root):
    frames = FrameSet(root)
    assert "history" in frames.read("classroom", 0, ["history"]).buffers
    with pytest.raises(ValueError, match="classroom/frame 0: missing buffer visibility"):
        frames.read("classroom", 0, ["visibility"])


def test_a_sequence_comes_in_ascending_order(root):
    assert [f.index for f in FrameSet(root).sequence("classroom")] == [0, 1, 2]


def test_motion_is_derived_along_a_sequence(tmp_path):
    penumbra_scene(tmp_path / "source", "classroom", 3)
    options = IngestOptions(buffers=("color", "normal", "position", "diffuse_albedo"))
    ingest("penumbra", tmp_path / "source", tmp_path / "set", options)
    motions = [f.buffers["motion"] for f in FrameSet(tmp_path / "set").sequence("classroom", ["motion"])]
    assert (np.abs(motions[0]) < 1e-3).all()
    assert 0.3 < np.median(np.abs(motions[1]).max(-1)) < 5


def test_motion_along_a_path_with_several_numbers_of_samples_is_that_from_view_to_view(tmp_path):
    penumbra_scene(tmp_path / "source", "classroom", 3)
    options = IngestOptions(buffers=("color", "normal", "position", "diffuse_albedo"))
    ingest("penumbra", tmp_path / "source", tmp_path / "set", options)
    single = FrameSet(tmp_path / "set")
    expected = {f.index: f.buffers["motion"] for f in single.sequence("classroom", ["motion"])}
    records = []
    for index in range(6):
        made = replace(single.read("classroom", index // 2), index=index, spp=4 * (1 + index % 2))
        made.notes["view"] = index // 2
        records.append(write_record(made, tmp_path / "both"))
    scene = replace(single.manifest.scenes["classroom"], frames=tuple(records))
    replace(single.manifest, scenes={"classroom": scene}).save(tmp_path / "both")
    found = {
        f.index: f.buffers["motion"] for f in FrameSet(tmp_path / "both").sequence("classroom", ["motion"])
    }
    assert list(found) == [0, 2, 4, 1, 3, 5]
    for index, motion in found.items():
        np.testing.assert_allclose(motion, expected[index // 2], atol=1e-3)


def test_unknown_scenes_and_frames_are_named_with_the_known_ones(root):
    frames = FrameSet(root)
    with pytest.raises(ValueError, match="has no scene 'attic'; scenes: cbox-glossy, classroom"):
        frames.read("attic", 0)
    with pytest.raises(ValueError, match=r"scene 'classroom' has no frame 9; it has \[0, 1, 2\]"):
        frames.read("classroom", 9)


def test_a_missing_file_names_the_command_that_repairs(root):
    (root / "classroom" / "f001.exr").unlink()
    with pytest.raises(FileNotFoundError, match=r"f001\.exr is missing.*`trainer ingest --force"):
        FrameSet(root).read("classroom", 1)


def test_a_truncated_or_altered_file_is_noticed_before_it_is_read(root):
    path = root / "classroom" / "f001.exr"
    content = bytearray(path.read_bytes())
    content[-30] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"f001\.exr does not match the manifest's checksum"):
        FrameSet(root).read("classroom", 1)
    path.write_bytes(content[:-5])
    with pytest.raises(ValueError, match=r"f001\.exr has \d+ bytes, the manifest says \d+"):
        FrameSet(root).read("classroom", 1)


def test_check_lists_every_problem_and_nothing_when_all_is_well(root):
    frames = FrameSet(root)
    assert frames.check() == []
    (root / "classroom" / "f000.exr").unlink()
    (root / "cbox-glossy" / "f002.exr").write_bytes(b"x")
    assert len(frames.check()) == 2


def test_a_folder_without_manifest_is_no_frame_set(root):
    (root / MANIFEST).unlink()
    with pytest.raises(FileNotFoundError, match="its ingestion did not finish; run `trainer ingest"):
        FrameSet(root)
