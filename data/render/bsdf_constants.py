"""Constants of Mitsuba's BSDFs that their interface does not tell: specular colour, roughness, albedo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Parameters = dict[str, NDArray[np.float64] | None]
_NESTED = ("brdf_0", "brdf_1", "bsdf_0", "bsdf_1", "nested_bsdf")


@dataclass(frozen=True)
class Material:
    """Constants of one BSDF.

    Attributes:
        specular: Reflectance at normal incidence of all but the diffuse lobe (3,).
        roughness: Microfacet alpha; 0 smooth, 1 without a specular lobe.
        albedo: Mean diffuse reflectance (3,).
        fixed: `albedo` is used as it is.
        measured: The albedo is the diffuse lobe's value in the direction of the normal, times pi.
        textured: Roughness is evaluated at the hit.
        principled: Metallic, base colour … are evaluated at the hit.
        fresnel: Reflectance of the principled BSDF's dielectric at normal incidence.
    """

    specular: NDArray[np.float64]
    roughness: float
    albedo: NDArray[np.float64]
    fixed: bool = False
    measured: bool = False
    textured: bool = False
    principled: bool = False
    fresnel: float = 0.0

    def row(self) -> list[float]:
        """Return the columns of the table."""
        flags = (self.fixed, self.measured, self.textured, self.principled)
        values = [*self.specular, self.roughness, *self.albedo, *flags, self.fresnel]
        return [float(value) for value in values]


def describe(bsdf: Any) -> Material:
    """Return the constants of a `mitsuba.BSDF`."""
    import mitsuba

    parameters = {name: _mean(value) for name, value in mitsuba.traverse(bsdf)}
    blend = any("bsdf_1" in name for name in parameters)
    principled = any(".base_color." in f".{name}" for name in parameters)
    reached = principled and not blend and bool(np.all(bsdf.has_attribute("base_color")))
    rough = any(".alpha." in f".{name}" and not name.endswith("alpha.value") for name in parameters)
    return replace(
        _of(parameters),
        fixed=principled and not reached,
        measured=bsdf.class_name().startswith(("Polarized", "Measured")) or (blend and not principled),
        textured=rough and not blend and bool(np.all(bsdf.has_attribute("alpha"))),
        principled=reached,
    )


def _mean(value: Any) -> NDArray[np.float64] | None:
    """Return a parameter's mean over pixels (1 or 3 channels), None for what is no number."""
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None
    if numbers.ndim == 3:
        return numbers.reshape(-1, numbers.shape[-1]).mean(0)
    return numbers.reshape(-1) if numbers.size in (1, 3) else None


def _of(parameters: Parameters) -> Material:
    parts = [_of(inner) for inner in (_below(parameters, name) for name in _NESTED) if inner]
    if not parts:
        return _leaf(parameters)
    if len(parts) == 1 or any(name.startswith("brdf_") for name in parameters):
        return parts[0]
    weight = float(np.mean(_value(parameters, "weight", 0.5)))
    a, b = parts[0], parts[1]
    return Material(
        (1 - weight) * a.specular + weight * b.specular,
        (1 - weight) * a.roughness + weight * b.roughness,
        (1 - weight) * a.albedo + weight * b.albedo,
    )


def _below(parameters: Parameters, name: str) -> Parameters:
    return {k[len(name) + 1 :]: v for k, v in parameters.items() if k.startswith(f"{name}.")}


def _value(parameters: Parameters, name: str, default: float) -> NDArray[np.float64]:
    """Return a constant, or the mean of a texture, called `name`, as (3,)."""
    inner = [k for k in parameters if k.startswith(f"{name}.") and not k.endswith("to_uv")]
    for key in (name, f"{name}.value", f"{name}.data", *inner):  # the last: textures made of textures
        value = parameters.get(key)
        if value is not None:
            return np.broadcast_to(value[:3] if value.size >= 3 else value[:1], 3).astype(np.float64)
    return np.full(3, default)


def _leaf(parameters: Parameters) -> Material:
    names = {key.split(".")[0] for key in parameters}
    black = np.zeros(3)
    if "base_color" in names:
        return _principled(parameters)
    alpha = _alpha(parameters, names)
    if "k" in names:
        eta, k = _value(parameters, "eta", 0.0), _value(parameters, "k", 1.0)
        fresnel = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
        return Material(_clip(fresnel * _value(parameters, "specular_reflectance", 1.0)), alpha, black)
    if "diffuse_reflectance" in names:
        fresnel = _dielectric(_value(parameters, "eta", 1.49))
        specular = _clip(fresnel * _value(parameters, "specular_reflectance", 1.0))
        return Material(specular, alpha, _clip(_value(parameters, "diffuse_reflectance", 0.5)))
    if "eta" in names:
        return Material(np.ones(3), alpha, black)
    return Material(black, 1.0, _clip(_value(parameters, "reflectance", 0.0)))


def _alpha(parameters: Parameters, names: set[str]) -> float:
    used = [_value(parameters, name, 0.0).mean() for name in ("alpha", "alpha_u", "alpha_v") if name in names]
    return float(np.clip(np.mean(used), 0.0, 1.0)) if used else 0.0


def _principled(parameters: Parameters) -> Material:
    base, metallic = _value(parameters, "base_color", 0.5), _value(parameters, "metallic", 0.0)
    through = _value(parameters, "spec_trans", 0.0)
    fresnel = 0.08 * _value(parameters, "specular", 0.5)
    if "eta" in parameters:
        fresnel = _dielectric(_value(parameters, "eta", 1.5))
    specular = _clip(principled_specular(base, metallic, through, fresnel))
    roughness = float(_value(parameters, "roughness", 0.5).mean()) ** 2
    albedo = _clip(base * (1 - metallic) * (1 - through))
    return Material(specular, roughness, albedo, fresnel=float(fresnel.mean()))


def principled_specular(base: Any, metallic: Any, through: Any, fresnel: Any) -> Any:
    """Return the specular reflectance at normal incidence of the principled BSDF, without clear coat.

    Args:
        base: Base colour.
        metallic: Share of the metal.
        through: Share of the glass in the rest (`spec_trans`).
        fresnel: Reflectance of its dielectric at normal incidence.
    """
    return metallic * base + (1 - metallic) * ((1 - through) * fresnel + through * base)


def _dielectric(eta: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(((eta - 1) / (eta + 1)) ** 2)


def _clip(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip(values, 0.0, 1.0)
