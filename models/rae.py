"""RAE: the recurrent autoencoder, which carries a hidden state from frame to frame.

Chakravarty R. Alla Chaitanya, Anton S. Kaplanyan, Christoph Schied, Marco Salvi, Aaron Lefohn, Derek
Nowrouzezahrai, Timo Aila: "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent
Denoising Autoencoder", ACM Transactions on Graphics 36(4), 2017, doi:10.1145/3072959.3073601.

Fan et al. 2021 compare WSKP with ONND, the denoiser of OptiX 5.1, which this paper describes. Neither its
weights nor its exact layers are public: this is the published network as its open stand-in, not ONND itself.

A U-Net of 3x3 convolutions with leaky ReLU of slope 0.1. An encoder stage, and the bottleneck, convolves and
passes a recurrent block, which joins what it is given with its own output in the frame before:

    h_t = conv(conv([conv(x_t), h_(t-1)])),   h_(-1) = 0

The noisy irradiance e = (exposure * irradiance)^0.2, normals and depth go in; the network makes the denoised
e, and color = albedo * e^5 / exposure. There is no filter kernel: a constant image need not stay constant.

Of the paper no code is public. Read from the text and from what others have made of it, or ours:
- channels: `features`; the paper has the first two coordinates of normals in the space of the view, depth and
  roughness, which BMFR's data lack: here world-space normals and depth, 7 channels, 1,951,935 parameters;
- depth is scaled by the frame's minimum and maximum (`depth_range`), as in `models.wskp`;
- hidden states are what recurrent blocks return, at full, 1/2 … 1/32 of the resolution;
- the state is not moved along with the image: the paper does not either;
- sizes that are no multiples of 32 are padded by repeating the last row and column; what is no number counts
  as 0; radiance that becomes negative is 0; the last convolution runs in float32.

The loss (`trainer.losses.Recurrent`) compares e in seven frames, their edges and their changes. Irradiance is
that of the frame alone, without accumulation: the state accumulates. Published, by Fan et al. 2021 for ONND
on BMFR: average of six scenes 25.930 dB PSNR, SSIM 0.915. What is reached here: configs/rae_bmfr.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from data.buffers import buffer
from models.denoiser import Buffers, Denoised, Denoiser, Pair, State, select
from models.ops.boxes import exporting
from models.ops.guides import finite
from models.ops.memory_format import innermost
from models.ops.padding import padded
from models.ops.precision import wide
from models.ops.ten_channels import depth_bounds, scaled_depth
from models.ops.tonemap import LARGEST

POWER = 0.2
"""Exponent of the tone curve."""

SLOPE = 0.1
"""Of the leaky ReLUs."""

STAGES = (32, 43, 57, 76, 101)
"""Channels of the encoder's stages, at full resolution first."""

TAIL = (128, 64)
"""Channels of the last two layers before the image."""


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    made = nn.Conv2d(inputs, outputs, 3, padding=1)
    nn.init.kaiming_normal_(made.weight, a=SLOPE)
    assert made.bias is not None
    nn.init.zeros_(made.bias)
    return made


def _active(maps: Tensor) -> Tensor:
    return F.leaky_relu(maps, SLOPE)


class Recurrent(nn.Module):
    """A stage: convolution to `outputs` channels and a recurrent block."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.enter = _convolution(inputs, outputs)
        self.before = _convolution(outputs, outputs)
        self.join = _convolution(2 * outputs, outputs)
        self.after = _convolution(outputs, outputs)

    def forward(self, maps: Tensor, hidden: Tensor | None) -> Tensor:
        """Return (B, outputs, H, W), which is the next hidden state too; None: all zeros."""
        maps = _active(self.before(_active(self.enter(maps))))
        hidden = torch.zeros_like(maps) if hidden is None else hidden.to(maps.dtype)
        joined: Tensor = _active(self.after(_active(self.join(torch.cat([maps, hidden], 1)))))
        return joined


class Joined(nn.Module):
    """A decoder stage: doubles the resolution, joins the encoder's maps, two convolutions."""

    def __init__(self, inputs: int, middle: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = _convolution(inputs, middle), _convolution(middle, outputs)

    def forward(self, coarse: Tensor, skip: Tensor) -> Tensor:
        """Return (B, outputs, H, W) of (B, C, H / 2, W / 2) and (B, S, H, W)."""
        doubled = F.interpolate(coarse, scale_factor=2, mode="nearest")
        made: Tensor = _active(self.second(_active(self.first(torch.cat([doubled, skip], 1)))))
        return made


class RAE(Denoiser):
    """Recurrent denoising autoencoder of Chaitanya et al. 2017.

    Args:
        features: Buffers that the network sees beside irradiance: `normal`, `depth`, `roughness`, `albedo` …
        stages: Channels of the encoder's stages, each at half of the resolution of the one before.
        tail: Channels of the last two layers before the image.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    frame_numbers = ("exposure", "depth_range")
    recurrent = True
    bytes_per_pixel = 2000

    def __init__(
        self,
        features: Sequence[str] = ("normal", "depth"),
        stages: Sequence[int] = STAGES,
        tail: Sequence[int] = TAIL,
    ) -> None:
        super().__init__()
        if not stages or min(stages) < 1 or len(tail) != 2 or min(tail) < 1:
            raise ValueError(
                f"stages and tail must be positive numbers of channels, two of the tail, got {list(stages)} "
                f"and {list(tail)}"
            )
        self.features = tuple(dict.fromkeys(features))
        self.inputs = tuple(dict.fromkeys(("irradiance", "albedo", *self.features)))
        channels = 3 + sum(buffer(name).channels for name in self.features)
        self.enter = _convolution(channels, stages[0])
        outputs = [*stages, stages[-1]]
        self.encoder = nn.ModuleList(map(Recurrent, [stages[0], *stages], outputs))
        decoded = [*stages[:-1][::-1], tail[1]]
        middle = [*stages[:-1][::-1], tail[0]]
        below = [stages[-1], *decoded[:-1]]
        self.decoder = nn.ModuleList(
            Joined(under + skip, wide_, made)
            for under, skip, wide_, made in zip(below, stages[::-1], middle, decoded, strict=True)
        )
        self.last = _convolution(tail[1], 3)
        self.multiple = 2 ** len(stages)
        self.halo = _halo(len(stages))
        self.state_maps = {f"hidden{level}": (width, 1 << level) for level, width in enumerate(outputs)}

    def forward(self, buffers: Buffers, state: State | None = None) -> Denoised:
        """Denoise the next frame; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, of this frame alone, `albedo`
                (B, 3, H, W) that it was divided by, and `features`; optionally `exposure` (B,) and
                `depth_range` (B, 2).
            state: `Denoised.state` of the frame before, of the same size; None starts a sequence. Hidden
                state k is (B, C, H / 2**k, W / 2**k) of the padded image.

        Raises:
            ValueError: A buffer is missing or has another shape, or the state is one of another size.
        """
        toned, state = self._toned(buffers, state)
        return self._denoised(buffers, toned, state)

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2), smallest and largest depth of whole frames, where depth is read."""
        if "depth" not in self.features:
            return {}
        return {"depth_range": depth_bounds(finite(buffers["depth"]))}

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return the pair of a first frame; see `next_pair`."""
        return {"color": self.next_pair(batch, None)[0]}

    def next_pair(self, batch: Mapping[str, Any], state: State | None) -> tuple[Pair, Denoised]:
        """Return e and what it should be, the reference without albedo in the same curve, and the result."""
        buffers = select(self, batch)
        toned, state = self._toned(buffers, state)
        albedo, reference = wide(buffers["albedo"]), wide(batch["reference"])
        irradiance = torch.where(albedo > 0, reference / albedo.clamp_min(1e-6), 0.0)
        target = _tone(irradiance * self.exposure(buffers))
        return Pair(toned, target), self._denoised(buffers, toned, state)

    def _denoised(self, buffers: Buffers, toned: Tensor, state: State) -> Denoised:
        irradiance = toned.clamp_min(0.0) ** (1 / POWER) / self.exposure(buffers)
        return Denoised(irradiance * finite(buffers["albedo"]), state)

    def _toned(self, buffers: Buffers, state: State | None) -> tuple[Tensor, State]:
        """Return e (B, 3, H, W) and the next state."""
        height, width = self.check(buffers)[1:]
        maps = innermost(padded(self._channels(buffers), self.multiple))
        self._check_state(state, maps)
        maps, hidden = _active(self.enter(maps)), {}
        for level, stage in enumerate(self.encoder):
            maps = maps if level == 0 else F.max_pool2d(maps, 2)
            key = f"hidden{level}"
            maps = hidden[key] = stage(maps, None if state is None else state[key])
        for level, stage in zip(range(len(self.decoder) - 1, -1, -1), self.decoder, strict=True):
            maps = stage(maps, hidden[f"hidden{level}"])
        with torch.autocast(maps.device.type, enabled=False):
            return self.last(wide(maps))[..., :height, :width], hidden

    def _channels(self, buffers: Buffers) -> Tensor:
        channels = [_tone(wide(buffers["irradiance"]) * self.exposure(buffers))]
        for name in self.features:
            image = finite(buffers[name])
            channels.append(scaled_depth(image, buffers.get("depth_range")) if name == "depth" else image)
        return torch.cat(channels, 1)

    def _check_state(self, state: State | None, maps: Tensor) -> None:
        """Check that a state is one of an image of this size."""
        if state is None or exporting():
            return
        batch, _, height, width = maps.shape
        wanted = {n: (batch, c, height // side, width // side) for n, (c, side) in self.state_maps.items()}
        found = {name: tuple(image.shape) for name, image in state.items()}
        if found != wanted:
            raise ValueError(f"the state is that of another batch or size: {found}, expected {wanted}")


def _tone(image: Tensor) -> Tensor:
    """Return max(image, 0) ** 0.2, whose gradient at 0 is 0 here."""
    clean = finite(image).clamp_max(LARGEST)
    return torch.where(clean > 0, clean.clamp_min(1e-20), 1.0) ** POWER * (clean > 0)


def _halo(stages: int) -> int:
    """Return how many pixels around a core on the network's grid it depends on.

    The image convolves 3 times at full resolution, once for itself and twice in the decoder's last stage;
    a stage of the encoder 4 times.
    """
    reach, skips = 3, []
    for _ in range(stages):
        skips.append(reach)
        reach = -(-reach // 2) + 2
    reach = reach - 2 + 4
    for skip in skips[::-1]:
        reach = max(2 * reach, skip) + 4
    return reach + 1
