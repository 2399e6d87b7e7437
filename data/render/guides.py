"""Guides of camera samples: what the first hit is and how it was seen. Same rays as the radiance.

Everything here works on wavefronts (`llvm_ad_rgb`) and on single samples (`scalar_rgb`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from data.render.loading import LoadedScene
from data.render.projection import Displacements, Projection, number, vector
from data.render.reflectance import Reflectances
from data.render.spec import View

GUIDES = (
    "normal",
    "depth",
    "position",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "hit",
    "motion",
    "coc",
    "lens",
    "time",
    "offset",
)
Motion = Literal["previous", "shutter"]


@dataclass
class Samples:
    """Camera samples and their first hits.

    Attributes:
        si: `mitsuba.SurfaceInteraction3f`.
        ray: Camera ray.
        time: In [0, 1).
        offset: Position in the pixel, two numbers in [0, 1).
        lens: Position on the unit disc, two numbers.
        still: Moving objects are where they are at the middle of the shutter, whatever `time` says.
    """

    si: Any
    ray: Any
    time: Any
    offset: Any
    lens: Any
    still: bool


class Guides:
    """The guides of one frame.

    Args:
        loaded: The scene.
        materials: Its materials.
        views: This frame's view and the previous one; None: this frame has no previous one.
        motion: `previous` or `shutter`.
    """

    def __init__(
        self, loaded: LoadedScene, materials: Reflectances, views: tuple[View, View | None], motion: Motion
    ) -> None:
        self._view, self._previous = views
        self._materials = materials
        self._motion = motion
        self._displacements = Displacements(loaded)
        self._now = Projection(self._view)
        self._before = None if self._previous is None else Projection(self._previous)
        self._centre = vector(self._view.to_world[:3, 3])
        axis = np.asarray(self._view.to_world, np.float64)[:3, 2]
        self._axis = vector(axis / np.linalg.norm(axis))

    def of(self, samples: Samples, names: Sequence[str]) -> dict[str, Any]:
        """Return the named guides; each is a number, or a vector of the variant."""
        return {name: getattr(_Hit(self, samples), name) for name in names}


class _Hit:
    """Guides of the given samples; each is worked out when it is asked for."""

    def __init__(self, guides: Guides, samples: Samples) -> None:
        self._guides = guides
        self._samples = samples
        self._si = samples.si
        self._valid = samples.si.is_valid()

    def _where_hit(self, value: Any) -> Any:
        import drjit

        return drjit.select(self._valid, value, drjit.zeros(type(value)))

    @cached_property
    def _bsdf(self) -> Any:
        return self._si.bsdf()

    @property
    def _nothing(self) -> bool:
        """Whether this is a single sample that hit nothing, whose material cannot be asked for."""
        return self._valid is False

    @cached_property
    def _camera_shift(self) -> Any:
        """Displacement of the camera at the sample's time."""
        view = self._guides._view
        return None if not any(view.velocity) else vector(view.velocity) * (self._samples.time - 0.5)

    @property
    def hit(self) -> Any:
        import drjit
        import mitsuba

        return drjit.select(self._valid, mitsuba.Float(1.0), 0.0)

    @property
    def normal(self) -> Any:
        import drjit
        import mitsuba

        normal = mitsuba.Vector3f(self._si.sh_frame.n)
        away = drjit.dot(normal, self._samples.ray.d) > 0
        return self._where_hit(drjit.normalize(drjit.select(away, -normal, normal)))

    @property
    def position(self) -> Any:
        import mitsuba

        return self._where_hit(mitsuba.Vector3f(self._si.p))

    @property
    def depth(self) -> Any:
        import drjit
        import mitsuba

        return self._where_hit(drjit.norm(mitsuba.Vector3f(self._si.p) - self._guides._centre))

    @property
    def diffuse_albedo(self) -> Any:
        return self._of_material(self._guides._materials.albedo)

    @property
    def specular_albedo(self) -> Any:
        return self._of_material(self._guides._materials.specular)

    @property
    def roughness(self) -> Any:
        import mitsuba

        if self._nothing:
            return mitsuba.Float(0.0)
        return self._guides._materials.roughness(self._bsdf, self._si, self._valid)

    def _of_material(self, colour: Any) -> Any:
        import mitsuba

        return mitsuba.Color3f(0.0) if self._nothing else colour(self._bsdf, self._si, self._valid)

    @property
    def coc(self) -> Any:
        import drjit
        import mitsuba

        view = self._guides._view
        if view.aperture <= 0:
            return mitsuba.Float(0.0)
        offset = mitsuba.Vector3f(self._si.p) - self._guides._centre
        if self._camera_shift is not None:
            offset = offset - self._camera_shift
        z = drjit.dot(offset, self._guides._axis)
        inverse = drjit.select(self._valid, 1.0 / drjit.select(self._valid, z, 1.0), 0.0)
        focal = view.width / (2 * np.tan(np.radians(view.fov) / 2))
        return number(2 * view.aperture * focal) * (number(1 / view.focus) - inverse)

    @property
    def lens(self) -> Any:
        return self._samples.lens

    @property
    def time(self) -> Any:
        return self._samples.time

    @property
    def offset(self) -> Any:
        return self._samples.offset

    @property
    def motion(self) -> Any:
        return self._shutter_motion() if self._guides._motion == "shutter" else self._previous_motion()

    def _shutter_motion(self) -> Any:
        """Return how far the hit point moves over the shutter, in pixels."""
        import mitsuba

        point = mitsuba.Vector3f(self._si.p)
        moved = self._guides._displacements.of(self._si)
        at = 0.5 if self._samples.still else self._samples.time
        camera = vector(self._guides._view.velocity)
        project = self._guides._now.pixel
        begin, z_begin = project(point - moved * at + camera * 0.5)
        end, z_end = project(point + moved * (1.0 - at) - camera * 0.5)
        return self._between(begin, end, self._valid & (z_begin > 0) & (z_end > 0))

    def _previous_motion(self) -> Any:
        """Return the pixel in the previous frame's view minus the one in this frame's."""
        import drjit
        import mitsuba

        if self._guides._before is None or self._guides._previous is None:
            return mitsuba.Vector2f(0.0)
        point = mitsuba.Vector3f(self._si.p)
        before = point - self._guides._displacements.of(self._si)
        if self._camera_shift is not None:
            point = point - self._camera_shift
        if any(self._guides._previous.velocity):
            before = before - vector(self._guides._previous.velocity) * (self._samples.time - 0.5)
        now, z_now = self._guides._now.pixel(point)
        then, z_then = self._guides._before.pixel(before)
        direction = mitsuba.Vector3f(self._samples.ray.d)
        far_now, z_far_now = self._guides._now.pixel(direction, 0.0)
        far_then, z_far_then = self._guides._before.pixel(direction, 0.0)
        hit = self._between(now, then, self._valid & (z_now > 0) & (z_then > 0))
        background = self._between(far_now, far_then, (z_far_now > 0) & (z_far_then > 0))
        return drjit.select(self._valid, hit, background)

    @staticmethod
    def _between(begin: Any, end: Any, seen: Any) -> Any:
        import drjit
        import mitsuba

        return drjit.select(seen, end - begin, mitsuba.Vector2f(0.0))
