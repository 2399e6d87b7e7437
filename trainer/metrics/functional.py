"""Image metrics, one function per definition in use; the name says whose definition it is.

Every function takes linear radiance (B, 3, H, W), already multiplied by the exposure at which it is to be
judged, and returns one float32 number per image (B,). The transfer "gamma" of WSKP, NBGD and MR-KP is
`clamp(max(x, 0) ** 0.454545, 0, 1)`; AFGSA and ACFM evaluate 8-bit images (`levels`); the layer paper
`clamp(sRGB(log(1 + x)), 0, 1)` (`compressed`).

Whose a metric is: wskp, Fan et al. 2021; nbgd, Meng et al. 2020 (and the multi-resolution variant that came
with it); afgsa, Yu et al. 2021 and Xu et al. 2019; layer, Munkberg and Hasselgren 2020; sbmc, Gharbi et al.
2019.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.tonemap import srgb_log
from trainer.metrics.sharing import kept
from trainer.metrics.similarity import gaussian_means, gaussian_similarity, uniform_similarity

GAMMA = 0.454545


_SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM, the finest scale first."""

SBMC_BORDER = 21
"""Pixels on every side that SBMC's evaluation leaves out: what its network cannot see whole."""


@kept
def gamma(radiance: Tensor) -> Tensor:
    """Return the display values in [0, 1] on which WSKP evaluates."""
    return radiance.float().clamp_min(0).pow(GAMMA).clamp_max(1)


@kept
def gamma_8bit(radiance: Tensor) -> Tensor:
    """Return the display values on which NBGD evaluates: WSKP's, stored in 8 bits and read again, float64."""
    display = radiance.double().clamp_min(0).pow(GAMMA).clamp_max(1)
    return torch.floor(display * 255 + 0.5) / 255


def psnr_wskp(output: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB on gamma images, peak 1, mean over RGB; infinite where equal."""
    error = torch.square(gamma(output) - gamma(reference)).flatten(1).mean(1)
    return -10 * torch.log10(error)


def ssim_wskp(output: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity as in WSKP's tables: gamma images, uniform 7x7 window, sample covariance.

    Mean over RGB and over the windows that lie inside the image (Wang et al. 2004, eq. 13). The data range
    is 2 because the authors' version of scikit-image assumed -1..1 for floats; that raises the value, so
    `ssim_wskp_range1` is reported beside it.

    Raises:
        ValueError: The image is smaller than the window.
    """
    return _ssim_wskp(output, reference)[0]


def ssim_wskp_range1(output: Tensor, reference: Tensor) -> Tensor:
    """WSKP's structural similarity with the true data range of its images, 1."""
    return _ssim_wskp(output, reference)[1]


@kept
def _ssim_wskp(output: Tensor, reference: Tensor) -> list[Tensor]:
    """Return both, which differ in the constants only."""
    return uniform_similarity(gamma(output).double(), gamma(reference).double(), (2.0, 1.0))


def ms_ssim_gamma(output: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity over five scales of `gamma` images, range 1 (Wang et al. 2003).

    The window is Gaussian, 11x11, of 1.5 pixels; only windows inside the image count; scales are halved by
    means of 2x2 pixels. Weights and order as in the paper; negative means count as 0.

    Raises:
        ValueError: The image has less than 176 rows or columns: its last scale is smaller than the window.
    """
    smallest = 11 * 2 ** (len(_SCALES) - 1)
    if min(output.shape[-2:]) < smallest:
        raise ValueError(
            f"MS-SSIM needs at least {smallest}x{smallest} pixels, got {tuple(output.shape[-2:])}"
        )
    x, y = gamma(output).double(), gamma(reference).double()
    total = torch.ones(len(x), dtype=torch.float64, device=x.device)
    for scale, weight in enumerate(_SCALES):
        whole, structure = gaussian_means(x, y, 11, 1.5, 1.0)
        last = scale == len(_SCALES) - 1
        total = total * (whole if last else structure).clamp_min(0).pow(weight)
        if not last:
            x, y = F.avg_pool2d(x, 2), F.avg_pool2d(y, 2)
    return total.float()


def psnr_nbgd(output: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB as in NBGD: `gamma_8bit` images, peak 1; infinite where equal."""
    error = torch.square(gamma_8bit(output) - gamma_8bit(reference)).flatten(1).mean(1)
    return (-10 * torch.log10(error)).float()


def ssim_nbgd(output: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity as in NBGD: `ssim_wskp`, with its data range of 2, of `gamma_8bit` images.

    Raises:
        ValueError: The image is smaller than the window.
    """
    return uniform_similarity(gamma_8bit(output), gamma_8bit(reference), (2.0,))[0]


def rmse_nbgd(output: Tensor, reference: Tensor) -> Tensor:
    """Root of the mean squared difference of `gamma_8bit` images."""
    error = torch.square(gamma_8bit(output) - gamma_8bit(reference)).flatten(1).mean(1)
    return error.sqrt().float()


def smape_percent_nbgd(output: Tensor, reference: Tensor) -> Tensor:
    """NBGD's `100 mean 2 |o - r| / (|o| + |r| + 1e-7)` of `gamma_8bit` images, between 0 and 200.

    Twice WSKP's scale, in percent, and of display values where WSKP's is of radiance.
    """
    x, y = gamma_8bit(output), gamma_8bit(reference)
    return (200 * (x - y).abs() / (x.abs() + y.abs() + 1e-7)).flatten(1).mean(1).float()


def relmse_nbgd(output: Tensor, reference: Tensor) -> Tensor:
    """NBGD's `mean (o - r)^2 / (r^2 + 1e-7)` of `gamma_8bit` images; black pixels dominate it."""
    x, y = gamma_8bit(output), gamma_8bit(reference)
    return (torch.square(x - y) / (torch.square(y) + 1e-7)).flatten(1).mean(1).float()


def relmse_sbmc(output: Tensor, reference: Tensor) -> Tensor:
    """SBMC's `mean (o - r)^2 / (r^2 + 1e-4)` without a border of 21 pixels.

    Raises:
        ValueError: Nothing is left of the image.
    """
    border = SBMC_BORDER
    if min(output.shape[-2:]) <= 2 * border:
        raise ValueError(
            f"relmse_sbmc leaves out {border} pixels on every side of {tuple(output.shape[-2:])}"
        )
    inner = (..., slice(border, -border), slice(border, -border))
    return relmse_layer(output[inner], reference[inner])


def relmse_rousselle(output: Tensor, reference: Tensor, eps: float = 0.01) -> Tensor:
    """Relative mean squared error `mean (o - r)^2 / (r^2 + 0.01)` of Rousselle et al. 2011 and after them."""
    output, reference = output.float(), reference.float()
    return (torch.square(output - reference) / (torch.square(reference) + eps)).flatten(1).mean(1)


def relmse_tungsten(output: Tensor, reference: Tensor) -> Tensor:
    """Relative mean squared error `mean (o - r)^2 / (r^2 + 0.001)`, of the program that NFOR came with."""
    return relmse_rousselle(output, reference, eps=1e-3)


def relmse_layer(output: Tensor, reference: Tensor) -> Tensor:
    """Relative mean squared error of the layer paper and SBMC, `mean (o - r)^2 / (r^2 + 1e-4)`."""
    return relmse_rousselle(output, reference, eps=1e-4)


def smape_wskp(output: Tensor, reference: Tensor) -> Tensor:
    """WSKP's loss as a metric, `mean |o - r| / (|o| + |r| + 0.01)`, between 0 and 1."""
    output, reference = output.float(), reference.float()
    scale = output.abs() + reference.abs() + 0.01
    return ((output - reference).abs() / scale).flatten(1).mean(1)


def rel_mse_half_afgsa(output: Tensor, reference: Tensor, eps: float = 0.01) -> Tensor:
    """What AFGSA and ACFM print as "RMSE": `0.5 mean (o - r)^2 / (r^2 + eps)`, on linear radiance.

    Neither the half nor eps is in the papers; both are in the authors' code. Tables show it times 1000.
    """
    return 0.5 * relmse_rousselle(output, reference, eps)


@kept
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
    return gaussian_similarity(levels(output, exponent), levels(reference, exponent), size, sigma, data_range)


@kept
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
    return gaussian_similarity(compressed(output), compressed(reference), size, sigma, 1.0)
