import numpy as np
import pytest
import torch

from trainer.metrics.collection import METRICS, SceneMetrics
from trainer.metrics.functional import (
    levels,
    ms_ssim_gamma,
    psnr_afgsa,
    psnr_layer,
    psnr_nbgd,
    psnr_wskp,
    rel_mse_half_afgsa,
    relmse_layer,
    relmse_nbgd,
    relmse_rousselle,
    relmse_sbmc,
    relmse_tungsten,
    rmse_nbgd,
    smape_percent_nbgd,
    smape_wskp,
    ssim_afgsa,
    ssim_layer,
    ssim_nbgd,
    ssim_wskp,
    ssim_wskp_range1,
)
from trainer.reports.tables import print_scores


def pair(seed=0, size=(2, 3, 20, 23)):
    generator = torch.Generator().manual_seed(seed)
    reference = torch.rand(size, generator=generator) * 1.5
    return reference * (1 + 0.3 * torch.randn(size, generator=generator)), reference


def display(image):
    return np.clip(np.maximum(image.double().numpy(), 0) ** 0.454545, 0, 1)


def literal_ssim(x, y, data_range):
    """One window at a time, float64, as Wang et al. 2004 write it, with sample covariance."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for channel in range(3):
        for row in range(x.shape[1] - 6):
            for column in range(x.shape[2] - 6):
                a = x[channel, row : row + 7, column : column + 7].ravel()
                b = y[channel, row : row + 7, column : column + 7].ravel()
                covariance = np.cov(a, b)
                mean = (2 * a.mean() * b.mean() + c1) / (a.mean() ** 2 + b.mean() ** 2 + c1)
                spread = (2 * covariance[0, 1] + c2) / (covariance[0, 0] + covariance[1, 1] + c2)
                values.append(mean * spread)
    return np.mean(values)


@pytest.mark.parametrize(("metric", "data_range"), [(ssim_wskp, 2.0), (ssim_wskp_range1, 1.0)])
def test_ssim_equals_a_window_by_window_transcription(metric, data_range):
    output, reference = pair()
    pairs = zip(output, reference, strict=True)
    expected = [literal_ssim(display(o), display(r), data_range) for o, r in pairs]
    assert metric(output, reference).numpy() == pytest.approx(expected, abs=1e-6)


def test_psnr_is_on_gamma_images_with_peak_one_per_image():
    output, reference = pair()
    errors = [np.mean((display(o) - display(r)) ** 2) for o, r in zip(output, reference, strict=True)]
    assert psnr_wskp(output, reference).numpy() == pytest.approx(-10 * np.log10(errors), abs=1e-4)


def test_relmse_and_smape_have_their_own_constants():
    output, reference = torch.full((1, 3, 8, 8), 0.03), torch.full((1, 3, 8, 8), 0.01)
    assert float(relmse_layer(output, reference)) == pytest.approx(0.0004 / 0.0002, rel=1e-5)
    assert float(smape_wskp(output, reference)) == pytest.approx(0.02 / 0.05, rel=1e-5)


def test_ssim_refuses_an_image_smaller_than_its_window():
    with pytest.raises(ValueError, match="7x7"):
        ssim_wskp(torch.ones(1, 3, 6, 9), torch.ones(1, 3, 6, 9))


def test_scene_means_do_not_depend_on_how_images_are_batched():
    output, reference = pair(size=(5, 3, 16, 16))
    scenes = ["a", "b", "b", "a", "b"]
    whole, parts = SceneMetrics(["b", "a"]), SceneMetrics(["a", "b"])
    whole.update(output, reference, scenes)
    for row in (4, 0, 2, 1, 3):
        parts.update(output[row : row + 1], reference[row : row + 1], [scenes[row]])
    for scene, row in whole.compute().items():
        assert parts.compute()[scene] == pytest.approx(row, rel=1e-5), scene


def test_average_weighs_scenes_and_not_images():
    output, reference = pair(size=(3, 3, 16, 16))
    metrics = SceneMetrics(["a", "b"])
    metrics.update(output, reference, ["a", "a", "b"])
    table = metrics.compute()
    for name in METRICS:
        assert table["average"][name] == pytest.approx((table["a"][name] + table["b"][name]) / 2)


def test_sums_of_two_ranks_reduce_to_the_result_of_one():
    output, reference = pair(size=(4, 3, 16, 16))
    one, left, right = (SceneMetrics(["a", "b"]) for _ in range(3))
    one.update(output, reference, ["a", "b", "b", "b"])
    left.update(output[:1], reference[:1], ["a"])
    right.update(output[1:], reference[1:], ["b", "b", "b"])
    left.totals += right.totals
    left.counts += right.counts
    assert left.compute()["average"] == pytest.approx(one.compute()["average"])


def test_unknown_scene_is_named():
    with pytest.raises(ValueError, match="kitchen"):
        SceneMetrics(["a"]).update(*pair(size=(1, 3, 8, 8)), ["kitchen"])


def eight_bit(image):
    """What AFGSA's authors evaluate, by numpy: gamma 1/2.2, clipped, times 255, cut off to uint8."""
    return (np.clip(np.maximum(image.double().numpy(), 0) ** (1 / 2.2), 0, 1) * 255).astype(np.uint8)


def gaussian_ssim(x, y, data_range=255):
    """One 11x11 window at a time, float64, weighted by a Gaussian of 1.5 pixels."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    rows, columns = np.mgrid[-5:6, -5:6]
    weights = np.exp(-(rows**2 + columns**2) / (2 * 1.5**2))
    weights /= weights.sum()
    values = []
    for channel in range(3):
        for row in range(x.shape[1] - 10):
            for column in range(x.shape[2] - 10):
                a = x[channel, row : row + 11, column : column + 11].astype(np.float64)
                b = y[channel, row : row + 11, column : column + 11].astype(np.float64)
                ma, mb = (weights * a).sum(), (weights * b).sum()
                va, vb = (weights * (a - ma) ** 2).sum(), (weights * (b - mb) ** 2).sum()
                covariance = (weights * (a - ma) * (b - mb)).sum()
                mean = (2 * ma * mb + c1) / (ma**2 + mb**2 + c1)
                values.append(mean * (2 * covariance + c2) / (va + vb + c2))
    return np.mean(values)


def test_ssim_of_afgsa_equals_a_window_by_window_transcription_on_8_bit_images():
    output, reference = pair(3)
    pairs = zip(output, reference, strict=True)
    expected = [gaussian_ssim(eight_bit(o), eight_bit(r)) for o, r in pairs]
    assert ssim_afgsa(output, reference).numpy() == pytest.approx(expected, abs=1e-6)


def test_psnr_of_afgsa_is_on_8_bit_images():
    output, reference = pair(4)
    for o, r, found in zip(output, reference, psnr_afgsa(output, reference), strict=True):
        error = np.mean((eight_bit(o).astype(np.float64) - eight_bit(r)) ** 2)
        assert float(found) == pytest.approx(20 * np.log10(255 / np.sqrt(error)), abs=1e-5)


def log_srgb(image):
    """What the layer paper evaluates, by numpy: its equations 7 and 8, clipped to what can be shown."""
    value = np.log(1 + np.maximum(image.double().numpy(), 0))
    curve = np.where(value > 0.0031308, 1.055 * value ** (1 / 2.4) - 0.055, 12.92 * value)
    return np.clip(curve, 0, 1)


def test_psnr_and_ssim_of_the_layer_paper_are_on_its_tone_mapped_images_with_range_one():
    output, reference = pair(6, size=(2, 3, 14, 16))
    output[0, 0, 3, 4], reference[0, 0, 3, 4] = 50.0, 20.0  # both white
    shown = [(log_srgb(o), log_srgb(r)) for o, r in zip(output, reference, strict=True)]
    ratios = [-10 * np.log10(np.mean((o - r) ** 2)) for o, r in shown]
    assert psnr_layer(output, reference).numpy() == pytest.approx(ratios, abs=1e-3)
    similar = [gaussian_ssim(o, r, data_range=1) for o, r in shown]
    assert ssim_layer(output, reference).numpy() == pytest.approx(similar, abs=1e-5)
    with pytest.raises(ValueError, match="11x11"):
        ssim_layer(output[..., :10, :], reference[..., :10, :])


def stored(image):
    """What NBGD's authors evaluate: a picture of 8 bits, rounded, read again as 0..1."""
    return (display(image) * 255 + 0.5).astype(np.uint8) / 255


def test_metrics_of_nbgd_are_on_stored_pictures():
    output, reference = pair(7)
    for i in range(len(output)):
        x, y = stored(output[i]), stored(reference[i])
        expected = {
            psnr_nbgd: -10 * np.log10(np.mean((x - y) ** 2)),
            ssim_nbgd: literal_ssim(x, y, 2.0),
            rmse_nbgd: np.sqrt(np.mean((x - y) ** 2)),
            smape_percent_nbgd: 100 * np.mean(2 * np.abs(x - y) / (x + y + 1e-7)),
            relmse_nbgd: np.mean((x - y) ** 2 / (y**2 + 1e-7)),
        }
        for metric, value in expected.items():
            found = float(metric(output[i : i + 1], reference[i : i + 1]))
            assert found == pytest.approx(value, rel=1e-5), metric.__name__


@pytest.mark.parametrize(
    ("metric", "eps"), [(relmse_rousselle, 1e-2), (relmse_tungsten, 1e-3), (relmse_layer, 1e-4)]
)
def test_relative_errors_differ_by_what_keeps_black_finite(metric, eps):
    output, reference = (image.double().numpy() for image in pair(8))
    expected = [np.mean((o - r) ** 2 / (r**2 + eps)) for o, r in zip(output, reference, strict=True)]
    assert metric(*pair(8)).numpy() == pytest.approx(expected, rel=1e-5)


def test_sbmc_leaves_a_border_of_21_pixels_out():
    output, reference = pair(9, size=(1, 3, 45, 50))
    inner = (output[..., 21:-21, 21:-21], reference[..., 21:-21, 21:-21])
    assert float(relmse_sbmc(output, reference)) == float(relmse_layer(*inner))
    with pytest.raises(ValueError, match="21 pixels"):
        relmse_sbmc(output[..., :42, :], reference[..., :42, :])


def five_scales(x, y):
    """Wang et al. 2003 by numpy, float64: windows as views, a Gaussian of 1.5 pixels, means of 2x2 pixels."""
    rows, columns = np.mgrid[-5:6, -5:6]
    weights = np.exp(-(rows**2 + columns**2) / (2 * 1.5**2))
    weights /= weights.sum()

    def windows(image):
        return np.lib.stride_tricks.sliding_window_view(image, (11, 11), axis=(1, 2))

    def mean(image):
        return np.einsum("chwij,ij->chw", windows(image), weights)

    total = 1.0
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        mx, my = mean(x), mean(y)
        vx, vy, vxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
        part = (2 * vxy + 0.03**2) / (vx + vy + 0.03**2)
        if scale == 4:
            part = part * (2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2)
        total *= part.mean() ** exponent
        even = [image[:, : image.shape[1] // 2 * 2, : image.shape[2] // 2 * 2] for image in (x, y)]
        x, y = (e.reshape(3, e.shape[1] // 2, 2, e.shape[2] // 2, 2).mean((2, 4)) for e in even)
    return total


def test_ms_ssim_equals_a_transcription():
    output, reference = pair(10, size=(2, 3, 180, 203))
    pairs = zip(output, reference, strict=True)
    expected = [five_scales(display(o), display(r)) for o, r in pairs]
    assert ms_ssim_gamma(output, reference).numpy() == pytest.approx(expected, abs=1e-5)
    with pytest.raises(ValueError, match="176x176"):
        ms_ssim_gamma(output[..., :175, :], reference[..., :175, :])


def test_levels_are_cut_off_and_not_rounded():
    image = torch.tensor([-1.0, 0.0, (100.99 / 255) ** 2.2, (100.01 / 255) ** 2.2, 1.0, 7.0])
    assert levels(image).tolist() == [0, 0, 100, 100, 255, 255]


def test_psnr_of_afgsa_is_zero_where_images_are_equal_and_48_db_at_one_level():
    image = torch.full((1, 3, 16, 16), (100.5 / 255) ** 2.2)
    assert float(psnr_afgsa(image, image)) == 0.0
    assert float(psnr_afgsa(image, image, equal=99.0)) == 99.0
    assert float(ssim_afgsa(image, image)) == pytest.approx(1.0)
    brighter = torch.full_like(image, (101.5 / 255) ** 2.2)
    assert float(psnr_afgsa(brighter, image)) == pytest.approx(20 * np.log10(255), abs=1e-4)


def test_the_error_that_afgsa_calls_rmse_is_half_a_relative_square_with_its_own_eps():
    output, reference = torch.full((1, 3, 8, 8), 0.5), torch.full((1, 3, 8, 8), 0.3)
    assert float(rel_mse_half_afgsa(output, reference)) == pytest.approx(0.5 * 0.04 / 0.1, rel=1e-5)
    assert float(rel_mse_half_afgsa(output, reference, eps=0.07)) == pytest.approx(0.5 * 0.25, rel=1e-5)


def test_ssim_of_afgsa_refuses_an_image_smaller_than_its_window():
    with pytest.raises(ValueError, match="11x11"):
        ssim_afgsa(torch.ones(1, 3, 10, 20), torch.ones(1, 3, 10, 20))


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_says_which_direction_is_better(name):
    output, reference = pair(5)
    closer = reference + 0.25 * (output - reference)
    better, worse = (METRICS[name].function(image, reference).mean() for image in (closer, output))
    assert (better > worse) == METRICS[name].higher


def test_all_tables_fit_a_hundred_columns_and_say_how_metrics_are_defined(capsys):
    scenes = ("average", "sponza-moving-light")
    logged = {
        f"{kind}/{name}{'' if scene == 'average' else '/' + scene}": 12.3456789
        for kind in ("test", "input")
        for name in METRICS
        for scene in scenes
    }
    print_scores(logged, "test")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("sponza-moving-light" in line for line in lines) == 6
    assert sum(line.count("12.35 dB") for line in lines) == 12
    assert sum(line.startswith("Definitions:") for line in lines) == 3
    assert "…" not in "".join(lines)
