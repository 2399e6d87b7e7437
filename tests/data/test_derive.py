import numpy as np
import pytest

from data.camera import Camera
from data.derive import (
    ALBEDO_FLOOR,
    automatic_exposure,
    demodulate,
    derive,
    effective_albedo,
    luminance,
    remodulate,
)
from data.frame import Frame
from data.frames import FrameSet
from data.sample import SAMPLES

MATERIALS = {
    "diffuse": ([0.8, 0.4, 0.1], [0, 0, 0]),
    "metal": ([0, 0, 0], [0.95, 0.64, 0.54]),
    "mirror": ([0, 0, 0], [1, 1, 1]),
    "plastic": ([0.5, 0.5, 0.5], [0.04, 0.04, 0.04]),
    "glossy white": ([0.9, 0.9, 0.9], [0.2, 0.2, 0.2]),
    "lamp": ([0, 0, 0], [0, 0, 0]),
    "saturated": ([1, 0, 0], [0, 0, 0]),
}


def pixel(values):
    return np.array(values, np.float32).reshape(1, 1, 3)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("radiance", [0.0, 1e-4, 0.3, 17.75, 65504.0])
def test_demodulation_round_trip_keeps_every_material(material, radiance):
    diffuse, specular = map(pixel, MATERIALS[material])
    albedo = effective_albedo(diffuse, specular)
    color = pixel([radiance, radiance / 3, radiance / 7])
    back = remodulate(demodulate(color, albedo), albedo)
    assert np.allclose(back, color, rtol=2.5e-7, atol=0)


def test_effective_albedo_is_the_sum_where_something_is_known():
    assert effective_albedo(*map(pixel, MATERIALS["plastic"])).ravel() == pytest.approx([0.54] * 3)
    assert effective_albedo(*map(pixel, MATERIALS["metal"])).ravel() == pytest.approx([0.95, 0.64, 0.54])


def test_effective_albedo_is_one_where_nothing_is_known_and_never_above():
    assert effective_albedo(*map(pixel, MATERIALS["lamp"])).ravel().tolist() == [1, 1, 1]
    assert effective_albedo(*map(pixel, MATERIALS["glossy white"])).max() == 1


def test_effective_albedo_has_a_floor_in_each_channel():
    albedo = effective_albedo(*map(pixel, MATERIALS["saturated"])).ravel()
    assert albedo == pytest.approx([1, ALBEDO_FLOOR, ALBEDO_FLOOR])


def test_division_by_zero_albedo_is_refused():
    with pytest.raises(ValueError, match="use effective_albedo"):
        demodulate(pixel([1, 1, 1]), pixel([1, 0, 1]))


@pytest.mark.parametrize("scene", ["classroom", "cbox-glossy", "living-room-2"])
def test_demodulation_round_trip_is_exact_on_real_frames(scene):
    frame = FrameSet(SAMPLES["bmfr"]).read(scene, 4)
    color = frame.buffers["color"]
    back = remodulate(frame.buffers["irradiance"], frame.buffers["albedo"])
    assert np.allclose(back, color, rtol=2.5e-7, atol=0)


def frame_with(**buffers):
    return Frame({n: np.asarray(b, np.float32) for n, b in buffers.items()}, "room", 5)


ONES = np.ones((4, 6, 3), np.float32)


def camera():
    return Camera(np.array([[50.0, 0, 32, 0], [0, 50, 24, 0], [0, 0, 1, 0], [0, 0, 1, 0]]))


def test_irradiance_is_derived_through_the_albedo_and_both_are_noted():
    frame = derive(frame_with(color=ONES, diffuse_albedo=ONES / 2), ["irradiance"])
    assert (frame.buffers["irradiance"] == 2).all()
    assert list(frame.notes["derived"]) == ["albedo", "irradiance"]


def test_what_is_there_is_not_derived_again():
    original = frame_with(color=ONES, albedo=ONES / 2, irradiance=ONES * 7)
    assert (derive(original, ["irradiance", "color"]).buffers["irradiance"] == 7).all()


def test_deriving_leaves_the_given_frame_alone():
    original = frame_with(color=ONES, albedo=ONES)
    derive(original, ["irradiance"])
    assert "irradiance" not in original.buffers
    assert original.notes == {}


def test_color_is_the_product_or_the_mean_of_the_halves():
    product = derive(frame_with(irradiance=ONES * 3, albedo=ONES / 2), ["color"])
    halves = derive(frame_with(color_a=ONES, color_b=ONES * 2), ["color"])
    assert (product.buffers["color"] == 1.5).all()
    assert (halves.buffers["color"] == 1.5).all()


def test_specular_is_color_minus_diffuse():
    frame = derive(frame_with(color=ONES, diffuse=ONES / 4), ["specular"])
    assert (frame.buffers["specular"] == 0.75).all()


def test_depth_is_zero_where_nothing_was_hit():
    position = np.tile(np.array([3, 0, 4], np.float32), (4, 6, 1))
    position[0, 0] = 0
    frame = frame_with(position=position, normal=ONES * (position[..., 2:] > 0))
    frame.camera = camera()
    z, distance = (derive(frame, ["depth"], depth_kind=k).buffers["depth"] for k in ("z", "euclidean"))
    assert (z[0, 0, 0], z[1, 1, 0], distance[0, 0, 0], distance[1, 1, 0]) == (0, 4, 0, 5)


def test_a_surface_through_the_origin_of_the_world_is_a_hit():
    frame = frame_with(position=ONES * 0, normal=ONES)
    matrix = camera().world_to_pixel @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1.0]])
    frame.camera = Camera(matrix)
    assert (derive(frame, ["depth"]).buffers["depth"] == 2).all()


def test_motion_needs_the_preceding_camera():
    frame = frame_with(position=ONES)
    frame.camera = camera()
    with pytest.raises(ValueError, match="camera of this or the last frame"):
        derive(frame, ["motion"])
    assert (derive(frame, ["motion"], previous=camera()).buffers["motion"] == 0).all()


def test_history_of_a_single_frame_is_one():
    assert (derive(frame_with(color=ONES), ["history"]).buffers["history"] == 1).all()


@pytest.mark.parametrize(
    ("name", "missing"),
    [("albedo", "diffuse_albedo"), ("irradiance", "color"), ("depth", "position"), ("specular", "diffuse")],
)
def test_what_cannot_be_derived_is_named_with_what_is_missing(name, missing):
    with pytest.raises(
        ValueError, match=rf"room/frame 5: missing buffer '{name}', and {missing}.*it has normal"
    ):
        derive(frame_with(normal=ONES), [name])


def test_a_buffer_without_a_rule_is_simply_missing():
    with pytest.raises(ValueError, match="missing buffer normal; it has color"):
        derive(frame_with(color=ONES), ["normal"])


def oidn_exposure_by_hand(color):
    light = luminance(color).astype(np.float64)
    height, width = light.shape
    down, across = -(-height // 16), -(-width // 16)
    logs = []
    for i in range(down):
        for j in range(across):
            rows = slice(i * height // down, (i + 1) * height // down)
            columns = slice(j * width // across, (j + 1) * width // across)
            mean = light[rows, columns].mean()
            if mean > 1e-8:
                logs.append(np.log2(mean))
    return 0.18 / 2 ** np.mean(logs)


@pytest.mark.parametrize("size", [(16, 16), (17, 40), (5, 3), (180, 320)])
def test_automatic_exposure_equals_oidn_bin_by_bin(size):
    color = np.random.default_rng(1).gamma(0.5, 2.0, (*size, 3)).astype(np.float32)
    color[: size[0] // 2] = 0
    assert automatic_exposure(color) == pytest.approx(oidn_exposure_by_hand(color), rel=1e-9)


def test_automatic_exposure_undoes_a_change_of_unit():
    color = np.random.default_rng(2).random((32, 32, 3)).astype(np.float32)
    assert automatic_exposure(color * 20) == pytest.approx(automatic_exposure(color) / 20)


def test_automatic_exposure_of_a_black_image_is_one():
    assert automatic_exposure(np.zeros((20, 20, 3), np.float32)) == 1.0


def noisy(seed):
    return np.random.default_rng(seed).gamma(0.5, 2.0, (4, 6, 3)).astype(np.float32)


@pytest.mark.parametrize("name", ["color", "normal", "diffuse_albedo", "specular"])
def test_any_buffer_is_the_mean_of_its_halves(name):
    halves = {f"{name}_a": noisy(1), f"{name}_b": noisy(2)}
    frame = derive(frame_with(**halves), [name])
    assert np.allclose(frame.buffers[name], (noisy(1) + noisy(2)) / 2)
    assert frame.notes["derived"] == {name: f"mean of {name}_a and {name}_b"}


@pytest.mark.parametrize(("there", "wanted"), [("a", "b"), ("b", "a")])
def test_a_half_is_twice_the_mean_less_the_other(there, wanted):
    a, b = noisy(1), noisy(2)
    frame = frame_with(**{"color": (a + b) / 2, f"color_{there}": {"a": a, "b": b}[there]})
    frame = derive(frame, [f"color_{wanted}"])
    assert np.allclose(frame.buffers[f"color_{wanted}"], {"a": a, "b": b}[wanted], atol=1e-5)
    assert frame.notes["derived"] == {f"color_{wanted}": f"2 * color - color_{there}"}


def test_a_half_without_the_mean_is_simply_missing():
    with pytest.raises(ValueError, match="missing buffer color_b; it has color_a"):
        derive(frame_with(color_a=ONES), ["color_b"])


def test_the_variance_of_the_mean_follows_from_the_halves_only_where_it_is_allowed():
    generator = np.random.default_rng(5)
    a, b = (generator.normal(3, 2, (200, 300, 3)) for _ in range(2))
    frame = frame_with(color_a=a, color_b=b)
    with pytest.raises(ValueError, match="missing buffer color_variance"):
        derive(frame, ["color_variance"])
    variance = derive(frame, ["color_variance"], variance_from_halves=True).buffers["color_variance"]
    # Each half has the variance 4, so that their mean has 2.
    assert variance.mean() == pytest.approx(2, rel=0.02)
    assert variance.min() >= 0


def test_the_variance_follows_from_the_mean_and_one_half_as_well():
    a, b = noisy(1), noisy(2)
    frame = derive(
        frame_with(depth=(a + b)[..., :1] / 2, depth_a=a[..., :1]),
        ["depth_variance"],
        variance_from_halves=True,
    )
    assert np.allclose(frame.buffers["depth_variance"], ((a - b)[..., :1] / 2) ** 2, atol=1e-5)


def test_a_variance_without_halves_is_missing_even_where_it_is_allowed():
    with pytest.raises(ValueError, match="missing buffer normal_"):
        derive(frame_with(normal=ONES), ["normal_variance"], variance_from_halves=True)


def test_color_diffuse_and_specular_give_each_other():
    parts = {"color": ONES * 3, "diffuse": ONES, "specular": ONES * 2}
    for name in parts:
        rest = {k: v for k, v in parts.items() if k != name}
        assert (derive(frame_with(**rest), [name]).buffers[name] == parts[name]).all(), name


def test_irradiance_follows_from_diffuse_and_specular():
    frame = derive(frame_with(diffuse=ONES, specular=ONES, albedo=ONES / 2), ["irradiance"])
    assert (frame.buffers["irradiance"] == 4).all()


def test_visibility_has_no_rule():
    with pytest.raises(ValueError, match="missing buffer visibility; it has color"):
        derive(frame_with(color=ONES, depth=ONES[..., :1]), ["visibility"])


@pytest.mark.parametrize("half", ["a", "b"])
def test_halves_and_variance_of_the_albedo_follow_from_those_of_the_reflectance(half):
    reflectance = np.where(np.arange(6)[:, None] < 2, np.float32(0), noisy(3) / 50)
    names = {f"diffuse_albedo_{half}": reflectance, "diffuse_albedo_variance": noisy(4)}
    frame = derive(frame_with(**names), [f"albedo_{half}", "albedo_variance"])
    assert np.array_equal(frame.buffers[f"albedo_{half}"], effective_albedo(reflectance.astype(np.float32)))
    assert np.array_equal(frame.buffers["albedo_variance"], noisy(4))


def test_halves_of_specular_light_follow_from_those_of_color_and_diffuse():
    rng = np.random.default_rng(5)
    names = ("color_a", "color_b", "diffuse_a", "diffuse_b")
    given = {name: rng.gamma(1, 1, (3, 4, 3)).astype(np.float32) for name in names}
    result = derive(Frame(dict(given), "s", 0), ["specular_a", "specular_b"])
    for half in "ab":
        assert np.array_equal(
            result.buffers[f"specular_{half}"], given[f"color_{half}"] - given[f"diffuse_{half}"]
        )
    with pytest.raises(ValueError, match=r"missing buffer 'specular_a'.*diffuse_a"):
        derive(Frame({"color_a": given["color_a"]}, "s", 0), ["specular_a"])


@pytest.mark.parametrize(
    "name", ["second_albedo", "second_albedo_variance", "position_variance", "position_a"]
)
def test_what_follows_from_nothing_is_named_with_the_command_that_renders_it(name):
    frame = Frame({"color": np.ones((2, 2, 3), np.float32)}, "room", 1)
    with pytest.raises(ValueError, match=rf"missing buffer {name};.*trainer render stills --second-hit"):
        derive(frame, [name])
