import json
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from data.render.spec import Shot
from data.render.tracer import Tracer
from data.render.user_scenes import CameraMove, scene_files, scene_files_hash, user_scene
from tests.data.render import scenes

SCENE = """<scene version="3.0.0">
  <default name="picture" value="checks.png"/>
  <sensor type="thinlens">
    <float name="fov" value="50"/> <string name="fov_axis" value="x"/>
    <float name="aperture_radius" value="0.02"/> <float name="focus_distance" value="3"/>
    <transform name="to_world"><lookat origin="0, 0.5, 4" target="0, 0.5, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="32"/></film>
  </sensor>
  <shape type="cube"><transform name="to_world"><scale value="0.5"/></transform>
    <bsdf type="diffuse">
      <texture type="bitmap" name="reflectance"><string name="filename" value="$picture"/></texture>
    </bsdf>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><scale value="10"/><translate z="-3"/></transform>
  </shape>
  <emitter type="constant"/>
</scene>"""
SHOT = Shot(32, 18, frames=3)


@pytest.fixture
def scene(tmp_path):
    """A scene file with a texture."""
    scenes.activate()
    folder = tmp_path / "room"
    folder.mkdir()
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(folder / "checks.png")
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


def test_the_camera_of_the_file_is_used_with_the_size_of_the_shot(scene):
    spec = user_scene(scene, SHOT, CameraMove("fixed"), 1)
    assert spec.name == "room"
    assert len(spec.views) == 3
    view = spec.views[0]
    assert (view.width, view.height, view.fov) == (32, 18, pytest.approx(50, rel=1e-4))
    assert (view.aperture, view.focus) == (pytest.approx(0.02), pytest.approx(3))
    assert view.to_world[:3, 3] == pytest.approx([0, 0.5, 4])
    assert view.to_world[:3, 2] == pytest.approx([0, 0, -1])


def test_the_scene_can_be_traced(scene):
    values = scenes.trace(user_scene(scene, SHOT, CameraMove("fixed"), 1), "radiance", "hit", spp=2)
    assert values["hit"].mean() == 1.0
    assert 0.1 < values["radiance"].mean() < 1.0


def test_the_origin_holds_the_hashes_of_all_files_and_changes_with_them(scene):
    spec = user_scene(scene, SHOT, CameraMove("fixed"), 1)
    assert sorted(spec.origin["files"]) == ["checks.png", "scene.xml"]
    assert json.loads(json.dumps(spec.origin)) == spec.origin
    before = scene_files_hash(scene)
    Image.fromarray(np.full((4, 4, 3), 100, np.uint8)).save(scene.with_name("checks.png"))
    assert scene_files_hash(scene) != before


def test_independent_views_differ_and_are_the_same_for_the_same_seed(scene):
    first = user_scene(scene, SHOT, CameraMove("jitter"), 1)
    again = user_scene(scene, SHOT, CameraMove("jitter"), 1)
    other = user_scene(scene, SHOT, CameraMove("jitter"), 2)
    places = [tuple(v.to_world[:3, 3]) for v in first.views]
    assert len(set(places)) == 3
    assert places == [tuple(v.to_world[:3, 3]) for v in again.views]
    assert places[1:] != [tuple(v.to_world[:3, 3]) for v in other.views][1:]
    assert not first.path


def test_views_of_an_orbit_are_not_behind_walls(scene):
    walls = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="90"/><translate x="{}"/>'
    both = "".join(walls.format(x) + "</transform></shape>" for x in (-0.5, 0.5))
    scene.write_text(
        SCENE.replace("<emitter", both.replace("<translate", '<scale value="9"/><translate') + "<emitter")
    )
    free = user_scene(scene, Shot(32, 18, frames=3, path=True), CameraMove("orbit", degrees=40.0), 1)
    tracer = Tracer(free)
    places = [v.to_world[:3, 3] for v in free.views]
    assert all(tracer.free(a, b) for a, b in pairwise(places))
    assert free.path
    assert max(abs(p[0]) for p in places) < 0.5


def test_key_frames_give_the_path(scene, tmp_path):
    path = tmp_path / "keys.json"
    entries = [{"frame": f, "origin": [f / 10, 0.5, 4], "target": [0, 0, 0]} for f in (0, 4)]
    path.write_text(json.dumps(entries))
    spec = user_scene(scene, SHOT, CameraMove("keyframes", path=path), 1)
    assert [round(float(v.to_world[0, 3]), 3) for v in spec.views] == [0, 0.1, 0.2]
    digest = spec.origin["move"]["digest"]
    path.write_text(json.dumps([entries[0], {**entries[1], "frame": 8}]))
    assert CameraMove("keyframes", path=path).digest != digest


def test_the_licence_is_read_from_beside_the_scene(scene):
    assert user_scene(scene, SHOT, CameraMove("fixed"), 1).license == "not stated"
    scene.with_name("LICENSE.txt").write_text("CC0 1.0\nCopyright nobody\n")
    assert user_scene(scene, SHOT, CameraMove("fixed"), 1).license == "CC0 1.0 Copyright nobody"
    scene.with_suffix(".license").write_text("CC-BY 3.0\nCredit: A. Author\n")
    spec = user_scene(scene, SHOT, CameraMove("fixed"), 1)
    assert spec.license.startswith("CC-BY 3.0")
    assert spec.credit == "Credit: A. Author"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("</scene>", ""), "not valid XML"),
        (('value="checks.png"', 'value="lost.png"'), r"lost\.png is missing"),
        (('type="cube"', 'type="cubism"'), r"Mitsuba cannot load it.*cubism"),
        (
            ('type="diffuse">', 'type="diffuse"><float name="extEta" value="1"/>'),
            r"cannot load it.*remove the",
        ),
        (('sensor type="thinlens"', 'sensor type="orthographic"'), "Mitsuba cannot load it|orthographic"),
    ],
)
def test_a_broken_scene_is_named_with_the_reason(scene, change, message):
    scene.write_text(SCENE.replace(*change))
    with pytest.raises(ValueError, match=message) as caught:
        user_scene(scene, SHOT, CameraMove("fixed"), 1)
    assert "scene.xml" in str(caught.value)


def test_a_scene_without_camera_is_refused(scene):
    begin, end = SCENE.index("<sensor"), SCENE.index("</sensor>") + len("</sensor>")
    scene.write_text(SCENE[:begin] + SCENE[end:])
    with pytest.raises(ValueError, match="has no camera"):
        user_scene(scene, SHOT, CameraMove("fixed"), 1)


def test_a_scene_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.xml does not exist"):
        scene_files(tmp_path / "none.xml")


def test_a_move_and_its_file_go_together(tmp_path):
    for kind, path in (("keyframes", None), ("orbit", tmp_path)):
        with pytest.raises(ValueError, match="goes with `keyframes` only"):
            CameraMove(kind, path=path)
    with pytest.raises(ValueError, match="do not exist"):
        CameraMove("keyframes", path=tmp_path / "none.json")
    with pytest.raises(ValueError, match="camera move 'zoom'; known"):
        CameraMove("zoom")
