"""NBGD: the neural bilateral grid denoiser, for one sample per pixel in real time.

Xiaoxu Meng, Quan Zheng, Amitabh Varshney, Gurprit Singh, Matthias Zwicker: "Real-time Monte Carlo Denoising
with the Neural Bilateral Grid", Eurographics Symposium on Rendering, 2020, doi:10.2312/sr.20201133.

A small network predicts three guide images and blend weights from ten feature channels. With each guide the
irradiance is splatted into a bilateral grid, of cells of 4, 8 and 16 pixels and as many of 256 levels, and
read out again (`models.ops.bilateral_grid`); the three results are blended and multiplied by the albedo.

Two layers are for 1 sample per pixel, seven for 64: between the first and the last there are five with dense
connections, each of which adds 5 channels to what all before it made. Where paper and authors' code differ,
or the paper is silent, the code is followed:
- seven layers: a disabled part of the public code; the leaky ReLU runs over old and new channels alike;
- blend weights: two sigmoids, and what both leave of 1 for the coarsest grid, which may be negative. Radiance
  that becomes negative by it is cut off at 0, which loss and tables do not see. `softmax_blend=True`: a
  softmax over both logits and 0, so that all three are positive;
- gradients of the operators that are larger than 100 become 0 (`gradient_limit`);
- at 64 spp: a film's tone curve (`curve="filmic"`), for what the network sees and for the loss, and a filter
  of outliers (`outliers=True`, `models.ops.outliers`), which changes the image's energy; WSKP's tables are
  without it;
- biases start from 0; in the code from the distribution of the weights.

Ours: sizes that are no multiples of 16 are padded by repeating the last row and column; depth is scaled by
the frame's minimum and maximum, which the authors' files hold in 8 bits; `exposure`, as in WSKP; what is no
number counts as 0; the last convolution runs in float32, since in bfloat16 a guide has steps of a level.

Published, by Fan et al. 2021 (doi:10.1111/cgf.14338): two layers on BMFR, average of six held-out scenes,
29.474 dB PSNR, 0.940 SSIM (WSKP 30.323 dB, 0.951), 13.97 ms at 1280x720 on an RTX 2080 Ti; seven layers at
64 spp 35.53 dB on Kitchen and 35.98 dB on Dining room, 50.28 ms.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.denoiser import Buffers, Denoised, Denoiser, Pair, select
from models.ops.bilateral_grid import create_grid, slice_grid
from models.ops.grid_cells import LEVELS, Cells
from models.ops.guides import depth_range, finite
from models.ops.memory_format import innermost
from models.ops.outliers import replace_outliers
from models.ops.padding import padded
from models.ops.precision import wide
from models.ops.ten_channels import FEATURES, ten_channels
from models.ops.tonemap import LARGEST, exposed, filmic, gamma

GRIDS = (Cells(4, 4), Cells(8, 8), Cells(16, 16))
"""Cells of the three grids."""

GROWTH = 5
"""Channels that a dense layer adds."""

SIZE = 5
"""Rows and columns of a convolution."""

SLOPE = 0.2
"""Of the leaky ReLUs."""


class Guides(NamedTuple):
    """What the network predicts, for the grids and for looking at.

    Attributes:
        levels: (B, 3, H, W), from 0 to 255: where pixels lie in the depth of each grid.
        blend: (B, 3, H, W), sum 1: weights of what is read from the grids, the finest first.
    """

    levels: Tensor
    blend: Tensor


class NBGD(Denoiser):
    """Neural bilateral grid denoiser of Meng et al. 2020.

    Args:
        layers: Convolutions; 2 for 1 sample per pixel, 7 for 64. Those between first and last are dense.
        width: Channels of the first convolution.
        curve: Tone curve of what network and loss see: `gamma` or `filmic`.
        softmax_blend: Blend with positive weights.
        outliers: Replace outliers of the irradiance first.
        gradient_limit: Elements of gradients of the grids' operators that are larger become 0; None: none.
        temporal: `irradiance` is expected to be accumulated over the preceding frames.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = ("irradiance", "albedo", "normal", "depth")
    frame_numbers = ("exposure", "depth_range")
    multiple = GRIDS[-1].space
    exported_bytes_per_pixel = 900  # ONNX Runtime takes 820, TorchScript 410 to 490
    rounding_reach = 2 * GRIDS[-1].space  # of a pixel, by way of a cell that both weigh, to another

    def __init__(
        self,
        layers: int = 2,
        width: int = 20,
        curve: Literal["gamma", "filmic"] = "gamma",
        softmax_blend: bool = False,
        outliers: bool = False,
        gradient_limit: float | None = 100.0,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        if layers < 2 or width < 1:
            raise ValueError(f"NBGD needs at least 2 layers and width 1, got {layers} and {width}")
        if curve not in ("gamma", "filmic"):
            raise ValueError(f"curve {curve!r}; expected 'gamma' or 'filmic'")
        if gradient_limit is not None and not gradient_limit > 0:
            raise ValueError(f"gradient_limit must be positive or null, got {gradient_limit}")
        self.curve, self.softmax_blend, self.outliers = curve, softmax_blend, outliers
        self.gradient_limit, self.temporal = gradient_limit, temporal
        # Cells of the coarsest grid reach 24 pixels beyond a core; guides there depend on what is around.
        self.halo = GRIDS[-1].reach + layers * (SIZE // 2) + int(outliers)
        widths = [FEATURES, *(width + GROWTH * index for index in range(layers - 1))]
        outputs = [width, *[GROWTH] * (layers - 2), 2 * len(GRIDS) - 1]
        # Resident memory grows by 360 with two layers and by 500 with seven, at 512x512.
        self.bytes_per_pixel = 160 + 12 * widths[-1]
        self.convolutions = nn.ModuleList(map(_convolution, widths, outputs))

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, `albedo` (B, 3, H, W) that it
                was divided by, `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units;
                optionally `exposure` (B,) and `depth_range` (B, 2).
        """
        _, height, width = self.check(buffers)
        clean = self._clean(buffers)
        guides = self._guides(self._features(clean))
        total: Tensor | None = None
        for index, cells in enumerate(GRIDS):
            guide = guides.levels[:, index : index + 1]
            grid = create_grid(clean["irradiance"], guide, cells, self.gradient_limit)
            part = slice_grid(grid, guide, cells, self.gradient_limit) * guides.blend[:, index : index + 1]
            total = part if total is None else total + part
        assert total is not None
        color = total.clamp_min(0.0) * clean["albedo"]
        return Denoised(color[..., :height, :width].contiguous())

    def predict(self, buffers: Buffers) -> Guides:
        """Return guides and blend weights, from the same buffers as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        _, height, width = self.check(buffers)
        guides = self._guides(self._features(self._clean(buffers)))
        return Guides(*(maps[..., :height, :width] for maps in guides))

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return output and reference after the tone curve, as the authors compare them (with L1)."""
        exposure = self.exposure(batch).float()
        output = self(select(self, batch)).color.float() * exposure
        reference = exposed(batch["reference"].float(), exposure)
        return {"color": Pair(self._toned(output), self._toned(reference))}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_range(buffers["depth"])}

    def _toned(self, radiance: Tensor) -> Tensor:
        return gamma(radiance) if self.curve == "gamma" else filmic(radiance)

    def _clean(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return finite buffers of legal range, padded to the coarsest grid, and the numbers of the frame."""
        given = buffers.get("depth_range")
        clean = {
            "irradiance": torch.nan_to_num(wide(buffers["irradiance"]), 0.0).clamp(0.0, LARGEST),
            "albedo": finite(buffers["albedo"], 1.0).clamp_min(0.0),
            "normal": finite(buffers["normal"]).clamp(-1.0, 1.0),
            "depth": finite(buffers["depth"]).clamp_min(0.0),
        }
        clean = {name: padded(image, self.multiple) for name, image in clean.items()}
        exposure = wide(self.exposure(buffers))
        if self.outliers:
            clean["irradiance"] = replace_outliers(
                clean["irradiance"], clean["albedo"], clean["normal"], exposure
            )
        bounds = depth_range(buffers["depth"]) if given is None else wide(given)
        return {**clean, "exposure": exposure, "depth_range": bounds}

    def _features(self, clean: Mapping[str, Tensor]) -> Tensor:
        return ten_channels(clean, clean["exposure"], self._toned)

    def _guides(self, maps: Tensor) -> Guides:
        maps = innermost(maps)
        first, *dense, last = (cast(nn.Conv2d, layer) for layer in self.convolutions)
        maps = F.leaky_relu(first(maps), SLOPE, inplace=True)
        for layer in dense:
            maps = F.leaky_relu(torch.cat([maps, layer(maps)], 1), SLOPE, inplace=True)
        with torch.autocast(maps.device.type, enabled=False):
            made = last(maps.to(last.weight.dtype)).contiguous()
        levels, logits = made[:, : len(GRIDS)], made[:, len(GRIDS) :]
        return Guides((LEVELS - 1) * torch.sigmoid(wide(levels)), self._blend(wide(logits)))

    def _blend(self, logits: Tensor) -> Tensor:
        """Return three weights of two logits, (B, 3, H, W)."""
        if self.softmax_blend:
            return torch.softmax(torch.cat([logits, torch.zeros_like(logits[:, :1])], 1), 1)
        weights = torch.sigmoid(logits)
        return torch.cat([weights, 1.0 - weights.sum(1, keepdim=True)], 1)


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    made = nn.Conv2d(inputs, outputs, SIZE, padding=SIZE // 2)
    nn.init.xavier_uniform_(made.weight)
    assert made.bias is not None
    nn.init.zeros_(made.bias)
    return made
