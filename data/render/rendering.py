"""Render a data set: scenes spread over processes, progress, and the manifest last of all."""

from __future__ import annotations

import json
import multiprocessing
import os
import queue
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.ingestion import remove_set
from data.manifest import MANIFEST, FrameRecord, Manifest, SceneRecord, load_manifest, make_splits, write_json
from data.render.recipe import Recipe, view_key
from data.render.sources import Source
from data.render.variant import Variant, activate
from data.render.views import WORK, ViewWork
from data.render.worker import Task, render_task, speed_of, start

SPEED = "speed.json"
JOB = "job.json"

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
        force: Replace another data set in the output.
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
        samples: Samples that are needed in all.
        missing: Samples that are not there yet.
    """

    works: dict[str, list[ViewWork]]
    samples: int
    missing: int


def plan(sources: Sequence[Source], recipe: Recipe, root: Path) -> Plan:
    """Find out what is missing of a data set.

    Raises:
        ValueError: There are no scenes, or two have the same name.
    """
    if not sources:
        raise ValueError("nothing to render: give --random N or --scene FILE")
    names = [source.name for source in sources]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"two scenes are called {twice[0]!r}; a file's name must be unique")
    works, missing = {}, 0
    for source in sources:
        identity = source.identity()
        works[source.name] = [
            ViewWork(root, source.name, view, view_key(identity, view, recipe), recipe)
            for view in range(source.shot.frames)
        ]
        missing += sum(_missing(work) for work in works[source.name])
    total = recipe.samples_per_view() * sum(map(len, works.values()))
    return Plan(works, total, missing)


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
    plan(sources, recipe, root)  # what is wrong with the scenes is said before anything is touched
    splits = _splits([source.name for source in sources], options)
    _prepare_output(root, recipe, options.force)
    todo = plan(sources, recipe, root)
    _refuse_replacing(todo, root, options.force)
    if todo.missing:
        check_room(root, recipe, todo)
        (root / MANIFEST).unlink(missing_ok=True)
        _work(sources, todo, options, progress)
    manifest = _manifest(sources, todo, recipe, splits, options, root)
    manifest.save(root)
    return manifest


def bytes_of(recipe: Recipe, views: int) -> int:
    """Return about how many bytes a data set takes: channels times two or four bytes, less what ZIP saves."""
    channels = {"stills": 90, "sequences": 26, "samples": 20 * recipe.spp[0] + 14}[recipe.kind]
    frames = len(recipe.spp) if recipe.kind == "stills" else 1
    sums = 9 * 8
    return int(views * recipe.pixels * (channels * 2.0 * frames + sums))


def check_room(root: Path, recipe: Recipe, todo: Plan) -> None:
    """Raise an OSError if what is missing would not fit on the disk."""
    views = sum(map(len, todo.works.values()))
    need = int(bytes_of(recipe, views) * todo.missing / max(todo.samples, 1))
    free = shutil.disk_usage(root).free
    if need > free:
        raise OSError(
            f"{root}: about {need / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB are free; choose another "
            "--output, fewer scenes or a smaller size"
        )


def remembered_speed(root: Path) -> float | None:
    """Return the samples per second of the last call for this output, None where there was none."""
    try:
        return float(json.loads((root / WORK / SPEED).read_text(encoding="utf-8"))["samples_per_second"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def measure_speed(source: Source, recipe: Recipe, variant: Variant, threads: int) -> float:
    """Return the samples per second of one process on a scene, after what it takes to load the scene.

    Raises:
        ValueError: The scene cannot be rendered.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        1, mp_context=context, initializer=activate, initargs=(variant, threads)
    ) as pool:
        return pool.submit(speed_of, source, recipe).result()


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


def _prepare_output(root: Path, recipe: Recipe, force: bool) -> None:
    """Make the output ready: go on with the same work, refuse anything else unless forced."""
    if root.exists() and not root.is_dir():
        raise OSError(f"{root} is a file; --output must name a folder")
    known = _known_recipe(root)
    if known is not None and not recipe.same_work(known):
        if not force:
            raise ValueError(
                f"{root} holds frames of another recipe ({_difference(recipe, known)}); --force replaces "
                "them, or choose another --output"
            )
        if (root / MANIFEST).is_file():
            remove_set(root)
        shutil.rmtree(root / WORK, ignore_errors=True)
    elif known is None and root.is_dir() and any(root.iterdir()):
        if not (force and (root / MANIFEST).is_file()):
            raise ValueError(f"{root} is not empty and was not rendered; choose an empty or new --output")
        remove_set(root)
    try:
        (root / WORK).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot write to {root}: {error.strerror}; choose another --output") from error
    write_json(root / WORK / JOB, recipe.to_json())


def _refuse_replacing(todo: Plan, root: Path, force: bool) -> None:
    """Refuse to render a scene over one of the same name that was made from something else."""
    planned = {work.key for works in todo.works.values() for work in works}
    for path in sorted((root / WORK / "views").glob("*.json")):
        scene = json.loads(path.read_text(encoding="utf-8")).get("scene")
        if path.stem in planned or scene not in todo.works:
            continue
        if not force:
            raise ValueError(
                f"{root} holds another scene {scene!r}: its file, camera, probabilities or number of frames "
                "were different; --force replaces it, or choose another --output"
            )
        path.unlink()
        path.with_suffix(".npz").unlink(missing_ok=True)


def _known_recipe(root: Path) -> dict[str, Any] | None:
    try:
        values = json.loads((root / WORK / JOB).read_text(encoding="utf-8"))
        return values if isinstance(values, dict) else None
    except (OSError, ValueError):
        pass
    try:
        return load_manifest(root).recipe.get("recipe")
    except (OSError, ValueError):
        return None


def _difference(recipe: Recipe, known: dict[str, Any]) -> str:
    mine = recipe.to_json()
    names = [n for n in mine if n != "reference_spp" and mine[n] != known.get(n)]
    return ", ".join(f"{n} {known.get(n)} instead of {mine[n]}" for n in names)


def _work(sources: Sequence[Source], todo: Plan, options: RenderOptions, progress: Progress | None) -> None:
    """Run the tasks and report what they have done."""
    tasks = list(_tasks(sources, todo, options.processes))
    done, began = todo.samples - todo.missing, time.monotonic()
    context = multiprocessing.get_context("spawn")  # the renderer keeps threads, which no fork survives
    reports = context.Queue()
    pool = ProcessPoolExecutor(
        min(options.processes, len(tasks)),
        mp_context=context,
        initializer=start,
        initargs=(options.variant, options.threads, reports, os.getpid()),
    )
    try:
        pending = [pool.submit(render_task, task) for task in tasks]
        for count, label in _reports(reports, pending):
            done += count
            if progress is not None:
                progress(done, todo.samples, label)
        pool.shutdown()
    except BaseException:
        _end(pool)
        raise
    seconds = max(time.monotonic() - began, 1e-3)
    if todo.missing:
        root = next(iter(todo.works.values()))[0].root
        write_json(root / WORK / SPEED, {"samples_per_second": todo.missing / seconds})


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop the processes of a pool without waiting for the passes that they are at."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def _reports(reports: Any, pending: list[Future[None]]) -> Iterator[tuple[int, str]]:
    """Yield what the processes report until all tasks are done; raises the first error of a task."""
    left = set(pending)
    while left:
        try:
            yield reports.get(timeout=0.2)
            continue
        except queue.Empty:
            pass
        for future in [f for f in left if f.done()]:
            left.remove(future)
            try:
                future.result()
            except BrokenProcessPool:
                raise ValueError(
                    "a rendering process died (out of memory, or the renderer aborted); finished work is "
                    "kept: run the same command again, with fewer --processes or --variant scalar"
                ) from None
    while True:
        try:
            yield reports.get_nowait()
        except queue.Empty:
            return


def _tasks(sources: Sequence[Source], todo: Plan, processes: int) -> Iterator[Task]:
    """Yield tasks: whole scenes where there are enough, so that each is loaded once; else parts of them."""
    busy = [(s, [w for w in todo.works[s.name] if _missing(w)]) for s in sources]
    busy = [(source, works) for source, works in busy if works]
    parts = -(-processes // max(len(busy), 1))
    for source, works in busy:
        count = min(parts, len(works))
        for part in range(count):
            yield Task(source, works[part * len(works) // count : (part + 1) * len(works) // count])


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
        memories = [work.remembered() for work in todo.works[source.name]]
        lost = next((w for w, m in zip(todo.works[source.name], memories, strict=True) if m is None), None)
        if lost is not None:
            raise ValueError(
                f"{root}: frames of scene {lost.scene!r} vanished while rendering; run the same command again"
            )
        known: list[dict[str, Any]] = [m for m in memories if m is not None]
        records: list[FrameRecord] = [record for memory in known for record in memory["records"]]
        counts = sorted({m["reference_spp"] for m in known})
        spp = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        scenes[source.name] = SceneRecord(
            frames=tuple(sorted(records, key=lambda r: r.index)),
            sequence=bool(known[0]["path"]),
            credit=known[0]["credit"],
            license=known[0]["license"],
            provenance=f"{known[0]['renderer']}, path traced to depth {recipe.max_depth}, box filter, "
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
