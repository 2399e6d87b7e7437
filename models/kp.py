"""KP: kernel prediction with the network of WSKP, every weight of every kernel predicted by itself.

Hangming Fan, Rui Wang, Yuchi Huo, Hujun Bao: "Real-time Monte Carlo Denoising with Weight Sharing Kernel
Prediction Network", Computer Graphics Forum 40(4), 2021, doi:10.1111/cgf.14338, which compares WSKP with it:
the idea of KPCN (Bako et al. 2017, doi:10.1145/3072959.3073708) in a network for interactive rates,
with WSKP's inputs, blocks and loss.

A chain of multi-branch 5x5 blocks ends with K x K logits for every pixel. Their softmax filters the noisy
irradiance; the result is multiplied by the albedo:

    color(p) = albedo(p) sum_q softmax(logits(p))_q irradiance(p + q),   q over the K x K offsets

The paper has three sizes (`PRESETS`): KP with six layers and 13x13 kernels, KP-1 with two layers and 13x13
kernels, KP-2 with five layers and 7x7 kernels.

No code of it is public. Read from the text, or ours:
- width 14, the activation and blocks without biases and batch normalisation are those of WSKP's code, since
  the text says that KP has the same architecture. It also says that KP without branches is nearly three times
  as large as WSKP, and with width 14 it has 82,250 parameters to 27,300. The options are WSKP's;
- border: the softmax runs over the part of a window that lies inside the image, which is WSKP's rule;
- `exposure` and constant depth: as in `models.wskp`.
In training the K x K logits of a pixel and their gradient are kept, and nothing else of that size: not the
unfolded image, not the weights, no products (`models.ops.gather_inside`). In inference logits exist for some
rows at a time.

Published, BMFR, average of six scenes: KP 30.332 dB PSNR, SSIM 0.951; KP-1 29.517 dB, 0.941; KP-2 29.809 dB,
0.946. Without the branches KP loses 0.1 dB. WSKP with six layers: 30.323 dB, 0.951, in half the time.
"""

from __future__ import annotations

import copy
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.blocks.rep import SIZE, RepBlock, chain
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.boxes import exporting
from models.ops.gather_inside import gather_inside, gather_inside_rows
from models.ops.memory_format import innermost
from models.ops.streaming import strip_rows
from models.ops.ten_channels import FEATURES, depth_bounds, ten_channels
from models.ops.tonemap import gamma

PRESETS: dict[str, dict[str, Any]] = {
    "KP": {"layers": 6, "kernel_size": 13},
    "KP-1": {"layers": 2, "kernel_size": 13},
    "KP-2": {"layers": 5, "kernel_size": 7},
}
"""The paper's name of a network → arguments of `KP`."""


class KP(Denoiser):
    """Kernel-predicting network with the blocks of WSKP, the baseline of Fan et al. 2021.

    Args:
        layers: Blocks of the network; the paper has 6, 2 and 5.
        kernel_size: Rows and columns K of the predicted kernels, odd; the paper has 13, 13 and 7.
        width: Feature channels between blocks.
        activation: `leaky_relu` (slope 0.1, the code of WSKP) or `relu` (the paper).
        bias: Convolutions have biases.
        batch_norm: Branches are batch-normalised, as in the original RepVGG.
        branches: Blocks train 5x5, 3x3, 1x1 and identity branches; False: only 5x5.
        temporal: `irradiance` is expected to be accumulated over the preceding frames.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = ("irradiance", "albedo", "normal", "depth")
    frame_numbers = ("exposure", "depth_range")
    bytes_per_pixel = 250  # resident memory grows by 200 at 1280x720, deployed
    bytes_once = 1 << 26  # logits of some rows

    def __init__(
        self,
        layers: int = 6,
        kernel_size: int = 13,
        width: int = 14,
        activation: Literal["leaky_relu", "relu"] = "leaky_relu",
        bias: bool = False,
        batch_norm: bool = False,
        branches: bool = True,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        if layers < 2 or width < 1:
            raise ValueError(f"KP needs at least 2 layers and width 1, got {layers} and {width}")
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd and positive, got {kernel_size}")
        self.kernel_size, self.temporal = kernel_size, temporal
        self.halo = max(layers * (SIZE // 2), kernel_size // 2)
        widths = [FEATURES, *[width] * (layers - 1), kernel_size**2]
        self.blocks = chain(
            widths, activation=activation, bias=bias, batch_norm=batch_norm, branches=branches
        )
        # A recorded graph holds logits, weights, shifted images and products of a whole tile: 3300 measured.
        self.exported_bytes_per_pixel = self.bytes_per_pixel + 5 * 4 * kernel_size**2

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, `albedo` (B, 3, H, W) that it
                was divided by, `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units;
                optionally `exposure` (B,) and `depth_range` (B, 2).

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        hidden, irradiance = self._hidden(buffers), buffers["irradiance"]
        if exporting() or torch.is_grad_enabled() or self.training:
            filtered = gather_inside(irradiance, self.blocks[-1](hidden), self.kernel_size)
        else:
            filtered = self._by_rows(hidden, irradiance)
        return Denoised(filtered * buffers["albedo"])

    def predict(self, buffers: Buffers) -> Tensor:
        """Return the logits (B, K * K, H, W), from the same buffers as `forward`.

        Map `K * (dy + r) + dx + r` belongs to the pixel dy rows below and dx columns to the right.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        logits: Tensor = self.blocks[-1](self._hidden(buffers))
        return logits

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_bounds(buffers["depth"])}

    def deploy(self) -> KP:
        """Return a copy with every block collapsed to one 5x5 convolution, in evaluation mode."""
        made = copy.deepcopy(self)
        made.blocks = nn.ModuleList(cast(RepBlock, block).collapse() for block in self.blocks)
        return made.eval()

    def _features(self, buffers: Buffers) -> Tensor:
        return ten_channels(buffers, self.exposure(buffers), gamma)

    def _hidden(self, buffers: Buffers) -> Tensor:
        """Return what the last block reads, (B, width, H, W)."""
        self.check(buffers)
        maps = innermost(self._features(buffers))
        for block in list(self.blocks)[:-1]:
            maps = block(maps)
        # The filter reads map by map: so many of them are convolved that way, not copied afterwards.
        return maps.contiguous()

    def _by_rows(self, hidden: Tensor, irradiance: Tensor) -> Tensor:
        """Return filtered irradiance (B, 3, H, W); logits exist for some rows at a time."""
        last, reach, height = cast(RepBlock, self.blocks[-1]), SIZE // 2, hidden.shape[-2]
        padded = F.pad(hidden, (0, 0, reach, reach))
        rows = strip_rows(hidden, hidden.shape[0] * self.kernel_size**2)
        parts = []
        for first in range(0, height, rows):
            logits = last.rows(padded[..., first : first + rows + 2 * reach, :])
            parts.append(gather_inside_rows(irradiance, logits, self.kernel_size, first))
        return torch.cat(parts, -2)
