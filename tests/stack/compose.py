"""Reads the compose file and Dockerfiles as an engine would, to run the same commands without one."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "infra" / "compose"
VARIABLE = re.compile(r"\$(?:(\$)|\{(\w+)(?::?([-?])([^}]*))?\})")


@dataclass
class Service:
    """One service of the compose file, with variables filled in.

    Attributes:
        paths: Path in the container → file of the checkout that the image or a bind mount puts there.
        volumes: Path in the container → name of the volume.
    """

    name: str
    command: list[str]
    environment: dict[str, str]
    health: list[str]
    entrypoint: list[str] = field(default_factory=list)
    paths: dict[str, Path] = field(default_factory=dict)
    volumes: dict[str, str] = field(default_factory=dict)


def settings() -> dict[str, str]:
    """Return the variables of `.env.example`."""
    lines = (FOLDER / ".env.example").read_text().splitlines()
    pairs = (line.split("=", 1) for line in lines if line.strip() and not line.startswith("#"))
    return {name.strip(): value.strip() for name, value in pairs}


def interpolate(text: str, variables: dict[str, str]) -> str:
    """Fill in `${NAME}`, `${NAME:-default}` and `${NAME:?message}` as Compose does.

    Raises:
        KeyError: A variable has no value and no default.
    """

    def value(match: re.Match[str]) -> str:
        dollar, name, kind, default = match.groups()
        if dollar:
            return "$"
        if variables.get(name):
            return variables[name]
        if kind == "-":
            return default
        raise KeyError(f"{name} has neither a value nor a default in compose.yaml")

    return VARIABLE.sub(value, text)


def read_compose(variables: dict[str, str] | None = None) -> dict[str, Any]:
    """Return the compose file with `variables` (those of `.env.example` where None) filled in."""
    text = (FOLDER / "compose.yaml").read_text()
    return yaml.safe_load(interpolate(text, settings() if variables is None else variables))


def read_services(document: dict[str, Any]) -> dict[str, Service]:
    """Return the services of a compose document."""
    return {name: _service(name, entry) for name, entry in document["services"].items()}


def _service(name: str, entry: dict[str, Any]) -> Service:
    service = Service(
        name=name,
        command=[str(word) for word in entry["command"]],
        environment={key: str(value) for key, value in entry.get("environment", {}).items()},
        health=_health(entry.get("healthcheck", {})),
    )
    if image := image_of(entry["image"]):
        service.entrypoint = image.entrypoint
        service.paths = dict(image.copies)
    for mount in entry.get("volumes", []):
        source, target = mount.split(":")[:2]
        if source.startswith("."):
            service.paths[target] = (FOLDER / source).resolve()
        else:
            service.volumes[target] = source
    return service


def _health(check: dict[str, Any]) -> list[str]:
    if check.get("disable"):
        return []
    kind, *words = check["test"]
    assert kind == "CMD", f"health checks run without a shell, not as {kind}"
    return words


@dataclass
class Image:
    """What a stage of a Dockerfile and those below it say, as far as running needs it."""

    instructions: list[tuple[str, str]]

    def last(self, word: str) -> str | None:
        """Return the arguments of the last instruction of a kind."""
        found = [arguments for kind, arguments in self.instructions if kind == word]
        return found[-1] if found else None

    @property
    def entrypoint(self) -> list[str]:
        """ENTRYPOINT in its list form."""
        return json.loads(self.last("ENTRYPOINT") or "[]")

    @property
    def command(self) -> list[str]:
        """CMD in its list form."""
        return json.loads(self.last("CMD") or "[]")

    @property
    def health(self) -> list[str]:
        """Command of HEALTHCHECK in its list form."""
        return json.loads((self.last("HEALTHCHECK") or "CMD []").split("CMD", 1)[1])

    @property
    def copies(self) -> dict[str, Path]:
        """Path in the image → path in the checkout, for every COPY from the build context."""
        found = {}
        for kind, arguments in self.instructions:
            if kind != "COPY" or "--from=" in arguments:
                continue
            *sources, target = [word for word in arguments.split() if not word.startswith("--")]
            for source in sources:
                place = f"{target}/{Path(source).name}" if len(sources) > 1 else target
                found[place] = ROOT / source
        return found


def read_dockerfile(path: Path) -> dict[str, Image]:
    """Return the stages of a Dockerfile by name, each with what it inherits."""
    text = re.sub(r"\\\n", " ", re.sub(r"^\s*#.*\n", "", path.read_text(), flags=re.MULTILINE))
    stages: dict[str, Image] = {}
    current = Image([])
    for line in filter(None, map(str.strip, text.splitlines())):
        word, _, arguments = line.partition(" ")
        if word == "FROM":
            parent, _, name = arguments.partition(" AS ")
            inherited = stages[parent].instructions if parent in stages else []
            current = stages[name] = Image([*inherited, ("FROM", parent)])
        elif stages:
            current.instructions.append((word, arguments.strip()))
    return stages


def image_of(name: str) -> Image | None:
    """Return the image of this project that `REGISTRY/TARGET:VERSION` names, None for one of others."""
    target = name.rsplit("/", 1)[-1].split(":")[0]
    for path in sorted((ROOT / "docker").glob("*Dockerfile")):
        stages = read_dockerfile(path)
        if "/" in name and target in stages:
            return stages[target]
    return None
