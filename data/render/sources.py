"""Where scenes come from: a generator and a seed, or a file. Small enough to be sent to other processes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from data.render.assets import Assets
from data.render.random_scenes import GENERATOR_VERSION, Kind, random_scene
from data.render.scene_files import scene_files_hash, scene_name
from data.render.spec import SceneSpec, Shot

if TYPE_CHECKING:
    from data.render.user_scenes import CameraMove


class Source(Protocol):
    """A scene that can be built."""

    @property
    def name(self) -> str:
        """Name of the scene."""

    @property
    def shot(self) -> Shot:
        """Size and number of the views."""

    def identity(self) -> dict[str, Any]:
        """Return what tells this scene from others, plain JSON; cheap."""

    def build(self) -> SceneSpec:
        """Make the scene; may need the renderer."""


@dataclass(frozen=True)
class RandomSource:
    """A procedural scene.

    Attributes:
        seed: Of the scene.
        kind: `outdoor` or `indoor`.
        shot: Size and number of the views.
        assets: The user's meshes, textures and environments, mixed in.
    """

    seed: int
    kind: Kind
    shot: Shot
    assets: Assets | None = None

    @property
    def name(self) -> str:
        """Kind and seed."""
        return f"{self.kind}-{self.seed:06d}"

    def identity(self) -> dict[str, Any]:
        """Return generator, seed, kind, shot and the hash of the assets."""
        assets = None if self.assets is None else self.assets.hash
        return {
            "generator": GENERATOR_VERSION,
            "seed": self.seed,
            "kind": self.kind,
            "shot": asdict(self.shot),
            "assets": assets,
        }

    def build(self) -> SceneSpec:
        """Generate the scene."""
        return random_scene(self.seed, self.kind, self.shot, self.assets)


@dataclass(frozen=True)
class FileSource:
    """A scene in a Mitsuba XML file.

    Attributes:
        path: The file.
        shot: Size and number of the views.
        move: What the camera does.
        seed: Of the camera's random moves.
    """

    path: Path
    shot: Shot
    move: CameraMove
    seed: int

    @property
    def name(self) -> str:
        """Name of the file; that of its folder where the file is called scene.xml."""
        return scene_name(self.path)

    def identity(self) -> dict[str, Any]:
        """Return the hash of the file and of those it refers to, shot, move and seed."""
        return {
            "files": scene_files_hash(self.path),
            "shot": asdict(self.shot),
            # Where the key frames lie does not matter: their digest is part of the move.
            "move": {name: value for name, value in asdict(self.move).items() if name != "path"},
            "seed": self.seed,
        }

    def build(self) -> SceneSpec:
        """Read the camera and plan its views."""
        from data.render.user_scenes import user_scene

        return user_scene(self.path, self.shot, self.move, self.seed)
