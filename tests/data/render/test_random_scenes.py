from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data.render import random_scenes, textures
from data.render.assets import Assets
from data.render.backdrops import random_backdrop
from data.render.random_scenes import GENERATOR_VERSION, OBJECTS, Kind, random_scene
from data.render.room_kinds import ROOMS, random_room
from data.render.rooms import Rect, Room, plan_walls
from data.render.sketch import look_at, project
from data.render.spec import Mesh, SceneSpec, Shot, View
from data.render.surfaces import unit

Small = Callable[[int, Kind, Shot], SceneSpec]
KINDS: tuple[Kind, ...] = ("outdoor", "indoor")
STILL = Shot(96, 64, defocus=1.0, motion=1.0)
SHARP = Shot(96, 64, frames=3, defocus=0.0, motion=0.0)
SEQUENCE = Shot(160, 96, frames=5, path=True, defocus=0.0, motion=1.0)


@cache
def drawn(seed: int, kind: Kind, shot: Shot) -> SceneSpec:
    return random_scene(seed, kind, shot)


def meshes(scene: SceneSpec, prefix: str = "") -> dict[str, Mesh]:
    assert isinstance(scene.content, dict)
    return {k: v["mesh"] for k, v in scene.content.items() if k.startswith(prefix) and "mesh" in v}


def distances(mesh: Mesh, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along rays to a mesh, inf if missed, and the cosine at which the front is met."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    e1, e2, nearest = b - a, c - a, np.full(len(directions), np.inf)
    cosine = np.zeros(len(directions))
    normal = unit(np.cross(e1, e2))
    for i, d in enumerate(directions):
        p = np.cross(d, e2)
        det = (e1 * p).sum(1)
        det = np.where(np.abs(det) < 1e-12, np.nan, det)
        s = origin - a
        u, q = (s * p).sum(1) / det, np.cross(s, e1)
        v, t = q @ d / det, (e2 * q).sum(1) / det
        hit = np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6), t, np.inf)
        k = int(np.nanargmin(hit))
        nearest[i], cosine[i] = hit[k], -normal[k] @ d
    return nearest, cosine


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of few objects and materials, which are made faster."""
    monkeypatch.setattr(random_scenes, "OBJECTS", {"outdoor": 12, "indoor": 12})
    monkeypatch.setattr(random_scenes, "MATERIALS", 2)
    monkeypatch.setattr(random_scenes, "GLASSES", 1)


@cache
def _small(seed: int, kind: Kind, shot: Shot) -> SceneSpec:
    return random_scene(seed, kind, shot)


@pytest.fixture
def small(few: None) -> Small:
    """Makes such scenes, each once."""
    return _small


@pytest.mark.parametrize("kind", KINDS)
class TestEveryScene:
    def test_has_the_objects_and_lights_of_the_paper(self, kind: Kind) -> None:
        scene = drawn(0, kind, STILL)
        assert isinstance(scene.content, dict)
        assert len(meshes(scene, "object")) == {"outdoor": 75, "indoor": 50}[kind] == OBJECTS[kind]
        area = [v for v in scene.content.values() if "emitter" in v]
        points = [v for v in scene.content.values() if v["type"] == "point"]
        skies = [v for v in scene.content.values() if v["type"] == "envmap"]
        assert (len(area), len(points), len(skies)) == ((0, 0, 1) if kind == "outdoor" else (4, 1, 1))
        assert ("ground" in scene.content) == (kind == "outdoor")
        assert ("walls" in scene.content) == (kind == "indoor")

    def test_has_at_most_half_a_million_triangles(self, kind: Kind) -> None:
        for seed, shot in ((0, STILL), (1, SEQUENCE)):
            assert sum(len(m.faces) for m in meshes(drawn(seed, kind, shot)).values()) <= 500_000

    def test_says_what_makes_it_again(self, kind: Kind) -> None:
        scene = drawn(0, kind, STILL)
        assert scene.name == f"{kind}-000000"
        assert scene.license == "CC0-1.0"
        assert scene.credit == "Penumbra procedural scene"
        origin = json.loads(json.dumps(scene.origin))
        assert origin["version"] == GENERATOR_VERSION
        assert (origin["seed"], origin["kind"], origin["assets"]) == (0, kind, None)
        assert Shot(**origin["shot"]) == STILL

    def test_is_the_same_in_every_process(self, kind: Kind, small: Small) -> None:
        code = (
            "from data.render import random_scenes as made\nfrom data.render.spec import Shot\n"
            "made.OBJECTS, made.MATERIALS, made.GLASSES = {'outdoor': 12, 'indoor': 12}, 2, 1\n"
            f"print(made.random_scene(0, {kind!r}, Shot(96, 64, defocus=1.0, motion=1.0)).fingerprint())"
        )
        environment = {**os.environ, "PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1"}
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
        )
        assert run.stdout.strip() == small(0, kind, STILL).fingerprint()

    def test_differs_from_seed_to_seed(self, kind: Kind) -> None:
        first, second = drawn(0, kind, STILL), drawn(1, kind, SEQUENCE)
        assert first.fingerprint() != second.fingerprint()
        a, b = meshes(first, "object-00"), meshes(second, "object-00")
        assert not np.array_equal(a["object-00"].vertices[:50], b["object-00"].vertices[:50])

    def test_camera_is_inside_no_object_and_sees_some(self, kind: Kind) -> None:
        for scene in (drawn(0, kind, STILL), drawn(1, kind, SEQUENCE)):
            view, visible = scene.views[0], 0
            assert 25 <= view.fov <= 75
            for mesh in meshes(scene, "object").values():
                centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
                radius = np.linalg.norm(mesh.vertices - centre, axis=1).max()
                assert np.linalg.norm(view.to_world[:3, 3] - centre) > radius + 0.1
                pixel = project(view, centre[None].astype(float))[0]
                visible += bool(
                    np.isfinite(pixel).all()
                    and (pixel >= 0).all()
                    and (pixel <= [view.width, view.height]).all()
                )
            assert visible >= 3

    def test_lens_and_motion_follow_their_probabilities(self, kind: Kind, small: Small) -> None:
        scene = small(0, kind, STILL)
        assert 0 < scene.views[0].aperture <= 0.12
        assert 0.3 <= scene.views[0].focus <= 80
        assert scene.moving
        assert set(scene.moving) <= set(meshes(scene, "object"))
        still = small(0, kind, SHARP)
        assert still.views[0].aperture == 0
        assert still.moving == {}
        np.testing.assert_array_equal(still.views[0].to_world, scene.views[0].to_world)

    def test_moving_objects_cross_pixels_during_the_shutter(self, kind: Kind) -> None:
        scene = drawn(0, kind, STILL)
        view = scene.views[0]
        shift = np.array(list(scene.moving.values()))
        centres = np.stack([meshes(scene)[k].vertices.mean(0) for k in scene.moving]).astype(float)
        depth = np.maximum((centres - view.to_world[:3, 3]) @ view.to_world[:3, 2], 1)
        pixels = np.linalg.norm(shift, axis=1) / depth * 96 / (2 * np.tan(np.radians(view.fov) / 2))
        assert pixels.max() <= 45 * 96 / 256
        assert np.median(pixels) > 1

    def test_path_moves_one_to_four_pixels_per_frame_and_hits_nothing(self, kind: Kind) -> None:
        scene = drawn(1, kind, SEQUENCE)
        assert scene.path
        assert len(scene.views) == 5
        points = np.concatenate([m.vertices[::50] for m in meshes(scene, "object").values()]).astype(float)
        for frame, (a, b) in enumerate(zip(scene.views[:-1], scene.views[1:], strict=True)):
            first, second = project(a, points), project(b, points)
            seen = np.isfinite(first).all(1) & (first >= 0).all(1) & (first <= [160, 96]).all(1)
            moved = np.linalg.norm(second - first, axis=1)[seen & np.isfinite(second).all(1)]
            assert 0.5 < np.median(moved) < 6, frame
            assert (a.fov, a.aperture) == (b.fov, b.aperture)
        for name, mesh in meshes(scene, "object").items():
            centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
            radius = np.linalg.norm(mesh.vertices - centre, axis=1).max()
            shift = np.array(scene.moving.get(name, (0, 0, 0)))
            for i, view in enumerate(scene.views):
                away = np.linalg.norm(view.to_world[:3, 3] - centre - i * shift)
                assert away > radius + 0.05, (name, i)

    def test_independent_views_are_different_cameras(self, kind: Kind, small: Small) -> None:
        places = np.stack([v.to_world[:3, 3] for v in small(0, kind, SHARP).views])
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 0.05
        np.testing.assert_array_equal(places[0], small(0, kind, STILL).views[0].to_world[:3, 3])

    def test_new_textures_leave_the_geometry_as_it_was(
        self, kind: Kind, small: Small, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        known = small(0, kind, STILL)
        plain = {"none": lambda rng, size: rng.random((size, size))}
        monkeypatch.setattr(textures, "PATTERNS", plain)
        changed = random_scene(0, kind, STILL)
        assert changed.fingerprint() != known.fingerprint()
        for name, mesh in meshes(known).items():
            np.testing.assert_array_equal(meshes(changed)[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(changed.views[0].to_world, known.views[0].to_world)

    def test_own_files_are_used_named_and_hashed(
        self, kind: Kind, few: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(random_scenes, "MATERIALS", 5)
        pytest.importorskip("trimesh").creation.icosphere(2).export(tmp_path / "ball.ply")
        (tmp_path / "broken.obj").write_text("")
        Image.fromarray(np.full((8, 8, 3), 90, np.uint8)).save(tmp_path / "grey.png")
        assets = Assets.scan(meshes=tmp_path, textures=tmp_path, share=0.5)
        scene = random_scene(3, kind, STILL, assets)
        count = sum(len(m.faces) == 320 for m in meshes(scene, "object").values())
        assert 0.2 < count / 12 < 0.8
        used = scene.origin["assets"]
        assert sorted(used["used"]) == ["ball.ply", "grey.png"]
        assert all(len(digest) == 64 for digest in used["used"].values())
        assert any("broken.obj" in text for text in used["skipped"])
        assert scene.license == "as the assets: ball.ply, grey.png"
        assert (
            scene.fingerprint() == random_scene(3, kind, STILL, Assets.scan(tmp_path, tmp_path)).fingerprint()
        )


def test_own_files_that_cannot_be_read_are_an_error_that_names_one(tmp_path: Path) -> None:
    (tmp_path / "broken.obj").write_text("")
    with pytest.raises(ValueError, match=r"broken\.obj"):
        random_scene(0, "indoor", STILL, Assets.scan(meshes=tmp_path, share=1.0))


def test_unknown_kinds_and_negative_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="expected outdoor or indoor"):
        random_scene(0, "sea", STILL)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="negative"):
        random_scene(-1, "indoor", STILL)


def test_generators_need_no_renderer() -> None:
    code = "import sys, data.render.random_scenes\nprint({'mitsuba', 'trimesh'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


class TestRooms:
    def test_there_are_eight(self) -> None:
        assert len(ROOMS) == 8

    @pytest.mark.parametrize("kind", ROOMS)
    def test_walls_enclose_it_but_for_openings_and_face_inside(self, kind: str) -> None:
        for seed in range(2):
            room = random_room(np.random.default_rng(seed), kind)
            origin = _free_point(room, np.random.default_rng(seed))
            directions = unit(np.random.default_rng(9).normal(size=(80, 3)))
            met = [distances(m, origin, directions) for m in room.parts.values()]
            nearest = np.stack([d for d, _ in met])
            first = nearest.argmin(0)
            front = np.stack([c for _, c in met])[first, np.arange(80)]
            hit = np.isfinite(nearest.min(0))
            assert 0.6 < hit.mean() <= 1, "openings are a small part of the walls"
            assert (front[hit] > -1e-6).mean() > 0.97
            clear = room.clearance(origin[None])[0]
            assert 0 < clear <= nearest.min() + 1e-6

    @pytest.mark.parametrize("kind", ROOMS)
    def test_light_from_outside_comes_in(self, kind: str) -> None:
        escaped = 0
        for seed in range(3):
            room = random_room(np.random.default_rng(seed), kind)
            origin = _free_point(room, np.random.default_rng(seed))
            directions = unit(np.random.default_rng(9).normal(size=(80, 3)))
            nearest = np.stack([distances(m, origin, directions)[0] for m in room.parts.values()]).min(0)
            escaped += int(np.isinf(nearest).sum())
        assert escaped > 0

    def test_walls_go_round_the_union_of_the_plan(self) -> None:
        plan = [Rect(0, 0, 2, 4), Rect(0, 0, 5, 1)]
        lengths = [np.linalg.norm(w.end - w.start) for w in plan_walls(plan)]
        assert sum(lengths) == pytest.approx(2 * (5 + 4))
        room = Room("l", plan, lambda x, z: np.full(np.shape(x), 3.0), 3.0, walls=plan_walls(plan))
        points = np.array([[1.0, 1, 2], [4, 1, 0.5], [4, 1, 3], [1, 1, 0.5]])
        np.testing.assert_allclose(room.clearance(points), [1, 0.5, -2, 0.5])

    def test_things_stand_on_a_platform(self) -> None:
        room = random_room(np.random.default_rng(0), "two_level")
        deck = room.boxes[0]
        inside = np.array([[(deck.low[0] + deck.high[0]) / 2, 0.0]])
        assert room.floor(inside)[0] == deck.high[1]
        above = np.array([[inside[0, 0], deck.high[1] + 0.1, 0.0]])
        assert room.clearance(above)[0] == pytest.approx(0.1)
        assert room.clearance(above, floor=False)[0] > 0.1


def _free_point(room: Room, rng: np.random.Generator) -> np.ndarray:
    low, high = room.bounds
    points = rng.uniform(low, high, (2000, 3))
    return points[room.clearance(points).argmax()]


class TestCameras:
    def test_target_is_in_the_middle_of_the_image(self) -> None:
        view = View(look_at(np.array([1.0, 2, 3]), np.array([-2.0, 0, 1])), 50, 64, 48)
        np.testing.assert_allclose(project(view, np.array([[-2.0, 0, 1]])), [[32, 24]], atol=1e-9)
        assert project(view, np.array([[-2.0, 0.5, 1]]))[0, 1] < 24, "up is up"
        assert np.linalg.det(view.to_world[:3, :3]) == pytest.approx(1)

    def test_left_axis_points_to_the_left(self) -> None:
        view = View(look_at(np.zeros(3), np.array([0.0, 0, 1])), 90, 64, 64)
        left = view.to_world[:3, 3] + view.to_world[:3, 2] + 0.5 * view.to_world[:3, 0]
        assert project(view, left[None])[0, 0] == pytest.approx(16)


@pytest.mark.parametrize("seed", range(6))
def test_backdrop_is_a_surface_that_looks_up_and_has_its_height(seed: int) -> None:
    backdrop = random_backdrop(np.random.default_rng(seed))
    assert backdrop.mesh.normals is not None
    assert (backdrop.mesh.normals[:, 1] > 0).all()
    ground = backdrop.mesh.vertices[:, [0, 2]].astype(float)
    np.testing.assert_allclose(backdrop.height(ground), backdrop.mesh.vertices[:, 1], atol=2e-3)
    assert np.abs(backdrop.height(np.random.default_rng(0).uniform(-3, 3, (50, 2)))).max() < 0.5


_RENDER = """
import json
import numpy as np
import mitsuba as mi
mi.set_variant("scalar_rgb")
from data.render.loading import load, sensor
from data.render.random_scenes import random_scene
from data.render.spec import Shot
import data.render.random_scenes as made
made.OBJECTS, made.MATERIALS = {"outdoor": 12, "indoor": 12}, 4
result = []
for kind in ("indoor",):
    scene = random_scene(2, kind, Shot(16, 12, motion=1.0))
    loaded = load(scene)
    integrator = mi.load_dict({"type": "path", "max_depth": 5})
    image = np.array(mi.render(loaded.scene, integrator=integrator, sensor=sensor(scene.views[0]), spp=4))
    moves = len(loaded.moving) == len(scene.moving)
    result.append([bool(np.isfinite(image).all()), float(np.median(image)), moves])
print(json.dumps(result))
"""


def test_scenes_load_in_the_renderer_and_are_neither_black_nor_blown_out() -> None:
    done = subprocess.run([sys.executable, "-c", _RENDER], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for finite, median, moving in json.loads(done.stdout):
        assert finite
        assert 0.01 < median < 10
        assert moving
