"""Radiance along a camera ray: whole, or split at the first hit into diffuse and specular.

The first hit is integrated here (Veach 1997, section 9.2: light and BSDF sampling, power heuristic), what
follows it by Mitsuba's `path` integrator, so that the long part runs as compiled code in every variant. The
integrator counts the emission of the second vertex in full, as nothing before it sampled the lights; that
part is taken out and put back with the weight that the first hit's light sample leaves to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from data.render.reflectance import Reflectances
from data.render.variant import is_scalar

ROULETTE = 5
"""Russian roulette starts at this path length, as in Mitsuba."""


@dataclass
class Split:
    """Radiance of samples.

    Attributes:
        radiance: All of it, RGB.
        diffuse: What left the first hit through its diffuse lobes, and the first hit's emission, RGB.
        visibility: 1 where the first hit's light sample is not occluded.
        second_albedo: Diffuse plus specular reflectance of the second hit, at most 1, RGB; 0 where there is
            none. None unless it was asked for.
    """

    radiance: Any
    diffuse: Any
    visibility: Any
    second_albedo: Any = None


class Radiance:
    """Path-traced radiance in a loaded scene."""

    def __init__(self, scene: Any, materials: Reflectances, max_depth: int) -> None:
        import mitsuba

        if max_depth < 2:
            raise ValueError(f"max_depth is {max_depth}, expected at least 2: light must reach a surface")
        self._scene = scene
        self._materials = materials
        self._scalar = is_scalar()
        # Images of the scalar variant are made in blocks with a seed each: the same whatever the threads.
        path = {"type": "path", "max_depth": max_depth, "rr_depth": ROULETTE, "block_size": 16}
        self.path = mitsuba.load_dict(path)
        self._rest = mitsuba.load_dict({"type": "path", "max_depth": max_depth - 1, "rr_depth": ROULETTE - 1})

    def whole(self, sampler: Any, ray: Any) -> Any:
        """Return the radiance along rays, RGB."""
        import mitsuba

        return self.path.sample(self._scene, sampler, mitsuba.RayDifferential3f(ray))[0]

    def split(self, sampler: Any, si: Any, second: bool = False) -> Split:
        """Return the radiance that leaves first hits towards the camera.

        Args:
            sampler: Source of random numbers.
            si: `mitsuba.SurfaceInteraction3f` of the camera rays.
            second: Return the reflectance of the second hits too; it takes no random numbers.
        """
        import mitsuba

        emission = self._emission(si, True)
        valid = si.is_valid()
        if self._scalar and not valid:
            nothing = mitsuba.Color3f(0.0) if second else None
            return Split(emission, emission, 0.0, nothing)
        bsdf = si.bsdf()
        direct, direct_diffuse, visibility = self._direct(sampler, si, bsdf, valid)
        indirect, indirect_diffuse, following, alive = self._indirect(sampler, si, bsdf, valid)
        diffuse = mitsuba.Color3f(emission + direct_diffuse + indirect_diffuse)
        albedo = self._reflectance(following, alive) if second else None
        return Split(emission + direct + indirect, diffuse, visibility, albedo)

    def _emission(self, si: Any, active: Any) -> Any:
        import mitsuba

        emitter = si.emitter(self._scene, active)
        if self._scalar and emitter is None:
            return mitsuba.Color3f(0.0)
        return mitsuba.Color3f(emitter.eval(si, active))

    def _direct(self, sampler: Any, si: Any, bsdf: Any, active: Any) -> tuple[Any, Any, Any]:
        """Return one light sample's contribution, its diffuse part, and whether the light was visible."""
        import drjit
        import mitsuba

        light, spectrum = self._scene.sample_emitter_direction(si, sampler.next_2d(), False, active)
        reaches = active & (light.pdf > 0) & drjit.any(spectrum > 0)
        occluded = self._scene.ray_test(si.spawn_ray_to(light.p), reaches)
        visible = reaches & (occluded ^ True)
        context = mitsuba.BSDFContext()
        smooth = visible & mitsuba.has_flag(bsdf.flags(), mitsuba.BSDFFlags.Smooth)
        wo = si.to_local(light.d)
        value, density = bsdf.eval_pdf(context, si, wo, smooth)
        value = mitsuba.Color3f(value)
        weight = drjit.select(light.delta, 1.0, _heuristic(light.pdf, density))
        incident = drjit.select(smooth, spectrum * weight, mitsuba.Color3f(0.0))
        part = self._materials.diffuse_value(bsdf, si, wo, value, smooth)
        return value * incident, part * incident, drjit.select(visible, mitsuba.Float(1.0), 0.0)

    def _indirect(self, sampler: Any, si: Any, bsdf: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Return a BSDF sample's contribution, its diffuse part, what it hits, and whether it is alive."""
        import drjit
        import mitsuba

        context = mitsuba.BSDFContext()
        sample, throughput = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        alive = active & drjit.any(throughput > 0)
        ray = si.spawn_ray(si.to_world(sample.wo))
        following = self._scene.ray_intersect(ray, alive)
        emitted = self._emission(following, alive)
        delta = mitsuba.has_flag(sample.sampled_type, mitsuba.BSDFFlags.Delta)
        density = self._light_density(following, si, alive & (delta ^ True))
        weight = drjit.select(delta, 1.0, _heuristic(sample.pdf, density))
        beyond = self._rest.sample(self._scene, sampler, mitsuba.RayDifferential3f(ray), None, alive)[0]
        incident = drjit.maximum(beyond - emitted, 0.0) + weight * emitted
        result = drjit.select(alive, throughput * incident, mitsuba.Color3f(0.0))
        share = self._diffuse_share(bsdf, si, sample.wo, alive & (delta ^ True))
        return result, result * share, following, alive

    def _reflectance(self, si: Any, active: Any) -> Any:
        """Return the diffuse plus the specular reflectance of hits in [0, 1], RGB, 0 without a hit."""
        import drjit
        import mitsuba

        hit = active & si.is_valid()
        if self._scalar and not hit:  # nothing has no material that could be asked
            return mitsuba.Color3f(0.0)
        bsdf = si.bsdf()
        total = self._materials.albedo(bsdf, si, hit) + self._materials.specular(bsdf, si, hit)
        return drjit.minimum(total, mitsuba.Color3f(1.0))

    def _light_density(self, following: Any, si: Any, active: Any) -> Any:
        """Return the density with which a light sample of `si` would have found the next vertex."""
        import mitsuba

        if self._scalar and (not active or following.emitter(self._scene) is None):
            return 0.0
        light = mitsuba.DirectionSample3f(self._scene, following, si)
        return self._scene.pdf_emitter_direction(si, light, active)

    def _diffuse_share(self, bsdf: Any, si: Any, wo: Any, active: Any) -> Any:
        """Return the diffuse lobes' part of the BSDF's value, RGB in [0, 1]."""
        import drjit
        import mitsuba

        total = mitsuba.Color3f(bsdf.eval(mitsuba.BSDFContext(), si, wo, active))
        part = self._materials.diffuse_value(bsdf, si, wo, total, active)
        safe = drjit.select(total > 0, total, mitsuba.Color3f(1.0))
        return drjit.select(active, part / safe, mitsuba.Color3f(0.0))


def _heuristic(chosen: Any, other: Any) -> Any:
    """Return the power heuristic's weight of a sample drawn with density `chosen`."""
    import drjit

    a, b = chosen * chosen, other * other
    weight = a / drjit.maximum(a + b, 1e-37)
    return drjit.select(drjit.isfinite(weight), weight, 0.0)
