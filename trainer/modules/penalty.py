"""The gradient penalty of WGAN-GP.

Ishaan Gulrajani, Faruk Ahmed, Martin Arjovsky, Vincent Dumoulin, Aaron Courville: "Improved Training of
Wasserstein GANs", Advances in Neural Information Processing Systems 30, 2017, arXiv:1704.00028.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

FLOOR = 1e-12
"""Below the root of the norm, whose derivative at zero would be infinite."""


def mixing(key: Sequence[int], like: Tensor, rank: int = 0) -> Tensor:
    """Return one number in [0, 1) per sample, (B, 1, 1, 1), the same whenever the key is the same.

    Numbers follow from the key, such as seed, epoch and batch, and the sample's place in the batches of all
    ranks put together. So a run that was killed draws the same ones without any state in the checkpoint, and
    one process draws on joint batches what many draw on theirs.

    Args:
        key: Non-negative integers.
        like: Images (B, …), whose device and type the numbers get.
        rank: Which of the batches it is; all have B images.
    """
    start = rank * len(like)
    drawn = np.random.default_rng(list(key)).random(start + len(like), dtype=np.float32)[start:]
    return torch.from_numpy(drawn).to(like).reshape(-1, *[1] * (like.ndim - 1))


def gradient_penalty(critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, mix: Tensor) -> Tensor:
    """Return mean((||grad_x D(x)||_2 - 1)^2) at x = mix * fake + (1 - mix) * real, equation 3 of the paper.

    The norm is over all values of an image. It is computed in float32 at least, and is differentiable with
    respect to the critic's parameters. Where the critic normalises over its batch, the gradient of the sum of
    the scores mixes samples, as in the authors' codes of AFGSA and ACFM.

    Args:
        critic: D, images to one score each.
        real: References (B, 3, H, W).
        fake: What the denoiser made of them; no gradient flows into it.
        mix: (B, 1, 1, 1) from `mixing`.
    """
    with torch.autocast(real.device.type, enabled=False), torch.enable_grad():
        if real.dtype != torch.float64:
            real, fake = real.float(), fake.float()
        between = (mix * fake.detach() + (1 - mix) * real.detach()).requires_grad_()
        (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
        norm = (slope.flatten(1).square().sum(1) + FLOOR).sqrt()
        return (norm - 1).square().mean()
