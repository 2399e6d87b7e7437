"""WSKP: weight-sharing kernel prediction, a small network for one sample per pixel in real time.

Hangming Fan, Rui Wang, Yuchi Huo, Hujun Bao: "Real-time Monte Carlo Denoising with Weight Sharing Kernel
Prediction Network", Computer Graphics Forum 40(4), 2021, doi:10.1111/cgf.14338.

A chain of six (or three) multi-branch 5x5 blocks predicts one log-importance map and one fusion logit per
kernel size. A window softmax of each map filters the noisy irradiance with kernels of 3 … 13 pixels; the
results are fused and multiplied by the albedo.

Paper and authors' code differ; the code is followed, since its weights are the published ones:
- activation: ReLU in the paper, leaky ReLU 0.1 in the code and none after the last block
  (`activation="relu"` gives the paper's);
- blocks: "a variant of RepVGG" in the paper, without batch normalisation and biases in the code (`bias`,
  `batch_norm`; `branches=False` trains plain 5x5 blocks as in the paper's Table 5);
- the window softmax: exp without a shift in the code; here exact for any range (`models.ops.sharing`);
- depth is scaled by minimum and maximum of the whole frame; a frame of constant depth, where the code
  divides 0 by 0, gives 0;
- width 14 of the three-layer network is not printed; it follows from the paper's timings.
`exposure` is ours: BMFR's radiance is already at a displayable level (exposure 1), other data is not, and
the tone-mapped input is clamped to [0, 1].

Published, BMFR, average of six scenes: 30.323 dB PSNR with six layers, 29.637 dB with three.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, cast

import torch
from torch import Tensor, nn

from models.blocks.rep import SIZE, RepBlock, chain
from models.denoiser import Buffers, Denoised, Denoiser
from models.ops.kernel_views import VIEWS_BYTES, full_size, kernel_views
from models.ops.memory_format import innermost
from models.ops.sharing import reconstruct
from models.ops.ten_channels import FEATURES, depth_bounds, ten_channels
from models.ops.tonemap import gamma


class Kernels(NamedTuple):
    """What the network predicts, for the reconstruction and for looking at.

    Attributes:
        log_importance: (B, K, H, W): a window softmax turns map k into the kernels of size k.
        fusion_logits: (B, K, H, W): their softmax over K weighs the K filtered images.
    """

    log_importance: Tensor
    fusion_logits: Tensor

    @property
    def fusion(self) -> Tensor:
        """Fusion weights (B, K, H, W), positive, sum 1 over K."""
        return torch.softmax(self.fusion_logits.float(), 1)


class WSKP(Denoiser):
    """Weight-sharing kernel prediction network of Fan et al. 2021.

    Args:
        layers: Blocks of the network; the paper has 6 and 3.
        width: Feature channels between blocks.
        kernel_sizes: Odd sizes of the filter windows.
        activation: `leaky_relu` (slope 0.1, the authors' code) or `relu` (the paper).
        bias: Convolutions have biases.
        batch_norm: Branches are batch-normalised, as in the original RepVGG.
        branches: Blocks train 5x5, 3x3, 1x1 and identity branches; False: only 5x5.
        temporal: `irradiance` is expected to be accumulated over the preceding frames.

    Attributes:
        aux: Return what each kernel makes as `Denoised.aux` (`models.ops.kernel_views`): the image that it
            filters, its fusion weight, its log-importance.
    """

    inputs = ("irradiance", "albedo", "normal", "depth")
    frame_numbers = ("exposure", "depth_range")
    aux = False

    def __init__(
        self,
        layers: int = 6,
        width: int = 14,
        kernel_sizes: Sequence[int] = (3, 5, 7, 9, 11, 13),
        activation: Literal["leaky_relu", "relu"] = "leaky_relu",
        bias: bool = False,
        batch_norm: bool = False,
        branches: bool = True,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        if layers < 2:
            raise ValueError(f"WSKP needs at least 2 layers, got {layers}")
        if not kernel_sizes or any(size < 1 or size % 2 == 0 for size in kernel_sizes):
            raise ValueError(f"kernel_sizes must be odd and positive, got {tuple(kernel_sizes)}")
        self.kernel_sizes = tuple(kernel_sizes)
        self.temporal = temporal
        self.halo = layers * (SIZE // 2) + max(self.kernel_sizes) // 2
        widths = [FEATURES, *[width] * (layers - 1), 2 * len(self.kernel_sizes)]
        self.blocks = chain(
            widths, activation=activation, bias=bias, batch_norm=batch_norm, branches=branches
        )

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) linear radiance without albedo, `albedo` (B, 3, H, W) that it
                was divided by, `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units;
                optionally `exposure` (B,) and `depth_range` (B, 2).
        """
        kernels = self.predict(buffers)
        irradiance = buffers["irradiance"]
        color = reconstruct(irradiance, *kernels, self.kernel_sizes) * buffers["albedo"]
        if not self.aux:
            return Denoised(color)
        views = kernel_views(irradiance, *kernels, self.kernel_sizes)
        return Denoised(color, aux=full_size(views, 1, buffers["albedo"]))

    @property
    def bytes_per_pixel(self) -> int:  # type: ignore[override]
        """Resident memory grows by 180 at 1280x720, 140 when deployed; what `aux` holds is added."""
        return 250 + self.aux * VIEWS_BYTES * len(self.kernel_sizes)

    def predict(self, buffers: Buffers) -> Kernels:
        """Return importance maps and fusion logits, from the same buffers as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        maps = innermost(self._features(buffers))
        for block in self.blocks:
            maps = block(maps)
        log_importance, fusion_logits = maps.contiguous().chunk(2, 1)
        return Kernels(log_importance, fusion_logits)

    def _features(self, buffers: Buffers) -> Tensor:
        return ten_channels(buffers, self.exposure(buffers), gamma)

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_bounds(buffers["depth"])}

    def deploy(self) -> WSKP:
        """Return a copy with every block collapsed to one 5x5 convolution, in evaluation mode."""
        blocks = [cast(RepBlock, block).collapse() for block in self.blocks]
        first, last = blocks[0], blocks[-1]
        copy = WSKP(
            layers=len(blocks),
            width=first.outputs,
            kernel_sizes=self.kernel_sizes,
            activation="relu" if first.activation == "relu" else "leaky_relu",
            bias=last.convolutions[0].bias is not None,
            branches=False,
            temporal=self.temporal,
        )
        copy.blocks = nn.ModuleList(blocks)
        copy.aux = self.aux
        return copy.eval()
