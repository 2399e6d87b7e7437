"""What the networks of Munkberg and Hasselgren 2020 (`models.layers`) share: what they see, and the U-Net."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor, nn

from data.buffers import SAMPLE_BUFFERS, SAMPLES, sample_channels
from models.blocks.pointwise import Pointwise
from models.blocks.unet import UNet, Upsampling
from models.denoiser import Buffers, Denoiser
from models.ops.guides import farthest
from models.ops.per_sample import Seen, known, sample_depths, seen
from models.ops.precision import wide
from models.ops.tonemap import exposed, srgb_log

RADIANCE_LIMIT = 65535.0
"""Exposed radiance is clipped to this, as in the authors' code."""

_READ = (
    "radiance",
    "normal",
    "depth",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "motion",
    "coc",
    "lens",
    "time",
)
FEATURES = len(sample_channels(*_READ))
"""Channels of a sample: 20."""

_SCALES = {"motion": 1 / 128, "coc": 1 / 2}
"""Pixels to the authors' numbers: device coordinates of a frame of 256 pixels, and a radius."""


class Frame(NamedTuple):
    """A batch: samples (B, S, 20, H, W), exposure and largest depth (B, 1, 1, 1)."""

    samples: Tensor
    exposure: Tensor
    farthest: Tensor

    @property
    def numbers(self) -> tuple[Tensor, ...]:
        """What belongs to the frame and not to a pixel: for some rows, `Frame(rows, *numbers)`."""
        return (self.exposure, self.farthest)


class PerSample(Denoiser):
    """What the networks of the paper share.

    Attributes:
        order: In which the sample reducer reads the quantities.
        reads: Channels that it reads.

    Args:
        kernel_size: Rows and columns of the kernels, odd.
        width: Channels of the U-Net at full resolution; all its widths and those of the kernel generator
            follow from it.
        levels: How often the U-Net halves the resolution.
        embedding: Channels of an embedding.
        upsampling: In the U-Net: `nearest` (authors' code) or `bilinear` (paper).
        recompute: In training, compute what belongs to single samples again in the backward pass.
        fill: Quantity → the constant that stands for it where samples lack it, such as `{"lens": 0}`.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = (SAMPLES,)
    frame_numbers = ("exposure", "depth_range")
    per_sample = True
    samples = _READ  # as files and shards hold them, so that batches need not be copied
    bytes_once = 1 << 26  # strips of `models.ops.streaming`
    order = _READ
    reads = FEATURES
    _widths = 7  # alive in the U-Net at full resolution

    def __init__(
        self,
        kernel_size: int = 17,
        width: int = 64,
        levels: int = 5,
        embedding: int = 32,
        upsampling: Upsampling = "nearest",
        recompute: bool = True,
        fill: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__()
        if kernel_size < 3 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd and at least 3, got {kernel_size}")
        if width < 2 or width % 2 or embedding < 1 or not 1 <= levels <= 5:
            raise ValueError(
                f"width {width}, embedding {embedding}, levels {levels}: expected an even width from 2, an "
                "embedding from 1 and 1 to 5 levels"
            )
        for name in fill or {}:
            if name not in _READ or name == "radiance":
                raise ValueError(f"fill: {name!r} is no guide that is read; those are {', '.join(_READ[1:])}")
        self.kernel_size, self.width, self.embedding = kernel_size, width, embedding
        self.recompute, self.fill = recompute, dict(fill or {})
        self.multiple = 2**levels
        self.context = 2 * width
        self.unet = self._unet(levels, upsampling)
        self.reducer = Pointwise(self.reads, *[embedding] * 3, linear=False)
        self._add_heads()
        self.halo = self._halo()
        self.bytes_per_pixel = 5 * self._numbers()

    def _add_heads(self) -> None:
        """Make the networks that follow the U-Net."""
        self.generator: nn.Module = self._generator()

    def _generator(self) -> nn.Module:
        hidden = 2 * self.width
        return Pointwise(self.embedding + self.context, hidden, hidden, self.kernel_size**2, linear=True)

    def _halo(self) -> int:
        return self.unet.halo([self.kernel_size // 2])

    def _numbers(self) -> int:
        """Return the numbers per pixel that are alive at once, at most; those of strips do not count.

        Bytes are five times as many, with what convolutions take for themselves.
        """
        return self._widths * self.width + 2 * self.embedding

    def _unet(self, levels: int, upsampling: Upsampling) -> UNet:
        w = self.width
        encoder, decoder = (2 * w, 4 * w, 8 * w, 8 * w), (8 * w, 4 * w, 2 * w, 2 * w, 2 * w)
        return UNet(self.embedding, w, encoder[: levels - 1], decoder[-levels:], self.context, upsampling)

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of the samples of whole frames."""
        return {"depth_range": sample_depths(buffers[SAMPLES], _READ)}

    def _frame(self, buffers: Buffers) -> Frame:
        self.check(buffers)
        samples = buffers[SAMPLES]
        depths = buffers["depth_range"] if "depth_range" in buffers else self.measure(buffers)["depth_range"]
        return Frame(samples, self.exposure(buffers), farthest(samples[:, 0, :1], depths))

    def _seen(self, samples: Tensor, frame: Frame) -> Seen:
        """Return some rows of a frame's samples as networks see them."""
        clean, counts = known(samples, _READ)
        parts: dict[str, Tensor] = {}
        for name, part in zip(
            _READ, wide(clean).split([len(SAMPLE_BUFFERS[n].letters) for n in _READ], 2), strict=True
        ):
            parts[name] = part * _SCALES[name] if name in _SCALES else part
        radiance = exposed(parts["radiance"], frame.exposure[:, None]).clamp_max(RADIANCE_LIMIT)
        parts["radiance"] = srgb_log(radiance)
        parts["depth"] = parts["depth"] / frame.farthest[:, None]
        return seen(radiance, [parts[name] for name in self.order], counts)

    def _images(self, frame: Frame) -> int:
        return frame.samples.shape[0] * frame.samples.shape[1]

    def _cropped(self, image: Tensor, buffers: Buffers) -> Tensor:
        """Return images (B, …, H, W) of exposed radiance without padding, in the units of the input."""
        height, width = buffers[SAMPLES].shape[-2:]
        exposure = self.exposure(buffers)
        return image[..., :height, :width] / (exposure if image.ndim == 4 else exposure[:, None])
