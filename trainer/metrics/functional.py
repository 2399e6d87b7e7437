"""Image metrics, one function per definition in use; the name says whose definition it is.

Every function takes linear radiance (B, 3, H, W), already multiplied by the exposure at which it is to be
judged, and returns one float32 number per image (B,). The transfer "gamma" of WSKP, NBGD and MR-KP is
`clamp(max(x, 0) ** 0.454545, 0, 1)`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

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
    if min(output.shape[-2:]) < size:
        raise ValueError(f"SSIM needs at least {size}x{size} pixels, got {tuple(output.shape[-2:])}")
    x, y = gamma(output).double(), gamma(reference).double()
    unbiased = size * size / (size * size - 1)

    def mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, size, stride=1)

    mx, my = mean(x), mean(y)
    vx = unbiased * (mean(x * x) - mx * mx)
    vy = unbiased * (mean(y * y) - my * my)
    vxy = unbiased * (mean(x * y) - mx * my)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    similarity = ((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return similarity.flatten(1).mean(1).float()


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
