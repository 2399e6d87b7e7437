import numpy as np
import pytest

from data.render.moments import Moments, at_counts, over_hits

RNG = np.random.default_rng(1)


def stream(values, sizes, rows=slice(0, 5)):
    start = 0
    for size in sizes:
        yield rows, {"radiance": values[start : start + size]}
        start += size


@pytest.mark.parametrize("sizes", [[8], [3, 5], [1] * 8, [4, 1, 3]])
def test_means_halves_and_variance_equal_numpys_however_samples_arrive(sizes):
    values = RNG.gamma(0.4, 3, (8, 5, 4, 3)).astype(np.float32)
    ((count, moments),) = at_counts(stream(values, sizes), (8,), (5, 4))
    found = moments["radiance"]
    exact = values.astype(np.float64)
    assert count == 8
    assert np.allclose(found.mean(), exact.mean(0), rtol=1e-6)
    assert np.allclose(found.half("a"), exact[::2].mean(0), rtol=1e-6)
    assert np.allclose(found.half("b"), exact[1::2].mean(0), rtol=1e-6)
    assert np.allclose(found.variance(), exact.var(0, ddof=1) / 8, rtol=1e-5)


def test_several_counts_are_prefixes_of_the_same_stream():
    values = RNG.uniform(0, 1, (16, 5, 4, 3)).astype(np.float32)
    found = dict(at_counts(stream(values, [5, 11]), (2, 4, 16), (5, 4)))
    for count in (2, 4, 16):
        assert np.allclose(
            found[count]["radiance"].mean(), values[:count].mean(0, dtype=np.float64), rtol=1e-6
        )
        assert found[count]["radiance"].count == count


def test_bands_of_rows_are_joined_in_order():
    values = RNG.uniform(0, 1, (4, 6, 4, 1)).astype(np.float32)
    chunks = [(slice(a, b), {"depth": values[:, a:b]}) for a, b in ((0, 2), (2, 4), (4, 6))]
    found = dict(at_counts(iter(chunks), (2, 4), (6, 4)))
    assert np.allclose(found[2]["depth"].mean(), values[:2].mean(0, dtype=np.float64))
    assert np.allclose(found[4]["depth"].mean(), values.mean(0, dtype=np.float64))


def test_a_stream_that_ends_early_is_an_error():
    values = np.ones((3, 5, 4, 1), np.float32)
    with pytest.raises(ValueError, match="fewer than 4"):
        list(at_counts(stream(values, [3]), (2, 4), (5, 4)))


def test_depth_is_averaged_over_the_samples_that_hit():
    depth, hits = Moments.zero(1, 2, 1), Moments.zero(1, 2, 1)
    values = np.array([[3.0, 0.0], [5.0, 0.0], [0.0, 0.0]], np.float32).reshape(3, 1, 2, 1)
    depth.add(values)
    hits.add((values > 0).astype(np.float32))
    assert over_hits(depth, hits).ravel().tolist() == [4.0, 0.0]


def test_the_variance_of_a_constant_is_zero_and_never_negative():
    moments = Moments.zero(2, 2, 1)
    moments.add(np.full((64, 2, 2, 1), 1000.1, np.float32))
    assert (moments.variance() == 0).all() or moments.variance().max() < 1e-6
    assert moments.variance().min() >= 0
