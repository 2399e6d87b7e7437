import numpy as np
import pytest

from data.camera import Camera, depth, footprint, motion, project

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0


def looking_along_z(x=0.0):
    """A camera at (x, 0, 0) that looks along +z, x to the right, y down."""
    k = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
    view = np.eye(4)
    view[0, 3] = -x
    return Camera(k @ view)


def test_a_point_on_the_axis_projects_to_the_middle_of_the_image():
    pixels, w = project(looking_along_z(), np.array([0.0, 0.0, 5.0]))
    assert pixels.tolist() == [32, 24]
    assert w == 5


def test_points_behind_the_camera_have_a_negative_w():
    assert project(looking_along_z(), np.array([[0.0, 0.0, -1.0]]))[1][0] < 0


def test_the_centre_is_recovered_from_the_matrix():
    assert looking_along_z(3.0).centre() == pytest.approx([3, 0, 0])


def test_a_given_origin_is_the_centre():
    camera = Camera(looking_along_z().world_to_pixel, np.array([1.0, 2.0, 3.0]))
    assert camera.centre().tolist() == [1, 2, 3]


def test_a_matrix_without_perspective_has_no_centre():
    with pytest.raises(ValueError, match="not a perspective projection"):
        Camera(np.diag([1.0, 1.0, 1.0, 0.0])).centre()


def test_z_and_euclidean_depth_differ_off_the_axis():
    position = np.array([[[3.0, 0.0, 4.0]]], np.float32)
    assert depth(looking_along_z(), position, "z").item() == 4
    assert depth(looking_along_z(), position, "euclidean").item() == 5


def test_depths_do_not_depend_on_the_scale_of_the_image():
    camera = looking_along_z(1.0)
    position = np.random.default_rng(0).uniform(1, 5, (4, 4, 3)).astype(np.float32)
    scale = np.diag([2.0, 3.0, 1.0, 1.0])
    scaled = Camera(scale @ camera.world_to_pixel)
    for kind in ("z", "euclidean"):
        assert np.allclose(depth(scaled, position, kind), depth(camera, position, kind))


def test_motion_points_to_where_the_surface_was():
    # The camera moved right by 0.1, so a surface 5 away moved left by focal * 0.1 / 5 pixels.
    position = np.array([[[0.0, 0.0, 5.0]]], np.float32)
    moved = motion(position, looking_along_z(0.1), looking_along_z(0.0))
    assert moved[0, 0] == pytest.approx([FOCAL * 0.1 / 5, 0], abs=1e-5)


def test_points_behind_a_camera_do_not_move():
    position = np.array([[[0.0, 0.0, -5.0], [0.0, 0.0, 0.0]]], np.float32)
    assert (motion(position, looking_along_z(0.1), looking_along_z()) == 0).all()


def test_a_footprint_is_the_distance_between_neighbouring_pixels():
    camera = looking_along_z(0.3)
    left, right = np.array([0.0, 0.0, 7.0]), np.array([7.0 / FOCAL, 0.0, 7.0])
    assert np.diff([project(camera, p)[0][0] for p in (left, right)]) == pytest.approx(1)
    assert footprint(camera, left[None, None]).item() == pytest.approx(7 / FOCAL)


def test_a_camera_survives_json():
    camera = Camera(looking_along_z().world_to_pixel, np.array([1.0, 2.0, 3.0]), (0.25, 0.75))
    copy = Camera.from_json(camera.to_json())
    assert np.array_equal(copy.world_to_pixel, camera.world_to_pixel)
    assert np.array_equal(copy.centre(), camera.centre())
    assert copy.offset == (0.25, 0.75)


@pytest.mark.parametrize("values", [{}, {"world_to_pixel": [[1, 2], [3, 4]]}, {"world_to_pixel": "x"}, None])
def test_a_damaged_camera_is_refused(values):
    with pytest.raises(ValueError, match="4x4"):
        Camera.from_json(values)
