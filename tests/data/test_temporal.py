from dataclasses import replace

import numpy as np
import pytest

from data.camera import Camera, footprint, motion
from data.derive import remodulate
from data.frame import Frame
from data.frames import FrameSet
from data.sample import SAMPLES
from data.temporal import POSITION_LIMIT_FOOTPRINTS, Accumulator, accumulate, automatic_thresholds
from tests.data.miniature import Crop, bmfr_matrix, sample_crop

RNG = np.random.default_rng(0)


def frames(scene="classroom", count=3, crop=None):
    return [sample_crop(scene, i, crop or Crop(width=40, height=26)) for i in range(count)]


def literal_accumulation(sequence, position_limit, normal_limit):
    """The rule written out pixel by pixel, with a row-vector matrix in clip space, in double precision."""
    results, last_color, last_count = [], None, None
    for t, frame in enumerate(sequence):
        height, width = frame.height, frame.width
        position, normal = frame.buffers["position"], frame.buffers["normal"]
        color, count = np.zeros((height, width, 3)), np.ones((height, width))
        for y in range(height):
            for x in range(width):
                current = frame.buffers["irradiance"][y, x].astype(float)
                alpha, history, s = 1.0, np.zeros(3), 0.0
                empty = (position[y, x] == 0).all() and (normal[y, x] == 0).all()
                if t > 0 and not empty:
                    before = sequence[t - 1]
                    clip = np.append(position[y, x], 1.0) @ bmfr_matrix(before.camera, width, height)
                    f = (clip[:2] / clip[3] + 1) / 2 * (width, height) - 0.5
                    corner = np.floor(f).astype(int)
                    total = 0.0
                    for dy in (0, 1):
                        for dx in (0, 1):
                            u, v = corner[0] + dx, corner[1] + dy
                            if clip[3] <= 0 or not (0 <= u < width and 0 <= v < height):
                                continue
                            dp = position[y, x] - before.buffers["position"][v, u]
                            dn = normal[y, x] - before.buffers["normal"][v, u]
                            if dp @ dp >= position_limit or dn @ dn >= normal_limit:
                                continue
                            weight = (f[0] - corner[0] if dx else 1 - f[0] + corner[0]) * (
                                f[1] - corner[1] if dy else 1 - f[1] + corner[1]
                            )
                            history += weight * last_color[v, u]
                            s += weight * last_count[v, u]
                            total += weight
                    if total > 0:
                        history, s = history / total, s / total
                        alpha = max(1 / (s + 1), 0.2)
                color[y, x] = alpha * current + (1 - alpha) * history
                count[y, x] = s + 1 if alpha < 1 else 1
        results.append((color, count))
        last_color, last_count = color, count
    return results


@pytest.mark.parametrize("scene", ["classroom", "cbox-glossy"])
def test_accumulation_equals_the_rule_written_pixel_by_pixel(scene):
    sequence = frames(scene, 4)
    expected = literal_accumulation(sequence, 0.02, 1.0)
    for frame, (color, count) in zip(accumulate(sequence, 0.02, 1.0), expected, strict=True):
        scale = np.abs(color).max()
        wrong = np.abs(frame.buffers["irradiance"] - color).max(-1) > 1e-4 * scale
        wrong |= np.abs(frame.buffers["history"][..., 0] - count) > 1e-3
        # A distance on the limit may fall on either side in single precision.
        assert wrong.mean() < 0.005


def still(count, noise=1.0):
    """A static camera in front of a wall: every frame sees the same points."""
    camera = Camera(np.array([[20.0, 0, 8, 0], [0, 20, 6, 0], [0, 0, 1, 0], [0, 0, 1, 0]]))
    y, x = np.mgrid[0:12, 0:16] + 0.5
    position = np.stack([(x - 8) / 20 * 4, (y - 6) / 20 * 4, np.full_like(x, 4)], -1).astype(np.float32)
    normal = np.tile(np.array([0, 0, -1], np.float32), (12, 16, 1))
    return [
        Frame(
            {
                "irradiance": (1 + noise * RNG.random((12, 16, 3))).astype(np.float32),
                "position": position,
                "normal": normal,
            },
            "wall",
            i,
            camera,
        )
        for i in range(count)
    ]


def test_five_frames_are_an_exact_running_mean_and_later_ones_exponential():
    sequence = still(9)
    seen = [f.buffers["irradiance"] for f in sequence]
    results = list(accumulate(sequence))
    for i in range(5):
        assert np.allclose(results[i].buffers["irradiance"], np.mean(seen[: i + 1], 0), rtol=1e-5)
    for i in range(5, 9):
        expected = 0.2 * seen[i] + 0.8 * results[i - 1].buffers["irradiance"]
        assert np.allclose(results[i].buffers["irradiance"], expected, rtol=1e-5)
    assert [float(r.buffers["history"].mean()) for r in results] == pytest.approx(range(1, 10), rel=1e-5)


def test_constant_radiance_stays_constant():
    for frame in accumulate(still(6, noise=0.0)):
        assert np.allclose(frame.buffers["irradiance"], 1, rtol=1e-6)


def test_results_are_marked_and_the_input_frames_are_left_alone():
    sequence = still(2)
    before = sequence[1].buffers["irradiance"].copy()
    results = list(accumulate(sequence))
    assert all(r.accumulated for r in results)
    assert not sequence[1].accumulated
    assert np.array_equal(sequence[1].buffers["irradiance"], before)
    assert results[0].notes["accumulation"] == "first frame"
    assert results[1].notes["accumulation"] == "position and the preceding camera"


def test_an_accumulated_frame_is_not_accumulated_again():
    accumulator = Accumulator()
    with pytest.raises(ValueError, match="wall/frame 0: its irradiance is accumulated already"):
        accumulator.step(accumulator.step(still(1)[0]))


@pytest.mark.parametrize(
    "change",
    [
        lambda f: replace(f, scene="other"),
        lambda f: replace(f, index=f.index + 1),
        lambda f: replace(f, index=0),
        lambda f: replace(f, notes={"sequence": False}),
        lambda f: replace(f, buffers={n: b[:-1] for n, b in f.buffers.items()}),
    ],
)
def test_history_starts_anew_when_a_frame_does_not_follow(change):
    sequence = still(3)
    accumulator = Accumulator()
    accumulator.step(sequence[0])
    accumulator.step(sequence[1])
    other = change(sequence[2])
    result = accumulator.step(other)
    assert (result.buffers["history"] == 1).all()
    assert np.array_equal(result.buffers["irradiance"], other.buffers["irradiance"])


def test_a_view_with_more_samples_has_no_history_and_the_next_view_with_as_many_has():
    first, second = still(2)
    views = [
        replace(first, spp=4, notes={"view": 0}),
        replace(second, spp=8, notes={"view": 0}),
        replace(second, spp=8, index=2, notes={"view": 1}),
    ]
    counts = [frame.buffers["history"].max() for frame in accumulate(views)]
    assert counts == [1, 1, 2]


def test_a_moved_surface_and_a_turned_normal_lose_their_history():
    first, second = still(2)
    position, normal = second.buffers["position"].copy(), second.buffers["normal"].copy()
    position[2, 3, 2] += 2
    normal[5, 6] = [1, 0, 0]
    second = second.with_buffers(position=position, normal=normal)
    history = list(accumulate([first, second]))[1].buffers["history"]
    assert history[2, 3] == 1
    assert history[5, 6] == 1
    assert (history == 2).sum() == history.size - 2


def test_points_behind_the_preceding_camera_have_no_history():
    first, second = still(2)
    second = second.with_buffers(position=-second.buffers["position"])
    result = list(accumulate([first, second], 1e9, 4.1))[1]
    assert (result.buffers["history"] == 1).all()


def test_pixels_that_hit_nothing_start_anew_or_follow_their_motion():
    sequence = still(2)
    for frame in sequence:
        for name in ("position", "normal"):
            frame.buffers[name] = frame.buffers[name].copy()
            frame.buffers[name][:3] = 0
    alone = list(accumulate(sequence))[1].buffers["history"]
    assert (alone[:3] == 1).all()
    assert (alone[4:] == 2).all()
    sequence[1].buffers["motion"] = np.zeros((12, 16, 2), np.float32)
    assert (list(accumulate(sequence))[1].buffers["history"] == 2).all()


def test_motion_replaces_position_and_camera_where_they_are_absent():
    sequence = frames("classroom", 3)
    for before, frame in zip(sequence[:1] + sequence[:-1], sequence, strict=True):
        frame.buffers["motion"] = motion(frame.buffers["position"], frame.camera, before.camera)
    precise = list(accumulate(sequence, 0.02, 1.0))[-1]
    bare = [f.with_buffers() for f in sequence]
    for frame in bare:
        del frame.buffers["position"], frame.buffers["depth"]
        frame.camera = None
    moved = list(accumulate(bare, 0.02, 1.0))[-1]
    assert moved.notes["accumulation"] == "motion"
    interior = np.s_[4:-4, 4:-4]
    agree = np.isclose(moved.buffers["history"], precise.buffers["history"], atol=0.2)[interior]
    assert agree.mean() > 0.8


def test_a_frame_without_normals_is_accumulated_by_position_alone():
    sequence = still(3)
    for frame in sequence:
        del frame.buffers["normal"]
    assert (list(accumulate(sequence))[-1].buffers["history"] == 3).all()


def test_nothing_to_reproject_with_is_an_error_that_says_what_is_needed():
    sequence = still(2)
    for frame in sequence:
        del frame.buffers["position"]
    with pytest.raises(
        ValueError, match="wall/frame 1: accumulation needs `position` and cameras, or `motion`"
    ):
        list(accumulate(sequence))


def test_irradiance_is_derived_from_color_and_albedo():
    sequence = still(2)
    for frame in sequence:
        frame.buffers["color"] = frame.buffers.pop("irradiance") / 2
        frame.buffers["albedo"] = np.full((12, 16, 3), 0.5, np.float32)
    result = list(accumulate(sequence))[1]
    colors = [f.buffers["color"] for f in sequence]
    assert np.allclose(result.buffers["irradiance"], colors[0] + colors[1], rtol=1e-5)
    assert np.array_equal(result.buffers["color"], colors[1])


def test_jitter_of_the_frame_shifts_the_lookup():
    first, second = still(2)
    y, x = np.mgrid[0:12, 0:16]
    shifted = np.stack([(x + 0.25 - 8) / 5, (y + 0.75 - 6) / 5, np.full(x.shape, 4)], -1).astype(np.float32)
    second = second.with_buffers(position=shifted)
    second.camera = replace(second.camera, offset=(0.25, 0.75))
    result = list(accumulate([first, second]))[1].buffers["irradiance"]
    expected = (first.buffers["irradiance"] + second.buffers["irradiance"]) / 2
    assert np.allclose(result, expected, rtol=1e-4)


def test_automatic_limits_scale_with_the_scene():
    frame = frames(count=1)[0]
    limits = automatic_thresholds(frame)
    scaled = frame.with_buffers(position=frame.buffers["position"] * 10)
    matrix = frame.camera.world_to_pixel @ np.diag([0.1, 0.1, 0.1, 1.0])
    scaled.camera = Camera(matrix)
    assert automatic_thresholds(scaled).position_limit_squared == pytest.approx(
        100 * limits.position_limit_squared, rel=1e-3
    )
    size = np.median(footprint(frame.camera, frame.buffers["position"]))
    assert limits.position_limit_squared == pytest.approx((POSITION_LIMIT_FOOTPRINTS * size) ** 2, rel=0.05)


def test_automatic_limits_are_of_the_order_that_bmfr_uses():
    # BMFR's classroom and living room: 0.1 and 0.03 units at 1280x720. Pixels here are four times as wide.
    for scene, known in (("classroom", 0.1), ("living-room-2", 0.03)):
        frame = FrameSet(SAMPLES["bmfr"]).read(scene, 0)
        limit = automatic_thresholds(frame).position_limit_squared ** 0.5 / 4
        assert known / 4 < limit < known * 4


def test_automatic_limits_are_those_of_the_second_frame_for_the_whole_sequence():
    sequence = frames("classroom", 3)
    limits = [automatic_thresholds(frame).position_limit_squared for frame in sequence]
    assert len(set(limits)) == 3
    automatic, given = (list(accumulate(sequence, limit)) for limit in (None, limits[1]))
    for found, expected in zip(automatic, given, strict=True):
        assert np.array_equal(found.buffers["irradiance"], expected.buffers["irradiance"])
    accumulator = Accumulator()
    for frame in sequence:
        accumulator.step(frame)
        assert (accumulator._limits is None) == (frame.index == sequence[0].index)
    assert accumulator._limits == automatic_thresholds(sequence[1])


def test_limits_without_position_or_camera_are_refused():
    frame = still(1)[0]
    frame.camera = None
    with pytest.raises(ValueError, match="no camera, so its scale is unknown"):
        automatic_thresholds(frame)


@pytest.mark.parametrize("limits", [(0.0, None), (None, -1.0)])
def test_limits_must_be_positive(limits):
    with pytest.raises(ValueError, match="expected a positive number"):
        Accumulator(*limits)


def quality(frame):
    scale = frame.exposure
    a, b = (
        np.clip(np.maximum(i * scale, 0) ** (1 / 2.2), 0, 1)
        for i in (
            remodulate(frame.buffers["irradiance"], frame.buffers["albedo"]),
            frame.buffers["reference"],
        )
    )
    return -10 * np.log10(np.mean((a - b) ** 2))


def test_accumulation_gains_at_least_five_decibels_on_every_sample_scene():
    for scene in ("classroom", "cbox-glossy", "living-room-2"):
        sequence = [sample_crop(scene, i, Crop(0, 0, 320, 180)) for i in range(8)]
        results = list(accumulate(sequence))
        assert quality(results[-1]) > quality(sequence[-1]) + 5
