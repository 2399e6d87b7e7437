import json

import numpy as np
import pytest

from data.render.camera_paths import Jitter, jittered, keyframed, look_at, orbit
from data.render.projection import view_world_to_pixel
from tests.data.render import scenes


def test_look_at_is_mitsuba_s_convention():
    scenes.activate()
    import mitsuba

    for origin, target, up in (((1, 2, 3), (0, 0.5, -1), (0, 1, 0)), ((4, 0, 0), (0, 0, 1), (0, 0, 1))):
        transform = mitsuba.ScalarTransform4f().look_at(list(origin), list(target), list(up))
        assert look_at(origin, target, up) == pytest.approx(np.array(transform.matrix), abs=1e-5)


def test_a_camera_that_looks_at_itself_or_along_up_is_refused():
    with pytest.raises(ValueError, match="cannot look at its own position"):
        look_at((1, 1, 1), (1, 1, 1))
    with pytest.raises(ValueError, match="parallel to the line of sight"):
        look_at((0, 0, 0), (0, 2, 0), (0, 1, 0))


def pixel_of(view, point):
    x, y, _, w = view_world_to_pixel(view) @ [*point, 1.0]
    return np.array([x / w, y / w])


def test_an_orbit_starts_at_the_view_keeps_its_distance_and_ends_at_the_angle():
    views = orbit(scenes.view(), (0, 0, 0), 8.0, 5)
    assert views[0].to_world == pytest.approx(scenes.view().to_world)
    eyes = np.stack([v.to_world[:3, 3] for v in views])
    assert np.linalg.norm(eyes, axis=1) == pytest.approx(4.0)
    angles = np.degrees(np.arctan2(eyes[:, 0], eyes[:, 2]))
    assert angles == pytest.approx([0, 2, 4, 6, 8])
    for view in views:
        assert pixel_of(view, (0, 0, 0)) == pytest.approx([8, 6])
        assert view.to_world[:3, :3] @ view.to_world[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_an_orbit_keeps_the_pivot_where_it_is_in_the_image_also_off_the_axis():
    for view in orbit(scenes.view(), (0.5, 0.2, 0.3), 20.0, 3):
        assert pixel_of(view, (0.5, 0.2, 0.3)) == pytest.approx(
            pixel_of(scenes.view(), (0.5, 0.2, 0.3)), abs=1.0
        )


def test_jittered_views_are_within_reach_and_reproducible():
    reach = Jitter(degrees=(5.0, 10.0), dolly=0.2, tilt=0.5)
    views = jittered(scenes.view(), (0, 0, 0), 50, np.random.default_rng(1), reach)
    again = jittered(scenes.view(), (0, 0, 0), 50, np.random.default_rng(1), reach)
    eyes = np.stack([v.to_world[:3, 3] for v in views])
    assert np.array_equal(eyes, np.stack([v.to_world[:3, 3] for v in again]))
    distance = np.linalg.norm(eyes, axis=1)
    assert distance.min() >= 3.2 - 1e-9
    assert distance.max() <= 4.8 + 1e-9
    angle = np.degrees(np.arccos(eyes[:, 2] / distance))
    assert angle.min() >= 4.9
    assert angle.max() <= 11.3
    assert len({tuple(e) for e in eyes.tolist()}) == 50


def keys(tmp_path, content):
    path = tmp_path / "keys.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_key_framed_path_passes_its_keys_smoothly(tmp_path):
    entries = [
        {"frame": 0, "origin": [0, 0, 4], "target": [0, 0, 0]},
        {"frame": 4, "origin": [1, 0, 4], "target": [0, 0, 0], "fov": 50},
        {"frame": 12, "origin": [3, 1, 4], "target": [0, 1, 0], "up": [0, 1, 0], "fov": 30},
    ]
    views = keyframed(keys(tmp_path, entries), scenes.view())
    assert len(views) == 13
    for entry in entries:
        view = views[entry["frame"]]
        assert view.to_world[:3, 3] == pytest.approx(entry["origin"])
        assert view.fov == pytest.approx(entry.get("fov", 40))
    eyes = np.stack([v.to_world[:3, 3] for v in views])
    assert np.abs(np.diff(eyes, 2, axis=0)).max() < 0.1
    assert len(keyframed(keys(tmp_path, entries), scenes.view(), 5)) == 5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[", "not a JSON file"),
        ("[]", "expected a list of"),
        ("[1]", "key 0 is not an object"),
        ([{"origin": [0, 0, 1], "target": [0, 0, 0]}], "key 0: frame is None, expected a number"),
        (
            [{"frame": 0, "origin": [0, 0], "target": [0, 0, 0]}],
            r"origin is \[0, 0\], expected three numbers",
        ),
        ([{"frame": 0, "origin": [0, 0, "a"], "target": [0, 0, 0]}], "origin is 'a', expected a number"),
        ([{"frame": 0, "origin": [0, 0, 1], "target": [0, 0, 1]}], "frame 0: a camera at"),
        ([{"frame": 0, "origin": [0, 0, 1], "target": [0, 0, 0], "zoom": 2}], "unknown 'zoom'; known: frame"),
        ([{"frame": 0, "origin": [0, 0, 1], "target": [0, 0, 0], "fov": 180}], "fov is 180"),
        ([{"frame": i, "origin": [0, 0, 1], "target": [0, 0, 0]} for i in (3, 3)], "frame 3 follows frame 3"),
    ],
)
def test_a_broken_file_of_key_frames_is_named_with_what_is_wrong(tmp_path, content, message):
    with pytest.raises(ValueError, match=message) as caught:
        keyframed(keys(tmp_path, content), scenes.view())
    assert "keys.json" in str(caught.value)


def test_frames_beyond_the_last_key_are_refused(tmp_path):
    path = keys(tmp_path, [{"frame": 2, "origin": [0, 0, 1], "target": [0, 0, 0]}])
    with pytest.raises(ValueError, match="the last key is frame 2, but frame 4 is asked for"):
        keyframed(path, scenes.view(), 5)
    with pytest.raises(ValueError, match=r"none\.json do not exist"):
        keyframed(tmp_path / "none.json", scenes.view())
