"""Image metrics, one function per definition in use; the name says whose definition it is.

Every function takes linear radiance (B, 3, H, W), already multiplied by the exposure at which it is to be
judged, and returns one float32 number per image (B,). The transfer "gamma" of WSKP, NBGD and MR-KP is
`clamp(max(x, 0) ** 0.454545, 0, 1)`; AFGSA and ACFM evaluate 8-bit images (`levels`); the layer paper
`clamp(sRGB(log(1 + x)), 0, 1)` (`compressed`).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.tonemap import srgb_log

GAMMA = 0.454545


def gamma(radiance: Tensor) -> Tensor:
    """Return the display values in [0, 1] on which WSKP evaluates."""
    return radiance.float().clamp_min(0).pow(GAMMA).clamp_max(1)


def psnr_wskp(output: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB on gamma images, peak 1, mean over RGB; infinite where equal."""
    error = torch.square(gamma(output) - gamma(reference)).flatten(1).mean(1)
    return -10 * torch.log10(error)


def ssim_wskp(output: Tensor, reference: Tensor, data_range: float = 2.0) -> Tensor:
    """Structural similarity as in WSKP's tables: gamma images, uniform 7x7 window, sample covariance.

    Mean over RGB and over the windows that lie inside the image (Wang et al. 2004, eq. 13). The data range
    is 2 because the authors' version of scikit-image assumed -1..1 for floats; that raises the value, so
    `ssim_wskp_range1` is reported beside it.

    Raises:
        ValueError: The image is smaller than the window.
    """
    size = 7
    _check_window(output, size)
    x, y = gamma(output).double(), gamma(reference).double()
    unbiased = size * size / (size * size - 1)

    def mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, size, stride=1)

    mx, my = mean(x), mean(y)
    vx = unbiased * (mean(x * x) - mx * mx)
    vy = unbiased * (mean(y * y) - my * my)
    vxy = unbiased * (mean(x * y) - mx * my)
    return _similarity(mx, my, vx, vy, vxy, data_range)


def ssim_wskp_range1(output: Tensor, reference: Tensor) -> Tensor:
    """WSKP's structural similarity with the true data range of its images, 1."""
    return ssim_wskp(output, reference, data_range=1.0)


def relmse_layer(output: Tensor, reference: Tensor) -> Tensor:
    """Relative mean squared error of the layer paper and SBMC, `mean (o - r)^2 / (r^2 + 1e-4)`."""
    output, reference = output.float(), reference.float()
    return (torch.square(output - reference) / (torch.square(reference) + 1e-4)).flatten(1).mean(1)


def smape_wskp(output: Tensor, reference: Tensor) -> Tensor:
    """WSKP's loss as a metric, `mean |o - r| / (|o| + |r| + 0.01)`, between 0 and 1."""
    output, reference = output.float(), reference.float()
    scale = output.abs() + reference.abs() + 0.01
    return ((output - reference).abs() / scale).flatten(1).mean(1)


def rel_mse_half_afgsa(output: Tensor, reference: Tensor, eps: float = 0.01) -> Tensor:
    """What AFGSA and ACFM print as "RMSE": `0.5 mean (o - r)^2 / (r^2 + eps)`, on linear radiance.

    Neither the half nor eps is in the papers; both are in the authors' code. Tables show it times 1000.
    """
    output, reference = output.float(), reference.float()
    relative = torch.square(output - reference) / (torch.square(reference) + eps)
    return 0.5 * relative.flatten(1).mean(1)


def levels(radiance: Tensor, exponent: float = 2.2, peak: int = 255) -> Tensor:
    """Return the 8-bit image that AFGSA evaluates: `clamp(x^(1/2.2), 0, 1) * 255`, truncated, float64."""
    display = radiance.double().clamp_min(0).pow(1 / exponent).clamp_max(1)
    return torch.floor(display * peak)


def psnr_afgsa(output: Tensor, reference: Tensor, exponent: float = 2.2, equal: float = 0.0) -> Tensor:
    """Peak signal-to-noise ratio in dB as in AFGSA and ACFM: `20 log10(255 / RMSE)` of 8-bit images.

    Args:
        output: Exposed radiance.
        reference: What it should be.
        exponent: Of the transfer to display values; these are truncated to whole levels, not rounded.
        equal: What equal images have; the authors' code returns 0 where the ratio is infinite.
    """
    error = torch.square(levels(output, exponent) - levels(reference, exponent)).flatten(1).mean(1)
    ratio = 20 * torch.log10(255 / error.sqrt())
    return torch.where(error == 0, torch.full_like(ratio, equal), ratio).float()


def ssim_afgsa(
    output: Tensor,
    reference: Tensor,
    exponent: float = 2.2,
    size: int = 11,
    sigma: float = 1.5,
    data_range: float = 255.0,
) -> Tensor:
    """Structural similarity as in AFGSA and ACFM: their 8-bit images, Gaussian window, biased variances.

    Mean over RGB and over the windows that lie inside the image (Wang et al. 2004, eq. 13). The papers print
    1 - SSIM.

    Args:
        output: Exposed radiance.
        reference: What it should be.
        exponent: Of the transfer to display values.
        size: Side of the window.
        sigma: Standard deviation of the window in pixels.
        data_range: Largest difference of two display values.

    Raises:
        ValueError: The image is smaller than the window.
    """
    _check_window(output, size)
    return _gaussian_similarity(
        levels(output, exponent), levels(reference, exponent), size, sigma, data_range
    )


def compressed(radiance: Tensor) -> Tensor:
    """Return the display values in [0, 1] on which the layer paper evaluates: sRGB(log(1 + x)), float64.

    Equations 7 and 8 of Munkberg and Hasselgren 2020; white is radiance 1.72.
    """
    return srgb_log(radiance.double()).clamp(0, 1)


def psnr_layer(output: Tensor, reference: Tensor) -> Tensor:
    """Signal-to-noise ratio in dB as in the layer paper: `compressed` images, peak 1; inf where equal."""
    error = torch.square(compressed(output) - compressed(reference)).flatten(1).mean(1)
    return (-10 * torch.log10(error)).float()


def ssim_layer(output: Tensor, reference: Tensor, size: int = 11, sigma: float = 1.5) -> Tensor:
    """Structural similarity on the layer paper's tone-mapped images, range 1.

    The paper does not give window or range: these are of Wang et al. 2004, a Gaussian with biased variances.

    Args:
        output: Exposed radiance.
        reference: What it should be.
        size: Side of the window.
        sigma: Standard deviation of the window in pixels.

    Raises:
        ValueError: The image is smaller than the window.
    """
    _check_window(output, size)
    return _gaussian_similarity(compressed(output), compressed(reference), size, sigma, 1.0)


def _gaussian_similarity(x: Tensor, y: Tensor, size: int, sigma: float, data_range: float) -> Tensor:
    """Return the mean similarity per image under a Gaussian window, with biased variances."""
    offsets = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    weights = torch.exp(-torch.square(offsets) / (2 * sigma * sigma))
    weights = weights / weights.sum()
    maps = torch.stack([x, y, x * x, y * y, x * y])
    mx, my, mxx, myy, mxy = _weighted(_weighted(maps, weights.tolist(), -1), weights.tolist(), -2)
    return _similarity(mx, my, mxx - mx * mx, myy - my * my, mxy - mx * my, data_range)


def _weighted(maps: Tensor, weights: list[float], axis: int) -> Tensor:
    """Return weighted sums of successive rows or columns; no convolution, which autocast would round."""
    length = maps.shape[axis] - len(weights) + 1
    total = maps.narrow(axis, 0, length) * weights[0]
    for place, weight in enumerate(weights[1:], 1):
        total.add_(maps.narrow(axis, place, length), alpha=weight)
    return total


def _check_window(image: Tensor, size: int) -> None:
    if min(image.shape[-2:]) < size:
        raise ValueError(f"SSIM needs at least {size}x{size} pixels, got {tuple(image.shape[-2:])}")


def _similarity(mx: Tensor, my: Tensor, vx: Tensor, vy: Tensor, vxy: Tensor, data_range: float) -> Tensor:
    """Return the mean similarity per image from windows' means, variances and covariance."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    similarity = ((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return similarity.flatten(1).mean(1).float()
