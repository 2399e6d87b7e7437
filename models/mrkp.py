"""MR-KP: 5x5 kernels predicted in several resolutions, what WSKP's form for stills is compared with.

Thijs Vogels, Fabrice Rousselle, Brian McWilliams, Gerhard Röthlin, Alex Harvill, David Adler, Mark Meyer, Jan
Novák: "Denoising with Kernel Prediction and Asymmetric Loss Functions", ACM Transactions on Graphics 37(4),
2018, doi:10.1145/3197517.3201388, in the small form that Meng et al. 2020 (doi:10.2312/sr.20201133) made and
Fan et al. 2021 (doi:10.1111/cgf.14338) compare WSKP with.

A U-Net (`models.blocks.average_unet`) predicts 25 numbers of a kernel and one weight at full, half and
quarter resolution. The kernels filter the noisy irradiance, averaged to each resolution. From coarse to fine
the results are combined with the weights (`models.ops.resolutions`), and the albedo is multiplied back.

The text of Fan et al. and the code of Meng et al. differ. Preset `wskp`, the default, is the text, preset
`meng` the code. Fan et al. compare with the authors' implementation, trained with their own loss and data;
which of the other points their tables have they do not say. Every point is an option of its own:

    point           wskp                                 meng
    kernels         softmax over what of the window      ReLU; neighbours that are 0 in a channel do not
                    lies inside the image                count there, sums are divided by their weights
    color           what the network sees is radiance    irradiance, without tone curve and albedo
                    after a tone curve
    alpha           sigmoid                              ReLU, without bound
    raw_level       the quarter resolution is the        a fourth level, the unfiltered means of 8x8 pixels,
                    coarsest                             is below it
    upsampling      nearest pixel                        between pixels (`models.ops.resolutions.doubled`)
    compare         radiance, by SMAPE                   gamma-corrected radiance, by L1

Common to both, from the code: the U-Net with 48 channels and five levels, all three heads with 26 channels,
so that parameters fit either way (with `wskp` the weight of the coarsest head is not used), uniform weights
after Glorot and Bengio, biases 0. Ours:
- the text names no range of the weight: sigmoid;
- combining gives negative radiance where a dark pixel has much brighter neighbours: it becomes 0;
- irradiance that the network sees itself ends at 65504, since Meng et al. hold frames in half precision;
- where all 25 numbers of a ReLU kernel are 0 the filtered pixel is black, as in the code;
- images whose sides are no multiples of 32 are padded by repeating their last row and column;
- `exposure` and constant depth: as in `models.wskp`.
For stills of 64 spp the text has `color="filmic"` and no temporal accumulation.

Published, by Fan et al.: BMFR, average of six held-out scenes, 30.322 dB PSNR, SSIM 0.952 (WSKP 30.323 dB,
0.951), 24.73 ms at 1280x720 on an RTX 2080 Ti; 64-spp Tungsten, kitchen 36.31 dB, 0.978, dining room 37.87
dB, 0.980.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.blocks.average_unet import AverageUNet
from models.denoiser import Buffers, Denoised, Denoiser, Pair, select
from models.ops.gather_inside import gather_inside
from models.ops.gather_positive import gather_positive
from models.ops.memory_format import innermost
from models.ops.padding import padded
from models.ops.precision import wide
from models.ops.resolutions import Upsampling, blended, resolutions
from models.ops.ten_channels import FEATURES, depth_bounds, ten_channels
from models.ops.tonemap import exposed, filmic, gamma

Preset = Literal["wskp", "meng"]
KernelWeights = Literal["softmax", "relu"]
Color = Literal["gamma", "filmic", "irradiance"]
Alpha = Literal["sigmoid", "relu"]
Compare = Literal["radiance", "gamma"]

PRESETS: dict[str, dict[str, Any]] = {
    "wskp": {
        "kernels": "softmax",
        "color": "gamma",
        "alpha": "sigmoid",
        "raw_level": False,
        "upsampling": "nearest",
        "compare": "radiance",
    },
    "meng": {
        "kernels": "relu",
        "color": "irradiance",
        "alpha": "relu",
        "raw_level": True,
        "upsampling": "linear",
        "compare": "gamma",
    },
}
"""Name of a preset → arguments of `MRKP`."""

_CHOICES: dict[str, tuple[Any, ...]] = {
    "kernels": get_args(KernelWeights),
    "color": get_args(Color),
    "alpha": get_args(Alpha),
    "raw_level": (False, True),
    "upsampling": get_args(Upsampling),
    "compare": get_args(Compare),
}

_CURVES = {"gamma": gamma, "filmic": filmic, "irradiance": None}


class Level(NamedTuple):
    """What the network predicts for one resolution.

    Attributes:
        kernels: (B, K * K, h, w): logits, or weights that are not negative; map `K * (dy + r) + dx + r`
            belongs to the pixel dy rows below and dx columns to the right.
        alpha: (B, 1, h, w): how much of the coarser result is taken, at least 0; None where there is none.
    """

    kernels: Tensor
    alpha: Tensor | None


class MRKP(Denoiser):
    """Multi-resolution kernel prediction of Vogels et al. 2018, in the form of Meng et al. 2020.

    Args:
        preset: What the following options are where they are not given: `wskp` or `meng`.
        kernels: `softmax`, or `relu`: weights that are not negative, and only neighbours with light count.
        color: Colour that the network sees: radiance after the curve `gamma` or `filmic`, or `irradiance`.
        alpha: What makes the combining weight: `sigmoid`, or `relu` without upper bound.
        raw_level: Combine the coarsest filtered image with the unfiltered means below it.
        upsampling: Of coarser images: `nearest`, or `linear` between pixels.
        compare: What `training_pairs` compares: exposed `radiance`, or the same after `gamma`.
        kernel_size: Rows and columns K of the predicted kernels, odd.
        width: Channels of the U-Net.
        levels: Resolutions of the U-Net.
        resolutions: Resolutions in which the image is filtered, at most `levels`.
        temporal: `irradiance` is expected to be accumulated over the preceding frames.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = ("irradiance", "albedo", "normal", "depth")
    frame_numbers = ("exposure", "depth_range")

    def __init__(
        self,
        preset: Preset = "wskp",
        kernels: KernelWeights | None = None,
        color: Color | None = None,
        alpha: Alpha | None = None,
        raw_level: bool | None = None,
        upsampling: Upsampling | None = None,
        compare: Compare | None = None,
        kernel_size: int = 5,
        width: int = 48,
        levels: int = 5,
        resolutions: int = 3,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        if preset not in PRESETS:
            raise ValueError(f"preset {preset!r}; expected one of {', '.join(PRESETS)}")
        given = {name: value for name, value in locals().items() if name in _CHOICES and value is not None}
        chosen = {**PRESETS[preset], **given}
        _check(chosen, kernel_size, width, levels, resolutions)
        self.kernels, self.color, self.alpha = chosen["kernels"], chosen["color"], chosen["alpha"]
        self.raw_level, self.upsampling = chosen["raw_level"], chosen["upsampling"]
        self.compare, self.kernel_size, self.temporal = chosen["compare"], kernel_size, temporal
        self.unet = AverageUNet(FEATURES, width, levels, [kernel_size**2 + 1] * resolutions)
        for module in self.unet.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d) and module.bias is not None:
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        self.multiple = 2**levels
        self._declare_reach(resolutions)
        # Resident memory grows by 1000 at 1280x720 with 5x5 kernels, in ONNX Runtime by 1850.
        self.bytes_per_pixel = 1000 + 8 * kernel_size**2
        self.exported_bytes_per_pixel = 1500 + 16 * kernel_size**2

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
        images = resolutions(padded(buffers["irradiance"], self.multiple), len(predicted) + self.raw_level)
        gather = gather_inside if self.kernels == "softmax" else gather_positive
        result = images[-1]
        for image, (kernels, alpha) in zip(images[len(predicted) - 1 :: -1], predicted[::-1], strict=True):
            filtered = gather(image, kernels, self.kernel_size)
            result = filtered if alpha is None else blended(filtered, result, alpha, self.upsampling)
        height, width = buffers["albedo"].shape[-2:]
        return Denoised(result[..., :height, :width].clamp_min(0.0) * buffers["albedo"])

    def predict(self, buffers: Buffers) -> list[Level]:
        """Return what the network predicts, from fine to coarse, of images padded to multiples of 32.

        Args:
            buffers: As for `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        maps = padded(ten_channels(buffers, self.exposure(buffers), _CURVES[self.color]), self.multiple)
        *finer, coarsest = (self._level(made) for made in self.unet(innermost(maps)))
        return [*finer, coarsest if self.raw_level else coarsest._replace(alpha=None)]

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return exposed output and reference, after the curve `gamma` where that is what is compared."""
        if self.compare == "radiance":
            return super().training_pairs(batch)
        exposure = self.exposure(batch).float()
        output = self(select(self, batch)).color.float() * exposure
        reference = exposed(batch["reference"].float(), exposure)
        return {"color": Pair(gamma(output), gamma(reference))}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_bounds(buffers["depth"])}

    def _declare_reach(self, resolutions: int) -> None:
        """Set `halo` and `rounding_reach`."""
        # Between pixels a coarser image is needed one pixel beyond the core, and with it the mean that is
        # subtracted from it there, of two pixels beyond in the finer one.
        beyond = 2 if self.upsampling == "linear" else 0
        needed = [beyond] * resolutions
        if not self.raw_level:
            needed[-1] = beyond // 2 if resolutions > 1 else 0
        radius = self.kernel_size // 2
        seen = ((pixels + radius) * 2**level for level, pixels in enumerate(needed))
        self.halo = max(self.unet.halo(needed), *seen)
        # A firefly is in every mean whose window has it, and such means are subtracted from each other;
        # without a tone curve all that the network makes of it has its rounding.
        cell = 2 ** (resolutions - 1 + self.raw_level)
        through = radius * cell // 2 + 2 * cell if self.color != "irradiance" else self.halo
        self.rounding_reach = max(through, type(self).rounding_reach)

    def _level(self, made: Tensor) -> Level:
        taps = self.kernel_size**2
        kernels, alpha = made[:, :taps].contiguous(), wide(made[:, taps:])
        return Level(
            kernels if self.kernels == "softmax" else F.relu(kernels),
            torch.sigmoid(alpha) if self.alpha == "sigmoid" else F.relu(alpha),
        )


def _check(chosen: Mapping[str, Any], kernel_size: int, width: int, levels: int, resolutions: int) -> None:
    for name, value in chosen.items():
        if value not in _CHOICES[name]:
            expected = ", ".join(map(str, _CHOICES[name]))
            raise ValueError(f"{name} {value!r}; expected one of {expected}")
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise ValueError(f"kernel_size must be odd and positive, got {kernel_size}")
    if width < 1 or not 1 <= resolutions <= levels:
        raise ValueError(
            f"width must be at least 1 and resolutions lie between 1 and levels, got {width}, {resolutions} "
            f"and {levels}"
        )
