"""WSKP in several resolutions: the form for stills of 64 samples per pixel.

Hangming Fan, Rui Wang, Yuchi Huo, Hujun Bao: "Real-time Monte Carlo Denoising with Weight Sharing Kernel
Prediction Network", Computer Graphics Forum 40(4), 2021, doi:10.1111/cgf.14338, section 5.2.

A U-Net predicts two log-importance maps and two fusion logits at full, half and quarter resolution. In each,
their window softmax filters the noisy irradiance, averaged to that resolution, with kernels of 3 and 5
pixels and fuses the results (`models.ops.sharing`, equations 2 to 5). From coarse to fine they are combined
with predicted weights (`models.ops.resolutions`, equation 7), and the albedo is multiplied back.

Stated in the paper: the U-Net, three resolutions, kernels, equation 7, filmic tone mapping of the network's
colour, no temporal accumulation. The layers are in a supplement that is not public. Here, and why:
- U-Net: that of MR-KP (`models.blocks.average_unet`), 48 channels and five levels, since the paper calls the
  architectures similar and measures 21.85 ms and 23.73 ms for them. Its heads have 5 channels in place of 26,
  at the coarsest resolution 4: 286,478 parameters where MR-KP has 341,838;
- the combining weight is a sigmoid of a channel of the head; the paper asks for a weight per pixel;
- the coarsest result is the filtered image itself;
- filmic curve: constants of the code of the authors of that data; `curve="gamma"` is that of `models.wskp`;
- equation 7 gives negative radiance where a dark pixel has much brighter neighbours: it becomes 0;
- images whose sides are no multiples of 32 are padded by repeating their last row and column;
- `exposure` and constant depth: as in `models.wskp`.

Published, 64-spp Tungsten data of Meng et al. 2020: kitchen 35.88 dB PSNR, SSIM 0.976; dining room 38.03 dB,
0.981 (KP 36.03 dB and 38.11 dB). The paper states SMAPE as loss for BMFR only; it is the default here too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from models.blocks.average_unet import AverageUNet
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.kernel_views import VIEWS_BYTES, full_size, kernel_views
from models.ops.memory_format import innermost
from models.ops.padding import padded
from models.ops.precision import wide
from models.ops.resolutions import blended, resolutions
from models.ops.sharing import reconstruct
from models.ops.ten_channels import FEATURES, depth_bounds, ten_channels
from models.ops.tonemap import filmic, gamma

CURVES = {"filmic": filmic, "gamma": gamma}


class Level(NamedTuple):
    """What the network predicts for one resolution.

    Attributes:
        log_importance: (B, K, h, w): a window softmax turns map k into the kernels of size k.
        fusion_logits: (B, K, h, w): their softmax over K weighs the K filtered images.
        alpha: (B, 1, h, w): how much of the coarser result is taken, 0 … 1; None at the coarsest.
    """

    log_importance: Tensor
    fusion_logits: Tensor
    alpha: Tensor | None


class MultiResolutionWSKP(Denoiser):
    """Weight-sharing kernel prediction in several resolutions, of Fan et al. 2021.

    Args:
        width: Channels of the U-Net.
        levels: Resolutions of the U-Net.
        resolutions: Resolutions in which the image is filtered, at most `levels`.
        kernel_sizes: Odd sizes of the filter windows in each.
        curve: Tone curve of the colour that the network sees.
        temporal: `irradiance` is expected to be accumulated over the preceding frames.

    Attributes:
        aux: Return what each kernel makes in each resolution, in full size, as `Denoised.aux`:
            `x1_kernel03_…` (`models.ops.kernel_views`) at full resolution, `x2_…` of means over 2x2 pixels,
            and `x1_alpha`, the share of the coarser result.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = ("irradiance", "albedo", "normal", "depth")
    frame_numbers = ("exposure", "depth_range")
    aux = False

    def __init__(
        self,
        width: int = 48,
        levels: int = 5,
        resolutions: int = 3,
        kernel_sizes: Sequence[int] = (3, 5),
        curve: Literal["filmic", "gamma"] = "filmic",
        temporal: bool = False,
    ) -> None:
        super().__init__()
        if not kernel_sizes or any(size < 1 or size % 2 == 0 for size in kernel_sizes):
            raise ValueError(f"kernel_sizes must be odd and positive, got {tuple(kernel_sizes)}")
        if width < 1 or not 1 <= resolutions <= levels:
            raise ValueError(
                f"width must be at least 1 and resolutions lie between 1 and levels, got {width}, "
                f"{resolutions} and {levels}"
            )
        if curve not in CURVES:
            raise ValueError(f"curve {curve!r}; expected one of {', '.join(CURVES)}")
        self.kernel_sizes, self.temporal, self.curve = tuple(kernel_sizes), temporal, curve
        maps = 2 * len(self.kernel_sizes)
        self.unet = AverageUNet(FEATURES, width, levels, [maps + 1] * (resolutions - 1) + [maps])
        self.multiple = 2**levels
        radius = max(self.kernel_sizes) // 2
        self.halo = max(self.unet.halo([radius] * resolutions), radius * 2 ** (resolutions - 1))

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, `albedo` (B, 3, H, W) that it
                was divided by, `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units;
                optionally `exposure` (B,) and `depth_range` (B, 2).

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        predicted = self.predict(buffers)
        images = resolutions(padded(buffers["irradiance"], self.multiple), len(predicted))
        result = images[-1]
        for image, level in zip(images[::-1], predicted[::-1], strict=True):
            filtered = reconstruct(image, level.log_importance, level.fusion_logits, self.kernel_sizes)
            result = filtered if level.alpha is None else blended(filtered, result, level.alpha)
        height, width = buffers["albedo"].shape[-2:]
        color = result[..., :height, :width].clamp_min(0.0) * buffers["albedo"]
        return Denoised(color, aux=self._views(images, predicted, buffers["albedo"]) if self.aux else None)

    @property
    def bytes_per_pixel(self) -> int:  # type: ignore[override]
        """Resident memory grows by 1000 at 1280x720; what `aux` holds is added."""
        return 1200 + self.aux * VIEWS_BYTES * len(self.unet.heads) * len(self.kernel_sizes)

    def predict(self, buffers: Buffers) -> list[Level]:
        """Return what the network predicts, from fine to coarse, of images padded to multiples of 32.

        Args:
            buffers: As for `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        maps = padded(ten_channels(buffers, self.exposure(buffers), CURVES[self.curve]), self.multiple)
        *finer, coarsest = (self._level(made) for made in self.unet(innermost(maps)))
        return [*finer, coarsest._replace(alpha=None)]

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_bounds(buffers["depth"])}

    def _views(self, images: list[Tensor], predicted: list[Level], albedo: Tensor) -> dict[str, Tensor]:
        """Return what each kernel makes, and the shares of coarser results, by name and in full size."""
        made: dict[str, Tensor] = {}
        for number, (image, level) in enumerate(zip(images, predicted, strict=True)):
            views = kernel_views(image, level.log_importance, level.fusion_logits, self.kernel_sizes)
            if level.alpha is not None:
                views["alpha"] = level.alpha
            factor = 2**number
            made |= {f"x{factor}_{name}": view for name, view in full_size(views, factor, albedo).items()}
        return made

    def _level(self, made: Tensor) -> Level:
        count = len(self.kernel_sizes)
        log_importance, fusion_logits = made[:, :count].contiguous(), made[:, count : 2 * count].contiguous()
        return Level(log_importance, fusion_logits, torch.sigmoid(wide(made[:, 2 * count :])))
