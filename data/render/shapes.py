"""The families of procedural meshes and how one is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from data.render import implicit, sheets, solids, swept
from data.render.spec import Mesh
from data.render.surfaces import normalised

Rng = np.random.Generator


@dataclass(frozen=True)
class Family:
    """A kind of mesh.

    Attributes:
        make: Draws one; deterministic in the state of the generator.
        closed: Its meshes bound a volume, so that they can be made of glass.
        weight: How often it is drawn, relative to the others.
    """

    make: Callable[[Rng], Mesh]
    closed: bool = True
    weight: float = 1.0


FAMILIES: dict[str, Family] = {
    "metaballs": Family(implicit.metaballs),
    "minimal_surface": Family(implicit.minimal_surface, weight=0.6),
    "blend": Family(implicit.blend),
    "cut_solid": Family(implicit.cut_solid),
    "torus": Family(swept.torus),
    "knot": Family(swept.knot),
    "spring": Family(swept.spring),
    "worm": Family(swept.worm, weight=0.7),
    "shell": Family(swept.shell, closed=False),
    "lathe": Family(swept.lathe, weight=1.5),
    "chain": Family(swept.chain, closed=False, weight=0.7),
    "superquadric": Family(solids.superquadric, weight=1.5),
    "displaced_sphere": Family(solids.displaced_sphere),
    "displaced_box": Family(solids.displaced_box),
    "prism": Family(solids.prism),
    "gear": Family(solids.gear),
    "rock": Family(solids.rock),
    "fragments": Family(solids.fragments, closed=False),
    "plate": Family(sheets.plate, weight=0.7),
    "blades": Family(sheets.blades, closed=False),
    "terrain": Family(sheets.terrain, weight=0.5),
    "towers": Family(solids.towers, closed=False, weight=0.7),
}
"""Name → family, 22 of them."""


def random_family(rng: Rng) -> str:
    """Return the name of a random family."""
    weights = np.array([f.weight for f in FAMILIES.values()])
    return list(FAMILIES)[int(np.searchsorted(np.cumsum(weights / weights.sum()), rng.random()))]


def random_mesh(rng: Rng, family: str) -> Mesh:
    """Return a mesh of a family, with normals and texture coordinates, in the unit ball."""
    return normalised(FAMILIES[family].make(rng))
