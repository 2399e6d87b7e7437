import numpy as np
import pytest

from data.camera import project
from data.render.spec import SceneSpec
from data.render.tracer import GUIDES, NAMES, Tracer, view_world_to_pixel
from tests.data.render import scenes
from tests.data.render.scenes import trace


@pytest.fixture(scope="module")
def box():
    """All quantities of the box with every kind of material."""
    return trace(scenes.box(), *NAMES, spp=4)


def test_normals_are_unit_vectors_and_face_the_camera(box):
    hit = box["hit"][..., 0] > 0
    normals = box["normal"][hit]
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(1.0, abs=1e-4)
    assert (box["normal"][~hit] == 0).all()
    towards = np.array([0, 0, 4.0]) - box["position"][hit]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    assert (np.sum(towards * normals, -1) > -0.1).all()


def test_depth_is_the_distance_of_the_position_from_the_centre_of_the_camera(box):
    hit = box["hit"][..., 0] > 0
    expected = np.linalg.norm(box["position"] - [0, 0, 4], axis=-1)
    assert box["depth"][hit][:, 0] == pytest.approx(expected[hit], rel=1e-5)
    assert (box["depth"][~hit] == 0).all()


def test_reflectances_and_roughness_are_within_their_ranges(box):
    for name in ("diffuse_albedo", "specular_albedo", "roughness", "visibility", "hit", "time", "offset"):
        assert box[name].min() >= 0.0
        assert box[name].max() <= 1.0


def test_every_quantity_has_the_shape_of_its_vocabulary_entry(box):
    channels = {"depth": 1, "roughness": 1, "hit": 1, "visibility": 1, "coc": 1, "time": 1}
    channels |= {"motion": 2, "lens": 2, "offset": 2}
    for name in NAMES:
        assert box[name].shape == (4, 16, 16, channels.get(name, 3))
        assert box[name].dtype == np.float32
        assert np.isfinite(box[name]).all()


MATERIALS = {
    "diffuse": (scenes.GREY, (0.6, 0.6, 0.6), (0, 0, 0), 1.0),
    "rough gold": (scenes.GOLD, (0, 0, 0), (0.967, 0.802, 0.324), 0.15),
    "glass": ({"type": "dielectric"}, (0, 0, 0), (1, 1, 1), 0.0),
    "mirror": ({"type": "conductor", "material": "none"}, (0, 0, 0), (1, 1, 1), 0.0),
    "plastic": ({"type": "roughplastic", "alpha": 0.2}, (0.5, 0.5, 0.5), (0.0387,) * 3, 0.2),
    "principled": (scenes.PRINCIPLED, (0.48, 0.18, 0.06), (0.344, 0.144, 0.064), 0.16),
    "twosided": ({"type": "twosided", "inner": scenes.GOLD}, (0, 0, 0), (0.967, 0.802, 0.324), 0.15),
    "blend": (
        {"type": "blendbsdf", "weight": 0.25, "a": scenes.GREY, "b": scenes.GOLD},
        (0.45, 0.45, 0.45),
        (0.242, 0.2, 0.081),
        0.7875,
    ),
}


@pytest.fixture(scope="module")
def materials():
    """Guides of one cube per material, and which cube each sample hit."""
    spec = scenes.objects(*(bsdf for bsdf, *_ in MATERIALS.values()), width=8 * len(MATERIALS))
    values = trace(spec, "position", "hit", "diffuse_albedo", "specular_albedo", "roughness", spp=2)
    place = values["position"][..., 0] / (2.4 / len(MATERIALS)) + (len(MATERIALS) - 1) / 2
    values["cube"] = np.where(values["hit"][..., 0] > 0, np.round(place), -1)
    return values


@pytest.mark.parametrize("name", MATERIALS)
def test_the_reflectances_are_those_of_the_material(materials, name):
    _, albedo, specular, roughness = MATERIALS[name]
    chosen = materials["cube"] == list(MATERIALS).index(name)
    assert chosen.sum() > 3
    for guide, expected in (("diffuse_albedo", albedo), ("specular_albedo", specular)):
        assert np.abs(materials[guide][chosen] - np.array(expected)).max() < 0.03
    assert materials["roughness"][chosen] == pytest.approx(roughness, abs=1e-4)


def test_textured_roughness_is_that_of_the_hit():
    texture = scenes.picture(np.array([[0.1, 0.4]], np.float32)[..., None].repeat(2, 0))
    texture["picture"] = type(texture["picture"])(texture["picture"].pixels, raw=True)
    bsdf = {"type": "roughconductor", "alpha": texture}
    content = {"wall": {"type": "mesh", "mesh": scenes.square(20.0), "bsdf": bsdf}}
    values = trace(SceneSpec("rough", content, (scenes.view(),)), "roughness", "position", spp=1)
    left = values["position"][..., 0] < 0
    assert values["roughness"][left] == pytest.approx(0.1, abs=1e-3)
    assert values["roughness"][~left] == pytest.approx(0.4, abs=1e-3)


def test_positions_project_to_the_pixels_of_their_samples():
    spec = scenes.wall()
    values = trace(spec, "position", "offset", spp=2)
    pixels, w = project(Tracer(spec).pixel_camera(0), values["position"])
    rows, columns = np.mgrid[0:12, 0:16]
    expected = np.stack([columns, rows], -1) + values["offset"]
    assert np.abs(pixels - expected).max() < 1e-3
    assert (w > 0).all()


def test_world_to_pixel_has_the_image_of_the_left_axis_on_the_left():
    matrix = view_world_to_pixel(scenes.view())
    x, y, _, w = matrix @ [1.0, 0.5, 0.0, 1.0]
    assert w == pytest.approx(4)
    assert (x / w, y / w) == (pytest.approx(8 + 5.4950, abs=1e-3), pytest.approx(6 - 2.7475, abs=1e-3))


def test_motion_leads_to_the_pixel_of_the_same_point_in_the_previous_view():
    from data.render.camera_paths import orbit

    base = scenes.wall()
    spec = SceneSpec("path", base.content, orbit(base.views[0], (0, 0, 0), 6.0, 3), path=True)
    values = trace(spec, "motion", "position", frame=2, spp=2)
    now, _ = project(Tracer(spec).pixel_camera(2), values["position"])
    before, _ = project(Tracer(spec).pixel_camera(1), values["position"])
    assert np.abs(values["motion"] - (before - now)).max() < 1e-2
    assert np.abs(values["motion"]).max() > 0.05


def test_the_background_moves_as_if_infinitely_far():
    from data.render.camera_paths import orbit

    views = orbit(scenes.view(), (0, 0, 4), 2.0, 2)
    spec = SceneSpec("sky", {"sky": {"type": "constant"}}, views, path=True)
    motion = trace(spec, "motion", frame=1, spp=1)["motion"]
    focal = 8 / np.tan(np.radians(20))
    assert np.abs(np.abs(motion[..., 0]) - focal * np.tan(np.radians(2.0))).max() < 0.15


def test_the_first_frame_and_independent_views_have_no_motion():
    views = (scenes.view(), scenes.view())
    spec = SceneSpec("two", scenes.wall().content, views)
    assert (trace(spec, "motion", frame=0, spp=1)["motion"] == 0).all()
    assert (trace(spec, "motion", frame=1, spp=1)["motion"] == 0).all()


def test_moving_objects_have_their_own_motion_vectors():
    values = trace(scenes.moving((0.6, 0, 0)), "motion", "position", frame=1, spp=8, static=True)
    cube = values["position"][..., 2] > -0.9
    front = values["position"][..., 2] > 0.39
    assert (values["motion"][~cube] == 0).all()
    focal = 8 / np.tan(np.radians(20))
    expected = -0.6 * focal / (4 - 0.4)
    assert values["motion"][front][:, 0] == pytest.approx(expected, rel=1e-3)


def test_shutter_motion_is_the_displacement_over_the_shutter():
    values = trace(scenes.moving((0.6, 0, 0)), "motion", "position", motion="shutter", spp=8, static=True)
    front = values["position"][..., 2] > 0.39
    expected = 0.6 * (8 / np.tan(np.radians(20))) / (4 - 0.4)
    assert values["motion"][front][:, 0] == pytest.approx(expected, rel=1e-3)


def test_shutter_motion_of_a_moving_camera_is_the_opposite_of_its_velocity():
    values = trace(scenes.wall(velocity=(0.2, 0.0, 0.0)), "motion", motion="shutter", spp=2)["motion"]
    expected = -0.2 * (8 / np.tan(np.radians(20))) / 4
    assert values[..., 0] == pytest.approx(expected, rel=1e-3)


def test_a_moving_camera_sees_positions_from_where_it_is_at_the_sample_s_time():
    spec = scenes.wall(velocity=(1.0, 0.0, 0.0))
    values = trace(spec, "position", "offset", "time", spp=4)
    shifted = values["position"] - (values["time"] - 0.5) * np.array([1.0, 0, 0])
    pixels, _ = project(Tracer(spec).pixel_camera(0), shifted)
    rows, columns = np.mgrid[0:12, 0:16]
    assert np.abs(pixels - np.stack([columns, rows], -1) - values["offset"]).max() < 1e-3


@pytest.mark.parametrize(("focus", "sign"), [(2.0, 1), (8.0, -1)])
def test_the_circle_of_confusion_is_positive_behind_the_focus(focus, sign):
    coc = trace(scenes.wall(aperture=0.1, focus=focus), "coc", spp=1)["coc"]
    expected = 2 * 0.1 * (1 / focus - 1 / 4) * 8 / np.tan(np.radians(20))
    assert np.sign(expected) == sign
    assert coc == pytest.approx(expected, rel=1e-3)


def test_the_circle_of_confusion_is_as_wide_as_the_spread_of_a_pixel_s_samples():
    spec = scenes.wall(aperture=0.3, focus=2.0)
    values = trace(spec, "position", "coc", "lens", "offset", spp=64)
    pixels, _ = project(Tracer(spec).pixel_camera(0), values["position"])
    rows, columns = np.mgrid[0:12, 0:16]
    away = pixels - np.stack([columns, rows], -1) - values["offset"]
    assert np.abs(np.linalg.norm(away, axis=-1) * 2).max() <= values["coc"].max() * 1.001
    # Behind the focus rays have crossed, and +X of the camera is the left of the image, +Y its top.
    assert np.abs(away - values["lens"] * values["coc"] / 2).max() < 1e-2


def test_lens_positions_fill_the_unit_disc_and_pinholes_have_none():
    lens = trace(scenes.wall(aperture=0.1), "lens", spp=64)["lens"]
    radius = np.linalg.norm(lens, axis=-1)
    assert 0.97 < radius.max() <= 1.0 + 1e-6
    assert (radius**2).mean() == pytest.approx(0.5, abs=0.02)
    assert (trace(scenes.wall(), "lens", spp=1)["lens"] == 0).all()


def test_a_moving_object_is_blurred_in_guides_and_radiance_alike():
    values = trace(scenes.moving((1.2, 0, 0)), "radiance", "position", "time", spp=64)
    cube = values["position"][..., 2] > -0.9
    assert len(np.unique(values["time"])) == 16
    # The cube emits 2; the wall reflects less, but for a few noisy samples close to it.
    assert (values["radiance"][cube].min(-1) >= 2.0 - 1e-4).all()
    assert (values["radiance"][~cube].max(-1) >= 2.0).mean() < 0.01
    share = cube.mean(0)
    assert ((share > 0.1) & (share < 0.9)).sum() > 10
    front = values["position"][..., 2] > 0.39
    middle = 1.2 * (values["time"][..., 0] - 0.5)
    assert (np.abs(values["position"][..., 0] - middle)[front] <= 0.4 + 1e-4).all()


def test_static_objects_stay_at_the_middle_of_the_shutter_while_time_is_still_random():
    spec = scenes.moving((1.2, 0, 0))
    for frame in (0, 1):
        values = trace(spec, "position", "time", spp=4, static=True, frame=frame)
        front = values["position"][..., 2] > 0.39
        assert np.abs(values["position"][..., 0][front] - 1.2 * frame).max() <= 0.4 + 1e-4
        assert len(np.unique(values["time"])) > 100


def test_given_vertex_normals_survive_a_displacement():
    mesh = scenes.cube((0, 0, 0), 0.8)
    normals = np.tile(np.array([0.6, 0.0, 0.8], np.float32), (8, 1))
    spec = scenes.moving()
    spec.content["cube"]["mesh"] = type(mesh)(mesh.vertices, mesh.faces, normals)
    values = trace(spec, "normal", "position", spp=8, frame=1)
    cube = values["position"][..., 2] > -0.9
    assert np.abs(values["normal"][cube] - [0.6, 0, 0.8]).max() < 1e-3


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not():
    for spec in (scenes.box(8, 8), scenes.moving()):
        first = trace(spec, "radiance", "diffuse", "position", spp=4)
        again = trace(spec, "radiance", "diffuse", "position", spp=4)
        other = trace(spec, "radiance", "diffuse", "position", spp=4, seed=2)
        for name, values in first.items():
            assert np.array_equal(values, again[name])
            assert not np.array_equal(values, other[name])


def test_samples_of_different_seeds_frames_pixels_and_passes_are_uncorrelated():
    spec = SceneSpec("walls", scenes.wall().content, (scenes.view(),) * 2)
    a, b = (trace(spec, "offset", spp=16, seed=s)["offset"].astype(float) - 0.5 for s in (1, 2))
    c = trace(spec, "offset", spp=16, frame=1)["offset"].astype(float) - 0.5
    limit = 4.5 / 12 / np.sqrt(a.size)
    for x, y in ((a, b), (a, c), (a[1:], a[:-1]), (a[:, 1:], a[:, :-1]), (a[..., 0], a[..., 1])):
        assert abs((x * y).mean()) < limit * np.sqrt(a.size / x.size)
    assert a.mean() == pytest.approx(0, abs=4.5 * np.sqrt(1 / 12 / a.size))


def test_large_images_come_in_bands_of_whole_rows_and_small_ones_in_groups_of_samples():
    scenes.activate()
    spec = scenes.wall()
    bands = list(Tracer(spec, chunk=80).trace(0, 2, 1, ("position", "offset")))
    assert [(c.rows.start, c.rows.stop) for c in bands] == [(0, 5), (5, 10), (10, 12)] * 2
    assert bands[2].values["position"].shape == (1, 2, 16, 3)
    groups = list(Tracer(spec, chunk=500).trace(0, 5, 1, ("position",)))
    assert [c.values["position"].shape[0] for c in groups] == [2, 2, 1]
    camera = Tracer(spec).pixel_camera(0)
    for chunk in bands:
        pixels, _ = project(camera, chunk.values["position"])
        rows = np.floor(pixels[..., 1] + 1e-4 * (0.5 - chunk.values["offset"][..., 1]))
        assert (rows == np.arange(chunk.rows.start, chunk.rows.stop)[None, :, None]).all()


def test_samples_of_different_chunks_differ():
    scenes.activate()
    chunks = list(Tracer(scenes.wall(), chunk=192).trace(0, 4, 1, ("offset",)))
    values = np.concatenate([c.values["offset"] for c in chunks])
    assert len(np.unique(values.reshape(4, -1), axis=0)) == 4


def test_visibility_is_zero_in_shadow_and_one_in_the_light():
    content = {
        "floor": {"type": "mesh", "mesh": scenes.square(20.0, -1.0), "bsdf": scenes.GREY},
        "block": {"type": "mesh", "mesh": scenes.cube((0.6, 0, 0.5), 1.0), "bsdf": scenes.GREY},
        "lamp": {"type": "point", "position": [0.6, 0.0, 20.0], "intensity": 400.0},
    }
    values = trace(
        SceneSpec("shadow", content, (scenes.view(),)), *("visibility", "position", "diffuse"), spp=4
    )
    x, y, z = np.moveaxis(values["position"], -1, 0)
    floor = z < -0.9
    shadow = floor & (np.abs(x - 0.6) < 0.5) & (np.abs(y) < 0.5)
    lit = floor & ((np.abs(x - 0.6) > 0.6) | (np.abs(y) > 0.6))
    assert (values["visibility"][lit] == 1).all()
    assert (values["visibility"][shadow] == 0).all()
    assert (values["diffuse"][lit] > 0).all()


def test_an_unknown_name_frame_or_count_is_refused_by_name():
    scenes.activate()
    tracer = Tracer(scenes.wall())
    with pytest.raises(ValueError, match="cannot trace colour; known: radiance"):
        tracer.trace(0, 1, 1, ("colour",))
    with pytest.raises(ValueError, match="no frame 5"):
        tracer.trace(5, 1, 1, ("radiance",))
    with pytest.raises(ValueError, match="spp is 0"):
        tracer.trace(0, 0, 1, ("radiance",))


def test_a_scene_that_cannot_be_loaded_is_named():
    scenes.activate()
    broken = SceneSpec("odd", {"x": {"type": "no-such-shape"}}, (scenes.view(),))
    with pytest.raises(ValueError, match=r"scene odd: Mitsuba cannot load it.*no-such-shape"):
        Tracer(broken)
    lost = SceneSpec("lost", scenes.wall().content, (scenes.view(),), {"door": (1.0, 0.0, 0.0)})
    with pytest.raises(ValueError, match="moving object 'door' is no mesh; meshes: wall"):
        Tracer(lost)


def test_a_black_count_is_kept_of_samples_that_are_not_finite():
    scenes.activate()
    tracer = Tracer(scenes.wall(radiance=1e38))
    (chunk,) = tracer.trace(0, 16, 1, ("radiance", "diffuse"))
    assert np.isfinite(chunk.values["radiance"]).all()
    values = {"radiance": np.array([[[[np.nan, 1, 1], [1, 1, 1]]]], np.float32)}
    before = tracer.invalid
    assert tracer._without_invalid(values)["radiance"].tolist() == [[[[0, 0, 0], [1, 1, 1]]]]
    assert tracer.invalid == before + 1


def test_a_way_is_free_if_nothing_is_on_it():
    scenes.activate()
    tracer = Tracer(scenes.moving())
    assert tracer.free(np.array([0, 0, 4.0]), np.array([0, 0, 1.0]))
    assert not tracer.free(np.array([0, 0, 4.0]), np.array([0, 0, -0.5]))


def test_guides_alone_can_be_traced():
    values = trace(scenes.box(), *GUIDES, spp=1)
    assert list(values) == list(GUIDES)
