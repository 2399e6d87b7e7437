"""What guides need to know of materials and Mitsuba's BSDFs do not tell: specular colour and roughness.

A BSDF's parameters are read once per scene into a table that the samples look their hit's material up in.
Textured roughness and the principled BSDF's textured parameters are evaluated at the hit; a textured
specular reflectance and what is inside of a blend count with their means.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from data.render.bsdf_constants import describe, principled_specular
from data.render.variant import is_scalar

# Columns of the table.
_SPECULAR, _ROUGHNESS, _ALBEDO, _FIXED, _MEASURED, _TEXTURED, _PRINCIPLED, _FRESNEL = 0, 3, 4, 7, 8, 9, 10, 11
_COLUMNS = 12


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
