"""Least squares in blocks of pixels with stochastic regularisation, as BMFR fits noisy light to features.

The image is cut into blocks of 32x32 pixels, or another side, whose grid moves from frame to frame; pixels
beyond the border are mirrored ones. In each block the three channels of the light are fitted by a linear
combination of ten features T of the pixels,

    1, normal, position, position^2 (each of x, y, z),

the positions and their squares brought to [0, 1] by the block's extrema. Features may depend on each other,
as positions on a wall do, so noise is added to all but the constant: with N uniform in +-a,

    w = argmin sum over the block of |light - (T + N) w|^2,    fitted = T w

The noise makes the equations solvable; it is the same for all blocks and another in each frame. The
reconstruction is without it.

Source: Koskela et al. 2019, doi:10.1145/3269978, with the numbers of the released code, where the extrema are
divided by only if they are more than 1 apart (`scale="large"`), and block data is rounded to half precision
(`half`). Its noise comes from an integer hash; here it is the finaliser of MurmurHash3, of 32 bits.
Equations are solved by QR factorisation there; normal equations summed up in float64 give the same up to
rounding, since the noise bounds their condition.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Scale = Literal["large", "all"]
"""Which ranges of positions are brought to [0, 1]: those above 1 scene unit (of x, y, z or their squares), or
all."""

Solver = Literal["normal", "qr"]
"""How equations are solved: by normal equations and a Cholesky factorisation, or by a QR factorisation."""

FEATURES = 10

OFFSETS = (
    (-14, -14), (4, -6), (-8, 14), (8, 0), (-10, -8), (2, 12), (12, -12), (-10, 0),
    (12, 14), (-8, -16), (6, 6), (-2, -2), (6, -14), (-16, 12), (14, -4), (-6, 4),
)  # fmt: skip
"""Where the grid of successive frames lies, x and y from half a block above and left, in 32nds of a block."""

STEP = 16
"""Sides of blocks are multiples of it: then the grids of all frames begin at whole pixels."""

_HALF = 65504.0


@dataclass(frozen=True)
class BlockRegression:
    """How blocks are fitted.

    Attributes:
        noise: a.
        scale: See the module.
        half: Round block data to half precision, as the released code does.
        solver: See `Solver`.
        side: Of a block, in pixels, a multiple of 16.
    """

    noise: float = 0.01
    scale: Scale = "large"
    half: bool = False
    solver: Solver = "normal"
    side: int = 32

    def __call__(self, light: Tensor, normal: Tensor, position: Tensor, frame: Tensor) -> Tensor:
        """Return fitted light (B, 3, H, W), which may be negative.

        Args:
            light: (B, 3, H, W).
            normal: (B, 3, H, W).
            position: (B, 3, H, W), in scene units.
            frame: Number of each frame (B,), which says where its blocks lie and what its noise is.
        """
        with torch.autocast(light.device.type, enabled=False):  # whose products would have 8 bits
            return self._fit(light, normal, position, frame)

    def _fit(self, light: Tensor, normal: Tensor, position: Tensor, frame: Tensor) -> Tensor:
        height, width = light.shape[-2:]
        offsets = torch.tensor(OFFSETS, device=light.device) * self.side // 32 - self.side // 2
        first = offsets[frame % len(OFFSETS)]
        noise = self.noise * noise_of(frame, self.side).to(light.dtype)
        rows, columns = (_places(first[:, axis], size, self.side) for axis, size in ((1, height), (0, width)))
        data = torch.cat([light, normal, position], 1)
        fitted = []
        # A row of blocks at a time: their equations, in float64, stay near the processor.
        for part in rows.unflatten(1, (-1, self.side)).unbind(1):
            blocks = _cut(data, mirrored(part, height), mirrored(columns, width), self.side)
            fitted.append(_joined(self._fitted(blocks, noise), self.side))
        whole = torch.cat(fitted, 1)
        return _cut_back(whole, rows[:, 0], columns[:, 0], (height, width))

    def _fitted(self, blocks: Tensor, noise: Tensor) -> Tensor:
        """Return fitted light (B, N, side^2, 3) of blocks (B, N, side^2, 9)."""
        light, features = blocks[..., :3], self._features(blocks)
        if self.half:
            light, features = ((x.clamp(-_HALF, _HALF).half().to(x.dtype)) for x in (light, features))
        features = self._scaled(features)
        noisy = torch.cat([features[..., :1], features[..., 1:] + noise[:, None]], -1)
        return features @ solve(noisy, light, self.solver)

    def _features(self, blocks: Tensor) -> Tensor:
        normal, position = blocks[..., 3:6], blocks[..., 6:9]
        return torch.cat([torch.ones_like(normal[..., :1]), normal, position, position.square()], -1)

    def _scaled(self, features: Tensor) -> Tensor:
        """Bring positions and their squares to the range from 0, block by block."""
        positions = features[..., 4:]
        low, high = positions.amin(-2, keepdim=True), positions.amax(-2, keepdim=True)
        span = high - low
        least = 1.0 if self.scale == "large" else 0.0
        return torch.cat([features[..., :4], (positions - low) / torch.where(span > least, span, 1.0)], -1)


def solve(features: Tensor, light: Tensor, solver: Solver) -> Tensor:
    """Return the weights (…, F, 3) that fit light (…, N, 3) by features (…, N, F) best."""
    if solver == "qr":
        q, r = torch.linalg.qr(features)
        return torch.linalg.solve_triangular(r, q.mT @ light, upper=True)
    wide = features.double()
    factor = torch.linalg.cholesky_ex(wide.mT @ wide).L
    return torch.cholesky_solve(wide.mT @ light.double(), factor).to(light.dtype)


def noise_of(frame: Tensor, side: int = 32) -> Tensor:
    """Return noise in [-1, 1] for all features but the constant, (B, side^2, 9), float64.

    The hash of pixel in block + side^2 (feature + 10 frame), divided by its largest value.

    Args:
        frame: Number of each frame (B,).
        side: Of a block.
    """
    pixels = torch.arange(side * side, device=frame.device)[:, None]
    features = torch.arange(1, FEATURES, device=frame.device)
    key = pixels + side * side * (features + FEATURES * frame.long()[:, None, None])
    return 2.0 * hashed(key).double() / 0xFFFFFFFF - 1.0


def hashed(key: Tensor) -> Tensor:
    """Return 32 well mixed bits of integers, of which the lower 32 bits count: MurmurHash3's finaliser."""
    key = key & 0xFFFFFFFF
    key = _multiplied(key ^ (key >> 16), 0x85EBCA6B)
    key = _multiplied(key ^ (key >> 13), 0xC2B2AE35)
    return key ^ (key >> 16)


def mirrored(place: Tensor, size: int) -> Tensor:
    """Return places inside an image of this size: -1 is 0, -2 is 1 and so on, at both ends."""
    period = place.remainder(2 * size)
    return torch.minimum(period, 2 * size - 1 - period)


def _multiplied(key: Tensor, factor: int) -> Tensor:
    """Return the lower 32 bits of a product, whose halves fit into 63 bits."""
    low, high = key & 0xFFFF, key >> 16
    return (low * factor + ((high * factor & 0xFFFF) << 16)) & 0xFFFFFFFF


def _places(first: Tensor, size: int, side: int) -> Tensor:
    """Return the rows or columns (B, side n) of all blocks along an axis, of which the first begins there."""
    count = -(-size // side) + 1
    return first[:, None] + torch.arange(count * side, device=first.device)


def _cut(data: Tensor, rows: Tensor, columns: Tensor, side: int) -> Tensor:
    """Return blocks (B, N, side^2, C) of images (B, C, H, W) at rows (B, side) and columns (B, side N)."""
    image = torch.arange(len(data), device=data.device)[:, None, None]
    strip = data.permute(0, 2, 3, 1)[image, rows[:, :, None], columns[:, None, :]]
    return strip.unflatten(2, (-1, side)).transpose(1, 2).flatten(2, 3)


def _joined(blocks: Tensor, side: int) -> Tensor:
    """Return a strip (B, side, side N, C) of blocks (B, N, side^2, C): the inverse of `_cut`."""
    rows = blocks.unflatten(2, (side, side)).transpose(1, 2)
    return rows.flatten(2, 3)


def _cut_back(whole: Tensor, top: Tensor, left: Tensor, size: tuple[int, int]) -> Tensor:
    """Return images (B, C, H, W) out of images (B, R, W, C) that begin at rows `top` and columns `left`."""
    rows, columns = (
        torch.arange(length, device=whole.device) - first[:, None]
        for length, first in zip(size, (top, left), strict=True)
    )
    image = torch.arange(len(whole), device=whole.device)[:, None, None]
    return whole[image, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)
