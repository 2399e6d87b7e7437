"""`trainer render`: make a data set with a path tracer."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data.render.recipe import Recipe
    from data.render.rendering import RenderOptions
    from data.render.sources import Source

VARIANTS = {"auto": None, "llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}

HELP = "render a data set with Mitsuba: random scenes, or yours"

DESCRIPTION = """\
Makes a data set that `trainer prepare` and `trainer fit` take, with references, from random scenes or Mitsuba
files. Interrupted, the same command goes on; with a larger --reference-spp it refines what is there.

  stills      for AFGSA, ACFM, KPCN, NFOR: diffuse and specular light, guides, two half buffers and the
              variance of the mean of every buffer, at several samples per pixel of the same stream;
              with --histogram for RHF too, with --second-hit for LBF
  sequences   for WSKP, BMFR, SVGF: 1 sample per pixel, positions, motion vectors, a moving camera
  samples     for layer embeddings, sample splatting: every sample apart, with 20 numbers
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = DESCRIPTION
    parser.add_argument("kind", choices=("stills", "sequences", "samples"), help="what is made of each scene")
    parser.add_argument("--output", metavar="DIR", type=Path, required=True, help="folder of the data set")
    _scene_arguments(parser.add_argument_group("scenes"))
    _image_arguments(parser.add_argument_group("images"))
    work = parser.add_argument_group("work")
    work.add_argument(
        "--processes", type=int, help="rendering processes (default: one per two cores, at least two)"
    )
    work.add_argument("--variant", choices=tuple(VARIANTS), default="auto", help="of Mitsuba")
    work.add_argument(
        "--dry-run", action="store_true", help="print what would be rendered, its size and time"
    )
    work.add_argument(
        "--force", action="store_true", help="remove frames of another recipe or of other scenes from DIR"
    )


def _scene_arguments(group: Any) -> None:
    group.add_argument("--random", metavar="N", type=int, default=0, help="N random scenes")
    group.add_argument("--seed", type=int, default=1, help="seed of the first random scene (default 1)")
    group.add_argument(
        "--places",
        nargs="+",
        choices=("outdoor", "indoor"),
        help="kinds, in turn (default: both)",
    )
    for name, what in (("meshes", "OBJ, PLY, glTF"), ("textures", "PNG, JPEG"), ("environments", "EXR, HDR")):
        group.add_argument(f"--{name}", metavar="DIR", type=Path, help=f"your {name} to mix in ({what})")
    group.add_argument(
        "--scene", metavar="FILE", type=Path, action="append", default=[], help="a Mitsuba file"
    )
    group.add_argument(
        "--camera",
        metavar="MOVE",
        help="of Mitsuba files: fixed, jitter, orbit, or a JSON file with key frames (default: orbit for "
        "sequences, jitter otherwise)",
    )
    group.add_argument("--frames", type=int, help="frames per sequence, views per still or sample scene")
    group.add_argument(
        "--defocus", metavar="P", type=float, help="probability of a lens (default 0.5, sequences 0)"
    )
    group.add_argument(
        "--motion", metavar="P", type=float, help="probability of motion (default 0.5, sequences 0)"
    )
    group.add_argument("--test", metavar="SCENE", nargs="*", help="held out for test (default: every eighth)")
    group.add_argument("--validation", metavar="SCENE", nargs="*", default=(), help="held out for validation")


def _image_arguments(group: Any) -> None:
    group.add_argument("--size", metavar="WxH", help="columns and rows, such as 1280x720")
    group.add_argument(
        "--spp", type=int, nargs="+", help="samples per pixel of the noisy images; stills: several"
    )
    group.add_argument(
        "--histogram",
        action="store_true",
        help="stills also have the histogram of each pixel's samples, which RHF reads: 60 more channels",
    )
    group.add_argument(
        "--histogram-exposure",
        metavar="X",
        type=float,
        help="factor on the radiance that histograms count (default: measured of each view, so that their "
        "bins fit its brightness; 1 as the program of RHF's authors)",
    )
    group.add_argument(
        "--second-hit",
        action="store_true",
        help="stills also have the albedo of what paths hit second, and halves and variance of positions, "
        "which LBF reads: 21 more channels",
    )
    group.add_argument("--reference-spp", type=int, help="samples per pixel of the reference")
    group.add_argument("--max-depth", type=int, help="longest path in segments (default 8)")
    group.add_argument(
        "--memory", metavar="GB", type=float, help="of each process; fewer samples are traced at once"
    )


def check(args: argparse.Namespace) -> None:
    """Check the options alone; nothing is read or rendered.

    Raises:
        UsageError: Some do not fit.
    """
    from trainer.configs import UsageError

    try:
        _check(args)
        _recipe(args)
    except ValueError as error:
        raise UsageError(str(error)) from None


def run(args: argparse.Namespace) -> int:
    """Render, or print what would be; returns 0, or 1 where a noisy mean is not that of its reference.

    Raises:
        UsageError: Options that do not fit.
        ValueError: Mitsuba is not installed, or a scene cannot be rendered.
        OSError: The output cannot be written.
    """
    from data.render.rendering import RenderOptions, render
    from data.render.variant import choose
    from trainer.progress import sample_progress

    check(args)
    recipe = _recipe(args)
    sources = _sources(args, recipe)
    variant = choose(VARIANTS[args.variant])
    print(f"Mitsuba's variant: {variant.reason}", flush=True)
    cores = len(os.sched_getaffinity(0))
    # Loading a scene and compiling its kernels use one core, so that more processes keep more cores busy.
    processes = args.processes or max(min(cores, 2), cores // 2)
    options = RenderOptions(
        variant,
        processes,
        max(1, cores // processes),
        None if args.test is None else tuple(args.test),
        tuple(args.validation),
        args.force,
    )
    if args.dry_run:
        return _dry_run(args.output, recipe, sources, options)
    with _resumable(), sample_progress("rendering") as progress:
        manifest = render(sources, recipe, args.output, options, progress)
    return _summary(args.output, manifest)


@contextmanager
def _resumable() -> Iterator[None]:
    """Say that an interrupted command can go on, also where it is ended as batch systems do."""

    def end(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        print("what is finished is kept: the same command goes on from there", file=sys.stderr, flush=True)
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


def _check(args: argparse.Namespace) -> None:
    """Raise a ValueError where options do not fit each other or their range."""
    if args.random < 0:
        raise ValueError(f"--random {args.random}: expected a number of scenes, 0 or more")
    if not args.random and not args.scene:
        raise ValueError("nothing to render: give --random N or --scene FILE")
    if args.seed < 0:
        raise ValueError(f"--seed {args.seed}: expected 0 or more")
    if args.frames is not None and args.frames < 1:
        raise ValueError(f"--frames {args.frames}: expected at least 1")
    if args.processes is not None and args.processes < 1:
        raise ValueError(f"--processes {args.processes}: expected at least 1")
    for name in ("defocus", "motion"):
        value = getattr(args, name)
        if value is not None and not 0 <= value <= 1:
            raise ValueError(f"--{name} {value}: expected a probability from 0 to 1")
    for name in ("places", "meshes", "textures", "environments", "defocus", "motion"):
        if getattr(args, name) is not None and not args.random:
            raise ValueError(f"--{name} is for random scenes: give --random N, or leave it out")
    if args.camera is not None and not args.scene:
        raise ValueError("--camera is for Mitsuba files: give --scene FILE, or leave it out")
    if args.camera == "jitter" and args.kind == "sequences":
        raise ValueError("--camera jitter gives views that are no sequence: fixed, orbit or a JSON file")


def _recipe(args: argparse.Namespace) -> Recipe:
    from data.render.recipe import defaults, with_options

    width = height = None
    if args.size:
        try:
            width, height = (int(n) for n in args.size.lower().split("x"))
        except ValueError:
            raise ValueError(f"--size {args.size}: expected columns x rows, such as 1280x720") from None
    chunk = None
    if args.memory is not None:
        if not args.memory >= 0.5:
            raise ValueError(f"--memory {args.memory}: expected at least 0.5 GB for each process")
        chunk = 2 ** int(max(14, min(22, 20 + _log2(args.memory / 2))))
    spp = None if args.spp is None else tuple(args.spp)
    return with_options(
        defaults(args.kind),
        width=width,
        height=height,
        spp=spp,
        reference_spp=args.reference_spp,
        max_depth=args.max_depth,
        chunk=chunk,
        histogram=args.histogram,
        histogram_exposure=args.histogram_exposure,
        second_hit=args.second_hit,
    )


def _log2(number: float) -> float:
    import math

    return math.floor(math.log2(number))


def _sources(args: argparse.Namespace, recipe: Recipe) -> list[Source]:
    from data.render.assets import Assets
    from data.render.sources import FileSource, RandomSource
    from data.render.spec import Shot

    path = args.kind == "sequences"
    moving = 0.0 if path else 0.5
    places: Any = args.places or ("outdoor", "indoor")
    shot = Shot(
        recipe.width,
        recipe.height,
        args.frames or (8 if path else 1),
        path,
        moving if args.defocus is None else args.defocus,
        moving if args.motion is None else args.motion,
    )
    given = (args.meshes, args.textures, args.environments)
    assets = Assets.scan(*given) if any(given) else None
    random: list[Source] = [
        RandomSource(args.seed + i, places[i % len(places)], shot, assets) for i in range(args.random)
    ]
    files = [FileSource(path, shot, _camera(args), args.seed) for path in args.scene]
    return [*random, *files]


def _camera(args: argparse.Namespace) -> Any:
    from data.render.user_scenes import CameraMove

    kind: Any = args.camera or ("orbit" if args.kind == "sequences" else "jitter")
    if kind in ("fixed", "jitter", "orbit"):
        return CameraMove(kind)
    if not Path(kind).is_file():
        raise ValueError(f"--camera {kind}: neither fixed, jitter, orbit nor a JSON file with key frames")
    return CameraMove("keyframes", path=Path(kind))


def _dry_run(output: Path, recipe: Recipe, sources: Sequence[Source], options: RenderOptions) -> int:
    from data.render.rendering import bytes_of, measure_speed, plan, remembered_speed

    todo = plan(sources, recipe, output, options)
    views = sum(map(len, todo.works.values()))
    frames = views * len(recipe.spp)
    print(
        f"{len(sources)} scenes, {views} views, {frames} frames of {recipe.width}x{recipe.height}; "
        f"{'/'.join(map(str, recipe.spp))} spp, reference {recipe.reference_spp} spp"
    )
    for name, works in todo.works.items():
        print(f"  {name}: {len(works)} view{'s' if len(works) > 1 else ''}")
    print(
        f"{todo.samples / 1e6:,.1f} million samples, of which {todo.missing / 1e6:,.1f} million are missing; "
        f"about {bytes_of(recipe, views) / 1e6:,.0f} MB"
    )
    if not todo.missing:
        return 0
    speed, source = remembered_speed(output), "the last call"
    if speed is None:
        print(f"measuring the speed on {sources[0].name} …", flush=True)
        one = measure_speed(sources[0], recipe, options.variant, options.threads)
        speed, source = options.processes * one, "one scene"
    print(
        f"about {_duration(todo.missing / speed)} at {speed / 1e6:.2f} million samples per second ({source})"
    )
    return 0


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} seconds"
    return f"{seconds / 60:.0f} minutes" if seconds < 5400 else f"{seconds / 3600:.1f} hours"


def _summary(output: Path, manifest: Any) -> int:
    """Print what was made, and which frames need attention."""
    from data.render.references import ENERGY_LIMIT

    records = [(n, r) for n, s in manifest.scenes.items() for r in s.frames]
    far = [(n, r) for n, r in records if abs(r.checks["energy_z"]) > ENERGY_LIMIT]
    size = sum(r.bytes for _, r in records)
    noise = max(r.checks["reference_relmse"] for _, r in records)
    largest = max(abs(r.checks["energy_z"]) for _, r in records)
    print(
        f"{output}: {len(records)} frames of {len(manifest.scenes)} scenes, {size / 1e6:.0f} MB\n"
        f"largest difference between the means of a noisy frame and its reference: {largest:.1f} standard "
        f"errors (limit {ENERGY_LIMIT:g}); relMSE of the noisiest reference itself: {noise:.2g}"
    )
    for name, record in far:
        print(
            f"warning: {name}/frame {record.index}: the noisy mean is {record.checks['energy_z']:.1f} "
            "standard errors from its reference's: rare bright paths (a higher --reference-spp shows), or a "
            "defect"
        )
    skipped = sorted({said for scene in manifest.scenes.values() for said in _skipped(scene.origin)})
    if skipped:
        told = "; ".join(skipped[:5]) + (f"; and {len(skipped) - 5} more" if len(skipped) > 5 else "")
        print(f"warning: {len(skipped)} of your files cannot be used and were passed over: {told}")
    print(f"next: trainer inspect {output} --html report.html; trainer prepare {output} --output SHARDS")
    return 1 if far else 0


def _skipped(origin: dict[str, Any]) -> list[str]:
    """Return what a scene's origin says of the user's files that could not be read."""
    skipped: list[str] = (origin.get("assets") or {}).get("skipped", [])
    return skipped
