"""SVGF: spatiotemporal variance-guided filtering of one sample per pixel, in real time.

Christoph Schied, Anton Kaplanyan, Chris Wyman, Anjul Patney, Chakravarty R. Alla Chaitanya, John Burgess,
Shiqiu Liu, Carsten Dachsbacher, Aaron Lefohn, Marco Salvi: "Spatiotemporal Variance-Guided Filtering:
Real-Time Reconstruction for Path-Traced Global Illumination", High Performance Graphics 2017,
doi:10.1145/3105762.3105770.

Irradiance and the first two moments of its luminance are accumulated over the preceding frames as far as
these show the same surface; the moments give a variance per pixel, with which five a-trous iterations decide
how different neighbours may be. The result of the first iteration is the history of the next frame.

Where the released pass (in the Falcor framework) and the paper differ:

    point                      here by default                       the other, as an option
    iterations, history after  5, the first (paper)                  4, the second
    alpha of the colour        0.2 (paper)                           0.05
    sigma of luminances        4 (paper)                             10
    pixels with less than 4    also their colour is averaged over    prefilter=False: only their variance is
    frames                     7x7 neighbours (pass)                 that of their neighbours (paper)
    change of depth to a       steepest slope times distance (pass)  slope=along: slope in its direction
    neighbour                                                        times distance (paper)
    border of the image        takes part (paper says nothing)       margin=1: accumulates nothing (pass)

Mesh numbers, which the paper also compares, frames do not have. Direct and indirect light, which it filters
by themselves, come as one `irradiance`. Slopes are those of `models.ops.slopes`, not of 2x2 pixels. The count
of frames comes from all accepted neighbours, as the colour does; the pass takes the nearest pixel's, which
may show another surface. Normals are brought to unit length: in half precision the 128th power of a normal's
product with itself is anything from 0.88 to 1.13. The pass lets depths differ by 10 times their variation
plus 0.01 scene units, which suits scenes of some metres; here it is 0.001 of the depth unless told.
Antialiasing is a pass of its own in both; the one here is BMFR's. Luminances are multiplied by
`exposure` before they are compared, since constants are added to their variance.

Last of nine frames of 320x180 with one sample per pixel (classroom, glossy Cornell box, living room; PSNR in
dB, exposed, gamma 2.2): input 5.7, 15.5, 9.9; result 20.5, 24.4, 24.0; without antialiasing 19.7, 23.8, 23.3,
and then with 4, the second, 0.05 and 10 from the table 20.1, 22.7, 22.5.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from models.classical.sequence_filter import SequenceFilter, carried, checked, follows
from models.denoiser import Buffers, Denoised, Denoiser, State
from models.ops.atrous import (
    EdgeStops,
    Slope,
    Surfaces,
    atrous_taps,
    box_taps,
    edge_stopping_means,
    luminance,
    smoothed_variance,
)
from models.ops.boxes import exporting
from models.ops.guides import finite
from models.ops.reproject import Neighbours, bilinear, position_limit, surrounding
from models.ops.slopes import variation

Geometry = Literal["depth", "position"]
"""What tells whether two frames show the same surface, beside normals."""

RELATIVE_FLOOR = 0.001
"""Difference of depth, relative to the depth, that counts as no variation yet."""

_LEAST_VARIANCE = 1e-10


class _Past(NamedTuple):
    """What is known of pixels: colour (B, 3, H, W), moments (B, 2, H, W), number of frames (B, 1, H, W)."""

    color: Tensor
    moments: Tensor
    frames: Tensor


class SVGF(SequenceFilter):
    """Spatiotemporal variance-guided filter, for sequences of few samples per pixel.

    State: `color`, accumulated irradiance after iteration `feedback`; `moments` of the luminance; `count` of
    accumulated frames; `normal`; `depth` or `position`; `output`, where `taa` is on.

    Args:
        iterations: Number of a-trous iterations, whose taps are 1, 2, 4 … pixels apart.
        feedback: Iteration whose result is the history of the next frame; 0: what enters the first.
        alpha: Least weight of the new frame's colour.
        moments_alpha: The same for the moments.
        longest: Largest number of frames that is counted.
        sigma_z: How far depths may differ, relative to what their slope explains.
        sigma_n: Exponent of the cosine between normals.
        sigma_l: How far luminances may differ, in standard deviations.
        slope: `steepest` or `along`, see `models.ops.atrous`.
        young: Pixels with fewer frames take their variance from their neighbours.
        young_radius: Of the window of these neighbours.
        prefilter: These pixels also become the mean of their neighbours.
        geometry: What is compared with the frame before: `depth`, or `position`, which stays as it is when
            the camera moves forwards and which then is read as well.
        depth_limit: How far depths may differ, in their variation around the pixel plus `depth_floor`.
        depth_floor: In scene units; None: `RELATIVE_FLOOR` of the pixel's depth.
        normal_limit: How far normals may differ, in their variation around the pixel plus `normal_floor`.
        normal_floor: Length of a difference of unit vectors.
        position_limit_squared: With `position`: squared distance within which points are one surface's, in
            squared scene units; None: 6 pixels' footprints, see `models.ops.reproject.footprint`.
        least_share: Where the accepted of the four bilinear neighbours have less, the mean of 3x3 is taken.
        margin: Width of the border of the frame before that is not looked at.
        taa: Antialias the result over time, see `models.ops.antialiasing`.
        taa_new: Weight of the new frame there.
        aux: Also return `history`, the number of frames, and `variance`, that of the luminance which entered
            the first iteration, in squared units of the irradiance, both (B, 1, H, W).
        fused: Whether compiled kernels take over, None: where possible; see `models.ops.nlm.use_fused`.

    Raises:
        ValueError: A number is out of its range or a word unknown.
    """

    inputs: tuple[str, ...] = ("irradiance", "albedo", "normal", "depth", "motion")
    bytes_per_pixel = 700

    def __init__(
        self,
        iterations: int = 5,
        feedback: int = 1,
        *,
        alpha: float = 0.2,
        moments_alpha: float = 0.2,
        longest: int = 32,
        sigma_z: float = 1.0,
        sigma_n: float = 128.0,
        sigma_l: float = 4.0,
        slope: Slope = "steepest",
        young: int = 4,
        young_radius: int = 3,
        prefilter: bool = True,
        geometry: Geometry = "depth",
        depth_limit: float = 10.0,
        depth_floor: float | None = None,
        normal_limit: float = 16.0,
        normal_floor: float = 0.01,
        position_limit_squared: float | None = None,
        least_share: float = 0.01,
        margin: int = 0,
        taa: bool = True,
        taa_new: float = 0.2,
        aux: bool = False,
        fused: bool | None = None,
    ) -> None:
        arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__()
        self._arguments = arguments
        _check(arguments)
        self.iterations, self.feedback, self.longest = iterations, feedback, longest
        self.young, self.young_radius = young, young_radius
        self.alphas = (alpha, moments_alpha)
        self.stops, self.sigma_l = EdgeStops(sigma_z, sigma_n, slope), sigma_l
        self.prefilter, self.geometry, self.margin, self.aux = prefilter, geometry, margin, aux
        self.depth_limit, self.depth_floor = depth_limit, depth_floor
        self.normal_limit, self.normal_floor = normal_limit, normal_floor
        self.position_limit_squared, self.least_share = position_limit_squared, least_share
        self.taa_new, self.fused = (taa_new if taa else None), fused
        if geometry == "position":
            self.inputs = (*self.inputs, "position")

    def forward(self, buffers: Buffers, state: Mapping[str, Tensor] | None = None) -> Denoised:
        """Denoise a frame; see `Denoiser.forward`.

        Args:
            buffers: `irradiance` (B, 3, H, W) of this frame alone, linear radiance without albedo; `albedo`
                (B, 3, H, W) that it was divided by; `normal` (B, 3, H, W); `depth` (B, 1, H, W) in scene
                units, 0 where nothing was hit; `motion` (B, 2, H, W), previous pixel minus this pixel; with
                `geometry="position"` also `position` (B, 3, H, W). Optionally `exposure` (B,).
            state: That of the frame before, None: a sequence begins.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        light, exposure = self._exposed(buffers)
        seen = self._seen(buffers)
        grey = luminance(light)
        now = _Past(light, torch.cat([grey, grey.square()], 1), torch.ones_like(grey))
        before = None
        if state is not None and follows(state, light):
            before = (state, bilinear(buffers["motion"]))
            now = self._accumulated(now, before, seen, buffers["motion"], exposure)
        surfaces = Surfaces(seen["normal"], seen["depth"], self._reach(), self.stops)
        color, variance = self._with_variance(now, surfaces)
        filtered, remembered = self._filtered(color, variance, surfaces)
        output = self._finished(filtered, buffers, exposure, before, self.taa_new)
        scale = torch.cat([exposure, exposure.square()], 1)
        planes = {"color": remembered / exposure, "moments": now.moments / scale, "count": now.frames}
        if self.taa_new is not None:
            planes["output"] = output
        aux = {"history": now.frames, "variance": variance / exposure.square()}
        return Denoised(output, carried(**planes, **self._compared(seen)), aux if self.aux else None)

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return this method comparing depths where there are no positions; see `Denoiser.instead`."""
        other = SVGF(**{**self._arguments, "geometry": "depth"})
        if "position" in available or self.geometry == "depth" or not set(other.inputs) <= set(available):
            return None
        return other, ("no position: depths are compared, which a camera that moves forwards changes",)

    def _reach(self) -> int:
        return max(self.young_radius, 2 ** max(self.iterations, 1))

    def _seen(self, buffers: Buffers) -> State:
        """Return what pixels show: unit normals, depth, and positions where they are read."""
        seen = {"depth": finite(buffers["depth"]).clamp_min(0.0)}
        seen["normal"] = F.normalize(finite(buffers["normal"]), dim=1)
        if self.geometry == "position":
            seen["position"] = finite(buffers["position"])
        return seen

    def _compared(self, seen: State) -> State:
        return {name: seen[name] for name in ("normal", self.geometry)}

    def _accumulated(
        self,
        now: _Past,
        before: tuple[Mapping[str, Tensor], Neighbours],
        seen: State,
        motion: Tensor,
        exposure: Tensor,
    ) -> _Past:
        """Return colour and moments blended with those of the frame before, and the number of frames."""
        state, neighbours = before
        joined = torch.cat([state["color"], state["moments"], state["count"]], 1)
        four, nine = (
            found.only(self._same_surface(found, seen, state)) for found in (neighbours, surrounding(motion))
        )
        past = torch.where(four.total >= self.least_share, four.mean(joined), nine.mean(joined))
        known = (four.total >= self.least_share) | (nine.total > 0)
        count = torch.where(known, past[:, 5:] + 1, 1.0).clamp_max(float(self.longest))
        scale = torch.cat([exposure, exposure.square()], 1)
        blends = [torch.maximum(1 / count, count.new_tensor(alpha)) for alpha in self.alphas]
        return _Past(
            torch.lerp(past[:, :3] * exposure, now.color, blends[0]),
            torch.lerp(past[:, 3:5] * scale, now.moments, blends[1]),
            count,
        )

    def _same_surface(self, found: Neighbours, seen: State, state: Mapping[str, Tensor]) -> Tensor:
        """Return which neighbours show the surface that the pixel shows now, (B, K, H, W)."""
        normal, other = seen["normal"], seen[self.geometry]
        allowed = self.normal_limit * (variation(normal) + self.normal_floor)
        same = found.distances(normal, state["normal"]) <= allowed.square()
        apart = found.distances(other, state[self.geometry])
        if self.geometry == "position":
            same &= apart < position_limit(other, self.position_limit_squared)
        else:
            floor = RELATIVE_FLOOR * other if self.depth_floor is None else self.depth_floor
            same &= apart <= (self.depth_limit * (variation(other) + floor)).square()
        size = (normal.shape[-2], normal.shape[-1])
        return same & found.away_from_border(self.margin, size) if self.margin else same

    def _with_variance(self, now: _Past, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
        """Return the colour and the variance of its luminance (B, 1, H, W); young pixels ask around."""
        variance = _variance(now.moments)
        young = now.frames < self.young - 1e-3  # a mean's rounding makes no pixel young
        if not exporting() and not bool(young.any()):
            return now.color, variance
        joined, taps = torch.cat([now.color, now.moments], 1), box_taps(self.young_radius)
        spread = now.frames.new_tensor(self.sigma_l)
        around = edge_stopping_means(joined, joined[:, :0], spread, surfaces, taps, fused=self.fused).values
        guessed = _variance(around[:, 3:]) * (self.young / now.frames)
        color = torch.where(young, around[:, :3], now.color) if self.prefilter else now.color
        return color, torch.where(young, guessed, variance)

    def _filtered(self, color: Tensor, variance: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
        """Return the colour after all iterations and after that which the next frame gets."""
        remembered = color
        for iteration in range(self.iterations):
            spread = self.sigma_l * (smoothed_variance(variance) + _LEAST_VARIANCE).sqrt()
            taps = atrous_taps(2**iteration)
            color, variance = edge_stopping_means(color, variance, spread, surfaces, taps, fused=self.fused)
            if iteration + 1 == self.feedback:
                remembered = color
        return color, remembered


def _variance(moments: Tensor) -> Tensor:
    return (moments[:, 1:] - moments[:, :1].square()).clamp_min(0.0)


def _check(given: Mapping[str, Any]) -> None:
    positive = ("longest", "sigma_z", "sigma_n", "sigma_l", "depth_limit", "normal_limit", "least_share")
    shares = ("alpha", "moments_alpha", "taa_new")
    checked("SVGF", given, positive=(*positive, "position_limit_squared"), shares=shares)
    for name in ("iterations", "margin", "young", "young_radius", "depth_floor", "normal_floor"):
        if given[name] is not None and not given[name] >= 0:
            raise ValueError(f"SVGF: {name} must be at least 0, got {given[name]}")
    if not 0 <= given["feedback"] <= given["iterations"]:
        raise ValueError(
            f"SVGF: feedback must be an iteration, 0 to {given['iterations']}, got {given['feedback']}"
        )
    for name, words in (("slope", get_args(Slope)), ("geometry", get_args(Geometry))):
        if given[name] not in words:
            raise ValueError(f"SVGF: {name} must be {' or '.join(words)}, got {given[name]!r}")
