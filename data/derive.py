"""Buffers computed from others, each in one place: albedo, irradiance, colour, depth, motion, exposure."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from data import camera as cameras
from data.buffers import BUFFERS, HISTOGRAM, HISTOGRAM_MADE, SECOND_ALBEDO, SECOND_HIT_MADE
from data.camera import Camera, DepthKind
from data.dropped import mean as mean_of_samples
from data.frame import Frame, Image, Samples
from data.histograms import sample_histogram

ALBEDO_FLOOR = 0.01
"""Smallest effective albedo per channel. Division by it raises radiance at most a hundredfold, which keeps
irradiance of darker surfaces within half precision; being multiplied back, it changes no result."""

EXPOSURE_KEY = 0.18
"""Grey that `automatic_exposure` maps the mean log luminance to."""


_ROWS = 16
"""Rows that are worked on at a time, so that double precision stays within the cache."""


def effective_albedo(diffuse: Image, specular: Image | None = None) -> Image:
    """Return what radiance is divided by, (H, W, 3) in [0.01, 1].

    The sum of diffuse and specular reflectance clipped to at most 1, so that metals, mirrors and glass keep
    their texture; 1 where all channels are 0 and nothing is known (emitters, background, black materials);
    then at least `ALBEDO_FLOOR` in each channel.

    Args:
        diffuse: Diffuse reflectance (H, W, 3).
        specular: Specular reflectance at normal incidence, where the frame has it.
    """
    total = diffuse if specular is None else diffuse + specular
    unknown = (total <= 0).all(axis=-1, keepdims=True)
    return np.where(unknown, np.float32(1), np.clip(total, ALBEDO_FLOOR, 1)).astype(np.float32)


def demodulate(color: Image, albedo: Image) -> Image:
    """Return irradiance, `color / albedo` (H, W, 3).

    Raises:
        ValueError: Some albedo is not positive, so multiplying back would lose radiance.
    """
    if not (albedo > 0).all():
        raise ValueError("albedo has values <= 0, which cannot be divided by; use effective_albedo")
    return (color / albedo).astype(np.float32)


def remodulate(irradiance: Image, albedo: Image) -> Image:
    """Return radiance, `irradiance * albedo` (H, W, 3): the inverse of `demodulate` to float32 rounding."""
    return (irradiance * albedo).astype(np.float32)


def luminance(color: Image) -> Image:
    """Return the Rec. 709 luminance (H, W) of linear RGB, with OIDN's weights."""
    return np.asarray(color @ np.array([0.212671, 0.715160, 0.072169], np.float32), np.float32)


def automatic_exposure(color: Image) -> float:
    """Return the exposure that OIDN would use: 0.18 / 2^mean(log2 L).

    L are the mean luminances of bins of at most 16x16 pixels, of which those above 1e-8 count. An image
    without any (all black) gets 1, the exposure that changes nothing.

    Source: Open Image Denoise, autoexposure.
    """
    light = luminance(color).astype(np.float64)
    height, width = light.shape
    rows = np.arange(-(-height // 16)) * height // -(-height // 16)
    columns = np.arange(-(-width // 16)) * width // -(-width // 16)
    sums = np.add.reduceat(np.add.reduceat(light, rows, axis=0), columns, axis=1)
    heights = np.diff(np.append(rows, height))[:, None]
    widths = np.diff(np.append(columns, width))[None, :]
    bins = sums / (heights * widths)
    lit = bins[bins > 1e-8]
    return float(EXPOSURE_KEY / np.exp2(np.log2(lit).mean())) if lit.size else 1.0


def derive(
    frame: Frame,
    names: Iterable[str],
    *,
    depth_kind: DepthKind = "euclidean",
    previous: Camera | None = None,
    variance_from_halves: bool = False,
) -> Frame:
    """Return the frame with the named buffers added where they are absent.

    albedo, its halves and variance from diffuse_albedo and specular_albedo; irradiance = color / albedo;
    color = diffuse + specular, or irradiance * albedo; specular = color - diffuse and the reverse; depth from
    position and camera; motion from position and both cameras; hit from depth; history 1 for frames that are
    not accumulated; histogram from samples that are kept apart, exposed. Any buffer is the mean of its halves
    of equal size, and either half is twice the mean less the other.
    `notes["derived"]` of the result records each with its rule.

    Args:
        frame: The frame, left as it is.
        names: Buffers that are wanted; those already there are not touched.
        depth_kind: What depth means in this data set.
        previous: Camera of the preceding frame, for motion.
        variance_from_halves: Allow `<name>_variance` = ((a - b) / 2)^2, which is right in the mean but has,
            with two values per pixel, as much noise as signal: filter it before use.

    Raises:
        ValueError: A buffer is absent and what it would be derived from is too; the message names both.
    """
    result = frame.with_buffers()
    result.notes["derived"] = dict(frame.notes.get("derived", {}))
    context = _Context(result, depth_kind, previous, variance_from_halves)
    for name in names:
        context.need(name)
    return result


def obtainable(
    frame: Frame,
    names: Iterable[str],
    *,
    depth_kind: DepthKind = "euclidean",
    previous: Camera | None = None,
) -> set[str]:
    """Return which of these buffers a frame has or `derive` adds; found out on a frame of one pixel.

    Args:
        frame: The frame.
        names: Buffers that are asked for.
        depth_kind: As for `derive`.
        previous: As for `derive`.
    """
    pixels = {name: np.ones((1, 1, array.shape[2]), np.float32) for name, array in frame.buffers.items()}
    kept = frame.samples
    first = None if kept is None else Samples(kept.values[:1, :1, :1], kept.channels)
    pixel = replace(frame, buffers=pixels, samples=first, notes={})
    found = set()
    for name in names:
        with suppress(ValueError):
            derive(pixel, [name], depth_kind=depth_kind, previous=previous)
            found.add(name)
    return found


_LOOKED_AT = {
    "irradiance": ("color", "albedo"),
    "color": ("diffuse", "specular", "irradiance", "albedo"),
    "depth": ("position", "normal"),
    "motion": ("position", "normal"),
    "diffuse": ("specular", "color", "irradiance"),
    "specular": ("diffuse", "color", "irradiance"),
    "hit": ("depth",),
    **{f"diffuse_{half}": (f"specular_{half}", f"color_{half}") for half in "ab"},
    **{f"specular_{half}": (f"diffuse_{half}", f"color_{half}") for half in "ab"},
    **{
        f"albedo{part}": (f"diffuse_albedo{part}", f"specular_albedo{part}")
        for part in ("", "_a", "_b", "_variance")
    },
}
"""Buffers that the rules of `derive` look at, beside halves and means."""


def sources(names: Iterable[str], has: Collection[str]) -> set[str]:
    """Return those buffers of a frame that `derive` looks at in order to make others.

    Args:
        names: What is to be made; what the frame has already stands for itself.
        has: The buffers of the frame.

    Returns:
        Enough of `has` that `derive` makes the same from these alone.
    """
    found: set[str] = set()
    seen: set[str] = set()
    pending = list(names)
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        if name in has:
            found.add(name)
            continue
        base, _, part = name.rpartition("_")
        pending += _LOOKED_AT.get(name, ())
        for mean in (name, base) if part in ("a", "b", "variance") else (name,):
            pending += {mean, f"{mean}_a", f"{mean}_b"} & {*has, *_LOOKED_AT}
    return found


_OF_SECOND_HITS = frozenset(
    {SECOND_ALBEDO, *(f"{n}_{part}" for n in (SECOND_ALBEDO, "position") for part in ("a", "b", "variance"))}
)
"""Buffers that one option of `trainer render` writes."""


class _Context:
    """One call of `derive`: the growing frame and the parameters of its rules."""

    def __init__(
        self, frame: Frame, depth_kind: DepthKind, previous: Camera | None, variance_from_halves: bool
    ) -> None:
        self.frame, self.depth_kind, self.previous = frame, depth_kind, previous
        self.variance_from_halves = variance_from_halves
        self.rules: dict[str, Callable[[], tuple[Image, str]]] = {
            "albedo": self._albedo,
            **{f"albedo{part}": partial(self._albedo, part) for part in ("_a", "_b", "_variance")},
            "irradiance": self._irradiance,
            "color": self._color,
            "depth": self._depth,
            "motion": self._motion,
            "diffuse": partial(self._rest, "diffuse", "specular"),
            "specular": partial(self._rest, "specular", "diffuse"),
            **{f"diffuse_{h}": partial(self._rest_of_half, "diffuse", "specular", h) for h in "ab"},
            **{f"specular_{h}": partial(self._rest_of_half, "specular", "diffuse", h) for h in "ab"},
            "hit": self._hit,
            "history": self._history,
            HISTOGRAM: self._histogram,
        }

    def need(self, name: str) -> Image:
        buffers = self.frame.buffers
        if name not in buffers:
            array, rule = self._of_halves(name) or self._rule(name)
            buffers[name] = np.asarray(array, np.float32)
            self.frame.notes["derived"][name] = rule
        return buffers[name]

    def _rule(self, name: str) -> tuple[Image, str]:
        if name not in self.rules:
            hint = SECOND_HIT_MADE if name in _OF_SECOND_HITS else ""
            self.frame.require(name, hint=hint)
        return self.rules[name]()

    def _of_halves(self, name: str) -> tuple[Image, str] | None:
        """Derive a mean, a half or a variance from what there is of the mean and its halves."""
        buffers = self.frame.buffers
        if {f"{name}_a", f"{name}_b"} <= buffers.keys():
            mean = np.float32(0.5) * (buffers[f"{name}_a"] + buffers[f"{name}_b"])
            return mean, f"mean of {name}_a and {name}_b"
        base, _, part = name.rpartition("_")
        if part in ("a", "b"):
            other = f"{base}_{'b' if part == 'a' else 'a'}"
            if {base, other} <= buffers.keys():
                return 2 * buffers[base] - buffers[other], f"2 * {base} - {other}"
        if part == "variance" and self.variance_from_halves and base in BUFFERS:
            halves = [f"{base}_a", f"{base}_b"]
            if base in buffers or set(halves) <= buffers.keys():
                a, b = (self.need(half) for half in halves)
                return (np.float32(0.5) * (a - b)) ** 2, f"(({base}_a - {base}_b) / 2)^2"
        return None

    def _fail(self, name: str, needed: str) -> ValueError:
        return ValueError(
            f"{self.frame.label}: missing buffer {name!r}, and {needed} to derive it from is missing too; "
            f"it has {', '.join(self.frame.buffers)}"
        )

    def _albedo(self, part: str = "") -> tuple[Image, str]:
        diffuse = self.frame.buffers.get(f"diffuse_albedo{part}")
        specular = self.frame.buffers.get(f"specular_albedo{part}")
        if diffuse is None:
            raise self._fail(f"albedo{part}", f"diffuse_albedo{part} (and specular_albedo{part})")
        names = f"diffuse_albedo{part}" + ("" if specular is None else f" + specular_albedo{part}")
        if part == "_variance":
            return diffuse if specular is None else diffuse + specular, names
        return effective_albedo(diffuse, specular), f"{names}, 1 where 0, at least {ALBEDO_FLOOR}"

    def _irradiance(self) -> tuple[Image, str]:
        if not {"color", "color_a", "diffuse"} & self.frame.buffers.keys():
            raise self._fail("irradiance", "color")
        return demodulate(self.need("color"), self.need("albedo")), "color / albedo"

    def _color(self) -> tuple[Image, str]:
        buffers = self.frame.buffers
        if {"diffuse", "specular"} <= buffers.keys():
            return buffers["diffuse"] + buffers["specular"], "diffuse + specular"
        if "irradiance" not in buffers:
            raise self._fail("color", "irradiance and albedo, diffuse and specular, or color_a and color_b,")
        return remodulate(buffers["irradiance"], self.need("albedo")), "irradiance * albedo"

    def _depth(self) -> tuple[Image, str]:
        position, camera = self.frame.buffers.get("position"), self.frame.camera
        if position is None or camera is None:
            raise self._fail("depth", "position" if position is None else "the camera")
        if self.depth_kind == "z":
            depth = cameras.depth(camera, np.ascontiguousarray(position), "z")
        else:
            depth = _distance(position, camera.centre())
        np.maximum(depth, 0, out=depth)
        depth[no_hit(self.frame)] = 0
        rule = (
            "w of the projected position"
            if self.depth_kind == "z"
            else "distance of position from the camera"
        )
        return depth, rule

    def _motion(self) -> tuple[Image, str]:
        position, camera = self.frame.buffers.get("position"), self.frame.camera
        if position is None or camera is None or self.previous is None:
            raise self._fail(
                "motion", "position" if position is None else "the camera of this or the last frame"
            )
        motion = cameras.motion(np.ascontiguousarray(position), camera, self.previous)
        return np.where(no_hit(self.frame), np.float32(0), motion), "position and both cameras"

    def _rest(self, name: str, other: str) -> tuple[Image, str]:
        if other not in self.frame.buffers:
            raise self._fail(name, other)
        if not {"color", "color_a", "irradiance"} & self.frame.buffers.keys():
            raise self._fail(name, "color")
        rest = self.need("color") - self.frame.buffers[other]
        return np.maximum(rest, 0), f"color - {other}, at least 0"

    def _rest_of_half(self, name: str, other: str, half: str) -> tuple[Image, str]:
        """Return color - other of one half; not clipped, so that the mean of both halves stays right."""
        needed = [f"color_{half}", f"{other}_{half}"]
        for part in needed:
            if part not in self.frame.buffers:
                raise self._fail(f"{name}_{half}", part)
        color, rest = (self.frame.buffers[part] for part in needed)
        return color - rest, f"color_{half} - {other}_{half}"

    def _hit(self) -> tuple[Image, str]:
        return (self.need("depth") > 0).astype(np.float32), "depth > 0"

    def _history(self) -> tuple[Image, str]:
        if self.frame.accumulated:
            raise self._fail("history", "the count of accumulated frames")
        return np.ones((self.frame.height, self.frame.width, 1), np.float32), "1, not accumulated"

    def _histogram(self) -> tuple[Image, str]:
        samples = self.frame.samples
        if samples is None or "radiance" not in samples.names:
            raise ValueError(f"{self._fail(HISTOGRAM, 'the radiance of each sample')}; {HISTOGRAM_MADE}")
        radiance = samples.get("radiance")
        exposure = self.frame.exposure or automatic_exposure(np.nan_to_num(mean_of_samples(radiance)))
        return sample_histogram(radiance, exposure), f"samples times exposure {exposure:.6g}"


def _distance(position: Image, centre: NDArray[np.float64]) -> Image:
    """Return `data.camera.depth` of kind euclidean, (H, W, 1), row by row so that it stays in the cache."""
    height, width, _ = position.shape
    result = np.empty((height, width, 1), np.float32)
    part, total = np.empty((_ROWS, width)), np.empty((_ROWS, width))
    for top in range(0, height, _ROWS):
        rows = position[top : top + _ROWS]
        offset, squares = part[: len(rows)], total[: len(rows)]
        for axis in range(3):
            np.subtract(rows[..., axis], centre[axis], out=offset)
            np.multiply(offset, offset, out=squares if axis == 0 else offset)
            if axis:
                np.add(squares, offset, out=squares)
        result[top : top + _ROWS, :, 0] = np.sqrt(squares, out=squares)
    return result


def no_hit(frame: Frame) -> NDArray[np.bool_]:
    """Return where nothing was hit (H, W, 1): position exactly 0, and so is the normal where there is one."""
    nothing = np.ones((frame.height, frame.width), bool)
    for name in ("position", "normal"):
        if name in frame.buffers and nothing.any():
            for channel in np.moveaxis(frame.buffers[name], -1, 0):
                nothing &= channel == 0
    return nothing[..., None]
