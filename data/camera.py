"""Cameras: world points to pixels, positions to depth, motion between frames.

Pixels are measured from the top left corner of the image, x to the right, y down, centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

DepthKind = Literal["z", "euclidean"]
"""`z`: the homogeneous coordinate w of the projected point (BMFR, "clip w"); `euclidean`: the distance from
the camera's centre (Penumbra's own renders, Mitsuba)."""


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        world_to_pixel: 4x4, column vectors: `p = M @ [x, y, z, 1]`, pixel `p[:2] / p[3]`; `p[3]` is the
            z depth, positive in front of the camera.
        origin: Centre of the camera in world space (3,), None where the source does not say.
        offset: Where in a pixel this frame's rays passed, x and y from the pixel's top left corner.
    """

    world_to_pixel: NDArray[np.float64]
    origin: NDArray[np.float64] | None = None
    offset: tuple[float, float] = (0.5, 0.5)

    def centre(self) -> NDArray[np.float64]:
        """Return the centre of projection (3,): `origin`, or the point that projects to (0, 0, w = 0).

        Raises:
            ValueError: The matrix is not a perspective projection.
        """
        if self.origin is not None:
            return np.asarray(self.origin, np.float64)
        rows = self.world_to_pixel[[0, 1, 3]]
        try:
            return np.asarray(np.linalg.solve(rows[:, :3], -rows[:, 3]), np.float64)
        except np.linalg.LinAlgError:
            raise ValueError("the camera matrix is not a perspective projection: no centre") from None

    def to_json(self) -> dict[str, Any]:
        """Return a plain dictionary, for headers and manifests."""
        return {
            "world_to_pixel": np.asarray(self.world_to_pixel, float).tolist(),
            "origin": None if self.origin is None else np.asarray(self.origin, float).tolist(),
            "offset": list(self.offset),
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> Camera:
        """Return the camera that `to_json` described.

        Raises:
            ValueError: The matrix is missing or not 4x4.
        """
        try:
            matrix = np.asarray(values["world_to_pixel"], np.float64)
        except (KeyError, TypeError, ValueError):
            raise ValueError("camera without a 4x4 `world_to_pixel` matrix") from None
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"camera matrix `world_to_pixel` has shape {matrix.shape}, expected finite 4x4")
        origin = values.get("origin")
        x, y = values.get("offset") or (0.5, 0.5)
        return Camera(
            matrix, None if origin is None else np.asarray(origin, np.float64), (float(x), float(y))
        )


def project(camera: Camera, position: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels (..., 2) of world points (..., 3) and their w (...).

    Points with w <= 0 are behind the camera; their pixels are meaningless and may be infinite.
    """
    matrix = camera.world_to_pixel
    points = np.asarray(position, np.float64)
    homogeneous = points @ matrix[[0, 1, 3], :3].T + matrix[[0, 1, 3], 3]
    w = homogeneous[..., 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return homogeneous[..., :2] / w[..., None], w


def depth(camera: Camera, position: NDArray[Any], kind: DepthKind) -> NDArray[np.float32]:
    """Return the depth (H, W, 1) of world positions (H, W, 3), in scene units.

    Args:
        camera: Camera of the same frame.
        position: First hits in world space.
        kind: `z` for the projected point's w, `euclidean` for the distance from the centre.
    """
    if kind == "z":
        return project(camera, position)[1][..., None].astype(np.float32)
    offset = np.asarray(position, np.float64) - camera.centre()
    return np.sqrt((offset * offset).sum(-1, keepdims=True)).astype(np.float32)


def motion(position: NDArray[Any], current: Camera, previous: Camera) -> NDArray[np.float32]:
    """Return previous pixel minus current pixel (H, W, 2) of static world points (H, W, 3).

    Both are projections of the same point, so the position of the sample within its pixel cancels. Points
    behind either camera get 0.
    """
    now, w_now = project(current, position)
    before, w_before = project(previous, position)
    visible = ((w_now > 0) & (w_before > 0))[..., None]
    with np.errstate(invalid="ignore"):
        return np.where(visible, before - now, 0.0).astype(np.float32)


def footprint(camera: Camera, position: NDArray[Any]) -> NDArray[np.float32]:
    """Return the width of a pixel (H, W) at world positions (H, W, 3) on a plane that faces the camera.

    It is w divided by the focal length in pixels, in scene units; negative behind the camera.
    """
    axis = camera.world_to_pixel[3, :3]
    length = np.linalg.norm(axis)
    across = camera.world_to_pixel[0, :3]
    focal = np.linalg.norm(across - (across @ axis) / length**2 * axis) / length
    return (project(camera, position)[1] / (focal * length)).astype(np.float32)
