"""BMFR: blockwise multi-order feature regression of one sample per pixel, in real time.

Matias Koskela, Kalle Immonen, Markku Mäkitalo, Alessandro Foi, Timo Viitanen, Pekka Jääskeläinen, Heikki
Kultala, Jarmo Takala: "Blockwise Multi-Order Feature Regression for Real-Time Path-Tracing Reconstruction",
ACM Transactions on Graphics 38(5), 2019, doi:10.1145/3269978.

Irradiance is accumulated over the preceding frames as far as these show the same surface, fitted block by
block by features (`models.ops.block_regression`), accumulated again, multiplied by the albedo, and
antialiased over time. It follows the authors' released code, the numbers of which are the defaults.

Differences: the code cuts display values at 1 before antialiasing, and its result are display values. Here
brightness above 1 stays, since the result is linear radiance; `cut=True` cuts exposed radiance as the code
does. The position limit, which the code has from headers of each scene (0.0009 to 0.01 squared units, as
`data.layouts.bmfr` reads them), is chosen from the frame's scale unless given. Where pixels were, it gets
from `motion`, which for frames with positions and cameras is the same as the code's projection. Images
narrower than a block are mirrored as often as it takes.

Last of nine frames of 320x180 with one sample per pixel (classroom, glossy Cornell box, living room; PSNR in
dB, exposed, gamma 2.2): input 5.7, 15.5, 9.9; result 19.5, 19.9, 21.2; without antialiasing 18.7, 19.7, 20.6.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import torch
from torch import Tensor

from models.classical.sequence_filter import SequenceFilter, carried, checked, follows
from models.denoiser import Buffers, Denoised
from models.ops.block_regression import STEP, BlockRegression, Scale, Solver
from models.ops.guides import finite
from models.ops.reproject import Neighbours, bilinear, position_limit
from models.ops.tonemap import LARGEST

NORMAL_LIMIT_SQUARED = 1.0
"""Limit of the squared difference of normals: 60 degrees, the code's for its classroom."""


class BMFR(SequenceFilter):
    """Blockwise multi-order feature regression, for sequences of few samples per pixel.

    State: `noisy`, accumulated irradiance before the regression; `filtered`, accumulated after it; `count` of
    accumulated frames; `normal`; `position`; `frame`, how many frames the sequence has had, (B,); `output`,
    where `taa` is on.

    Args:
        noisy_alpha: Least weight of the new frame's irradiance before the regression.
        filtered_alpha: The same after it.
        longest: Largest number of frames that is counted.
        position_limit_squared: Squared distance within which points are one surface's, in squared scene
            units; None: 6 pixels' footprints, see `models.ops.reproject.footprint`.
        normal_limit_squared: Squared difference within which normals are one surface's, 0 to 4.
        block: Side of the blocks, in pixels, a multiple of 16. At 320x180 the paper's 32 hold four times as
            much of the scene in each direction as at its 1280x720, and 16 are better (1.1 dB on the sample).
        noise: Largest noise that regularises the regression.
        scale: Which ranges of positions are brought to [0, 1] within a block: `large`, above 1 scene unit
            (code), or `all`, which does not depend on the scene's unit.
        half: Round what is fitted, and the features, to half precision, as the code does.
        solver: `normal` or `qr`, see `models.ops.block_regression`.
        taa: Antialias the result over time, see `models.ops.antialiasing`.
        taa_new: Weight of the new frame there.
        cut: Cut exposed radiance at 1, as the code does.
        aux: Also return `history`, the number of frames (B, 1, H, W), and `irradiance`, what the regression
            fitted (B, 3, H, W).

    Raises:
        ValueError: A number is out of its range or a word unknown.
    """

    inputs: tuple[str, ...] = ("irradiance", "albedo", "normal", "position", "motion")
    bytes_per_pixel = 600

    def __init__(
        self,
        noisy_alpha: float = 0.2,
        filtered_alpha: float = 0.1,
        *,
        longest: int = 255,
        position_limit_squared: float | None = None,
        normal_limit_squared: float = NORMAL_LIMIT_SQUARED,
        block: int = 32,
        noise: float = 0.01,
        scale: Scale = "large",
        half: bool = False,
        solver: Solver = "normal",
        taa: bool = True,
        taa_new: float = 0.2,
        cut: bool = False,
        aux: bool = False,
    ) -> None:
        arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        positive = ("longest", "position_limit_squared", "normal_limit_squared", "noise")
        checked("BMFR", arguments, positive=positive, shares=("noisy_alpha", "filtered_alpha", "taa_new"))
        for name, value, words in (("scale", scale, get_args(Scale)), ("solver", solver, get_args(Solver))):
            if value not in words:
                raise ValueError(f"BMFR: {name} must be {' or '.join(words)}, got {value!r}")
        if block < STEP or block % STEP:
            raise ValueError(f"BMFR: block must be a multiple of {STEP}, got {block}")
        self.noisy_alpha, self.filtered_alpha, self.longest = noisy_alpha, filtered_alpha, longest
        self.position_limit_squared = position_limit_squared
        self.normal_limit_squared = normal_limit_squared
        self.regression = BlockRegression(noise, scale, half, solver, block)
        self.taa_new, self.cut, self.aux = (taa_new if taa else None), cut, aux

    def forward(self, buffers: Buffers, state: Mapping[str, Tensor] | None = None) -> Denoised:
        """Denoise a frame; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) of this frame alone, linear radiance without albedo; `albedo`
                (B, 3, H, W) that it was divided by; `normal` (B, 3, H, W); `position` (B, 3, H, W), world
                space; `motion` (B, 2, H, W), previous pixel minus this pixel. Optionally `exposure` (B,).
            state: That of the frame before, None: a sequence begins.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        batch, _, _ = self.check(buffers)
        light, exposure = self._exposed(buffers)
        seen = {
            "normal": finite(buffers["normal"]).clamp(-1.0, 1.0),
            "position": finite(buffers["position"]).clamp(-LARGEST, LARGEST),  # its square stays finite
        }
        count = torch.ones_like(light[:, :1])
        frame = torch.zeros(batch, dtype=torch.int64, device=light.device)
        before = same = None
        noisy = light
        if state is not None and follows(state, light):
            frame = state["frame"] + 1
            before = (state, bilinear(buffers["motion"]))
            same = before[1].only(self._same_surface(before[1], seen, state))
            noisy, count = self._accumulated(light, same, state, exposure)
        fitted = self.regression(noisy, seen["normal"], seen["position"], frame).clamp_min(0.0)
        filtered = fitted
        if state is not None and same is not None:
            alpha = (1 / count).clamp_min(self.filtered_alpha)
            filtered = torch.lerp(same.mean(state["filtered"]) * exposure, fitted, alpha)
        output = self._finished(filtered, buffers, exposure, before, self.taa_new, 1.0 if self.cut else None)
        planes = {"noisy": noisy / exposure, "filtered": filtered / exposure, "count": count, "frame": frame}
        if self.taa_new is not None:
            planes["output"] = output
        aux = {"history": count, "irradiance": fitted / exposure}
        return Denoised(output, carried(**planes, **seen), aux if self.aux else None)

    def _same_surface(
        self, found: Neighbours, seen: Mapping[str, Tensor], state: Mapping[str, Tensor]
    ) -> Tensor:
        """Return which neighbours show the surface that the pixel shows now, (B, K, H, W)."""
        limit = position_limit(seen["position"], self.position_limit_squared)
        near = found.distances(seen["position"], state["position"]) < limit
        return near & (found.distances(seen["normal"], state["normal"]) < self.normal_limit_squared)

    def _accumulated(
        self, light: Tensor, same: Neighbours, state: Mapping[str, Tensor], exposure: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return irradiance blended with that of the frame before, and the number of frames."""
        known = same.total > 0
        past = same.mean(torch.cat([state["noisy"], state["count"]], 1))
        number = past[:, 3:]
        alpha = torch.where(known, (1 / (number + 1)).clamp_min(self.noisy_alpha), 1.0)
        count = torch.where(known, number.round() + 1, 1.0).clamp_max(float(self.longest))
        return torch.lerp(past[:, :3] * exposure, light, alpha), count
