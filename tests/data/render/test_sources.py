"""What tells scenes from each other. No renderer."""

import json

import pytest

from data.render.scene_files import scene_files
from data.render.sources import FileSource
from data.render.spec import Shot
from data.render.user_scenes import CameraMove

KEYS = [{"frame": 0, "origin": [0, 1, 4], "target": [0, 0, 0]}]


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "ball.xml"
    path.write_text('<scene version="3.0.0"></scene>')
    return path


def source(scene, keys):
    return FileSource(scene, Shot(24, 16), CameraMove("keyframes", path=keys), 1)


def test_key_frames_are_the_same_wherever_their_file_lies(scene, tmp_path):
    here, there = tmp_path / "keys.json", tmp_path / "sub" / "path.json"
    there.parent.mkdir()
    for path in (here, there):
        path.write_text(json.dumps(KEYS))
    assert source(scene, here).identity() == source(scene, there).identity()
    there.write_text(json.dumps([{**KEYS[0], "fov": 20}]))
    assert source(scene, here).identity() != source(scene, there).identity()


def test_a_file_that_includes_itself_is_an_error_that_names_it(tmp_path):
    path = tmp_path / "loop.xml"
    (tmp_path / "inner.xml").write_text('<scene version="3.0.0"><include filename="loop.xml"/></scene>')
    path.write_text('<scene version="3.0.0"><include filename="inner.xml"/></scene>')
    with pytest.raises(ValueError, match=r"loop\.xml: loop\.xml includes itself"):
        scene_files(path)
