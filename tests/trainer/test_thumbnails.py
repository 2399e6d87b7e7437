import base64
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from data.buffers import buffer
from trainer.reports.svg import fixed, number, percent
from trainer.reports.thumbnails import buffer_thumbnail, expected_coverage, picture_of


def test_the_density_is_the_share_of_patches_that_cover_a_pixel():
    weights = np.random.default_rng(0).random((5, 7)).astype(np.float32)
    expected = np.zeros((7, 9))
    for y in range(5):
        for x in range(7):
            expected[y : y + 3, x : x + 3] += weights[y, x] / weights.sum()
    np.testing.assert_allclose(expected_coverage(weights, 3), expected, atol=1e-6)
    np.testing.assert_allclose(expected_coverage(np.zeros((1, 1), np.float32), 3), 1)


@pytest.mark.parametrize(
    ("name", "value", "pixel"),
    [
        ("color", (0.5, 0.5, 0.5), (255, 255, 255)),
        ("normal", (0, 0, 1), (128, 128, 255)),
        ("albedo", (1, 0, 0), (255, 0, 0)),
        ("roughness", (1,), (255, 255, 255)),
        ("depth", (0,), (0, 0, 0)),
        ("position", (0, 0, 0), (0, 0, 0)),
        ("motion", (0, 0), (0, 0, 0)),
    ],
)
def test_values_become_the_stated_colours(name, value, pixel):
    image = np.tile(np.array(value, np.float32), (4, 4, 1))
    picture, _ = picture_of(name, image, 2.0)
    difference = np.abs(np.asarray(picture)[0, 0].astype(int) - pixel)
    assert difference.max() <= 3


def test_near_is_brighter_than_far_and_noisy_brighter_than_clean():
    ramp = np.linspace(1, 100, 64, dtype=np.float32).reshape(8, 8, 1)
    depth = np.asarray(picture_of("depth", ramp, 1.0)[0]).sum(-1).ravel()
    variance = np.asarray(picture_of("depth_variance", ramp, 1.0)[0]).sum(-1).ravel()
    assert depth[0] > depth[32] > depth[-1]
    assert variance[0] < variance[32] < variance[-1]


@pytest.mark.parametrize("name", ["color", "normal", "depth", "position", "motion", "color_variance", "hit"])
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e30, -1.0])
def test_any_values_give_a_picture(name, value):
    image = np.full((5, 9, buffer(name).channels), value, np.float32)
    thumb = buffer_thumbnail(name, image, 1.0, 4)
    kind, _, coded = thumb.uri.partition(";base64,")
    with Image.open(BytesIO(base64.b64decode(coded))) as picture:
        assert picture.size == (thumb.width, thumb.height) == (4, 2)
        assert kind == f"data:image/{picture.format.lower()}"


def test_numbers_are_short_and_say_what_is_unknown():
    assert [number(v) for v in (None, float("nan"), float("inf"), 0.00123456, -2.0)] == [
        "–", "–", "∞", "0.00123", "−2",
    ]  # fmt: skip
    assert [fixed(v, 2) for v in (None, 1.005, -1.0)] == ["–", "1.00", "−1.00"]
    assert [percent(v) for v in (0, 1e-7, 0.0001234, 0.034, 0.567, 1)] == [
        "0 %", "< 0.001 %", "0.012 %", "3.4 %", "57 %", "100 %",
    ]  # fmt: skip
