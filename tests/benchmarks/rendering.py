"""Figure 2 of rendering: our samples per second beside Mitsuba's own, and two processes beside one.

Both contestants trace the same scene with the same number of samples in turns, in one process with all
threads. The other comparison gives every process one thread.

    python -m tests.benchmarks.rendering
"""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from data.render.recipe import STILLS
from data.render.sources import RandomSource
from data.render.spec import Shot
from data.render.variant import Variant, activate, choose
from tests.benchmarks.timing import Row, medians, print_table, row

SIZE, REPEATS = 128, 5
SPP = {"llvm_ad_rgb": 64, "scalar_rgb": 1}
SECONDS = 20.0


def source() -> RandomSource:
    """Return the measured scene: a random room without motion and defocus."""
    return RandomSource(12, "indoor", Shot(SIZE, SIZE, 1, False, 0.0, 0.0))


def beside_mitsuba(spp: int) -> dict[str, float]:
    """Return median seconds of ours and of Mitsuba's calls for the same samples, compilation excluded."""
    import mitsuba as mi

    from data.render.loading import load, sensor
    from data.render.tracer import Tracer

    spec = source().build()
    tracer, scene, camera = Tracer(spec), load(spec).scene, sensor(spec.views[0])
    path = mi.load_dict({"type": "path", "max_depth": 8})
    aovs = "depth:depth,normal:sh_normal,albedo:albedo,position:position"
    guided = mi.load_dict({"type": "aov", "aovs": aovs, "image": {"type": "path", "max_depth": 8}})
    seeds = iter(range(10_000))

    def ours(*names: str) -> None:
        for _ in tracer.trace(0, spp, next(seeds), names):
            pass

    def theirs(integrator: Any) -> None:
        image: Any = mi.render(
            scene, sensor=camera, integrator=integrator, spp=spp, seed=mi.UInt32(next(seeds))
        )
        np.array(image)

    calls = {
        "radiance": lambda: ours("radiance"),
        "split": lambda: ours("radiance", "diffuse"),
        "guided": lambda: ours(*STILLS),
        "path": lambda: theirs(path),
        "aov": lambda: theirs(guided),
    }
    return medians(calls, dict.fromkeys(calls, REPEATS))


def speed(barrier_time: float) -> float:
    """Return the samples per second of this process over a common span of time."""
    from data.render.tracer import Tracer

    tracer = Tracer(source().build())
    spp = SPP[_active()]
    list(tracer.trace(0, spp, 0, ("radiance",)))
    while time.time() < barrier_time:
        time.sleep(0.01)
    late = time.time() - barrier_time
    done, began = 0, time.monotonic()
    while time.monotonic() - began < SECONDS:
        list(tracer.trace(0, spp, 1 + done, ("radiance",)))
        done += 1
    if late > 1:
        raise RuntimeError(f"a process was ready {late:.0f} s late; the machine is too busy to measure this")
    return done * spp * SIZE * SIZE / (time.monotonic() - began)


def _active() -> str:
    import mitsuba

    return str(mitsuba.variant())


def together(processes: int, variant: Variant) -> float:
    """Return the samples per second of several processes with one thread each."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, activate, (variant, 1)) as pool:
        start = time.time() + 60 + 15 * (processes - 1)
        return sum(pool.map(speed, [start] * processes))


def run() -> list[Row]:
    """Return the rows of figure 2."""
    variant = choose()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, activate, (variant,)) as pool:
        seconds = pool.submit(beside_mitsuba, SPP[variant.name]).result()
    samples = SPP[variant.name] * SIZE * SIZE
    one, two = together(1, variant), together(2, variant)
    ratio, guided = seconds["path"] / seconds["radiance"], seconds["aov"] / seconds["guided"]
    efficiency = two / (2 * one)
    return [
        row(f"radiance, ours ({variant.name})", samples / seconds["radiance"] / 1e6, "M/s"),
        row("radiance, mi.render with path", samples / seconds["path"] / 1e6, "M/s"),
        row("radiance: samples per second, ours / Mitsuba", ratio, "", ">= 0.9", ratio >= 0.9),
        row("radiance with diffuse part, ours", samples / seconds["split"] / 1e6, "M/s"),
        row("radiance with 9 guides, ours", samples / seconds["guided"] / 1e6, "M/s"),
        row("radiance with 4 guides, mi.render with aov", samples / seconds["aov"] / 1e6, "M/s"),
        row("guided: samples per second, ours / Mitsuba", guided, "", ">= 0.9", guided >= 0.9),
        row("one process, one thread", one / 1e6, "M/s"),
        row("two processes, one thread each", two / 1e6, "M/s"),
        row("efficiency of two processes", efficiency, ""),
    ]


if __name__ == "__main__":
    print_table(run())
