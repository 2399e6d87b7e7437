"""Reading no more of a frame than is stored again gives what reading all of it gives."""

from itertools import combinations

import numpy as np
import pytest

from data.buffers import buffer
from data.camera import Camera, depth
from data.derive import derive, sources
from data.exr import read_frame, read_stored, write_exr
from data.frame import Frame
from data.shards.planes import Planes

SIZE = (12, 16)
LOOKED_AT = (
    "color",
    "color_a",
    "color_b",
    "albedo",
    "diffuse_albedo",
    "specular_albedo",
    "diffuse",
    "irradiance",
    "normal",
    "position",
)
WANTED = ("color", "albedo", "irradiance", "depth", "hit", "specular", "color_a", "history")


def image(name: str) -> np.ndarray:
    seed = LOOKED_AT.index(name) if name in LOOKED_AT else 99
    values = np.random.default_rng(seed).random((*SIZE, buffer(name).channels)) + 0.01
    return values.astype(np.float32)


def made(frame: Frame, name: str) -> tuple[np.ndarray, object] | None:
    try:
        result = derive(frame, [name])
    except ValueError:
        return None
    return result.buffers[name], result.notes["derived"]


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_sources_are_enough_to_derive_the_same(number: int) -> None:
    camera = Camera(np.eye(4), np.array([0.5, -2.0, 1.0]))
    for has in combinations(LOOKED_AT, number):
        whole = Frame({name: image(name) for name in has}, "a", 0, camera)
        for name in WANTED:
            kept = sources([name], has) or {has[0]}
            part = Frame({n: whole.buffers[n] for n in has if n in kept}, "a", 0, camera)
            one, other = made(whole, name), made(part, name)
            assert (one is None) == (other is None), (name, has)
            if one is not None and other is not None:
                assert np.array_equal(one[0], other[0]), (name, has)
                assert one[1] == other[1], (name, has)


def test_distance_is_that_of_the_camera_to_the_last_bit_in_any_order_of_memory() -> None:
    generator = np.random.default_rng(2)
    planes = (generator.normal(0, 1, (3, 70, 90)) * 10 ** generator.uniform(-3, 4, (3, 70, 90))).astype("f4")
    camera = Camera(np.eye(4), generator.normal(0, 3, 3))
    interleaved = np.ascontiguousarray(planes.transpose(1, 2, 0))
    expected = depth(camera, interleaved, "euclidean")
    for position in (planes.transpose(1, 2, 0), interleaved):
        found = derive(Frame({"position": position}, "a", 0, camera), ["depth"]).buffers["depth"]
        assert np.array_equal(found, expected)


def write(path, **changes) -> None:
    arrays = {name: image(name) for name in ("color", "albedo", "position")} | changes
    channels = {
        f"{name}.{letter}": array[..., i].astype(np.float32 if name == "position" else np.float16)
        for name, array in arrays.items()
        for i, letter in enumerate(buffer(name).letters)
    }
    write_exr(path, channels, {"penumbra": "1"})


def test_only_what_is_computed_with_is_converted(tmp_path) -> None:
    write(tmp_path / "f000.exr")
    stored = read_stored(tmp_path / "f000.exr", lambda has: ({"albedo"}, ["color", "position"]))
    whole = read_frame(tmp_path / "f000.exr").buffers
    assert set(stored.frame.buffers) == {"albedo", "position"}
    for name, array in stored.frame.buffers.items():
        assert array.dtype == np.float32
        assert np.array_equal(array, whole[name])
    assert set(stored.halves) == {"color"}
    assert stored.halves["color"].dtype == np.float16
    assert np.array_equal(stored.halves["color"].transpose(1, 2, 0), whole["color"])


def test_a_buffer_in_half_precision_with_a_broken_value_is_repaired(tmp_path) -> None:
    color = image("color")
    color[3, 4, 1] = np.nan
    write(tmp_path / "f000.exr", color=color)
    stored = read_stored(tmp_path / "f000.exr", lambda has: ((), ["color", "albedo"]))
    whole = read_frame(tmp_path / "f000.exr")
    assert set(stored.halves) == {"albedo"}
    assert stored.frame.notes["repaired"] == whole.notes["repaired"] == {"color": 1}
    assert np.array_equal(stored.frame.buffers["color"], whole.buffers["color"])


@pytest.mark.parametrize("factor", [1.0, 2.0**-7, 2.0**-9, 2.0**-20, 0.0, -1.0, -(2.0**-9)])
def test_planes_of_half_precision_cut_what_those_of_float_cut(factor: float) -> None:
    half = (image("color") * np.float32(factor)).astype(np.float16)
    half[4, 4] = np.float16(factor)  # among others that are smaller
    half[:, 10:] = -0.0
    one = Planes.of("color", half.astype(np.float32))
    other = Planes("color", np.ascontiguousarray(half.transpose(2, 0, 1)), True)
    for position in (None, (0, 0), (2, 3), (4, 4), (10, 2), (-3, -3), (40, 40)):
        expected, found = one.cut(position, 6), other.cut(position, 6)
        assert expected.dtype == found.dtype
        assert expected.tobytes() == found.tobytes()
        if position is not None:
            assert one.black(position, 6) == other.black(position, 6)


def test_planes_of_half_precision_are_checked_too() -> None:
    with pytest.raises(ValueError, match="'color' has values that are not finite"):
        Planes("color", np.full((3, 4, 4), np.inf, np.float16), True)
