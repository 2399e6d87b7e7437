"""Random scenes to train denoisers on, made from a seed.

After J. Munkberg, J. Hasselgren, Neural denoising with layer embeddings, EGSR 2020, DOI 10.1111/cgf.14049,
section 4, and M. Gharbi et al., Sample-based Monte Carlo denoising using a kernel-splatting network, SIGGRAPH
2019, DOI 10.1145/3306346.3322954: outdoors 75 meshes on a backdrop under an environment, indoors one of eight
rooms with 50 meshes, four area lights, a point light and an environment; random materials, textures, cameras,
lenses and linear motion. The papers take meshes, textures and environments from collections; here they are
procedural, and the user's own can be mixed in.

Every part of a scene draws from a stream of its own, so that a new texture leaves all geometry as it was.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from data.render.assets import Assets, file_hash, read_environment, read_mesh, read_texture
from data.render.backdrops import random_backdrop
from data.render.blur import choose_motion, with_lens
from data.render.lights import room_lights
from data.render.materials import random_material, surface_material
from data.render.placement import Layout, Region, Surroundings, place
from data.render.room_kinds import ROOMS, random_room
from data.render.shapes import FAMILIES, random_family, random_mesh
from data.render.sketch import Sketch
from data.render.skies import random_sky, scaled
from data.render.spec import Mesh, Picture, SceneSpec, Shot, View
from data.render.surfaces import affine, rotation
from data.render.textures import random_texture
from data.render.viewpoints import choose_path, choose_view

Rng = np.random.Generator
Kind = Literal["outdoor", "indoor"]
T = TypeVar("T")

GENERATOR_VERSION = 1
"""Part of every scene's origin; raised whenever a seed would give another scene."""

OBJECTS = {"outdoor": 75, "indoor": 50}
EXPOSURE = {"outdoor": 0.6, "indoor": 1.3}
MATERIALS = 24
GLASSES = 3
MAX_TRIANGLES = 500_000
_MOST_BROKEN = 50


@dataclass
class _Source:
    """The random streams of a scene and the user's files in it."""

    seed: int
    kind: str
    assets: Assets
    used: dict[Path, str] = field(default_factory=dict)
    skipped: dict[Path, str] = field(default_factory=dict)
    _read: dict[Path, Any] = field(default_factory=dict)

    def stream(self, part: str, number: int = 0) -> Rng:
        """Return the generator of a part of the scene, independent of all others."""
        key = (zlib.crc32(self.kind.encode()), zlib.crc32(part.encode()), number)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))

    def asset(self, rng: Rng, files: tuple[Path, ...], reader: Callable[[Path], T]) -> T | None:
        """Return one of the user's files with the probability they ask for; unreadable ones are noted.

        Raises:
            ValueError: None of the files can be read, or `_MOST_BROKEN` of them cannot.
        """
        if not files or rng.random() >= self.assets.share:
            return None
        while True:
            good = [p for p in files if p not in self.skipped]
            path = good[int(rng.integers(len(good)))]
            try:
                if path not in self._read:
                    self._read[path] = reader(path)
                self.used.setdefault(path, file_hash(path))
                return self._read[path]
            except (ValueError, OSError) as error:
                self.skipped[path] = str(error)
                if len(good) == 1 or len(self.skipped) >= _MOST_BROKEN:
                    raise ValueError(
                        f"too many of your own files cannot be used; the last: {error}"
                    ) from error

    def texture(self, part: str, number: int, vividness: float = 1.0) -> Callable[[], Picture]:
        """Return what draws colour textures for a part of the scene."""
        rng = self.stream(f"texture of {part}", number)

        def draw() -> Picture:
            return self.asset(rng, self.assets.textures, read_texture) or random_texture(rng, None, vividness)

        return draw

    def mesh(self, number: int, most: int) -> tuple[Mesh, bool]:
        """Return a mesh in the unit ball of at most `most` triangles, and whether it is closed."""
        given = self.asset(self.stream("own mesh", number), self.assets.meshes, read_mesh)
        if given is not None and len(given.faces) <= most:
            return given, False
        rng = self.stream("mesh", number)
        name = random_family(rng)
        mesh = random_mesh(rng, name)
        if len(mesh.faces) > most:
            name = "prism"
            mesh = random_mesh(rng, name)
        return mesh, FAMILIES[name].closed

    def sky(self, level: float) -> dict[str, Any]:
        """Return the environment."""
        rng = self.stream("sky")
        given = self.asset(rng, self.assets.environments, read_environment)
        if given is None:
            return {"type": "envmap", "picture": random_sky(rng, level)}
        turn = affine(rotation(np.array([0.0, 1.0, 0.0]), rng.uniform(0, 2 * np.pi)))
        return {"type": "envmap", "picture": scaled(given.pixels.astype(np.float64), level), "to_world": turn}


def random_scene(seed: int, kind: Kind, shot: Shot, assets: Assets | None = None) -> SceneSpec:
    """Return the scene of a seed; the same arguments always give the same scene.

    Args:
        seed: 0 or more.
        kind: `outdoor` or `indoor`.
        shot: Size and number of the views, whether they follow a path, odds of defocus and motion.
        assets: The user's meshes, textures and environments, mixed in.

    Raises:
        ValueError: Unknown kind, negative seed, or none of the user's files can be read.
    """
    if kind not in OBJECTS:
        raise ValueError(f"kind {kind!r} of random scene; expected outdoor or indoor")
    if seed < 0:
        raise ValueError(f"seed {seed} of a random scene is negative; give 0 or more")
    source = _Source(seed, kind, assets or Assets())
    content, sketch = _outdoor(source) if kind == "outdoor" else _indoor(source)
    views = _views(source, sketch, shot)
    moving: dict[str, tuple[float, float, float]] = {}
    if source.stream("moves").random() < shot.motion:
        moved = choose_motion(source.stream("motion"), sketch, views, shot.path)
        moving = {f"object-{k:02d}": shift for k, shift in moved.items()}
    return SceneSpec(
        name=f"{kind}-{seed:06d}",
        content=content,
        views=views,
        moving=moving,
        path=shot.path,
        origin=_origin(source, shot, assets),
        credit="Penumbra procedural scene" + (", with files of the user's" if source.used else ""),
        license=f"as the assets: {', '.join(p.name for p in sorted(source.used))}"
        if source.used
        else "CC0-1.0",
    )


def _origin(source: _Source, shot: Shot, assets: Assets | None) -> dict[str, Any]:
    """Return what makes the scene again, as plain JSON."""
    files = {p.name: digest for p, digest in sorted(source.used.items())}
    own = None
    if assets is not None:
        skipped = [said.replace(str(p), p.name) for p, said in sorted(source.skipped.items())]
        own = {"hash": assets.hash, "share": assets.share, "used": files, "skipped": skipped}
    return {
        "generator": "penumbra",
        "version": GENERATOR_VERSION,
        "seed": source.seed,
        "kind": source.kind,
        "shot": asdict(shot),
        "assets": own,
    }


def _level(source: _Source) -> float:
    """Return the radiance of a grey surface: two stops around what puts the median pixel near 0.3."""
    return float(EXPOSURE[source.kind] * 2 ** source.stream("exposure").uniform(-2, 2))


def _surface(source: _Source, part: str) -> dict[str, Any]:
    rng = source.stream(f"surface {part}")
    vividness = 1.0 if rng.random() < 0.4 else float(rng.uniform(0.1, 0.6))
    return surface_material(rng, source.texture(part, 0, vividness), vividness)


def _materials(source: _Source) -> dict[str, Any]:
    """Return the materials that the objects share: opaque ones, then glasses."""
    result = {}
    for i in range(MATERIALS + GLASSES):
        rng = source.stream("material", i)
        result[f"material-{i:02d}"] = random_material(rng, source.texture("material", i), i >= MATERIALS)
    return result


def _objects(source: _Source, region: Region, around: Surroundings, layout: Layout) -> dict[str, Any]:
    """Return the meshes, placed."""
    result: dict[str, Any] = {}
    count = OBJECTS[source.kind]
    left = MAX_TRIANGLES - 50_000
    for i in range(count):
        # What is left is shared so that even the last object has its thousand triangles.
        mesh, closed = source.mesh(i, left - 2000 * (count - 1 - i))
        left -= len(mesh.faces)
        placed = place(source.stream("place", i), mesh, region, around, layout)
        rng = source.stream("assign", i)
        number = int(rng.integers(MATERIALS))
        if rng.random() < 0.07 and closed:
            number = MATERIALS + int(rng.integers(GLASSES))
        repeat = np.float32(np.exp(rng.uniform(np.log(0.6), np.log(5.0))))
        uvs = None if placed.uvs is None else placed.uvs * repeat
        placed = Mesh(placed.vertices, placed.faces, placed.normals, uvs)
        bsdf = {"type": "ref", "id": f"material-{number:02d}"}
        result[f"object-{i:02d}"] = {"type": "mesh", "mesh": placed, "bsdf": bsdf}
    return result


def _outdoor(source: _Source) -> tuple[dict[str, Any], Sketch]:
    backdrop = random_backdrop(source.stream("backdrop"))
    layout, rng = Layout(), source.stream("region")
    half = np.full(2, rng.uniform(3.0, 5.5))
    region = Region(-half, half, True, rng.uniform(1.0, 3.5), (0.12, 0.95))
    content = _materials(source)
    content |= _objects(source, region, backdrop, layout)
    content["ground"] = {"type": "mesh", "mesh": backdrop.mesh, "bsdf": _surface(source, "ground")}
    content["sky"] = source.sky(_level(source))
    return content, Sketch(layout, backdrop, OBJECTS["outdoor"], None, backdrop.facing)


def _indoor(source: _Source) -> tuple[dict[str, Any], Sketch]:
    rng = source.stream("room")
    room = random_room(rng, list(ROOMS)[int(rng.integers(len(ROOMS)))])
    low, high = room.bounds
    layout = Layout()
    region = Region(low[[0, 2]], high[[0, 2]], False, 0.6 * room.height, (0.12, 0.6))
    content = _materials(source)
    content |= _objects(source, region, room, layout)
    for name, mesh in room.parts.items():
        repeat = np.float32(source.stream(f"repeat {name}").uniform(0.25, 1.0))
        uvs = None if mesh.uvs is None else mesh.uvs * repeat
        part = Mesh(mesh.vertices, mesh.faces, mesh.normals, uvs)
        content[name] = {"type": "mesh", "mesh": part, "bsdf": _surface(source, name)}
    level = _level(source)
    content |= room_lights(source.stream("lights"), room, layout, level)
    outside = float(np.exp(source.stream("outside").uniform(np.log(0.3), np.log(8.0))))
    content["sky"] = source.sky(level * outside)
    bounds = (low * [1, 0, 1] + [0, 0.35, 0], np.array([high[0], min(2.4, 0.8 * high[1]), high[2]]))
    return content, Sketch(layout, room, OBJECTS["indoor"], bounds)


def _views(source: _Source, sketch: Sketch, shot: Shot) -> tuple[View, ...]:
    rng = source.stream("camera")
    if shot.path:
        views = choose_path(rng, sketch, shot)
    else:
        views = tuple(choose_view(source.stream("camera", i), sketch, shot) for i in range(shot.frames))
    if source.stream("blurs").random() >= shot.defocus:
        return views
    if not shot.path:
        return tuple(with_lens(source.stream("lens", i), sketch, v) for i, v in enumerate(views))
    lens = with_lens(source.stream("lens"), sketch, views[0])
    return tuple(
        View(v.to_world, v.fov, v.width, v.height, aperture=lens.aperture, focus=lens.focus) for v in views
    )
