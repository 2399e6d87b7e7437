"""Camera samples of a scene: radiance and guides, kept apart. One implementation for all variants.

Samples are independent of each other: each has its own random position in its pixel (box filter: it belongs
to that pixel only), on the lens and in the shutter. No film is involved, so means, variances, halves and
per-sample layers are sums that the caller makes. `variant.activate` has to be called first.

Objects: Mitsuba has no motion blur of objects, so the shutter has `SLICES` slices, every sample belongs to a
random one, and the samples of a slice are traced with the objects displaced to the middle of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.camera import Camera
from data.render.guides import GUIDES, Guides, Motion, Samples
from data.render.loading import LoadedScene, load, sensor
from data.render.projection import vector, view_world_to_pixel
from data.render.radiance import Radiance
from data.render.reflectance import Reflectances
from data.render.seeds import Seeds, seeds_of
from data.render.spec import SceneSpec, View
from data.render.variant import is_scalar

__all__ = ["GUIDES", "NAMES", "SLICES", "Chunk", "Tracer", "view_world_to_pixel"]

SPLIT = ("diffuse", "visibility", "second_albedo")
RADIANCE = ("radiance", *SPLIT)
NAMES = (*RADIANCE, *GUIDES)
SLICES = 16
_CHANNELS = {"depth": 1, "roughness": 1, "hit": 1, "visibility": 1, "coc": 1, "time": 1} | {
    "motion": 2,
    "lens": 2,
    "offset": 2,
}


@dataclass(frozen=True)
class Chunk:
    """Some samples of some rows.

    Attributes:
        rows: Rows of the image that the samples belong to.
        values: Name → float32 (S, h, W, C), S samples of every pixel of the h rows.
    """

    rows: slice
    values: dict[str, NDArray[np.float32]]


@dataclass
class _Frame:
    """What all wavefronts of one call of `trace` share."""

    view: View
    sensor: Any
    guides: Guides
    names: tuple[str, ...]
    split: bool
    still: bool


class Tracer:
    """Traces camera samples of one scene, one frame after the other.

    Args:
        spec: The scene.
        chunk: Samples of one wavefront, at most; also what a chunk holds. About 1 KiB of memory each.
        max_depth: Longest path, in edges: 2 is direct light.

    Attributes:
        invalid: Samples so far whose radiance was NaN or infinite; they count as black.

    Raises:
        ValueError: The scene cannot be loaded.
    """

    def __init__(self, spec: SceneSpec, chunk: int = 2**20, max_depth: int = 8) -> None:
        import mitsuba

        if chunk < 1:
            raise ValueError(f"chunk is {chunk}, expected at least 1 sample")
        self.spec = spec
        self.invalid = 0
        self._chunk = chunk
        self._loaded: LoadedScene = load(spec)
        self._scene = self._loaded.scene
        self._materials = Reflectances(self._scene)
        self._radiance = Radiance(self._scene, self._materials, max_depth)
        self._scalar = is_scalar()
        self._sampler = mitsuba.load_dict({"type": "independent"})

    def pixel_camera(self, frame: int) -> Camera:
        """Return the camera of a frame, at the middle of the shutter."""
        view = self._view(frame)
        return Camera(view_world_to_pixel(view), np.asarray(view.to_world, np.float64)[:3, 3].copy())

    def free(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
        """Return whether nothing is on the straight way from one point to another."""
        import mitsuba

        a, b = (np.asarray(point, np.float64) for point in (begin, end))
        length = float(np.linalg.norm(b - a))
        if length == 0:
            return True
        ray: Any = mitsuba.Ray3f(mitsuba.Point3f(a.tolist()), mitsuba.Vector3f(((b - a) / length).tolist()))
        ray.maxt = length
        return not bool(np.any(self._scene.ray_test(ray)))

    def trace(
        self,
        frame: int,
        spp: int,
        seed: int,
        names: Sequence[str],
        motion: Motion = "previous",
        static: bool = False,
    ) -> Iterator[Chunk]:
        """Yield all samples of a frame, in chunks of whole rows.

        The same scene, frame, spp, seed, names and chunk give the same bits on the same variant and machine.

        Args:
            frame: Number of the view.
            spp: Samples per pixel.
            seed: Other seeds give independent samples.
            names: Quantities, out of `NAMES`. `normal` is flipped to the viewer; `depth` is the distance
                from the camera's centre at the middle of the shutter; `lens` is 0 for pinhole cameras;
                `second_albedo` leaves all others as they are without it.
            motion: `previous`: pixel of the same point in the previous frame's view minus the one in this
                view, 0 at frame 0 and between views that are no path; the background counts as infinitely
                far. `shutter`: how far the point moves over this frame's shutter. Both in pixels.
            static: Objects stay where they are at the middle of the shutter; time is drawn all the same.

        Raises:
            ValueError: An unknown name, frame or number of samples.
        """
        unknown = [name for name in names if name not in NAMES]
        if unknown or not names:
            raise ValueError(f"cannot trace {', '.join(unknown) or 'nothing'}; known: {', '.join(NAMES)}")
        if spp < 1:
            raise ValueError(f"spp is {spp}, expected at least 1")
        setting = self._setting(frame, tuple(names), motion, static)
        return self._chunks(setting, frame, spp, seeds_of(seed, frame))

    def _chunks(self, setting: _Frame, frame: int, spp: int, seeds: Seeds) -> Iterator[Chunk]:
        width, height = setting.view.width, setting.view.height
        if (
            self._scalar
            and setting.names == ("radiance",)
            and setting.still
            and not any(setting.view.velocity)
        ):
            yield from self._passes(setting, frame, spp, seeds)
            return
        rows = min(height, max(1, self._chunk // width))
        together = max(1, self._chunk // (rows * width))
        for first in range(0, spp, together):
            count = min(together, spp - first)
            for top in range(0, height, rows):
                band = slice(top, min(top + rows, height))
                values = self._band(setting, frame, band, count, seeds)
                yield Chunk(band, self._without_invalid(values))

    def _passes(self, setting: _Frame, frame: int, spp: int, seeds: Seeds) -> Iterator[Chunk]:
        """Yield radiance alone in the scalar variant: Mitsuba's own loop is many times faster than ours.

        An image of one sample per pixel and a box filter is a sample of every pixel.
        """
        import mitsuba

        view = setting.view
        render: Any = mitsuba.render
        self._loaded.displace(self._shutters(frame))
        together = max(1, self._chunk // (view.width * view.height))
        for first in range(0, spp, together):
            images = [
                np.array(
                    render(
                        self._scene,
                        sensor=setting.sensor,
                        integrator=self._radiance.path,
                        seed=seeds.next(),
                        spp=1,
                    ),
                    np.float32,
                )
                for _ in range(min(together, spp - first))
            ]
            yield Chunk(slice(0, view.height), self._without_invalid({"radiance": np.stack(images)}))

    def _band(
        self, setting: _Frame, frame: int, band: slice, count: int, seeds: Seeds
    ) -> dict[str, NDArray[np.float32]]:
        """Return `count` samples of every pixel of some rows."""
        shape = (count, band.stop - band.start, setting.view.width)
        if setting.still or not self._loaded.moving:
            self._loaded.displace(self._shutters(frame))
            flat = self._wavefront(setting, band.start, np.arange(int(np.prod(shape))), seeds.next(), None)
        else:
            flat = self._slices(setting, frame, band.start, shape, seeds)
        return {name: values.reshape(*shape, -1) for name, values in flat.items()}

    def _shutters(self, frame: int) -> int:
        """Return how many shutters have passed at a frame; independent views are all of the same moment."""
        return frame if self.spec.path else 0

    def _slices(
        self, setting: _Frame, frame: int, top: int, shape: tuple[int, int, int], seeds: Seeds
    ) -> dict[str, NDArray[np.float32]]:
        """Trace every sample with the objects where they are in the sample's slice of the shutter."""
        total = int(np.prod(shape))
        drawn = seeds.generator().integers(SLICES, size=total)
        order = np.argsort(drawn, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(drawn, minlength=SLICES))[:-1])
        result = {name: np.zeros((total, _CHANNELS.get(name, 3)), np.float32) for name in setting.names}
        for place, lanes in enumerate(parts):
            own = seeds.next()
            if not lanes.size:
                continue
            time = (place + 0.5) / SLICES
            self._loaded.displace(self._shutters(frame) + time - 0.5)
            for name, values in self._wavefront(setting, top, lanes, own, time).items():
                result[name][lanes] = values
        return result

    def _wavefront(
        self, setting: _Frame, top: int, lanes: NDArray[np.int64], seed: int, time: float | None
    ) -> dict[str, NDArray[np.float32]]:
        """Return the samples numbered `lanes`, float32 (n, C) each.

        Args:
            setting: What is traced.
            top: Row of the image that sample 0 belongs to.
            lanes: Number of each sample: by sample, row and column.
            seed: Seed of this wavefront's random numbers.
            time: Time of all samples; None: random.
        """
        import drjit
        import mitsuba

        if self._scalar:
            return self._one_by_one(setting, top, lanes, seed, time)
        self._sampler.seed(seed, len(lanes))
        index = mitsuba.UInt32(lanes.astype(np.uint32))
        values = self._trace(setting, index, top, time)
        flat = {name: drjit.ravel(value) for name, value in values.items()}
        drjit.eval(flat)
        return {
            name: _wide(np.array(value, np.float32), len(lanes), _CHANNELS.get(name, 3))
            for name, value in flat.items()
        }

    def _one_by_one(
        self, setting: _Frame, top: int, lanes: NDArray[np.int64], seed: int, time: float | None
    ) -> dict[str, NDArray[np.float32]]:
        self._sampler.seed(seed, 1)
        result = {name: np.zeros((len(lanes), _CHANNELS.get(name, 3)), np.float32) for name in setting.names}
        for i, lane in enumerate(lanes.tolist()):
            for name, value in self._trace(setting, lane, top, time).items():
                result[name][i] = value
        return result

    def _trace(self, setting: _Frame, index: Any, top: int, time: float | None) -> dict[str, Any]:
        """Trace one wavefront, or one sample."""
        import drjit
        import mitsuba

        width = drjit.opaque(mitsuba.UInt32, setting.view.width)
        height = drjit.opaque(mitsuba.UInt32, self._rows(setting, top))
        row = index // width
        column = index - row * width
        row = row % height + drjit.opaque(mitsuba.UInt32, top)
        offset = self._sampler.next_2d()
        aperture = self._sampler.next_2d()
        drawn = self._sampler.next_1d()
        when = drawn if time is None else drjit.opaque(mitsuba.Float, time)
        film = mitsuba.Point2f(
            (mitsuba.Float(column) + offset.x) / mitsuba.Float(width),
            (mitsuba.Float(row) + offset.y) / drjit.opaque(mitsuba.Float, setting.view.height),
        )
        ray, _ = setting.sensor.sample_ray(when, 0.5, film, aperture)
        if any(setting.view.velocity):
            ray.o += vector(setting.view.velocity) * (when - 0.5)
        return self._quantities(setting, ray, (when, offset, aperture))

    def _quantities(self, setting: _Frame, ray: Any, drawn: tuple[Any, Any, Any]) -> dict[str, Any]:
        import mitsuba

        time, offset, aperture = drawn
        if setting.names == ("radiance",):
            return {"radiance": self._radiance.whole(self._sampler, ray)}
        si = self._scene.ray_intersect(ray)
        lens = mitsuba.Vector2f(0.0)
        if setting.view.aperture > 0:
            lens = mitsuba.Vector2f(mitsuba.warp.square_to_uniform_disk_concentric(aperture))
        samples = Samples(si, ray, time, mitsuba.Vector2f(offset), lens, setting.still)
        wanted = [name for name in setting.names if name in GUIDES]
        values = setting.guides.of(samples, wanted)
        if setting.split:
            split = self._radiance.split(self._sampler, si, "second_albedo" in setting.names)
            values |= {name: getattr(split, name) for name in setting.names if name in RADIANCE}
        elif "radiance" in setting.names:
            values["radiance"] = self._radiance.whole(self._sampler, ray)
        return values

    def _rows(self, setting: _Frame, top: int) -> int:
        """Return how many rows the band that starts at `top` has."""
        rows = min(setting.view.height, max(1, self._chunk // setting.view.width))
        return min(rows, setting.view.height - top)

    def _setting(self, frame: int, names: tuple[str, ...], motion: Motion, static: bool) -> _Frame:
        view = self._view(frame)
        previous = self._view(frame - 1) if frame > 0 and self.spec.path else None
        guides = Guides(self._loaded, self._materials, (view, previous), motion)
        split = any(name in names for name in SPLIT)
        return _Frame(view, sensor(view), guides, names, split, static or not self._loaded.moving)

    def _view(self, frame: int) -> View:
        if not 0 <= frame < len(self.spec.views):
            raise ValueError(f"scene {self.spec.name} has no frame {frame}, only {len(self.spec.views)}")
        return self.spec.views[frame]

    def _without_invalid(self, values: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
        """Make samples black whose radiance is NaN or infinite, and count them."""
        light = [values[name] for name in ("radiance", "diffuse") if name in values]
        if not light:
            return values
        # The sum of finite numbers is finite unless it overflows, and it is much faster than looking at each.
        if all(np.isfinite(part.sum(dtype=np.float64)) for part in light):
            return values
        bad = ~np.logical_and.reduce([np.isfinite(part).all(-1) for part in light])
        self.invalid += int(bad.sum())
        for part in light:
            part[bad] = 0
        return values


def _wide(values: NDArray[np.float32], samples: int, channels: int) -> NDArray[np.float32]:
    """Return (samples, channels); quantities that are equal for all samples come as one."""
    return np.array(np.broadcast_to(values.reshape(-1, channels), (samples, channels)))
