"""Pixels of world points, and the displacement of moving objects, in the numbers of the active variant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.render.loading import LoadedScene, Vector
from data.render.spec import View
from data.render.variant import is_scalar


def view_world_to_pixel(view: View) -> NDArray[np.float64]:
    """Return the matrix (4, 4) that takes world points to pixels, as `data.camera.Camera` describes it.

    Both focal lengths use the width: pixels are square. Mitsuba's camera has +X to the left of the image.
    """
    half = np.tan(np.radians(view.fov) / 2)
    focal = view.width / (2 * half)
    onto = np.array(
        [
            [-focal, 0.0, view.width / 2, 0.0],
            [0.0, -focal, view.height / 2, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    return np.asarray(onto @ np.linalg.inv(np.asarray(view.to_world, np.float64)))


class Projection:
    """World points to pixels, in the variant's numbers."""

    def __init__(self, view: View) -> None:
        rows = view_world_to_pixel(view)[[0, 1, 3]]
        self._rows = [[number(x) for x in row] for row in rows]

    def pixel(self, point: Any, w: float = 1.0) -> tuple[Any, Any]:
        """Return pixels (2) and depths z of points; with `w` 0, of directions."""
        import drjit
        import mitsuba

        x, y, z = (row[0] * point.x + row[1] * point.y + row[2] * point.z + row[3] * w for row in self._rows)
        scale = 1.0 / drjit.select(z == 0.0, 1.0, z)
        return mitsuba.Vector2f(x * scale, y * scale), z


class Displacements:
    """The displacement over one shutter of the object that was hit."""

    def __init__(self, loaded: LoadedScene) -> None:
        import mitsuba

        self._scalar = is_scalar()
        self._shapes = {s.id(): s for s in loaded.scene.shapes() if s.id() in loaded.moving}
        if self._scalar:
            self._of = {id(shape): loaded.moving[name] for name, shape in self._shapes.items()}
            return
        numbers = {name: _shape_number(mitsuba.ShapePtr(shape)) for name, shape in self._shapes.items()}
        table = np.zeros((max(numbers.values(), default=0) + 1, 3), np.float32)
        for name, place in numbers.items():
            table[place] = loaded.moving[name]
        self._rows = len(table)
        self._table = mitsuba.Float(table.ravel())

    def of(self, si: Any) -> Any:
        """Return the displacement of every hit, 0 for what stands still."""
        import drjit
        import mitsuba

        if not self._shapes:
            return mitsuba.Vector3f(0.0)
        if self._scalar:
            return mitsuba.Vector3f(*self._of.get(id(si.shape), (0.0, 0.0, 0.0)))
        place: Any = drjit.reinterpret_array(mitsuba.UInt32, si.shape)
        known = place < drjit.opaque(mitsuba.UInt32, self._rows)
        return drjit.gather(mitsuba.Vector3f, self._table, place, known)


def _shape_number(pointer: Any) -> int:
    import drjit
    import mitsuba

    number: Any = drjit.reinterpret_array(mitsuba.UInt32, pointer)
    return int(number[0])


def number(value: float) -> Any:
    """Return a number that is no constant of the compiled kernel, so that another one needs no new kernel."""
    import drjit
    import mitsuba

    return drjit.opaque(mitsuba.Float, float(value))


def vector(values: Sequence[float] | Vector | NDArray[np.float64]) -> Any:
    """Return three such numbers."""
    import mitsuba

    return mitsuba.Vector3f(*(number(float(x)) for x in values))
