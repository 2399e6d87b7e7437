"""Losses on linear radiance. Each computes in float32 whatever the precision of its inputs.

The training modules call a loss with exposed radiance (radiance times the frame's exposure), so the
constants below mean the same in every scene.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
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


class Recurrent(nn.Module):
    """The loss of the recurrent autoencoder: images, their edges and their changes, late frames most.

    Of sequences of T frames, with L the Laplacian of a Gaussian and D the difference from the frame before:

        sum_t w_t (spatial |o - t| + edges |L o - L t|) / sum_t w_t
        + changes sum_(t > 0) w_t |D o - D t| / sum_(t > 0) w_t,   w_t = exp(-(T - 1 - t)^2 / 8)

    Chaitanya et al. 2017, section 4.3 (doi:10.1145/3072959.3073601). The weights are those that the paper
    lists for seven frames, 0.011 to 1; dividing by their sum is ours. The filter is that of others'
    implementations, 9x9 with sigma 1.5, which the paper does not give; each channel is filtered by itself.

    Args:
        spatial: Weight of the images.
        edges: Weight of the edges.
        changes: Weight of the changes.
        size: Odd, rows and columns of the filter.
        sigma: Of the Gaussian, in pixels.

    Raises:
        ValueError: A weight is negative, `size` even, or `sigma` not positive.
    """

    kernel: Tensor

    def __init__(
        self,
        spatial: float = 0.8,
        edges: float = 0.1,
        changes: float = 0.1,
        size: int = 9,
        sigma: float = 1.5,
    ) -> None:
        super().__init__()
        if min(spatial, edges, changes) < 0 or size < 1 or size % 2 == 0 or not sigma > 0:
            raise ValueError(
                f"weights {spatial}, {edges}, {changes}, size {size}, sigma {sigma}: expected weights of at "
                "least 0, an odd size, a positive sigma"
            )
        self.spatial, self.edges, self.changes = spatial, edges, changes
        self.register_buffer("kernel", laplacian_of_gaussian(size, sigma), persistent=False)

    def forward(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the loss of sequences (B, T, C, H, W)."""
        difference = output.float() - target.float()
        count = difference.shape[1]
        back = torch.arange(count - 1, -1, -1, device=difference.device)
        weights = torch.exp(-(back.float() ** 2) / 8)
        each = self.spatial * _per_frame(difference) + self.edges * _per_frame(self._edges(difference))
        loss = (weights * each).sum() / weights.sum()
        if count > 1:
            moved = _per_frame(difference[:, 1:] - difference[:, :-1])
            loss = loss + self.changes * (weights[1:] * moved).sum() / weights[1:].sum()
        return loss

    def _edges(self, images: Tensor) -> Tensor:
        """Return the Laplacian of the Gaussian; beyond the border pixels repeat, so flat images give 0."""
        flat = images.flatten(0, 2)[:, None]
        reach = self.kernel.shape[-1] // 2
        padded = F.pad(flat, (reach,) * 4, mode="replicate")
        with torch.autocast(images.device.type, enabled=False):
            return F.conv2d(padded, self.kernel[None, None]).reshape(images.shape)


def laplacian_of_gaussian(size: int, sigma: float) -> Tensor:
    """Return the filter (size, size), float32, whose sum is 0.

    The Laplacian of exp(-r^2 / (2 sigma^2)) divided by the sum of the Gaussian, less its mean.
    """
    place = torch.arange(size, dtype=torch.float64) - size // 2
    squared = place[:, None] ** 2 + place[None, :] ** 2
    gauss = torch.exp(-squared / (2 * sigma**2))
    kernel = gauss / gauss.sum() * (squared - 2 * sigma**2) / sigma**4
    return (kernel - kernel.mean()).float()


def _per_frame(difference: Tensor) -> Tensor:
    """Return the mean absolute value of each frame, (T,)."""
    return difference.abs().mean((0, 2, 3, 4))
