"""A scene description becomes a Mitsuba scene whose moving meshes can be displaced."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.render.spec import Mesh, Picture, SceneSpec, View

Vector = tuple[float, float, float]
_VIEWING = ("sensor", "integrator", "film")
_SENSORS = ("perspective", "thinlens", "orthographic", "batch", "radiancemeter", "irradiancemeter")


@dataclass
class LoadedScene:
    """A scene in Mitsuba's memory.

    Attributes:
        scene: The `mitsuba.Scene`.
        moving: Id of a shape that can be displaced → its displacement over one shutter.
    """

    scene: Any
    moving: dict[str, Vector] = field(default_factory=dict)
    _parameters: Any = None
    _rest: dict[str, tuple[NDArray[np.float32], Any]] = field(default_factory=dict)
    _at: float = 0.0

    def displace(self, shutters: float) -> None:
        """Move all moving shapes to where they are `shutters` after the description's own time.

        Args:
            shutters: Time in shutters; at frame i and time t of its shutter it is `i + t - 0.5`.
        """
        if not self.moving or shutters == self._at:
            return
        for name, displacement in self.moving.items():
            positions = self._rest[name][0] + np.float32(shutters) * np.asarray(displacement, np.float32)
            self._set(f"{name}.vertex_positions", positions.ravel())
        self._parameters.update()
        # Mitsuba makes its own vertex normals whenever positions change; a displacement keeps the given ones.
        kept = {name: normals for name, (_, normals) in self._rest.items() if normals is not None}
        for name, normals in kept.items():
            self._set(f"{name}.vertex_normals", normals)
        if kept:
            self._parameters.update()
        self._at = shutters

    def _set(self, key: str, values: NDArray[np.float32]) -> None:
        # A copy: Dr.Jit shares memory with NumPy, and Mitsuba writes its own normals into it.
        self._parameters[key] = type(self._parameters[key])(values.copy())


def load(spec: SceneSpec) -> LoadedScene:
    """Load a scene, without its cameras.

    Mitsuba's optimisation merges meshes of one material: these can no longer be moved apart, and they come
    in the order of addresses in memory, so that the same seed chooses other lights in every process.

    Raises:
        ValueError: Mitsuba cannot load it, the message names the scene or the file and says what Mitsuba
            said; or `moving` names something that is not a mesh of the scene.
    """
    if isinstance(spec.content, Path):
        return _moving(spec, load_file(spec.content))
    import mitsuba

    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        content = _Conversion(Path(folder)).of(spec.content)
        content = {k: v for k, v in content.items() if not _views(k, v)}
        try:
            scene = mitsuba.load_dict({"type": "scene", **content}, optimize=False)
        except Exception as error:
            raise ValueError(f"scene {spec.name}: Mitsuba cannot load it: {_told(error)}") from error
    return _moving(spec, scene)


def load_file(path: Path) -> Any:
    """Return the `mitsuba.Scene` of an XML file.

    Raises:
        ValueError: Missing file, broken XML, unknown plugin, missing texture …; names the file.
    """
    import mitsuba

    if not path.is_file():
        raise ValueError(f"scene {path} does not exist; name a Mitsuba XML file")
    try:
        return mitsuba.load_file(str(path), optimize=False)
    except Exception as error:
        text = _told(error)
        hint = ""
        if "unreferenced" in text or "Plugin" in text or "could not be found" in text:
            hint = (
                " (files for Mitsuba 0.5 and 0.6 use plugins and properties that Mitsuba 3 has not: remove "
                "the property, or replace the plugin by a present one)"
            )
        raise ValueError(f"scene {path}: Mitsuba cannot load it: {text}{hint}") from error


def sensor(view: View) -> Any:
    """Return the `mitsuba.Sensor` of a view: pinhole, or thin lens where the aperture is not 0."""
    import mitsuba

    lens: dict[str, Any] = {"type": "perspective"}
    if view.aperture > 0:
        lens = {"type": "thinlens", "aperture_radius": view.aperture, "focus_distance": view.focus}
    size = {"width": view.width, "height": view.height}
    film = {"type": "hdrfilm", **size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return mitsuba.load_dict(
        {
            **lens,
            "fov": view.fov,
            "fov_axis": "x",
            "near_clip": view.near,
            "far_clip": view.far,
            "to_world": mitsuba.ScalarTransform4f(np.asarray(view.to_world, np.float64)),
            "film": {**film, "component_format": "float32"},
            "sampler": {"type": "independent"},
        }
    )


@dataclass
class _Conversion:
    """Plain data to what `load_dict` takes."""

    folder: Path
    _written: dict[int, Path] = field(default_factory=dict)

    def of(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return a plugin's dictionary with its plain leaves replaced."""
        result: dict[str, Any] = {}
        for key, value in content.items():
            if isinstance(value, Mesh):
                result |= {"type": "ply", "filename": str(self._file(value))}
                if value.normals is None:
                    result["face_normals"] = True
            elif isinstance(value, Picture):
                result |= _picture(value, str(content.get("type")))
            elif not (key == "type" and value == "mesh"):
                result[key] = self._leaf(value)
        return result

    def _leaf(self, value: Any) -> Any:
        import mitsuba

        if isinstance(value, Mapping):
            return self.of(value)
        if isinstance(value, np.ndarray) and value.shape == (4, 4):
            return mitsuba.ScalarTransform4f(np.asarray(value, np.float64))
        if isinstance(value, np.ndarray) and value.shape == (3, 3):
            return mitsuba.ScalarTransform3f(np.asarray(value, np.float64))
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        return value

    def _file(self, mesh: Mesh) -> Path:
        if id(mesh) not in self._written:
            path = self.folder / f"{len(self._written):05d}.ply"
            _write_ply(path, mesh)
            self._written[id(mesh)] = path
        return self._written[id(mesh)]


def _picture(picture: Picture, plugin: str) -> dict[str, Any]:
    import mitsuba

    bitmap = mitsuba.Bitmap(np.ascontiguousarray(picture.pixels, np.float32))
    return {"bitmap": bitmap} if plugin == "envmap" else {"bitmap": bitmap, "raw": picture.raw}


def _write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY file: Mitsuba loads these in parallel and merges equal materials."""
    columns = {"x y z": mesh.vertices, "nx ny nz": mesh.normals, "u v": mesh.uvs}
    given = {names: np.asarray(values, "<f4") for names, values in columns.items() if values is not None}
    properties = "".join(f"property float {name}\n" for names in given for name in names.split())
    faces = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("vertices", "<u4", 3)]))
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        file.write(np.hstack(list(given.values())).tobytes())
        file.write(faces.tobytes())


def _views(key: str, value: Any) -> bool:
    """Return whether an entry of the description is about viewing the scene, which views do."""
    if key in _VIEWING or key == "type":
        return True
    return isinstance(value, Mapping) and value.get("type") in _SENSORS


def _moving(spec: SceneSpec, scene: Any) -> LoadedScene:
    if not spec.moving:
        return LoadedScene(scene)
    import mitsuba

    parameters = mitsuba.traverse(scene)
    rest: dict[str, tuple[NDArray[np.float32], Any]] = {}
    for name in spec.moving:
        key = f"{name}.vertex_positions"
        if key not in parameters:
            known = sorted(str(k).rsplit(".", 1)[0] for k in parameters.keys() if k.endswith(".faces"))  # noqa: SIM118
            raise ValueError(
                f"scene {spec.name}: moving object {name!r} is no mesh; meshes: {', '.join(known)}"
            )
        normals = np.array(parameters[f"{name}.vertex_normals"], np.float32)
        rest[name] = (
            np.array(parameters[key], np.float32).reshape(-1, 3),
            normals if normals.size else None,
        )
    return LoadedScene(scene, dict(spec.moving), parameters, rest)


def _told(error: Exception) -> str:
    """Return what Mitsuba said, on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines)[:600] or type(error).__name__
