"""Random materials as Mitsuba plugin dictionaries; pictures in them stay plain data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from data.render.spec import Picture
from data.render.textures import BRIGHTEST, muted, random_colour, random_weights

Rng = np.random.Generator
Plugin = dict[str, Any]
Textures = Callable[[], Picture]
"""Draws a colour texture."""

METALS = ("Ag", "Al", "Au", "Cu", "Cr", "W", "Ir", "TiN", "VN", "Be", "Li")
"""Names of metals that Mitsuba has measured refractive indices for."""


def _rgb(values: Any) -> Plugin:
    return {"type": "rgb", "value": [float(v) for v in values]}


def _colour(rng: Rng, textures: Textures, share: float = 0.5) -> Plugin:
    """Return a texture in `share` of the cases, else a plain colour."""
    if rng.random() < share:
        return {"type": "bitmap", "picture": textures()}
    return _rgb(random_colour(rng))


def _roughness(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _rough_map(rng: Rng, low: float, high: float, share: float = 0.25) -> Plugin | float:
    """Return a picture of roughness in `share` of the cases, else a number."""
    if rng.random() < share:
        a, b = sorted((_roughness(rng, low, high), _roughness(rng, low, high)))
        return {"type": "bitmap", "picture": random_weights(rng, a, b)}
    return _roughness(rng, low, high)


def _twosided(plugin: Plugin) -> Plugin:
    return {"type": "twosided", "bsdf": plugin}


def _diffuse(rng: Rng, textures: Textures) -> Plugin:
    return _twosided({"type": "diffuse", "reflectance": _colour(rng, textures, 0.65)})


def _plastic(rng: Rng, textures: Textures) -> Plugin:
    body = {"diffuse_reflectance": _colour(rng, textures), "int_ior": rng.uniform(1.35, 1.7)}
    return _twosided({"type": "plastic", **body, "nonlinear": bool(rng.random() < 0.5)})


def _rough_plastic(rng: Rng, textures: Textures) -> Plugin:
    body = {"diffuse_reflectance": _colour(rng, textures), "int_ior": rng.uniform(1.35, 1.7)}
    shine = {
        "alpha": _roughness(rng, 0.03, 0.5),
        "distribution": "ggx",
        "nonlinear": bool(rng.random() < 0.5),
    }
    return _twosided({"type": "roughplastic", **body, **shine})


def _metal(rng: Rng) -> Plugin:
    """Return a named metal, or an ideal one with a tint."""
    if rng.random() < 0.75:
        return {"material": str(rng.choice(METALS))}
    return {"material": "none", "specular_reflectance": _rgb(np.clip(random_colour(rng) + 0.2, 0, BRIGHTEST))}


def _conductor(rng: Rng, textures: Textures) -> Plugin:
    return _twosided({"type": "conductor", **_metal(rng)})


def _rough_conductor(rng: Rng, textures: Textures) -> Plugin:
    rough: Plugin = {"alpha": _rough_map(rng, 0.03, 0.6)}
    if rng.random() < 0.2:
        rough = {"alpha_u": _roughness(rng, 0.02, 0.15), "alpha_v": _roughness(rng, 0.15, 0.6)}
    return _twosided({"type": "roughconductor", **_metal(rng), **rough, "distribution": "ggx"})


def _mirror(rng: Rng, textures: Textures) -> Plugin:
    tint = _rgb(np.full(3, rng.uniform(0.7, BRIGHTEST)))
    return _twosided({"type": "conductor", "material": "none", "specular_reflectance": tint})


def _principled(rng: Rng, textures: Textures) -> Plugin:
    body: Plugin = {"base_color": _colour(rng, textures, 0.6), "roughness": _rough_map(rng, 0.1, 0.9)}
    body["specular"] = rng.uniform(0.2, 0.8)
    kind = rng.integers(4)
    if kind == 0:
        body |= {"metallic": rng.uniform(0.5, 1.0), "anisotropic": rng.uniform(0, 0.8)}
    elif kind == 1:
        body |= {"clearcoat": rng.uniform(0.4, 1.0), "clearcoat_gloss": rng.uniform(0.3, 1.0)}
    elif kind == 2:
        body |= {"sheen": rng.uniform(0.3, 1.0), "sheen_tint": rng.uniform(0, 1.0)}
    else:
        body |= {"spec_tint": rng.uniform(0, 1.0)}
    return _twosided({"type": "principled", **body})


def _dielectric(rng: Rng, textures: Textures) -> Plugin:
    return {"type": "dielectric", "int_ior": rng.uniform(1.3, 1.8)}


def _rough_dielectric(rng: Rng, textures: Textures) -> Plugin:
    alpha = _roughness(rng, 0.03, 0.4)
    return {
        "type": "roughdielectric",
        "int_ior": rng.uniform(1.3, 1.7),
        "alpha": alpha,
        "distribution": "ggx",
    }


Maker = Callable[[Rng, Textures], Plugin]
OPAQUE: dict[str, tuple[Maker, float]] = {
    "diffuse": (_diffuse, 3.2),
    "plastic": (_plastic, 1.0),
    "rough_plastic": (_rough_plastic, 2.0),
    "conductor": (_conductor, 0.5),
    "rough_conductor": (_rough_conductor, 1.3),
    "mirror": (_mirror, 0.3),
    "principled": (_principled, 1.7),
}
"""Name → (draws one, weight): materials for any mesh, seen from both sides."""

GLASS: dict[str, tuple[Maker, float]] = {
    "dielectric": (_dielectric, 2.0),
    "rough_dielectric": (_rough_dielectric, 1.0),
}
"""Name → (draws one, weight): materials that need a closed mesh."""


def random_material(rng: Rng, textures: Textures, glass: bool = False, kind: str | None = None) -> Plugin:
    """Return a material.

    Args:
        rng: Source of all choices.
        textures: Draws the colour textures that are used.
        glass: Draw from the transparent ones.
        kind: A name of `OPAQUE` or `GLASS`; None: any.
    """
    makers = GLASS if glass else OPAQUE
    weights = np.cumsum([w for _, w in makers.values()])
    name = kind or list(makers)[int(np.searchsorted(weights, rng.random() * weights[-1]))]
    return (OPAQUE | GLASS)[name][0](rng, textures)


def surface_material(rng: Rng, textures: Textures, vividness: float = 1.0) -> Plugin:
    """Return a material for floors, walls and grounds: mostly matt, textured, none that is metal.

    Args:
        rng: Source of all choices.
        textures: Draws the colour textures that are used.
        vividness: Saturation of a plain colour.
    """
    colour = _rgb(muted(random_colour(rng), vividness))
    if rng.random() < 0.8:
        colour = {"type": "bitmap", "picture": textures()}
    kind = rng.random()
    if kind < 0.6:
        return _twosided({"type": "diffuse", "reflectance": colour})
    if kind < 0.8:
        alpha = _roughness(rng, 0.08, 0.5)
        return _twosided({"type": "roughplastic", "diffuse_reflectance": colour, "alpha": alpha})
    rough = _rough_map(rng, 0.15, 0.8, 0.4)
    return _twosided(
        {"type": "principled", "base_color": colour, "roughness": rough, "specular": rng.uniform(0.2, 0.6)}
    )
