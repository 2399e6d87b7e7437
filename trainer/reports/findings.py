"""What in a data set needs attention before training, most urgent first."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from data.duplicates import Pair
from data.manifest import Manifest
from trainer.reports.frame_facts import FrameFacts
from trainer.reports.svg import percent

Level = Literal["problem", "warning", "note"]
LEVELS: tuple[Level, ...] = ("problem", "warning", "note")

ENERGY_Z = 4.0
"""Standard errors by which mean input and mean reference may differ."""

FIREFLIES = 0.005
"""Share of pixels from which fireflies are a warning."""

REFERENCE_SHARE = 0.1
"""Share of the input's error that the reference's own error may reach."""

REFERENCE_SPP = 8
"""How many times as many samples as the input a reference should have."""


@dataclass(frozen=True)
class Finding:
    """One thing to look at.

    Attributes:
        level: `problem`: unusable as it is; `warning`: training would suffer; `note`: good to know.
        text: One sentence.
        scenes: Where, for links.
        details: Lines to unfold.
        damaged: Files cannot be read or do not match their checksums.
    """

    level: Level
    text: str
    scenes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    damaged: bool = False


def findings(manifest: Manifest, facts: Sequence[FrameFacts], pairs: Sequence[Pair]) -> list[Finding]:
    """Return everything that needs attention, most urgent first."""
    good = [f for f in facts if not f.problem]
    found = [
        *_damaged(facts),
        *_references(good),
        *_pairs(manifest, facts, pairs),
        *_broken_values(good),
        *_energy(good),
        *_noise(good),
        *_sets(manifest, good),
    ]
    return sorted(found, key=lambda f: LEVELS.index(f.level))


def _where(facts: Iterable[FrameFacts]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(f.scene for f in facts))


def _lines(facts: Iterable[FrameFacts], text: Callable[[FrameFacts], str]) -> tuple[str, ...]:
    return tuple(f"{f.scene}, frame {f.record.index}: {text(f)}" for f in facts)


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _has(count: int, one: str, many: str) -> str:
    return f"{_frames(count)} {one if count == 1 else many}"


def _damaged(facts: Sequence[FrameFacts]) -> list[Finding]:
    bad = [f for f in facts if f.problem]
    if not bad:
        return []
    text = f"{_frames(len(bad))} cannot be read and {'is' if len(bad) == 1 else 'are'} left out below"
    return [Finding("problem", text, _where(bad), tuple(f.problem for f in bad), damaged=True)]


def _references(facts: Sequence[FrameFacts]) -> list[Finding]:
    without = [f for f in facts if "reference" not in f.buffers]
    found = []
    if without:
        level: Level = "problem" if len(without) == len(facts) else "warning"
        text = f"{_has(len(without), 'has', 'have')} no reference: nothing to train or score against"
        found.append(Finding(level, text, _where(without)))
    noisy = [f for f in facts if _own_error(f) > REFERENCE_SHARE]
    if noisy:
        text = (
            f"the reference of {_frames(len(noisy))} is itself noisy: its relMSE is more than "
            f"{percent(REFERENCE_SHARE)} of the input's"
        )
        lines = _lines(noisy, lambda f: f"{percent(_own_error(f))} of the input's relMSE")
        found.append(Finding("warning", text, _where(noisy), lines))
    few = [f for f in facts if f not in noisy and 0 < _factor(f) < REFERENCE_SPP]
    if few:
        text = f"the reference of {_frames(len(few))} has less than {REFERENCE_SPP} times the input's samples"
        found.append(Finding("warning", text, _where(few), _lines(few, lambda f: f"{_factor(f):.3g} times")))
    return found


def _own_error(facts: FrameFacts) -> float:
    """Return the reference's relMSE as share of the input's, 0 where unknown."""
    own, noisy = facts.record.checks.get("reference_relmse"), facts.scores.get("relmse_layer")
    return own / noisy if own is not None and noisy else 0.0


def _factor(facts: FrameFacts) -> float:
    """Return how many times as many samples the reference has, 0 where unknown."""
    record = facts.record
    return record.reference_spp / record.spp if record.reference_spp and record.spp else 0.0


def _pairs(manifest: Manifest, facts: Sequence[FrameFacts], pairs: Sequence[Pair]) -> list[Finding]:
    def splits(pair: Pair) -> set[str]:
        return {manifest.split_of(facts[i].scene) for i in (pair.first, pair.second)}

    found = []
    texts: tuple[tuple[bool, Level, str], ...] = (
        (True, "problem", "show the same view in different splits: scores would be too good"),
        (False, "warning", "have the same geometry and camera in different splits"),
    )
    for view, level, text in texts:
        across = [p for p in pairs if p.same_view == view and len(splits(p)) > 1]
        if across:
            scenes = _where(facts[i] for p in across for i in (p.first, p.second))
            found.append(Finding(level, f"{len(scenes)} scenes {text}", scenes))
    same = [p for p in pairs if p.same_view and len(splits(p)) == 1]
    if same:
        scenes = _where(facts[i] for p in same for i in (p.first, p.second))
        found.append(Finding("note", f"{len(scenes)} scenes of one split show the same view", scenes))
    return found


def _broken_values(facts: Sequence[FrameFacts]) -> list[Finding]:
    found = []
    repaired = [f for f in facts if f.record.repaired]
    if repaired:
        count = sum(sum(f.record.repaired.values()) for f in repaired)
        text = f"{count} pixels in {_frames(len(repaired))} were NaN or Inf and were repaired"
        lines = _lines(repaired, lambda f: ", ".join(f"{n} {k}" for n, k in f.record.repaired.items()))
        found.append(Finding("warning", text, _where(repaired), lines))
    encoded = [f for f in facts if f.encoded]
    if encoded:
        text = f"radiance of {_frames(len(encoded))} looks 8-bit or tone-mapped; linear radiance is expected"
        lines = _lines(encoded, lambda f: "; ".join(f"{n} {why}" for n, why in f.encoded.items()))
        found.append(Finding("warning", text, _where(encoded), lines))
    # Normals have a line of their own.
    outside = [f for f in facts if f.outside.keys() - {"normal"}]
    if outside:
        names = ", ".join(dict.fromkeys(n for f in outside for n in f.outside if n != "normal"))
        text = f"{names}: values outside of the legal range in {_frames(len(outside))}"
        lines = _lines(outside, lambda f: ", ".join(f"{percent(s)} of {n}" for n, s in f.outside.items()))
        found.append(Finding("warning", text, _where(outside), lines))
    normals = [f for f in facts if f.normal]
    if normals:
        text = f"normals of {_frames(len(normals))} are not unit vectors"
        found.append(Finding("warning", text, _where(normals), _lines(normals, lambda f: f.normal)))
    constant = [f for f in facts if f.constant]
    if constant:
        names = ", ".join(dict.fromkeys(n for f in constant for n in f.constant))
        text = f"{names}: the same in all pixels of {_frames(len(constant))}"
        lines = _lines(constant, lambda f: ", ".join(f.constant))
        found.append(Finding("note", text, _where(constant), lines))
    return found


def _energy(facts: Sequence[FrameFacts]) -> list[Finding]:
    bad = [f for f in facts if f.energy_z is not None and abs(f.energy_z) > ENERGY_Z]
    if not bad:
        return []
    text = (
        f"input and reference of {_frames(len(bad))} differ in mean radiance by more than {ENERGY_Z:g} "
        "standard errors"
    )

    def line(f: FrameFacts) -> str:
        ratio = "" if f.energy_ratio is None else f", mean ratio {f.energy_ratio:.4f}"
        return f"{f.energy_z:+.1f}{ratio}"

    return [Finding("warning", text, _where(bad), _lines(bad, line))]


def _noise(facts: Sequence[FrameFacts]) -> list[Finding]:
    many = [f for f in facts if (f.fireflies or 0) > FIREFLIES]
    if not many:
        return []
    text = f"{_has(len(many), 'has', 'have')} fireflies in more than {percent(FIREFLIES)} of the pixels"
    lines = _lines(many, lambda f: percent(f.fireflies or 0))
    return [Finding("note", text, _where(many), lines)]


def _sets(manifest: Manifest, facts: Sequence[FrameFacts]) -> list[Finding]:
    found = []
    if not manifest.splits.get("train"):
        found.append(Finding("problem", "no scene in split train: there is nothing to train on"))
    if not manifest.splits.get("test"):
        found.append(Finding("note", "no scene in split test: nothing is held out for a fair score"))
    unstated = tuple(name for name, scene in manifest.scenes.items() if not scene.license)
    if unstated:
        scenes = "1 scene does" if len(unstated) == 1 else f"{len(unstated)} scenes do"
        found.append(Finding("warning", f"{scenes} not state a licence: do not pass them on", unstated))
    everywhere = dict.fromkeys(n for f in facts for n in f.buffers if n != "reference")
    partial: dict[tuple[str, ...], list[str]] = {}
    for name in everywhere:
        scenes_without = _where(f for f in facts if name not in f.buffers)
        if scenes_without:
            partial.setdefault(scenes_without, []).append(name)
    for scenes_without, names in partial.items():
        found.append(Finding("note", f"missing in frames of some scenes: {', '.join(names)}", scenes_without))
    return found
