"""What is to be rendered, as plain data: a scene, its views, meshes and pictures. Needs no renderer.

A scene's `content` is a dictionary as Mitsuba's `load_dict` takes it, without sensor, film and integrator,
in which three kinds of leaves are still plain data: `{"type": "mesh", "mesh": Mesh, "bsdf": {…}}` for a
shape, `{"type": "bitmap" | "envmap", "picture": Picture, …}` for an image, and 4x4 arrays for transforms.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: Positions, float32 (N, 3).
        faces: Vertex numbers, uint32 (M, 3), counter-clockwise seen from outside.
        normals: Unit vertex normals, float32 (N, 3); None: flat faces.
        uvs: Texture coordinates, float32 (N, 2); None: no texture can be used.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    normals: NDArray[np.float32] | None = None
    uvs: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Picture:
    """An image used as texture or environment.

    Attributes:
        pixels: Linear values, float32 (H, W, 1 or 3), row 0 at the top.
        raw: The values are no colour (roughness, weights).
    """

    pixels: NDArray[np.float32]
    raw: bool = False


@dataclass(frozen=True)
class View:
    """A camera at one frame.

    Attributes:
        to_world: 4x4, camera to world, column vectors; the camera looks along +Z, +X is to the LEFT, +Y up.
        fov: Horizontal field of view in degrees.
        width: Columns of the image.
        height: Rows of the image.
        near: Near clipping distance in scene units.
        far: Far clipping distance in scene units.
        aperture: Radius of the lens in scene units, 0 for a pinhole.
        focus: Z depth that is in focus.
        velocity: Displacement of the camera over the shutter (3,), in scene units.
    """

    to_world: NDArray[np.float64]
    fov: float
    width: int
    height: int
    near: float = 1e-2
    far: float = 1e4
    aperture: float = 0.0
    focus: float = 1.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Shot:
    """What a scene has to provide.

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        frames: Frames of a scene: one still, or consecutive frames of a camera path, or several views.
        path: The frames follow each other along a camera path; otherwise they are independent views.
        defocus: Probability that a random scene is seen through a lens of finite aperture.
        motion: Probability that objects of a random scene move during the shutter.
    """

    width: int
    height: int
    frames: int = 1
    path: bool = False
    defocus: float = 0.5
    motion: float = 0.5


@dataclass
class SceneSpec:
    """A scene that can be rendered.

    Attributes:
        name: Unique in a data set; the name of a folder.
        content: See the module; or the path of a Mitsuba XML file.
        views: One per frame.
        moving: Id of a shape in `content` → its linear displacement over one shutter (3,), scene units.
            A shape is where `content` says at the middle of the shutter of frame 0, and moves on from there
            from frame to frame of a path: at frame i and time t in [0, 1) it is displaced by
            `displacement * (i + t - 0.5)`. Independent views (`path` is False) are all of frame 0's moment.
        path: Consecutive frames of one camera path.
        origin: Everything needed to make this scene again: generator, version, seed, kind, options, hashes of
            files. Plain JSON; jobs are keyed by it.
        credit: Author.
        license: Terms under which pictures of it may be passed on.
    """

    name: str
    content: dict[str, Any] | Path
    views: tuple[View, ...]
    moving: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    path: bool = False
    origin: dict[str, Any] = field(default_factory=dict)
    credit: str = ""
    license: str = ""

    def fingerprint(self) -> str:
        """Return a hash of everything in the scene, arrays included; equal scenes have equal ones."""
        digest = hashlib.sha256()
        content = self.content if isinstance(self.content, dict) else str(self.content)
        for part in _parts([content, [vars(v) for v in self.views], self.moving]):
            digest.update(part)
        return digest.hexdigest()


def _parts(value: Any) -> Iterator[bytes]:
    """Yield bytes that two values share exactly if they are equal."""
    if isinstance(value, Mapping):
        for key in sorted(value):
            yield f"key {key}\0".encode()
            yield from _parts(value[key])
    elif isinstance(value, (Mesh, Picture)):
        yield from _parts(vars(value))
    elif isinstance(value, np.ndarray):
        yield f"array {value.dtype} {value.shape}\0".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, (list, tuple)):
        yield f"list {len(value)}\0".encode()
        for item in value:
            yield from _parts(item)
    else:
        yield json.dumps(value.item() if isinstance(value, np.generic) else value).encode() + b"\0"
