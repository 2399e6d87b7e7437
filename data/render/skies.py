"""Procedural environments as latitude-longitude pictures (256, 512): skies, studios, interiors, gradients.

As Mitsuba's `envmap` has it, the first row is straight up (+Y) and the last straight down, and columns are
half a pixel from the picture's edge: the first looks along -Z, a quarter of the width further is +X.

The clear sky is a gradient of our own with the ingredients of A. Preetham, P. Shirley, B. Smits, A practical
analytic model for daylight, SIGGRAPH 1999, DOI 10.1145/311535.311545: darker and bluer away from the horizon,
a bright halo around the sun, everything redder as the sun sinks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data.render.noise import SpaceNoise
from data.render.spec import Picture
from data.render.surfaces import unit
from data.render.textures import random_colour

Floats = NDArray[np.float64]
Rng = np.random.Generator

HEIGHT, WIDTH = 256, 512
GREY = 0.4
"""Reflectance of the surface by which the brightness of an environment is set."""


def directions(height: int = HEIGHT, width: int = WIDTH) -> Floats:
    """Return the unit direction of every pixel (height, width, 3)."""
    theta = np.arange(height)[:, None] / (height - 1) * np.pi
    phi = (np.arange(width) + 0.5)[None, :] / width * 2 * np.pi
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)], -1)


def solid_angles(height: int = HEIGHT, width: int = WIDTH) -> Floats:
    """Return the solid angle of every pixel (height, 1) in steradians."""
    edges = np.cos(np.clip((np.arange(height + 1) - 0.5) / (height - 1), 0, 1) * np.pi)
    return (-np.diff(edges) * 2 * np.pi / width)[:, None]


def ground_level(pixels: Floats) -> float:
    """Return the mean radiance of a horizontal surface of reflectance 0.4 under pixels (H, W, 3)."""
    height, width = pixels.shape[:2]
    cosine = np.maximum(directions(height, width)[..., 1], 0) * solid_angles(height, width)
    return float(GREY / np.pi * (pixels.mean(-1) * cosine).sum())


def sphere_level(pixels: Floats) -> float:
    """Return the mean radiance of pixels (H, W, 3) over all directions, times 0.4."""
    height, width = pixels.shape[:2]
    return float(GREY * (pixels.mean(-1) * solid_angles(height, width)).sum() / (4 * np.pi))


def _from_angles(elevation: float, azimuth: float) -> Floats:
    c = np.cos(elevation)
    return np.array([c * np.sin(azimuth), np.sin(elevation), -c * np.cos(azimuth)])


def disc(way: Floats, centre: Floats, diameter: float) -> Floats:
    """Return the coverage (H, W) of a disc of the sky, in [0, 1] with an edge of a pixel.

    Args:
        way: Directions (H, W, 3).
        centre: Direction of the middle (3,).
        diameter: In degrees.
    """
    angle = np.degrees(np.arccos(np.clip(way @ centre, -1, 1)))
    pixel = 180 / way.shape[0]
    return np.clip((diameter / 2 - angle) / pixel + 0.5, 0, 1)


def add_sun(pixels: Floats, centre: Floats, diameter: float, colour: Floats, share: float) -> Floats:
    """Return pixels (H, W, 3) with a sun that gives a surface facing it `share` times the sky's irradiance.

    Args:
        pixels: The sky without a sun.
        centre: Direction of the sun (3,).
        diameter: Of the disc in degrees, 2 or more: it has to be found by random samples.
        colour: Colour (3,), of any scale.
        share: Irradiance of the sun on a surface that faces it over the sky's on the ground.
    """
    cover = disc(directions(*pixels.shape[:2]), centre, diameter)
    angle = (cover * solid_angles(*pixels.shape[:2])).sum()
    irradiance = share * ground_level(pixels) * np.pi / GREY
    return pixels + cover[..., None] * (colour / colour.mean()) * irradiance / angle


def _ground(way: Floats, sky: Floats, rng: Rng) -> Floats:
    """Return the sky with a ground of random colour below the horizon."""
    colour = random_colour(rng) * 0.5 + 0.05
    below = np.clip(-way[..., 1:2] / 0.02, 0, 1)
    level = max(ground_level(sky), 1e-6) / GREY
    return sky * (1 - below) + below * colour * level * (1 + 0.5 * way[..., 1:2])


def _daylight(way: Floats, sun: Floats, turbidity: float) -> Floats:
    """Return a clear sky (H, W, 3) for the direction of the sun; the ground is not in it."""
    up, toward = np.maximum(way[..., 1], 0.0), np.clip(way @ sun, -1, 1)
    low = np.clip(1 - sun[1] / 0.45, 0, 1)
    zenith = np.array([0.16, 0.32, 0.75]) * (1 - 0.55 * low)
    haze = np.array([0.75, 0.85, 0.95]) * (1 - low) + np.array([1.1, 0.62, 0.3]) * low
    air = np.exp(-up * (9 - turbidity))[..., None]
    sky = zenith * (0.6 + 0.4 * up[..., None]) * (1 - air) + haze * air * (0.6 + 0.4 * toward[..., None])
    halo = np.exp(-np.arccos(toward) * (7 - turbidity / 2))[..., None]
    glow = np.array([1.0, 0.95, 0.85]) * (1 - low) + np.array([1.4, 0.6, 0.2]) * low
    return sky + halo * glow * (1 + turbidity / 3)


def _clouds(way: Floats, rng: Rng, cover: float) -> tuple[Floats, Floats]:
    """Return the opacity (H, W, 1) and brightness (H, W, 1) of a layer of clouds."""
    noise = SpaceNoise(rng)
    flat = way / (np.maximum(way[..., 1:2], 0) + 0.12)
    flat[..., 1] = rng.uniform(0, 9)
    scale = rng.uniform(0.6, 1.6)
    above = flat[: HEIGHT // 2].reshape(-1, 3) * scale
    value, thick = np.zeros((2, *way.shape[:2]))
    value[: HEIGHT // 2] = noise.fbm(above + 8, 6).reshape(HEIGHT // 2, WIDTH)
    thick[: HEIGHT // 2] = noise.fbm(above + np.array([8.3, 8, 8.2]), 3).reshape(HEIGHT // 2, WIDTH)
    opacity = np.clip((value - 0.35 + 0.7 * cover) * 3.5, 0, 1) * np.clip(way[..., 1] * 12, 0, 1)
    return opacity[..., None], np.clip(0.75 + 1.2 * (thick - value), 0.25, 1.2)[..., None]


def _sunny(rng: Rng, elevation: float, cover: float) -> Floats:
    way = directions()
    sun = _from_angles(elevation, rng.uniform(0, 2 * np.pi))
    sky = _daylight(way, sun, rng.uniform(1.5, 5.0))
    low = float(np.clip(1 - sun[1] / 0.45, 0, 1))
    colour = np.array([1.0, 0.93, 0.82]) * (1 - low) + np.array([1.0, 0.5, 0.18]) * low
    veil = 1.0
    if cover > 0:
        opacity, light = _clouds(way, rng, cover)
        base = 0.9 * (1 - low) + np.array([1.0, 0.65, 0.5]) * low
        facing = 0.7 + 0.6 * np.clip(way @ sun, 0, 1)[..., None]
        sky = sky * (1 - opacity) + opacity * light * base * facing
        veil = 1 - 0.7 * float((opacity[..., 0] * disc(way, sun, 6)).sum() / disc(way, sun, 6).sum())
    sky = _ground(way, sky, rng)
    share = veil * rng.uniform(2.0, 6.0) * (1 - 0.7 * low)
    return add_sun(sky, sun, rng.uniform(2.0, 5.0), colour, share)


def _clear(rng: Rng) -> Floats:
    return _sunny(rng, np.radians(rng.uniform(20, 75)), 0.0)


def _cloudy(rng: Rng) -> Floats:
    return _sunny(rng, np.radians(rng.uniform(15, 70)), rng.uniform(0.3, 0.8))


def _sunset(rng: Rng) -> Floats:
    return _sunny(rng, np.radians(rng.uniform(2, 12)), rng.uniform(0, 0.7) * (rng.random() < 0.7))


def _overcast(rng: Rng) -> Floats:
    way = directions()
    opacity, light = _clouds(way, rng, 1.0)
    tint = 1 + rng.uniform(-0.08, 0.08, 3)
    # The overcast sky of the CIE is three times as bright at the zenith as at the horizon.
    sky = (1 + 2 * np.maximum(way[..., 1:2], 0)) / 3 * tint * (1 + 0.5 * opacity * (light - 0.75))
    return _ground(way, sky, rng)


def _night(rng: Rng) -> Floats:
    way = directions()
    sky = np.array([0.03, 0.05, 0.11]) * (0.5 + np.exp(-4 * np.abs(way[..., 1:2])))
    sky = _ground(way, np.maximum(sky, 1e-3), rng)
    total = sky
    for _ in range(int(rng.integers(3, 9))):
        centre = _from_angles(np.radians(rng.uniform(2, 40)), rng.uniform(0, 2 * np.pi))
        warm = np.array([1.0, rng.uniform(0.5, 0.95), rng.uniform(0.2, 0.9)])
        total = total + disc(way, centre, rng.uniform(2, 6))[..., None] * warm * rng.uniform(3, 15)
    if rng.random() < 0.6:
        moon = _from_angles(np.radians(rng.uniform(20, 70)), rng.uniform(0, 2 * np.pi))
        total = total + disc(way, moon, 3)[..., None] * np.array([0.8, 0.9, 1.0]) * 25
    return total


def _panel(way: Floats, centre: Floats, width: float, height: float) -> Floats:
    """Return the coverage (H, W) of a rectangle seen around a direction, its sizes in tangents."""
    right = unit(np.cross(centre, [0.0, 1.0, 0.001]))
    up = np.cross(right, centre)
    depth = way @ centre
    x, y = way @ right / np.maximum(depth, 1e-3), way @ up / np.maximum(depth, 1e-3)
    inside = np.minimum(width - np.abs(x), height - np.abs(y))
    return np.where(depth > 0, np.clip(inside / 0.02 + 0.5, 0, 1), 0)


def _studio(rng: Rng) -> Floats:
    way = directions()
    pixels = np.ones((HEIGHT, WIDTH, 3)) * random_colour(rng) * rng.uniform(0.05, 0.4)
    for _ in range(int(rng.integers(2, 6))):
        centre = _from_angles(np.radians(rng.uniform(5, 85)), rng.uniform(0, 2 * np.pi))
        colour = 1 + rng.uniform(-0.3, 0.3, 3) if rng.random() < 0.7 else random_colour(rng) * 2
        cover = _panel(way, centre, rng.uniform(0.1, 0.6), rng.uniform(0.15, 0.8))
        pixels = pixels + cover[..., None] * colour * rng.uniform(2, 12)
    return pixels


def _interior(rng: Rng) -> Floats:
    """A room around the scene: coloured walls of a box, windows, lamps."""
    way = directions()
    half = rng.uniform(0.6, 1.4, 3)
    reach = half / np.maximum(np.abs(way), 1e-6)
    side = reach.argmin(-1)
    face = 2 * side + (np.take_along_axis(way, side[..., None], -1)[..., 0] > 0)
    colours = np.stack([random_colour(rng) for _ in range(6)]) * 0.6
    point = way * reach.min(-1, keepdims=True)
    shade = 1 + 0.4 * SpaceNoise(rng).fbm(point.reshape(-1, 3) * 3 + 8, 4).reshape(way.shape[:2])
    pixels = colours[face] * shade[..., None] * 0.5
    for _ in range(int(rng.integers(1, 5))):
        centre = _from_angles(np.radians(rng.uniform(-5, 30)), rng.uniform(0, 2 * np.pi))
        window = _panel(way, centre, rng.uniform(0.1, 0.35), rng.uniform(0.2, 0.5))
        pixels = pixels + window[..., None] * rng.uniform(3, 10) * (1 + rng.uniform(-0.1, 0.2, 3))
    lamp = _panel(way, _from_angles(np.radians(rng.uniform(60, 89)), rng.uniform(0, 6)), 0.2, 0.2)
    return pixels + lamp[..., None] * np.array([1.0, 0.85, 0.6]) * rng.uniform(3, 12)


def _gradient(rng: Rng) -> Floats:
    way = directions()
    axis = unit(rng.normal(size=3) + np.array([0, 1.5, 0]))
    t = (0.5 + 0.5 * (way @ axis)[..., None]) ** rng.uniform(0.7, 3)
    return random_colour(rng) * 0.3 * (1 - t) + (random_colour(rng) + 0.3) * t * rng.uniform(1, 4)


KINDS: dict[str, tuple[Callable[[Rng], Floats], float]] = {
    "clear": (_clear, 2.0),
    "cloudy": (_cloudy, 2.0),
    "sunset": (_sunset, 1.5),
    "overcast": (_overcast, 1.0),
    "night": (_night, 0.7),
    "studio": (_studio, 1.5),
    "interior": (_interior, 1.3),
    "gradient": (_gradient, 0.7),
}
"""Name → (draws one, weight), 8 of them."""


def random_sky(rng: Rng, level: float, kind: str | None = None) -> Picture:
    """Return an environment (256, 512, 3) in linear radiance.

    Args:
        rng: Source of all choices.
        level: Mean of what a horizontal and a randomly turned surface of reflectance 0.4 would show under it.
        kind: A name of `KINDS`; None: any.
    """
    weights = np.cumsum([w for _, w in KINDS.values()])
    name = kind or list(KINDS)[int(np.searchsorted(weights, rng.random() * weights[-1]))]
    return scaled(KINDS[name][0](rng), level)


def scaled(pixels: Floats, level: float) -> Picture:
    """Return pixels (H, W, 3) as an environment of a level, as `random_sky` has it."""
    present = (ground_level(pixels) + sphere_level(pixels)) / 2
    return Picture((np.maximum(pixels, 0) * (level / max(present, 1e-9))).astype(np.float32))
