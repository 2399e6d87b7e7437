"""One view: noisy frames, passes of the reference, the finished files; it can stop and go on anywhere.

Below `ROOT/.render/`, `views/KEY.json` remembers the finished files of a view and `references/KEY.npz` holds
the sums of its reference. KEY is a hash of everything that decides the pixels, so that other options never
meet work that does not fit them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from data.derive import automatic_exposure
from data.exr import read_frame
from data.frame import Frame
from data.ingestion import write_record
from data.manifest import FrameRecord, file_sha256, write_json
from data.render.frames import Report, Tracing, ignored, noisy_color, noisy_frames, reported
from data.render.recipe import Recipe, seed_of
from data.render.references import Reference, energy_z
from data.render.spec import SceneSpec

WORK = ".render"
"""Folder inside a rendered data set that remembers finished work and the sums of the references."""


@dataclass(frozen=True)
class ViewWork:
    """Where the work on one view is kept.

    Attributes:
        root: The data set.
        scene: Name of the scene.
        view: Number of the view.
        key: Hash of everything that decides its pixels.
        recipe: What is rendered.
        stream: Hash that its seeds follow from; empty: `key`.
    """

    root: Path
    scene: str
    view: int
    key: str
    recipe: Recipe
    stream: str = ""

    def seed(self, role: str, number: int = 0) -> int:
        """Return the seed of a role; see `data.render.recipe.seed_of`."""
        return seed_of(self.stream or self.key, role, number)

    @property
    def memory(self) -> Path:
        """File that remembers what is finished."""
        return self.root / WORK / "views" / f"{self.key}.json"

    @property
    def sums(self) -> Path:
        """File with the sums of the reference."""
        return self.root / WORK / "references" / f"{self.key}.npz"

    def remembered(self, unaltered: bool = True) -> dict[str, Any] | None:
        """Return the memory, None where there is none or a file of it is gone.

        Args:
            unaltered: Read the files, and return None where one is not what it was when it was written.
        """
        try:
            memory = json.loads(self.memory.read_text(encoding="utf-8"))
            records = [FrameRecord(**record) for record in memory["records"]]
            for record in records:
                path = self.root / record.file
                if path.stat().st_size != record.bytes:
                    return None
                if unaltered and file_sha256(path) != record.sha256:
                    return None
        except (OSError, ValueError, TypeError, KeyError):
            return None
        return {**memory, "records": records}


def render_view(work: ViewWork, tracer: Tracing, renderer: str, report: Report) -> None:
    """Do what is missing of a view.

    Args:
        work: Which view, and where.
        tracer: Of its scene.
        renderer: Name, version and variant of the renderer, for the manifest.
        report: Called with the number of samples traced since the last call.

    Raises:
        ValueError: The renderer failed.
        OSError: A file cannot be written; what was finished stays.
    """
    memory = work.remembered()
    recipe = work.recipe
    if memory is None:
        frames = noisy_frames(tracer, work.view, recipe, work.seed("input"), report)
        records = [_write(work, frame) for frame in frames]
        memory = _remember(work, tracer.spec, renderer, records, 0)
    reference = Reference.load(work.sums, recipe.height, recipe.width, recipe.kind == "stills")
    while reference.count < recipe.reference_spp:
        add_pass(reference, tracer, work, report)
        reference.save(work.sums)
    if memory["reference_spp"] != reference.count:
        records = [_finished(work, record, reference) for record in memory["records"]]
        _remember(work, tracer.spec, renderer, records, reference.count)


def add_pass(reference: Reference, tracer: Tracing, work: ViewWork, report: Report = ignored) -> None:
    """Render one pass, or what is missing where that is less, and add it to a reference.

    Its seed follows from the samples before it, so that a reference refined in steps of whole passes equals
    one that was rendered at once.
    """
    spp = min(work.recipe.pass_spp, work.recipe.reference_spp - reference.count)
    seed = work.seed("reference", reference.count)
    static = work.recipe.kind == "sequences"
    before = tracer.invalid
    chunks = tracer.trace(work.view, spp, seed, work.recipe.reference_names, static=static)
    for chunk in reported(chunks, report):
        reference.add(chunk.rows, *(chunk.values[name] for name in work.recipe.reference_names))
    reference.invalid += tracer.invalid - before
    reference.passes += 1
    reference.count += spp


def _write(work: ViewWork, frame: Frame) -> FrameRecord:
    exposure = frame.exposure or automatic_exposure(noisy_color(frame))
    return write_record(replace(frame, exposure=exposure), work.root)


def _finished(work: ViewWork, record: FrameRecord, reference: Reference) -> FrameRecord:
    """Write a frame again, with its reference."""
    frame = read_frame(work.root / record.file)
    target = reference.radiance()
    added = {"reference": target}
    if work.recipe.kind == "stills":
        added["reference_diffuse"] = reference.diffuse()
    spp, exposure = record.spp or work.recipe.spp[-1], automatic_exposure(target)
    notes = {
        "view": record.view,
        "reference_spp": reference.count,
        "checks": {
            **record.checks,
            "energy_z": round(energy_z(noisy_color(frame), spp, reference), 3),
            "reference_relmse": float(f"{reference.relative_error(exposure):.4g}"),
            "invalid_samples": float(reference.invalid),
        },
    }
    whole = replace(frame.with_buffers(**added), exposure=exposure, notes=notes)
    return write_record(whole, work.root)


def _remember(
    work: ViewWork, spec: SceneSpec, renderer: str, records: list[FrameRecord], spp: int
) -> dict[str, Any]:
    memory = {
        "renderer": renderer,
        "scene": work.scene,
        "view": work.view,
        "reference_spp": spp,
        "origin": spec.origin,
        "credit": spec.credit,
        "license": spec.license,
        "path": spec.path,
    }
    write_json(work.memory, {**memory, "records": [asdict(record) for record in records]})
    return {**memory, "records": records}
