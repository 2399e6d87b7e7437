"""What guides need to know of materials and Mitsuba's BSDFs do not tell: specular colour and roughness.

A BSDF's parameters are read once per scene into a table that the samples look their hit's material up in.
Textured roughness and the principled BSDF's textured parameters are evaluated at the hit; a textured
specular reflectance and what is inside of a blend count with their means.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.render.variant import is_scalar

Parameters = dict[str, NDArray[np.float64] | None]
_NESTED = ("brdf_0", "brdf_1", "bsdf_0", "bsdf_1", "nested_bsdf")
# Columns of the table.
_SPECULAR, _ROUGHNESS, _ALBEDO, _FIXED, _MEASURED, _TEXTURED, _PRINCIPLED, _FRESNEL = 0, 3, 4, 7, 8, 9, 10, 11
_COLUMNS = 12


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


class Reflectances:
    """The materials of a loaded scene, looked up for every hit.

    Works on wavefronts (`llvm_ad_rgb`) and on single hits (`scalar_rgb`).
    """

    def __init__(self, scene: Any) -> None:
        import mitsuba

        self._bsdfs = _all_bsdfs(scene)  # keeps them alive: single hits are looked up by identity
        described = [describe(bsdf) for bsdf in self._bsdfs]
        self._principled = any(m.principled for m in described)
        self._textured = any(m.textured for m in described)
        self._fixed = any(m.fixed for m in described)
        self._measured = any(m.measured for m in described)
        self._scalar = is_scalar()
        rows = [m.row() for m in described]
        if self._scalar:
            self._rows = {id(bsdf): row for bsdf, row in zip(self._bsdfs, rows, strict=True)}
        else:
            self._table = _table([_bsdf_number(b) for b in self._bsdfs], rows)
        self._diffuse = mitsuba.BSDFContext()
        self._diffuse.type_mask = mitsuba.BSDFFlags.Diffuse

    def roughness(self, bsdf: Any, si: Any, active: Any) -> Any:
        """Return microfacet alpha, 0 smooth to 1 diffuse."""
        import drjit

        value = self._column(bsdf, _ROUGHNESS)
        if self._textured:
            chosen = active & (self._column(bsdf, _TEXTURED) > 0)
            value = drjit.select(chosen, self._attribute(bsdf, "alpha", si, 1, chosen), value)
        if self._principled:
            chosen = self._is_principled(bsdf, active)
            rough = self._attribute(bsdf, "roughness", si, 1, chosen)
            value = drjit.select(chosen, rough * rough, value)
        return drjit.select(active, drjit.clip(value, 0.0, 1.0), 0.0)

    def specular(self, bsdf: Any, si: Any, active: Any) -> Any:
        """Return the specular reflectance at normal incidence in [0, 1], RGB."""
        import mitsuba

        value = self._colour(bsdf, _SPECULAR)
        if self._principled:
            chosen = self._is_principled(bsdf, active)
            base, metallic, through = self._mixture(bsdf, si, chosen)
            fresnel = mitsuba.Color3f(self._column(bsdf, _FRESNEL))
            value = _either(chosen, principled_specular(base, metallic, through, fresnel), value)
        return _unit(active, value)

    def albedo(self, bsdf: Any, si: Any, active: Any) -> Any:
        """Return the diffuse reflectance in [0, 1], RGB, 0 without a diffuse lobe."""
        import drjit
        import mitsuba

        # Without a diffuse lobe Mitsuba's default is a view-dependent number, far above 1 on rough metals.
        lobe = active & mitsuba.has_flag(bsdf.flags(), mitsuba.BSDFFlags.DiffuseReflection)
        value = mitsuba.Color3f(bsdf.eval_diffuse_reflectance(si, lobe))
        if self._principled:
            chosen = self._is_principled(bsdf, lobe)
            _, metallic, through = self._mixture(bsdf, si, chosen)
            value = _either(chosen, value * ((1 - metallic) * (1 - through)), value)
        if self._measured:
            chosen = lobe & (self._column(bsdf, _MEASURED) > 0)
            side = drjit.sign(mitsuba.Frame3f.cos_theta(si.wi))
            facing = bsdf.eval(self._diffuse, si, mitsuba.Vector3f(0.0, 0.0, side), chosen)
            value = _either(chosen, mitsuba.Color3f(facing) * drjit.pi, value)
        if self._fixed:
            value = _either(self._column(bsdf, _FIXED) > 0, self._colour(bsdf, _ALBEDO), value)
        return _unit(lobe, value)

    def diffuse_value(self, bsdf: Any, si: Any, wo: Any, total: Any, active: Any) -> Any:
        """Return the part of the BSDF's value times cosine that is its diffuse lobes', at most `total`.

        Args:
            bsdf: BSDF of the hit.
            si: The hit.
            wo: Direction, in the hit's frame.
            total: The value of all lobes, which bounds it.
            active: Which hits.
        """
        import drjit
        import mitsuba

        value = mitsuba.Color3f(bsdf.eval(self._diffuse, si, wo, active))
        if self._principled:
            # Mitsuba's principled BSDF ignores the choice of lobes.
            chosen = self._is_principled(bsdf, active)
            value = _either(chosen, self._principled_lobe(bsdf, si, wo, chosen), value)
        return drjit.minimum(value, total)

    def _column(self, bsdf: Any, column: int) -> Any:
        """Return one column of the table for every hit."""
        import drjit
        import mitsuba

        if self._scalar:
            return self._rows.get(id(bsdf), [0.0] * _COLUMNS)[column]
        number: Any = drjit.reinterpret_array(mitsuba.UInt32, bsdf)
        place = number * _COLUMNS + column
        return drjit.gather(mitsuba.Float, self._table, place, place < drjit.width(self._table))

    def _colour(self, bsdf: Any, column: int) -> Any:
        import mitsuba

        return mitsuba.Color3f(*(self._column(bsdf, column + i) for i in range(3)))

    def _attribute(self, bsdf: Any, name: str, si: Any, channels: int, active: Any) -> Any:
        """Return a texture's value at the hit, 0 where `active` is false."""
        import mitsuba

        if self._scalar and not active:  # a single hit's material need not have it
            return 0.0 if channels == 1 else mitsuba.Color3f(0.0)
        if channels == 1:
            return bsdf.eval_attribute_1(name, si, active)
        return mitsuba.Color3f(bsdf.eval_attribute_3(name, si, active))

    def _is_principled(self, bsdf: Any, active: Any) -> Any:
        return active & (self._column(bsdf, _PRINCIPLED) > 0)

    def _mixture(self, bsdf: Any, si: Any, active: Any) -> tuple[Any, Any, Any]:
        base = self._attribute(bsdf, "base_color", si, 3, active)
        metallic = self._attribute(bsdf, "metallic", si, 1, active)
        return base, metallic, self._attribute(bsdf, "spec_trans", si, 1, active)

    def _principled_lobe(self, bsdf: Any, si: Any, wo: Any, active: Any) -> Any:
        """Return the diffuse and retro-reflective lobe (Burley 2012, section 5.3), no sheen, flatness 0."""
        import drjit
        import mitsuba

        base, metallic, through = self._mixture(bsdf, si, active)
        roughness = self._attribute(bsdf, "roughness", si, 1, active)
        cos_i, cos_o = mitsuba.Frame3f.cos_theta(si.wi), mitsuba.Frame3f.cos_theta(wo)
        half = drjit.normalize(si.wi + wo)
        retro = 2.0 * roughness * drjit.square(drjit.dot(half, wo))
        f_i, f_o = _schlick(drjit.abs(cos_i)), _schlick(drjit.abs(cos_o))
        lobe = (1 - 0.5 * f_i) * (1 - 0.5 * f_o) + retro * (f_i + f_o + f_i * f_o * (retro - 1))
        share = (1 - metallic) * (1 - through) * lobe * drjit.abs(cos_o) * drjit.inv_pi
        return _either(active & (cos_i * cos_o > 0), base * share, mitsuba.Color3f(0.0))


def _either(condition: Any, a: Any, b: Any) -> Any:
    import drjit
    import mitsuba

    return drjit.select(condition, mitsuba.Color3f(a), mitsuba.Color3f(b))


def _unit(active: Any, value: Any) -> Any:
    """Return colours clipped to [0, 1], 0 where not active."""
    import drjit
    import mitsuba

    return drjit.select(active, drjit.clip(mitsuba.Color3f(value), 0.0, 1.0), mitsuba.Color3f(0.0))


def _schlick(cosine: Any) -> Any:
    import drjit

    return (1 - drjit.clip(cosine, 0.0, 1.0)) ** 5


def _bsdf_number(bsdf: Any) -> int:
    import drjit
    import mitsuba

    number: Any = drjit.reinterpret_array(mitsuba.UInt32, mitsuba.BSDFPtr(bsdf))
    return int(number[0])


def _table(numbers: list[int], rows: list[list[float]]) -> Any:
    import mitsuba

    table = np.zeros((max(numbers, default=0) + 1, _COLUMNS), np.float32)
    for place, row in zip(numbers, rows, strict=True):
        table[place] = row
    return mitsuba.Float(table.ravel())


def _all_bsdfs(scene: Any) -> list[Any]:
    """Return every BSDF of a scene, those inside shape groups included."""
    import mitsuba

    nodes = mitsuba.traverse(scene).hierarchy
    found = {id(node): node for node in nodes if isinstance(node, mitsuba.BSDF)}
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is not None:
            found[id(bsdf)] = bsdf
    return list(found.values())
