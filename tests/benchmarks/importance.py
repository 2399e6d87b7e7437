"""Figure: patches chosen by importance against uniform ones, and the time that choosing takes.

    python -m tests.benchmarks.importance

Noise of a patch is the mean of (color - reference)^2 / (reference^2 + 0.01), its relative mean squared error.
The frames of the samples are 320 (1 spp sequences) and 160 pixels wide (32 spp stills), a quarter and an
eighth of what the numbers are published for, so patches are 32x32 and 16x16 and candidates 400: the same
picture, scaled down. Both ways get the same number of patches.
Time is processor time, that of one core, for 400 candidates of 128x128 on 1280x720 pixels, a sample frame
tiled four by four.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from data.frame import Frame, Image
from data.frames import FrameSet
from data.importance import CANDIDATES, importance_map, importance_positions
from data.patches import Position, cut, uniform_positions
from data.sample import SAMPLES
from tests.benchmarks.timing import Row, print_table, row

PATCH, SCALE, REPEATS = 128, 4, 5
FLOORS = (1e-4, 1e-2)


def noise(frame: Frame, positions: list[Position], patch: int) -> list[float]:
    """Return the relative mean squared error of each patch."""
    color, reference = frame.buffers["color"], frame.buffers["reference"]
    error = (color - reference) ** 2 / (reference**2 + np.float32(0.01))
    return [float(cut(error, position, patch).mean()) for position in positions]


def frames_of(sample: str) -> list[Frame]:
    """Return all frames of a sample."""
    frames = FrameSet(SAMPLES[sample])
    return [frames.read(scene, record.index) for scene in frames.scenes() for record in frames.frames(scene)]


def compare(frame: Frame, floor: float) -> tuple[float, float, int]:
    """Return the mean noise of chosen and of as many uniform patches, and how many there are."""
    patch = PATCH * frame.width // 1280
    importance = importance_map(frame.buffers["color"], frame.buffers["normal"], patch, floor)
    seed = (1, frame.scene, frame.index)
    chosen = importance_positions(importance, CANDIDATES, patch, seed)
    uniform = uniform_positions(len(chosen), (frame.width, frame.height), patch, seed)
    return (
        float(np.mean(noise(frame, chosen, patch))),
        float(np.mean(noise(frame, uniform, patch))),
        len(chosen),
    )


def seconds(color: Image, normal: Image) -> tuple[float, float]:
    """Return the processor time of the map, and of choosing positions by it."""
    start = time.process_time()
    importance = importance_map(color, normal, PATCH)
    middle = time.process_time()
    importance_positions(importance, CANDIDATES, PATCH, (1,))
    return middle - start, time.process_time() - middle


def run() -> list[Row]:
    """Measure and return the rows."""
    rows = []
    for name in ("bmfr", "stills"):
        read = frames_of(name)
        for floor in FLOORS:
            found = [compare(frame, floor) for frame in read]
            ratios = [chosen / uniform for chosen, uniform, _ in found]
            kept = statistics.fmean(number for _, _, number in found)
            means = [statistics.fmean(part) for part in zip(*found, strict=True)]
            rows += [
                row(f"{name}: relative noise, chosen / uniform, floor {floor:g}", means[0] / means[1], "x"),
                row(f"{name}: the same, median over frames, floor {floor:g}", statistics.median(ratios), "x"),
                row(f"{name}: kept of {CANDIDATES} candidates, floor {floor:g}", kept, ""),
            ]
    first = frames_of("bmfr")[0]
    color, normal = (np.tile(first.buffers[name], (SCALE, SCALE, 1)) for name in ("color", "normal"))
    times = [seconds(color, normal) for _ in range(REPEATS)]
    mapping, choosing = (statistics.median(part) for part in zip(*times, strict=True))
    total = statistics.median(map(sum, times))
    return [
        *rows,
        row("importance map 1280x720", mapping * 1e3, "ms"),
        row("400 candidates chosen and pruned", choosing * 1e3, "ms"),
        row("importance patches, one core, per frame 1280x720", total, "s", "< 1", total < 1),
    ]


if __name__ == "__main__":
    print_table(run())
