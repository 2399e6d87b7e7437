"""Render a data set: scenes spread over processes, progress, and the manifest last of all."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.jobs import elsewhere
from data.manifest import MANIFEST, FrameRecord, Manifest, SceneRecord, make_splits, write_json
from data.render.output import bytes_of, check_room, examine, prepare
from data.render.pool import measure_speed, tasks_of, work_on
from data.render.recipe import Recipe, stream_key, view_key
from data.render.sources import Source
from data.render.variant import Variant
from data.render.views import WORK, ViewWork

__all__ = ["Plan", "RenderOptions", "bytes_of", "measure_speed", "plan", "remembered_speed", "render"]

SPEED = "speed.json"

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class RenderOptions:
    """How the work is done; none of it changes the pixels, but for the variant.

    Attributes:
        variant: The renderer's variant.
        processes: Number of processes.
        threads: Threads of each.
        test: Names of scenes held out for test; None: every eighth, the last of fewer.
        validation: Names of scenes held out for validation.
        force: Replace frames of another recipe or other scenes in the output.
    """

    variant: Variant
    processes: int = 1
    threads: int = 1
    test: tuple[str, ...] | None = None
    validation: tuple[str, ...] = ()
    force: bool = False


@dataclass(frozen=True)
class Plan:
    """What there is to do.

    Attributes:
        works: Views of every scene, in order.
        unfinished: Those of them that are not finished; scenes without any are left out.
        samples: Samples that are needed in all.
        missing: Samples that are not there yet.
    """

    works: dict[str, list[ViewWork]]
    unfinished: dict[str, list[ViewWork]]
    samples: int
    missing: int


def plan(sources: Sequence[Source], recipe: Recipe, root: Path, options: RenderOptions) -> Plan:
    """Find out what is missing of a data set, and whether it can be rendered into a folder; changes nothing.

    Every finished frame is read once, to see whether it is what it was.

    Raises:
        ValueError: There are no scenes, two are the same or have the same name, a name to hold out is no
            scene, or the folder holds something else.
        OSError: The folder is a file.
    """
    works = _works(sources, recipe, root)
    _splits(list(works), options)
    examine(root, recipe, works, options.force)
    return _plan(works, recipe)


def render(
    sources: Sequence[Source],
    recipe: Recipe,
    output: str | Path,
    options: RenderOptions,
    progress: Progress | None = None,
) -> Manifest:
    """Render a data set, or go on with it, or refine its references.

    A call that was interrupted goes on where it stopped; at most one pass of each process is lost. With more
    samples per pixel of the reference, or with more scenes, what is there is kept and the rest is added.

    Args:
        sources: The scenes.
        recipe: What is rendered of each view.
        output: Folder of the data set.
        options: See `RenderOptions`.
        progress: Called with samples done, samples in all, and a label.

    Raises:
        ValueError: The output holds something else, or the renderer failed.
        OSError: The output cannot be written, or the disk has too little room.
    """
    root = Path(output)
    works = _works(sources, recipe, root)
    splits = _splits(list(works), options)
    prepare(root, recipe, examine(root, recipe, works, options.force))
    todo = _plan(works, recipe)
    if todo.missing:
        views = sum(map(len, works.values()))
        check_room(root, int(bytes_of(recipe, views) * todo.missing / todo.samples))
        (root / MANIFEST).unlink(missing_ok=True)
        _work(sources, todo, root, options, progress)
    manifest = _manifest(sources, todo, recipe, splits, options, root)
    manifest.save(root)
    return manifest


def remembered_speed(root: Path) -> float | None:
    """Return the samples per second of the last call for this output, None where there was none."""
    try:
        return float(json.loads((root / WORK / SPEED).read_text(encoding="utf-8"))["samples_per_second"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _works(sources: Sequence[Source], recipe: Recipe, root: Path) -> dict[str, list[ViewWork]]:
    """Return the views of every scene."""
    if not sources:
        raise ValueError("nothing to render: give --random N or --scene FILE")
    works: dict[str, list[ViewWork]] = {}
    keys: dict[str, str] = {}
    for source in sources:
        name, identity = source.name, source.identity()
        if name in works:
            raise ValueError(f"two scenes are called {name!r}; a file's name must be unique")
        works[name] = [
            ViewWork(
                root, name, view, view_key(identity, view, recipe), recipe, stream_key(identity, view, recipe)
            )
            for view in range(source.shot.frames)
        ]
        same = keys.setdefault(works[name][0].key, name)
        if same != name:
            raise ValueError(f"scenes {same!r} and {name!r} have the same content; leave one of them out")
    return works


def _plan(works: dict[str, list[ViewWork]], recipe: Recipe) -> Plan:
    counts = {name: [(work, _missing(work)) for work in scene] for name, scene in works.items()}
    unfinished = {name: [work for work, count in scene if count] for name, scene in counts.items()}
    return Plan(
        works,
        {name: scene for name, scene in unfinished.items() if scene},
        recipe.samples_per_view() * sum(map(len, works.values())),
        sum(count for scene in counts.values() for _, count in scene),
    )


def _missing(work: ViewWork) -> int:
    memory = work.remembered()
    wanted = work.recipe.reference_spp
    if memory is None:
        return work.recipe.samples_per_view()
    return work.recipe.pixels * max(0, wanted - int(memory["reference_spp"]))


def _splits(names: list[str], options: RenderOptions) -> dict[str, list[str]]:
    test = options.test
    if test is None:
        test = tuple(name for name in names[7::8] if name not in options.validation)
    return make_splits(names, test, options.validation)


def _work(
    sources: Sequence[Source], todo: Plan, root: Path, options: RenderOptions, progress: Progress | None
) -> None:
    """Render what is missing, report it, and remember how fast it was."""
    busy = [(source, todo.unfinished[source.name]) for source in sources if source.name in todo.unfinished]
    runner = elsewhere()
    tasks = list(tasks_of(busy, runner.workers if runner else options.processes))
    done, began = todo.samples - todo.missing, time.monotonic()

    def report(count: int, label: str) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(min(done, todo.samples), todo.samples, label)

    work_on(tasks, options.processes, options.variant, options.threads, report)
    seconds = max(time.monotonic() - began, 1e-3)
    write_json(root / WORK / SPEED, {"samples_per_second": todo.missing / seconds})


def _manifest(
    sources: Sequence[Source],
    todo: Plan,
    recipe: Recipe,
    splits: dict[str, list[str]],
    options: RenderOptions,
    root: Path,
) -> Manifest:
    scenes = {}
    for source in sources:
        memories = [work.remembered(unaltered=False) for work in todo.works[source.name]]
        lost = next((w for w, m in zip(todo.works[source.name], memories, strict=True) if m is None), None)
        if lost is not None:
            raise ValueError(
                f"{root}: frames of scene {lost.scene!r} vanished while rendering; run the same command again"
            )
        known: list[dict[str, Any]] = [m for m in memories if m is not None]
        records: list[FrameRecord] = [record for memory in known for record in memory["records"]]
        counts = sorted({m["reference_spp"] for m in known})
        renderers = " and ".join(dict.fromkeys(m["renderer"] for m in known))
        spp = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        scenes[source.name] = SceneRecord(
            frames=tuple(sorted(records, key=lambda r: r.index)),
            sequence=bool(known[0]["path"]),
            credit=known[0]["credit"],
            license=known[0]["license"],
            provenance=f"{renderers}, path traced to depth {recipe.max_depth}, box filter, "
            f"reference {spp} spp",
            origin=known[0]["origin"],
        )
    return Manifest(
        name=root.resolve().name,
        layout="render",
        depth="euclidean",
        splits=splits,
        scenes=scenes,
        recipe={"recipe": recipe.to_json(), "variant": options.variant.name},
        notes="Rendered by `trainer render`; the recipe and each scene's origin say how to make it again.",
    )
