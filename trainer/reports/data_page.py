"""The page of the data report: which frames are shown, tables, and the template filled in."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from data.duplicates import Pair
from data.frames import FrameSet
from data.manifest import SPLITS, FrameRecord, Manifest, SceneRecord
from data.shards.division import plan_shards
from data.shards.options import RECIPES, recipe_options
from data.statistics import Histogram
from trainer.reports.findings import ENERGY_Z, FIREFLIES, Finding
from trainer.reports.frame_facts import FrameFacts
from trainer.reports.svg import fixed, heat_css, histogram_svg, number, outside_text, percent, split_svg

STRIP = 12
"""Frames of a scene that are shown in a row."""

PAIRS = 30
"""Pairs of scenes with near duplicates that are shown."""


@dataclass
class SceneView:
    """What the page shows of a scene.

    Attributes:
        name: Name of the scene.
        anchor: Id of its part of the page.
        split: Split that it belongs to.
        record: What the manifest says.
        shown: The frame whose buffers are shown, None where none can be read.
        facts: All frames that could be read.
        problems: Why others could not.
        columns: Frames of the shown view with different numbers of samples, fewest first.
        strip: Frames in a row.
        views: Number of frames that the row is chosen from.
        motion: The frame that shows the motion, where it is another one.
        histograms: Title, drawing, its legend, and what it does not show.
    """

    name: str
    anchor: str
    split: str
    record: SceneRecord
    shown: FrameFacts | None = None
    facts: list[FrameFacts] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    columns: list[FrameFacts] = field(default_factory=list)
    strip: list[FrameFacts] = field(default_factory=list)
    views: int = 1
    motion: FrameFacts | None = None
    histograms: list[dict[str, Any]] = field(default_factory=list)


def shown_frame(scene: SceneRecord) -> FrameRecord:
    """Return the frame whose buffers are shown: the first view, with the most samples there are of it."""
    return column_frames(scene)[-1] if column_frames(scene) else scene.frames[0]


def column_frames(scene: SceneRecord) -> list[FrameRecord]:
    """Return the frames of the first view, fewest samples first; empty where there is one only."""
    first = scene.frames[0].view
    same = [f for f in scene.frames if f.view == first] if first is not None else []
    return sorted(same, key=lambda f: (f.spp or 0, f.index)) if len(same) > 1 else []


def view_frames(scene: SceneRecord) -> list[FrameRecord]:
    """Return one frame of each view, that with the most samples per pixel."""
    views: dict[int, FrameRecord] = {}
    for f in scene.frames:
        key = f.index if f.view is None else f.view
        if key not in views or (f.spp or 0) > (views[key].spp or 0):
            views[key] = f
    return list(views.values())


def strip_frames(scene: SceneRecord) -> list[FrameRecord]:
    """Return frames for a row: at most `STRIP` of `view_frames`, evenly spread; none where there is one."""
    every = view_frames(scene)
    if len(every) < 2:
        return []
    places = np.linspace(0, len(every) - 1, min(STRIP, len(every))).round().astype(int)
    return [every[i] for i in places.tolist()]


def render(
    frames: FrameSet, facts: Sequence[FrameFacts], pairs: Sequence[Pair], found: Sequence[Finding]
) -> str:
    """Return the page."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "fixed": fixed,
        "percent": _percent,
        "json": _json,
        "mega": _mega,
    }
    manifest = frames.manifest
    scenes = [_scene_view(manifest, name, [f for f in facts if f.scene == name]) for name in manifest.scenes]
    splits, alike = split_rows(manifest), pair_rows(manifest, facts, pairs)
    return environment.get_template("data_report.html.j2").render(
        manifest=manifest,
        scenes=scenes,
        anchors={s.name: s.anchor for s in scenes},
        findings=found,
        noise=noise_rows(scenes),
        own=any("reference_relmse" in f.record.checks for f in facts),
        heat=heat_css(),
        splits=splits,
        split_bar=split_svg({r["split"]: r["frames"] for r in splits if r["frames"]}),
        pairs=alike[:PAIRS],
        more_pairs=alike[PAIRS:],
        patches=patch_rows(frames),
        size=_size_text(manifest),
        bytes=sum(f.bytes for s in manifest.scenes.values() for f in s.frames),
        version=_version(),
        energy_z=ENERGY_Z,
        fireflies=FIREFLIES,
    )


def _scene_view(manifest: Manifest, name: str, facts: list[FrameFacts]) -> SceneView:
    record = manifest.scenes[name]
    good = [f for f in facts if not f.problem]
    by_index = {f.record.index: f for f in good}
    view = SceneView(name, f"scene-{list(manifest.scenes).index(name)}", manifest.split_of(name), record)
    view.facts, view.problems = good, [f.problem for f in facts if f.problem]
    view.shown = by_index.get(shown_frame(record).index)
    columns = column_frames(record) or [shown_frame(record)]
    view.columns = [by_index[r.index] for r in columns if r.index in by_index and by_index[r.index].columns]
    view.views = len(view_frames(record))
    view.strip = [by_index[r.index] for r in strip_frames(record) if r.index in by_index]
    view.motion = next((f for f in good if f is not view.shown and "motion" in f.thumbnails), None)
    view.histograms = _histogram_rows(good)
    return view


def _histogram_rows(facts: Sequence[FrameFacts]) -> list[dict[str, Any]]:
    merged: dict[str, Histogram] = {}
    for f in facts:
        for name, h in f.histograms.items():
            merged[name] = merged[name] + h if name in merged else h
    groups = {
        "Luminance, logarithmic": ("color", "reference"),
        "Depth, logarithmic": ("depth",),
        "Albedo (height: square root)": ("albedo", "diffuse_albedo", "specular_albedo"),
        "Length of normals (height: square root)": ("normal",),
    }
    rows = []
    for title, names in groups.items():
        series = {n: merged[n] for n in names if n in merged and merged[n].total}
        if series:
            notes = {n: outside_text(h) for n, h in series.items()}
            rows.append(
                {
                    "title": title,
                    "svg": histogram_svg(series, title),
                    "names": list(series) if len(names) > 1 else [],
                    "notes": [f"{n}: {t}" for n, t in notes.items() if t],
                }
            )
    return rows


def noise_rows(scenes: Sequence[SceneView]) -> list[dict[str, Any]]:
    """Return one row per scene and number of samples: means over its frames, and the worst energy score."""
    rows = []
    for scene in scenes:
        for spp in dict.fromkeys(f.record.spp for f in scene.facts):
            group = [f for f in scene.facts if f.record.spp == spp]
            references = sorted({f.record.reference_spp for f in group if f.record.reference_spp})
            psnr = [f.scores["psnr_wskp"] for f in group if f.scores]
            scores_z = [f.energy_z for f in group if f.energy_z is not None]
            pixels = sum(f.record.width * f.record.height * len(f.record.buffers) for f in group)
            broken = sum(sum(f.record.repaired.values()) for f in group)
            rows.append(
                {
                    "scene": scene,
                    "spp": spp,
                    "reference_spp": " to ".join(map(str, dict.fromkeys((references[0], references[-1]))))
                    if references
                    else None,
                    "frames": len(group),
                    "psnr": _mean(psnr),
                    "psnr_range": (min(psnr), max(psnr)) if len(psnr) > 1 else None,
                    "relmse": _mean([f.scores["relmse_layer"] for f in group if f.scores]),
                    "own": _mean(
                        [
                            f.record.checks[k]
                            for f in group
                            for k in ("reference_relmse",)
                            if k in f.record.checks
                        ]
                    ),
                    "fireflies": _mean([f.fireflies for f in group if f.fireflies is not None]),
                    "broken": broken / pixels if pixels else 0.0,
                    "no_hit": _mean([f.no_hit for f in group if f.no_hit is not None]),
                    "ratio": _mean([f.energy_ratio for f in group if f.energy_ratio is not None]),
                    "z": max(scores_z, key=abs) if scores_z else None,
                }
            )
    return rows


def split_rows(manifest: Manifest) -> list[dict[str, Any]]:
    """Return one row per split: scenes, frames, pixels and bytes."""
    rows = []
    for split in SPLITS:
        names = manifest.splits.get(split, [])
        records = [f for n in names for f in manifest.scenes[n].frames]
        rows.append(
            {
                "split": split,
                "scenes": names,
                "frames": len(records),
                "pixels": sum(f.width * f.height for f in records),
                "bytes": sum(f.bytes for f in records),
            }
        )
    return rows


def patch_rows(frames: FrameSet) -> list[dict[str, Any]]:
    """Return what `trainer prepare` would plan, without a recipe and with each: samples of every split."""
    rows = []
    for recipe in (None, *RECIPES):
        options = recipe_options(recipe, {"samples": "none"})
        row: dict[str, Any] = {"recipe": recipe, "options": options, "counts": Counter(), "problem": ""}
        try:
            for plan in plan_shards(frames, options):
                row["counts"][plan.split] += len(plan.samples)
        except ValueError as error:
            row["problem"] = str(error).replace(f"{frames.root}/", "").replace(str(frames.root), "the set")
        rows.append(row)
    return rows


def pair_rows(manifest: Manifest, facts: Sequence[FrameFacts], pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Return one row per pair of scenes that look alike: the most alike frames; different splits first."""
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in pairs:
        groups.setdefault((facts[pair.first].scene, facts[pair.second].scene), []).append(pair)
    rows = []
    for (a, b), group in groups.items():
        best = max(group, key=lambda p: p.light + (0 if math.isnan(p.normal) else p.normal))
        splits = manifest.split_of(a), manifest.split_of(b)
        rows.append(
            {
                "first": facts[best.first],
                "second": facts[best.second],
                "splits": splits,
                "leak": splits[0] != splits[1],
                "same_view": best.same_view,
                "light": best.light,
                "normal": None if math.isnan(best.normal) else best.normal,
                "count": len(group),
            }
        )
    return sorted(rows, key=_urgency)


def _urgency(row: Mapping[str, Any]) -> tuple[bool, bool, float]:
    return not row["leak"], not row["same_view"], -row["light"]


def _percent(share: float | None) -> str:
    return "–" if share is None else percent(share)


def _mega(count: float) -> str:
    return f"{count / 1e6:.1f}"


def _json(values: Mapping[str, Any]) -> str:
    return json.dumps(values, indent=1, ensure_ascii=False, sort_keys=True)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _size_text(manifest: Manifest) -> str:
    sizes = sorted({(f.width, f.height) for s in manifest.scenes.values() for f in s.frames})
    return ", ".join(f"{w}×{h}" for w, h in sizes[:3]) + (
        f" and {len(sizes) - 3} more" if len(sizes) > 3 else ""
    )


def _version() -> str:
    try:
        return version("penumbra-denoise")
    except PackageNotFoundError:
        return "from source"
