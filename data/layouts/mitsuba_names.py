"""Names in Mitsuba's films: what a channel is, by its letters and by the name that its user gave."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

MOMENT = "m2_"
"""Prefix of second moments, written by the moment integrator."""

_NORMAL = re.compile(r"(sh(ading)?_?)?(n|nn|ns|nrm|norm|normals?)", re.IGNORECASE)
_GEOMETRIC = re.compile(r"(geo(metric)?_?|g)(n|nn|normals?)|ng", re.IGNORECASE)
_POSITION = re.compile(r"p|pp|pos|position|xyz|(world_?)?(pos|position)", re.IGNORECASE)
_ALBEDO = re.compile(r"a|aa|alb|albedo|(diffuse_?)?(reflectance|albedo)|kd", re.IGNORECASE)
_DEPTH = re.compile(r"d|dd|depth|dist|distance|z|zz", re.IGNORECASE)


@dataclass(frozen=True)
class Roles:
    """Which channels are what.

    Attributes:
        buffers: Buffer → channels: color, diffuse_albedo, normal, position, depth.
        unknown: Layers with X, Y, Z of unknown meaning; a normal where nothing else is and the length is 1.
        nested: Layers with the picture of a nested integrator.
        moments: Layer → its channels of second moments.
        ignored: The other channels.
    """

    buffers: dict[str, list[str]]
    unknown: dict[str, list[str]]
    nested: dict[str, list[str]]
    moments: dict[str, dict[str, str]]
    ignored: list[str]


def roles_of(channels: Iterable[str]) -> Roles:
    """Return which channels of a film are what, by their letters and names."""
    layers: dict[str, dict[str, str]] = {}
    for channel in channels:
        layer, _, letter = channel.rpartition(".")
        layers.setdefault(layer, {})[letter.upper()] = channel
    roles = Roles({}, {}, {}, {}, [])
    geometric: list[str] = []
    for layer, letters in layers.items():
        name, members = layer.rpartition(".")[2], [letters[c] for c in sorted(letters)]
        if layer.startswith(MOMENT):
            roles.moments[layer.removeprefix(MOMENT)] = letters
        elif {"R", "G", "B"} <= letters.keys():
            members = [letters[c] for c in "RGB"]
            # Nested integrators write alpha too, the albedo AOV does not.
            albedo = _ALBEDO.fullmatch(name) and "A" not in letters
            kind = "color" if not layer else "diffuse_albedo" if albedo else ""
            if kind and kind not in roles.buffers:
                roles.buffers[kind] = members
            else:
                roles.nested[layer] = members
        elif letters.keys() == {"X", "Y", "Z"}:
            geometric += members if _GEOMETRIC.fullmatch(name) else []
            _vector(roles, layer, name, members, MOMENT + layer in layers)
        elif letters.keys() == {"T"} or (len(members) == 1 and _DEPTH.fullmatch(name)):
            roles.buffers.setdefault("depth", members)
        elif not layer and "Y" in letters and letters.keys() <= {"Y", "A"}:
            roles.buffers["color"] = [letters["Y"]] * 3
        else:
            roles.ignored.extend(members)
    if geometric and "normal" not in roles.buffers:
        roles.buffers["normal"] = geometric[:3]
    return roles


def _vector(roles: Roles, layer: str, name: str, channels: list[str], moment: bool) -> None:
    if _NORMAL.fullmatch(name):
        roles.buffers.setdefault("normal", channels)
    elif _POSITION.fullmatch(name):
        roles.buffers.setdefault("position", channels)
    elif not _GEOMETRIC.fullmatch(name):
        # The moment integrator writes its nested pictures as CIE XYZ.
        if moment and "." not in layer:
            roles.ignored.extend(channels)
        else:
            roles.unknown[layer] = channels
