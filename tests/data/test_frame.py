import numpy as np
import pytest

from data.frame import Frame


def image(height=4, width=5, channels=3, dtype=np.float32):
    return np.zeros((height, width, channels), dtype)


def test_a_frame_knows_its_size_and_label():
    frame = Frame({"color": image()}, "room", 7)
    assert (frame.height, frame.width, frame.label) == (4, 5, "room/frame 7")


def test_a_frame_without_buffers_is_refused():
    with pytest.raises(ValueError, match="room/frame 0 has no buffers"):
        Frame({}, "room", 0)


def test_buffers_of_different_size_are_named_with_their_sizes():
    with pytest.raises(ValueError, match="different size: color 5x4, normal 4x4"):
        Frame({"color": image(), "normal": image(4, 4)}, "room", 0)


def test_a_wrong_number_of_channels_is_refused():
    with pytest.raises(ValueError, match=r"buffer 'depth' has shape \(4, 5, 3\), expected \(H, W, 1\)"):
        Frame({"depth": image()}, "room", 0)


def test_another_type_than_float32_is_refused():
    with pytest.raises(ValueError, match="buffer 'color' is float64, expected float32"):
        Frame({"color": image(dtype=np.float64)}, "room", 0)


def test_an_unknown_buffer_is_refused():
    with pytest.raises(ValueError, match="unknown buffer 'beauty'"):
        Frame({"beauty": image()}, "room", 0)


def test_require_names_what_is_missing_and_what_is_there():
    frame = Frame({"color": image()}, "room", 3)
    with pytest.raises(ValueError, match="room/frame 3: missing buffer normal, depth; it has color"):
        frame.require("color", "normal", "depth")


def test_a_frame_follows_the_one_before_of_its_scene_or_that_of_the_view_before_with_as_many_samples():
    def of(index, view=None, spp=4, scene="hall"):
        notes = {} if view is None else {"view": view}
        return Frame({"color": image()}, scene, index, spp=spp, notes=notes)

    assert of(3).follows(of(2, spp=8))
    assert not any(of(3).follows(last) for last in (None, of(1), of(3), of(4), of(2, scene="roof")))
    assert of(2, view=1).follows(of(0, view=0))
    assert not of(1, view=0, spp=8).follows(of(0, view=0))
    assert not of(2, view=1).follows(of(1, view=0, spp=8))


def test_with_buffers_leaves_the_original_alone():
    frame = Frame({"color": image()}, "room", 0)
    changed = frame.with_buffers(normal=image())
    changed.notes["x"] = 1
    assert list(frame.buffers) == ["color"]
    assert not frame.notes
    assert list(changed.buffers) == ["color", "normal"]
