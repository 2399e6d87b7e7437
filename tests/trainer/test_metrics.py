import numpy as np
import pytest
import torch

from trainer.metrics.collection import METRICS, SceneMetrics
from trainer.metrics.functional import psnr_wskp, relmse_layer, smape_wskp, ssim_wskp, ssim_wskp_range1


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
