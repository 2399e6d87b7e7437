"""What a network with shared weights does inside, kernel by kernel, as images to look at.

For each kernel k: the image R_k that it makes alone (`models.ops.sharing`), its fusion weight and its
log-importance. The sum over k of weight times image is the fused image. Figure 8 of Fan et al. 2021
(doi:10.1111/cgf.14338) shows images and weights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from models.ops.precision import wide
from models.ops.sharing import reconstruct

PARTS = ("filtered", "weight", "importance")
"""What is shown of each kernel, `<kernel>_<part>`."""

VIEWS_BYTES = 32
"""Working memory of the views of one kernel per pixel: five numbers that are kept, and three on their way."""


def kernel_names(sizes: Sequence[int]) -> list[str]:
    """Return a name for each kernel: `kernel03`, `kernel13`; those of one size are numbered, `kernel13_2`."""
    several = {size for size, count in Counter(sizes).items() if count > 1}
    names, seen = [], Counter[int]()
    for size in sizes:
        seen[size] += 1
        names.append(f"kernel{size:02d}" + (f"_{seen[size]}" if size in several else ""))
    return names


def kernel_views(
    irradiance: Tensor, log_importance: Tensor, fusion_logits: Tensor, sizes: Sequence[int]
) -> dict[str, Tensor]:
    """Return `<kernel>_filtered`, `<kernel>_weight` and `<kernel>_importance` of each kernel.

    Args:
        irradiance: (B, 3, H, W), linear.
        log_importance: (B, K, H, W), one map per kernel.
        fusion_logits: (B, K, H, W), softmax over K gives the fusion weights.
        sizes: K odd window sizes.

    Returns:
        Filtered irradiance (B, 3, H, W), without albedo; weights (B, 1, H, W) in 0 … 1, with sum 1 over
        kernels; log-importance (B, 1, H, W). In float32 or wider.

    Raises:
        ValueError: As `models.ops.sharing.reconstruct`.
    """
    weights = torch.softmax(wide(fusion_logits), 1)
    views: dict[str, Tensor] = {}
    for index, (name, size) in enumerate(zip(kernel_names(sizes), sizes, strict=True)):
        one = slice(index, index + 1)
        alone = torch.zeros_like(fusion_logits[:, one])  # the softmax over one kernel is 1
        filtered = reconstruct(irradiance, log_importance[:, one], alone, (size,))
        made = (filtered, weights[:, one], wide(log_importance[:, one]))
        views |= {f"{name}_{part}": image for part, image in zip(PARTS, made, strict=True)}
    return views


def full_size(views: dict[str, Tensor], factor: int, albedo: Tensor) -> dict[str, Tensor]:
    """Return views of a coarser resolution in full size, filtered images with albedo.

    Args:
        views: (B, C, h, w) each.
        factor: How often every pixel is repeated in rows and columns.
        albedo: (B, 3, H, W), H and W at most `factor` times h and w; what lies beyond is cut off.
    """
    height, width = albedo.shape[-2:]
    made = {}
    for name, image in views.items():
        large = image if factor == 1 else F.interpolate(image, scale_factor=factor, mode="nearest")
        large = large[..., :height, :width]
        made[name] = large * albedo if name.endswith(PARTS[0]) else large
    return made
