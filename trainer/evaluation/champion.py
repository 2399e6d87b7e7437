"""Which version of a registered model is the champion: the best one that is worse in no scene."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from trainer.evaluation.plan import Method
from trainer.evaluation.tables import Scored
from trainer.metrics.measures import SCORES
from trainer.spool.store import open_client

ALIAS = "champion"


@dataclass(frozen=True)
class Registered:
    """A method that is a version of a registered model.

    Attributes:
        label: Of the method.
        name: Of the model.
        version: Its number.
    """

    label: str
    name: str
    version: str


@dataclass(frozen=True)
class Decision:
    """Whether a version becomes the champion.

    Attributes:
        name: Of the model.
        version: The best one.
        before: The champion so far, None where there was none.
        reasons: Why it does not become it; empty where it does, or is it already.
        alone: Scenes in which the champion so far has no value, so that nothing could be compared.
    """

    name: str
    version: str
    before: str | None
    reasons: tuple[str, ...] = ()
    alone: tuple[str, ...] = ()

    @property
    def moves(self) -> bool:
        """Whether the alias moves."""
        return not self.reasons and self.version != self.before

    def text(self) -> str:
        """Return the decision in a sentence."""
        what = f"models:/{self.name}/{self.version}"
        if self.version == self.before:
            return f"{what} stays the champion"
        if self.moves:
            was = f", version {self.before} was" if self.before else ""
            lacks = f", which has no value in {', '.join(self.alone)}" if self.alone else ""
            return f"{what} is the champion now{was}{lacks}"
        return f"version {self.before} stays the champion of {self.name}: {what} {'; '.join(self.reasons)}"


def champions_beside(methods: Sequence[Method], uri: str) -> list[tuple[str, tuple[str, ...]]]:
    """Return the champions of the methods' models that are not among the methods, as `methods_of` takes them.

    Raises:
        ValueError: None of the methods is a registered model.
    """
    found = registered(methods, uri)
    if not found:
        raise ValueError(
            "--register-champion: none of the models is a registered version, such as models:/wskp/3"
        )
    named: list[tuple[str, tuple[str, ...]]] = []
    for name in dict.fromkeys(entry.name for entry in found):
        champion = champion_of(name, uri)
        if champion and champion not in [e.version for e in found if e.name == name]:
            named.append((f"{name}@{ALIAS}=models:/{name}/{champion}", ()))
    return named


def registered(methods: Sequence[Method], uri: str) -> list[Registered]:
    """Return those methods that are registered versions.

    Raises:
        MlflowException: The store has no such model or alias.
    """
    named = ((method.label, version_of(method.model, uri)) for method in methods)
    return [Registered(label, *version) for label, version in named if version is not None]


def version_of(model: str, uri: str) -> tuple[str, str] | None:
    """Return name and number of the registered version that a model means, None where it is none.

    Raises:
        MlflowException: The store has no such model or alias.
    """
    match = re.fullmatch(r"models:/+([^/@]+)(?:/([^/]+)|@(.+))", model)
    if match is None:
        return None
    name, version, alias = match.groups()
    if alias:
        return name, str(open_client(uri).get_model_version_by_alias(name, alias).version)
    if version == "latest":
        there = open_client(uri).search_model_versions(f"name = '{name}'")
        return name, str(max((int(v.version) for v in there), default=0))
    return name, version


def champion_of(name: str, uri: str) -> str | None:
    """Return the version of a model that is its champion, None where it has none."""
    model = open_client(uri).get_registered_model(name)
    version = model.aliases.get(ALIAS)
    return None if version is None else str(version)


def decide(
    scored: Scored, entries: Sequence[Registered], before: str | None, metric: str, tolerance: float
) -> Decision:
    """Return whether the best of a model's versions becomes its champion.

    Args:
        scored: The rows.
        entries: Versions of one model that were evaluated.
        before: The champion so far.
        metric: By which they are judged, averaged over scenes.
        tolerance: By which share a scene may get worse.
    """
    higher = SCORES[metric].higher
    name = entries[0].name

    def average(entry: Registered) -> float:
        cell = scored.average(entry.label, metric)
        if not cell.count or cell.missing:
            return float("-inf")
        return cell.mean if higher else -cell.mean

    best = max(entries, key=lambda entry: (average(entry), entry.version == before))
    if average(best) == float("-inf"):
        return Decision(name, best.version, before, (f"has no {metric} of every frame",))
    old = next((entry for entry in entries if entry.version == before), None)
    if old is None or best.version == before:
        return Decision(name, best.version, before)
    reasons, alone = [], []
    for scene in scored.scenes:
        mine, theirs = (scored.cell(entry.label, metric, scene) for entry in (best, old))
        worse = theirs.mean - mine.mean if higher else mine.mean - theirs.mean
        if worse > tolerance * abs(theirs.mean):
            reasons.append(f"is worse in {scene}: {metric} {mine.text()}, champion {theirs.text()}")
        if not theirs.count:
            alone.append(scene)
    return Decision(name, best.version, before, tuple(reasons), tuple(alone))


def move(decision: Decision, uri: str) -> None:
    """Move the alias."""
    open_client(uri).set_registered_model_alias(decision.name, ALIAS, decision.version)
