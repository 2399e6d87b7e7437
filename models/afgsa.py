"""AFGSA: self-attention guided by auxiliary features, a quality-first network for still images.

Jiaqi Yu, Yongwei Nie, Chengjiang Long, Wenju Xu, Qing Zhang, Guiqing Li: "Monte Carlo Denoising via Auxiliary
Feature Guided Self-Attention", ACM Transactions on Graphics 40(6), 2021, doi:10.1145/3478513.3480565.

Two extractors turn log(1 + colour) and the auxiliary buffers into features; transformer blocks attend from
every pixel to its surroundings by colour and auxiliary features together, but average colour features only;
a decoder predicts what is added to the log colour. 9,282,691 parameters, trained with L1 in log space and an
adversarial loss (`models.critic`).

Paper and authors' code differ; the code is followed, since its weights are the published ones:
- queries and keys: from [x; aux] directly in the paper; in the code through a shared 1x1 convolution and
  ReLU first;
- attention: one head and no positions in the paper's text, four heads and learned row and column tables,
  added to the keys, in the code;
- pixels outside the image: "padded with zero" in the paper; in the code their keys are positions alone and
  take part in the softmax (`mask_halo=True` leaves them out);
- the auxiliary extractor has a second 1x1 convolution and leaky ReLUs (0.2, but ReLU after its 1x1 branch);
- the last convolution is padded with zeros, all others by reflection.
Not printed anywhere, and chosen here: with one kernel size the extractors keep their 1x1 convolutions;
without auxiliary buffers q, k and v are computed from x as in equation 3, and when they are concatenated all
three from the shared convolution's features; in local attention the tables hold offsets from the query.
Ours: `exposure`, since the authors' Tungsten images are at a displayable level; images that are not made of
whole blocks repeat their last row and column (their script adds zeros, too many or too few of them). The log
output may be negative: radiance is clamped at 0, the training loss sees it as it is.

Published (Table 1; 3192 patches of 14 Tungsten scenes; "RMSE" is half the relative squared error, eps 0.01):
    spp      4        8        16       32       128
    PSNR     32.3770  34.6834  36.7625  38.3812  40.8028
    1-SSIM   0.1023   0.0713   0.0521   0.0410   0.0286
    RMSE     9.979e-3 4.855e-3 2.766e-3 1.839e-3 1.051e-3
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from data.buffers import buffer
from models.blocks.guided_transformer import Guidance, TransformerBlock
from models.blocks.reflect_conv import ReflectConv
from models.denoiser import Buffers, Denoised, Denoiser, Pair, select
from models.ops.boxes import exporting
from models.ops.guides import depth_range, finite, relative_depth, unit_normal
from models.ops.memory_format import innermost
from models.ops.padding import padded
from models.ops.reflect_conv import pointwise
from models.ops.tonemap import exposed, radiance_of
from models.ops.windows import Windows

AUXILIARY = ("normal", "depth", "albedo")
"""Auxiliary buffers in the order of the network's channels."""


class AFGSA(Denoiser):
    """Auxiliary-feature-guided self-attention network of Yu et al. 2021.

    Args:
        width: Channels of all features.
        blocks: Transformer blocks; the paper compares 4, 5 and 6.
        heads: Attention heads.
        kernel_sizes: Odd sizes of the extractors' parallel convolutions.
        guidance: How auxiliary features enter: `attention` (queries and keys, the paper's method),
            `concatenate` (queries, keys and values), `none` (not at all; no auxiliary buffer is read).
        auxiliary: Which of `normal`, `depth` and `albedo` are read.
        attention: `block` (blocks of pixels share a window) or `local` (each pixel has its own).
        block: Side of the blocks of block attention; the paper has (block, halo) = (8, 3) and (16, 5).
        halo: Pixels around a block that its pixels attend to; not larger than needed in the paper.
        window: Odd side of the window of local attention; the paper has 7 and 9.
        mask_halo: Pixels outside the image take no part in the attention.
        checkpointed: Number of transformer blocks that keep only their input in training and compute the
            rest again in the backward pass; if there are any, so do the extractors.

    Raises:
        ValueError: An argument is out of range, or arguments do not fit together.
    """

    def __init__(
        self,
        width: int = 256,
        blocks: int = 5,
        heads: int = 4,
        kernel_sizes: Sequence[int] = (1, 3, 5),
        guidance: Guidance = "attention",
        auxiliary: Sequence[str] = AUXILIARY,
        attention: Literal["block", "local"] = "block",
        block: int = 8,
        halo: int = 3,
        window: int = 7,
        mask_halo: bool = False,
        checkpointed: int = 0,
    ) -> None:
        super().__init__()
        _check(width, blocks, heads, kernel_sizes, checkpointed)
        self.auxiliary = _auxiliary(guidance, auxiliary)
        windows = _windows(heads, attention, (block, halo), window, mask_halo)
        self.inputs: tuple[str, ...] = ("color", *self.auxiliary)
        self.frame_numbers: tuple[str, ...] = (
            ("exposure", "depth_range") if "depth" in self.auxiliary else ("exposure",)
        )
        self.multiple = windows.own[0]
        self.halo = _reach(windows, blocks, kernel_sizes)
        # Resident memory of the published width grows by 7500 at 320x320, and by 10500 at 128x128.
        self.bytes_per_pixel = 800 + 32 * width
        self.checkpointed = checkpointed
        self.color_features = Extractor(3, width, kernel_sizes)
        channels = sum(buffer(name).channels for name in self.auxiliary)
        self.auxiliary_features = AuxiliaryExtractor(channels, width, kernel_sizes) if channels else None
        self.blocks = nn.ModuleList(TransformerBlock(width, windows, guidance) for _ in range(blocks))
        self.decoder = nn.Sequential(ReflectConv(width, width, 3), ReflectConv(width, width, 3))
        self.residual = nn.Conv2d(width, 3, 3, padding=1)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color` (B, 3, H, W) linear radiance, and of `normal` (B, 3, H, W) in world space,
                `depth` (B, 1, H, W) in scene units and `albedo` (B, 3, H, W) those that `inputs` names;
                optionally `exposure` (B,) and `depth_range` (B, 2).
        """
        return Denoised(radiance_of(self.predict(buffers)) / self.exposure(buffers))

    def predict(self, buffers: Buffers) -> Tensor:
        """Return log(1 + exposed radiance) as the network predicts it, (B, 3, H, W), possibly negative.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        _, height, width = self.check(buffers)
        noisy, aux = self._features(buffers)
        x, a = self._extract(noisy, aux)
        for index, block in enumerate(self.blocks):
            x = self._run(block, index < self.checkpointed, x, a)
        return (noisy + self._decode(x))[..., :height, :width].contiguous()

    @torch.no_grad()
    def attention(self, buffers: Buffers, row: int, column: int) -> Tensor:
        """Return where every transformer block looks for one pixel (figure 10 of the paper).

        Args:
            buffers: The inputs of one image, (1, C, H, W).
            row: Row of the query pixel, from 0 at the top.
            column: Column of the query pixel, from 0 at the left.

        Returns:
            (blocks, heads, H, W): weights, 0 outside the window. Their sum is 1 less what pixels outside the
            image take, which is nothing with `mask_halo` or where the window lies inside the image.

        Raises:
            ValueError: The pixel lies outside the image, or there are several images.
        """
        batch, height, width = self.check(buffers)
        if batch != 1:
            raise ValueError(f"attention maps are made for one image, got a batch of {batch}")
        if not (0 <= row < height and 0 <= column < width):
            raise ValueError(
                f"the query pixel (row {row}, column {column}) lies outside the image; expected rows "
                f"0 to {height - 1} and columns 0 to {width - 1}"
            )
        x, a = self._extract(*self._features(buffers))
        maps = []
        for module in self.blocks:
            block = cast(TransformerBlock, module)
            maps.append(block.attention.weights(x, a, (row, column)))
            x = block(x, a)
        return torch.cat(maps)[..., :height, :width]

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return log(1 + exposed radiance) of output and reference, as the paper compares them."""
        reference = torch.log1p(exposed(batch["reference"].float(), self.exposure(batch).float()))
        return {"color": Pair(self.predict(select(self, batch)).float(), reference)}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2), smallest and largest depth of whole frames, where depth is read."""
        if "depth" not in self.auxiliary:
            return {}
        return {"depth_range": depth_range(buffers["depth"])}

    def _features(self, buffers: Buffers) -> tuple[Tensor, Tensor | None]:
        """Return log colour (B, 3, h, w) and auxiliary channels, padded to the grid of blocks."""
        noisy = torch.log1p(exposed(buffers["color"], self.exposure(buffers)))
        channels = []
        for name in self.auxiliary:
            if name == "normal":
                channels.append(unit_normal(buffers[name]))
            elif name == "depth":
                channels.append(relative_depth(buffers[name], buffers.get("depth_range")))
            else:
                channels.append(finite(buffers[name]))
        aux = torch.cat(channels, 1) if channels else None
        return self._padded(noisy), None if aux is None else self._padded(aux)

    def _padded(self, images: Tensor) -> Tensor:
        images = padded(images, self.multiple)
        return innermost(images)

    def _extract(self, noisy: Tensor, aux: Tensor | None) -> tuple[Tensor, Tensor | None]:
        recomputed = self.checkpointed > 0
        x = self._run(self.color_features, recomputed, noisy)
        if self.auxiliary_features is None or aux is None:
            return x, None
        return x, self._run(self.auxiliary_features, recomputed, aux)

    def _run(self, module: nn.Module, recomputed: bool, *tensors: Tensor | None) -> Tensor:
        """Call a module, in training optionally without keeping what it computes in between."""
        if recomputed and torch.is_grad_enabled() and not exporting():
            return cast(Tensor, checkpoint(module, *tensors, use_reentrant=False))
        return cast(Tensor, module(*tensors))

    def _decode(self, x: Tensor) -> Tensor:
        """Return what is added to the log colour, in float32 or wider."""
        x = self.decoder(x)
        with torch.autocast(x.device.type, enabled=False):
            # Rounding of this sum to bfloat16 would be seen.
            return cast(Tensor, self.residual(x.to(self.residual.weight.dtype)))


class Extractor(nn.Module):
    """Parallel convolutions of several sizes, merged by a 1x1 convolution; section 3.2.1 of the paper."""

    slope = 0.0

    def __init__(self, inputs: int, width: int, kernel_sizes: Sequence[int]) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            ReflectConv(inputs, width, size, 0.0 if size == 1 else self.slope) for size in kernel_sizes
        )
        self.fusion = nn.Conv2d(len(self.branches) * width, width, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Return features (B, width, H, W) of images (B, inputs, H, W)."""
        parts = [branch(images) for branch in self.branches]
        return F.leaky_relu_(pointwise(parts, self.fusion.weight, self.fusion.bias), self.slope)


class AuxiliaryExtractor(Extractor):
    """The same with a second 1x1 convolution, and leaky ReLUs except after the 1x1 branch."""

    slope = 0.2

    def __init__(self, inputs: int, width: int, kernel_sizes: Sequence[int]) -> None:
        super().__init__(inputs, width, kernel_sizes)
        self.second = nn.Conv2d(width, width, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Return features (B, width, H, W) of images (B, inputs, H, W)."""
        merged = super().forward(images)
        return F.leaky_relu_(pointwise([merged], self.second.weight, self.second.bias), self.slope)


def _check(width: int, blocks: int, heads: int, kernel_sizes: Sequence[int], checkpointed: int) -> None:
    if blocks < 1 or heads < 1 or width < 1 or width % (2 * heads):
        raise ValueError(
            "AFGSA needs at least one block and one head, and a width that divides by twice the heads; got "
            f"width {width}, blocks {blocks}, heads {heads}"
        )
    if not kernel_sizes or any(size < 1 or size % 2 == 0 for size in kernel_sizes):
        raise ValueError(f"kernel_sizes must be odd and positive, got {tuple(kernel_sizes)}")
    if len(set(kernel_sizes)) != len(kernel_sizes):
        raise ValueError(f"kernel_sizes must differ from each other, got {tuple(kernel_sizes)}")
    if not 0 <= checkpointed <= blocks:
        raise ValueError(f"checkpointed must be 0 to {blocks}, the number of blocks; got {checkpointed}")


def _auxiliary(guidance: str, names: Sequence[str]) -> tuple[str, ...]:
    if guidance not in ("attention", "concatenate", "none"):
        raise ValueError(f"guidance must be attention, concatenate or none, got {guidance!r}")
    if guidance == "none":
        return ()
    if not names or not set(names) <= set(AUXILIARY):
        raise ValueError(
            f"auxiliary must name some of {', '.join(AUXILIARY)}, got {', '.join(names) or 'nothing'}; "
            "guidance: none reads no auxiliary buffers"
        )
    return tuple(name for name in AUXILIARY if name in names)


def _windows(heads: int, attention: str, block: tuple[int, int], window: int, mask_halo: bool) -> Windows:
    if attention == "local":
        if window < 1 or window % 2 == 0:
            raise ValueError(f"window must be odd and positive, got {window}")
        return Windows(heads, halo=window // 2, local=True, mask_halo=mask_halo)
    if attention != "block":
        raise ValueError(f"attention must be block or local, got {attention!r}")
    if block[0] < 1 or block[1] < 0:
        raise ValueError(f"block must be positive and halo not negative, got {block[0]} and {block[1]}")
    return Windows(heads, *block, mask_halo=mask_halo)


def _reach(windows: Windows, blocks: int, kernel_sizes: Sequence[int]) -> int:
    """Return how many pixels around a core on the grid of blocks the output there depends on.

    Backwards: three convolutions of the decoder; per transformer block two convolutions, then all blocks of
    pixels that this touches, and their halo; the extractors' largest kernel.
    """
    reach, grid = 3, windows.own[0]
    for _ in range(blocks):
        reach = -(-(reach + 2) // grid) * grid + windows.halo
    return reach + max(kernel_sizes) // 2
