"""The vocabulary of buffers: what each image of a frame is called and what its numbers mean.

This is a leaf module (standard library only) that every other part shares. A *buffer* is an image of one
frame; a *frame number* is one value, or a few, that belong to the whole frame and not to a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal["radiance", "ratio", "vector", "distance", "count", "variance"]
Repair = Literal["neighbours", "no_hit"]


@dataclass(frozen=True)
class Buffer:
    """One entry of the vocabulary.

    Attributes:
        name: The word used everywhere: in batches, shards, exported artifacts and our own EXR files.
        channels: Number of channels, or 0 where a list of channels describes the buffer (`samples`).
        letters: EXR channel letters, or names, in the order of the array's channels.
        kind: `radiance` scales with exposure, `vector` turns with the image if it lives in the image plane.
        unit: Unit of the stored value.
        low: Smallest legal value (None: unbounded).
        high: Largest legal value (None: unbounded).
        no_hit: Value of a pixel whose rays left the scene.
        half: Whether half precision holds its range and precision.
        repair: What replaces NaN and Inf: the mean of the finite 3x3 neighbours, or `no_hit`.
        meaning: One sentence.
    """

    name: str
    channels: int
    letters: str | tuple[str, ...]
    kind: Kind
    unit: str
    low: float | None
    high: float | None
    no_hit: float
    half: bool
    repair: Repair
    meaning: str


def _radiance(name: str, meaning: str) -> Buffer:
    return Buffer(name, 3, "RGB", "radiance", "linear radiance", 0.0, None, 0.0, True, "neighbours", meaning)


HISTOGRAM = "histogram"
"""Name of the buffer with the histograms of the samples of each pixel."""

HISTOGRAM_BINS = 20
"""Bins of each colour channel."""

HISTOGRAM_MADE = (
    "trainer render stills --histogram writes histograms, and trainer render samples keeps samples apart, "
    "from which they follow"
)
"""Where the buffer comes from, which few frames have."""

SECOND_ALBEDO = "second_albedo"
"""Name of the buffer with the reflectance of the second hits."""

SECOND_HIT_MADE = (
    "trainer render stills --second-hit writes the albedo of the second hit, with halves and variance, and "
    "those of the position"
)
"""Where `second_albedo` and `position_variance` come from, which few frames have."""

_PLAIN = (
    _radiance("color", "Noisy radiance, with albedo."),
    _radiance(
        "irradiance",
        "Radiance divided by `albedo`; of this frame alone, or accumulated over the preceding frames where "
        "the frame or the manifest says so.",
    ),
    Buffer(
        "albedo",
        3,
        "RGB",
        "ratio",
        "reflectance",
        0.0,
        None,
        1.0,
        True,
        "no_hit",
        "Effective albedo that `irradiance` was divided by: diffuse plus specular reflectance, 1 where "
        "nothing is known (emitters, background).",
    ),
    Buffer(
        "diffuse_albedo",
        3,
        "RGB",
        "ratio",
        "reflectance",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Diffuse reflectance of the first hit, 0 without a diffuse lobe.",
    ),
    Buffer(
        "specular_albedo",
        3,
        "RGB",
        "ratio",
        "reflectance",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Specular reflectance of the first hit at normal incidence, 0 for diffuse surfaces.",
    ),
    Buffer(
        SECOND_ALBEDO,
        3,
        "RGB",
        "ratio",
        "reflectance",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Diffuse plus specular reflectance, at most 1, of what each path hits second; 0 where it left the "
        "scene or ended before.",
    ),
    Buffer(
        "normal",
        3,
        "XYZ",
        "vector",
        "unit vector",
        -1.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Shading normal in world space, shorter than 1 where a pixel mixes surfaces.",
    ),
    Buffer(
        "depth",
        1,
        "Z",
        "distance",
        "scene units",
        0.0,
        None,
        0.0,
        False,
        "no_hit",
        "Distance from the camera; z or Euclidean as the manifest says.",
    ),
    Buffer(
        "position",
        3,
        "XYZ",
        "distance",
        "scene units",
        None,
        None,
        0.0,
        False,
        "no_hit",
        "First hit in world space.",
    ),
    Buffer(
        "motion",
        2,
        "XY",
        "vector",
        "pixels",
        None,
        None,
        0.0,
        True,
        "no_hit",
        "Previous pixel minus this pixel of the same world point; x to the right, y down.",
    ),
    Buffer(
        "visibility",
        1,
        "Z",
        "ratio",
        "fraction",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Unoccluded fraction of the light samples.",
    ),
    Buffer(
        "roughness",
        1,
        "Z",
        "ratio",
        "microfacet alpha",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Roughness of the first hit: 0 smooth, 1 diffuse.",
    ),
    Buffer(
        "hit",
        1,
        "Z",
        "ratio",
        "fraction",
        0.0,
        1.0,
        0.0,
        True,
        "no_hit",
        "Fraction of the pixel's samples that hit something.",
    ),
    _radiance("diffuse", "Radiance that left the first hit through its diffuse lobe, with albedo."),
    _radiance("specular", "Radiance that left the first hit through its specular lobes."),
    _radiance("reference", "Converged radiance, with albedo: the target."),
    _radiance("reference_diffuse", "The part of `reference` that left its first hit as diffuse light."),
    Buffer(
        "history",
        1,
        "Z",
        "count",
        "frames",
        0.0,
        None,
        1.0,
        True,
        "no_hit",
        "Number of frames accumulated in `irradiance`.",
    ),
    Buffer(
        HISTOGRAM,
        3 * HISTOGRAM_BINS,
        tuple(f"{color}{place:02d}" for color in "RGB" for place in range(HISTOGRAM_BINS)),
        "count",
        "samples",
        0.0,
        None,
        0.0,
        False,
        "no_hit",
        "How many of the pixel's samples lie in each of 20 bins, of red, green and blue.",
    ),
)


def _derived(buffer: Buffer) -> tuple[Buffer, ...]:
    halves = tuple(
        replace(buffer, name=f"{buffer.name}_{half}", meaning=f"Half {half.upper()} of `{buffer.name}`.")
        for half in "ab"
    )
    variance = replace(
        buffer,
        name=f"{buffer.name}_variance",
        kind="variance",
        low=0.0,
        high=None,
        no_hit=0.0,
        half=False,
        repair="no_hit",
        meaning=f"Variance of the mean of `{buffer.name}`, per channel.",
    )
    return (*halves, variance)


_SINGLE = ("reference", "reference_diffuse", "history", "hit", HISTOGRAM)
"""Buffers without halves and variance."""

BUFFERS: dict[str, Buffer] = {b.name: b for b in _PLAIN}
BUFFERS |= {d.name: d for b in _PLAIN if b.name not in _SINGLE for d in _derived(b)}

THIN_LENS = "thin_lens"
"""Frame number that describes the camera's lens."""

FRAME_NUMBERS: dict[str, int] = {"exposure": 1, "depth_range": 2, THIN_LENS: 3}
"""Numbers of a whole frame and how many each has: the factor that brings radiance to a displayable level
(1 where absent), the smallest and largest depth of the whole frame, which a crop cannot know, and the
camera's aperture radius, focus distance (both in the unit of depth, 0 for a pinhole) and field of view in
degrees (all 0 where unknown)."""


@dataclass(frozen=True)
class SampleChannel:
    """One quantity that a renderer writes for every sample.

    Attributes:
        letters: Names of its channels in files, in order.
        low: Smallest legal value (None: unbounded).
        high: Largest legal value (None: unbounded).
        no_hit: Value where the ray left the scene, and what replaces NaN and Inf.
        half: Whether half precision holds its range and precision.
        meaning: One sentence.
    """

    letters: tuple[str, ...]
    low: float | None
    high: float | None
    no_hit: float
    half: bool
    meaning: str


def _numbers(count: int) -> tuple[str, ...]:
    return tuple(f"{i:02d}" for i in range(count))


def _as_samples(*names: str) -> dict[str, SampleChannel]:
    """Return the entries of plain buffers, as they are in a single sample."""
    plain = {name: BUFFERS[name] for name in names}
    return {
        n: SampleChannel(tuple(b.letters), b.low, b.high, b.no_hit, b.half, b.meaning)
        for n, b in plain.items()
    }


SAMPLE_BUFFERS: dict[str, SampleChannel] = {
    "radiance": SampleChannel(tuple("RGB"), 0.0, None, 0.0, True, "Radiance of the sample, with albedo."),
    **_as_samples("diffuse", "specular", "normal", "depth", "position", "diffuse_albedo", "specular_albedo"),
    **_as_samples("roughness", "visibility", "hit"),
    "motion": SampleChannel(
        tuple("XY"), None, None, 0.0, True, "Displacement of the hit point over the shutter, in pixels."
    ),
    "coc": SampleChannel(
        ("Z",),
        None,
        None,
        0.0,
        True,
        "Signed circle of confusion, a diameter in pixels; > 0 behind the focus.",
    ),
    "lens": SampleChannel(tuple("XY"), -1.0, 1.0, 0.0, True, "Position on the lens, in the unit disc."),
    "time": SampleChannel(("Z",), 0.0, 1.0, 0.0, True, "Time within the shutter."),
    "offset": SampleChannel(tuple("XY"), 0.0, 1.0, 0.5, True, "Position within the pixel."),
    "first_normal": SampleChannel(tuple("XYZ"), -1.0, 1.0, 0.0, True, "Normal of the first hit of any kind."),
    "first_depth": SampleChannel(("Z",), 0.0, None, 0.0, False, "Depth of the first hit of any kind."),
    "first_albedo": SampleChannel(tuple("RGB"), 0.0, 1.0, 0.0, True, "Albedo of the first hit of any kind."),
    "path_probability": SampleChannel(
        _numbers(24), None, None, 0.0, False, "Four probability densities per path vertex (SBMC)."
    ),
    "light_direction": SampleChannel(
        _numbers(12), None, None, 0.0, False, "Two angles to the light per path vertex (SBMC)."
    ),
    "bounce": SampleChannel(
        _numbers(30), 0.0, 1.0, 0.0, True, "Five flags per path vertex: kind of the bounce (SBMC)."
    ),
}
"""What `Frame.samples` may hold. Channels are called `<name>.<letter>`, such as `radiance.R`."""


SAMPLES = "samples"
"""Name under which the samples of each pixel are stored, (S, C, H, W), and read by networks."""


MAY_BE_INFINITE = frozenset({"depth", "first_depth", "position", "path_probability"})
"""Per-sample quantities whose infinity has a meaning: a ray that left the scene, or a direction without
alternative. It is read as the value of a ray that left the scene."""


def sample_channels(*names: str) -> tuple[str, ...]:
    """Return the channels of per-sample quantities in order, such as `normal.X`, `normal.Y`, `normal.Z`.

    Raises:
        ValueError: A name is not in the vocabulary.
    """
    for name in names:
        if name not in SAMPLE_BUFFERS:
            raise ValueError(f"unknown per-sample quantity {name!r}; known: {', '.join(SAMPLE_BUFFERS)}")
    return tuple(f"{name}.{letter}" for name in names for letter in SAMPLE_BUFFERS[name].letters)


def buffer(name: str) -> Buffer:
    """Return the vocabulary entry called `name`.

    Raises:
        ValueError: The name is not in the vocabulary; the message lists what is.
    """
    try:
        return BUFFERS[name]
    except KeyError:
        plain = ", ".join(b.name for b in _PLAIN)
        raise ValueError(
            f"unknown buffer {name!r}; known: {plain}, each also as <name>_a, <name>_b, <name>_variance"
        ) from None
