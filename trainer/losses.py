"""Losses on linear radiance. Each computes in float32 whatever the precision of its inputs.

The training modules call a loss with exposed radiance (radiance times the frame's exposure), so the
constants below mean the same in every scene.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from models.ops.tonemap import srgb_log


class SMAPE(nn.Module):
    """Symmetric mean absolute percentage error, `mean |o - t| / (|o| + |t| + epsilon)`.

    The form of WSKP (Fan et al. 2021), the layer paper and OIDN: the gradient flows through the
    denominator. Range 0 to 1.

    Args:
        epsilon: Keeps black pixels finite.
    """

    def __init__(self, epsilon: float = 0.01) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean over all elements of (B, 3, H, W)."""
        output, target = output.float(), target.float()
        return ((output - target).abs() / (output.abs() + target.abs() + self.epsilon)).mean()


class L1(nn.Module):
    """Mean absolute error."""

    def forward(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean over all elements of (B, 3, H, W)."""
        return (output.float() - target.float()).abs().mean()


class RelativeL2(nn.Module):
    """Relative squared error, `factor * mean (o - t)^2 / (t^2 + epsilon)`; Rousselle et al. 2011.

    Args:
        epsilon: Keeps black pixels finite.
        symmetric: Divide by the square of the (detached) output instead of the target's, as
            Lehtinen et al. 2018 do, which keeps fireflies in a noisy target from dominating.
        factor: 1, or 0.5 as in SBMC (Gharbi et al. 2019), AFGSA and ACFM.
    """

    def __init__(self, epsilon: float = 0.01, symmetric: bool = False, factor: float = 1.0) -> None:
        super().__init__()
        self.epsilon = epsilon
        self.symmetric = symmetric
        self.factor = factor

    def forward(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean over all elements of (B, 3, H, W)."""
        output, target = output.float(), target.float()
        scale = output.detach() if self.symmetric else target
        return self.factor * (torch.square(output - target) / (torch.square(scale) + self.epsilon)).mean()


class TonemappedL2(nn.Module):
    """Mean squared difference of sRGB(log(1 + x)), of Munkberg and Hasselgren 2020, section 4.

    Radiance is clipped to [0, 65536]; the authors' lower bound of 1e-5, for what networks see, would leave
    black output without a gradient.
    """

    def forward(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean over all elements of (B, 3, H, W)."""
        return (srgb_log(output.float(), 0.0) - srgb_log(target.float(), 0.0)).square().mean()
