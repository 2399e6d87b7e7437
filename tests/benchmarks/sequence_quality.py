"""Columns BMFR, SVGF and NFOR of tables 1 and 2 of Fan et al. 2021, on the sequences that ship.

Each has nine frames of 320x180 with one sample per pixel. Scores are means over all frames, the first of
which has no history, and then over scenes:

    PSNR, SSIM   as in the paper, `psnr_wskp` and `ssim_wskp`, whose data range is 2; `range 1` is SSIM with 1
    last         PSNR of the last frame alone
    flicker      `flicker_gamma`: how much the error of display values changes from frame to frame where the
                 same surface is seen in both; the paper's temporal measure is in its supplement, which is
                 not known here
    change       `change_gamma`, the warping error of Lai et al. 2018; that of the reference is not 0, and
                 what is below it is blurred

BMFR and SVGF read the light of each frame and carry their own history, which for BMFR is the accumulation
that the paper gives to all. It says nothing of what NFOR reads; here it is the frame alone, the accumulated
radiance, and the accumulated light without albedo, which is multiplied afterwards. These frames have neither
halves nor variances: NFOR estimates the noise of the image and takes features as free of noise.

The paper's order by PSNR is NFOR, BMFR, SVGF; by SSIM all three are within 0.01. Here it is SVGF, NFOR on
accumulated frames, BMFR, NFOR on single frames, and these are the reasons as far as they are known:
- Lamps and windows are in view, 4 to 7 % of the pixels above twice white. A lamp lies in the plane of its
  ceiling: no feature of BMFR tells it from that, and its light spreads over the block. With the same pixels
  at white in the input BMFR gains 0.2, 1.2 and 2.7 dB (classroom, Cornell box, living room), SVGF -0.1, -2.3
  and 0.1: BMFR is then 0.3 dB ahead in the classroom, 1.2 and 0.3 behind in the others.
- A block of 32x32 pixels holds four times as much of the scene in each direction as at the paper's 1280x720,
  which one quadratic function has to fit. With blocks of 16x16 BMFR gains -0.3, 2.0 and 1.4 dB.
- The paper's SVGF loses 3 dB to BMFR in PSNR and nothing in SSIM, as an image of other brightness would;
  here both measures agree.
- NFOR needs to know how noisy a pixel is. From one sample per pixel it can only ask the neighbours, and a
  firefly among black pixels then looks like detail; accumulated frames give it 1.7 dB more.

What is seen in the pictures, and why:
- BMFR: haloes around lamps and windows, and rectangles of light in what is dark, by the reason above; faint
  squares beside the Cornell box, where blocks hold both the box and nothing.
- BMFR, SVGF: reflections in glass, screen and gold are blurred: features are those of the first hit.
- BMFR, SVGF: dotted edges, since features are those of one sample anywhere in the pixel, and the pixel that
  was seen before there may have shown the other side.
- SVGF: soft edges of sunlight on the classroom's floor: at one sample per pixel differences of luminance are
  within the noise that is allowed for. With `sigma_l=1` the floor gains 0.1 dB and the frame loses 1.
- NFOR: stars and rings around fireflies, black and white in single frames: lines are fitted to them (see
  `models.ops.fireflies`, which needs two halves).
- No trails behind moving edges were found. Frames differ by 1 to 2 pixels.

    python -m tests.benchmarks.sequence_quality [--picture FILE]
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from data.frame import Frame
from data.frames import FrameSet
from data.sample import SAMPLES
from data.temporal import accumulate
from models import BMFR, NFOR, SVGF
from models.classical.sequence_filter import SequenceFilter
from models.denoiser import State, select
from tests.benchmarks.classical_frames import FEATURES
from tests.benchmarks.crops import Tile, cropped, page, window
from tests.benchmarks.timing import Row, row
from trainer.metrics.functional import psnr_wskp, ssim_wskp, ssim_wskp_range1
from trainer.metrics.temporal import change_gamma, flicker_gamma, places_before

READ = ("color", "irradiance", *FEATURES, "position", "motion", "reference")
STILL = {"PSNR": psnr_wskp, "SSIM": ssim_wskp, "range 1": ssim_wskp_range1}
UNITS = {"PSNR": "dB", "last": "dB"}


class Clip(NamedTuple):
    """The frames of a scene.

    Attributes:
        frames: As read.
        buffers: Of each frame, tensors (1, C, H, W) and `exposure` (1,); `accumulated` is the light.
    """

    frames: list[Frame]
    buffers: list[dict[str, Tensor]]


def clip(frames: FrameSet, scene: str) -> Clip:
    """Read the frames of a scene, and accumulate their light."""
    read = list(frames.sequence(scene, READ))
    buffers = []
    for frame, done in zip(read, accumulate(read), strict=True):
        planes = {name: _tensor(frame.buffers[name]) for name in READ}
        planes["accumulated"] = _tensor(done.buffers["irradiance"])
        buffers.append({**planes, "exposure": torch.tensor([frame.exposure or 1.0])})
    return Clip(read, buffers)


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None]


def _carried(net: SequenceFilter, shown: Clip) -> Iterator[Tensor]:
    """Yield every frame of a method that carries its history."""
    state: State | None = None
    for buffers in shown.buffers:
        color, state, _ = net(select(net, buffers), state)
        yield color


def _nfor(shown: Clip, color: Callable[[Mapping[str, Tensor]], Tensor]) -> Iterator[Tensor]:
    """Yield what NFOR makes of an image of each frame."""
    net = NFOR("paper", FEATURES, color_noise="estimated", feature_noise="none")
    for buffers in shown.buffers:
        yield net(select(net, {**buffers, "color": color(buffers)})).color


METHODS: dict[str, Callable[[Clip], Iterator[Tensor]]] = {
    "input": lambda shown: (b["color"] for b in shown.buffers),
    "accumulated": lambda shown: (b["accumulated"] * b["albedo"] for b in shown.buffers),
    "BMFR": lambda shown: _carried(BMFR(), shown),
    "BMFR, blocks of 16": lambda shown: _carried(BMFR(block=16), shown),
    "SVGF": lambda shown: _carried(SVGF(), shown),
    "NFOR": lambda shown: _nfor(shown, lambda b: b["color"]),
    "NFOR, accumulated": lambda shown: _nfor(shown, lambda b: b["accumulated"] * b["albedo"]),
    "NFOR, light": lambda shown: (
        light * b["albedo"]
        for light, b in zip(_nfor(shown, lambda b: b["accumulated"]), shown.buffers, strict=True)
    ),
    "reference": lambda shown: (b["reference"] for b in shown.buffers),
}


def scores(images: Sequence[Tensor], shown: Clip) -> dict[str, float]:
    """Return metric → mean over the frames (1, 3, H, W) of a scene.

    Both frames of a pair are judged at the exposure of the second, as `trainer evaluate` does.
    """
    references = [buffers["reference"] for buffers in shown.buffers]
    exposures = [float(buffers["exposure"]) for buffers in shown.buffers]
    pairs = [(x * e, r * e) for x, r, e in zip(images, references, exposures, strict=True)]
    found = {name: [float(measure(*pair)) for pair in pairs] for name, measure in STILL.items()}
    values = {name: statistics.fmean(listed) for name, listed in found.items()}
    flicker, change = [], []
    for t in range(1, len(images)):
        places = places_before(shown.frames[t], shown.frames[t - 1])
        now, before, reference, reference_before = (
            (image * exposures[t])[0]
            for image in (images[t], images[t - 1], references[t], references[t - 1])
        )
        flicker.append(flicker_gamma(now, before, reference, reference_before, places))
        change.append(change_gamma(now, before, places))
    return {
        **values,
        "last": found["PSNR"][-1],
        "flicker": statistics.fmean(flicker),
        "change": statistics.fmean(change),
    }


def tiles(
    scene: str, last: Mapping[str, Tensor], table: Mapping[str, Mapping[str, float]], exposure: float
) -> list[Tile]:
    """Return the crops of a scene's last frame (method → image)."""
    where = window(last["reference"] * exposure)
    found = []
    for name, image in last.items():
        title = f"{scene}: input" if name == "input" else name
        caption = "" if name == "reference" else f"{table[name]['last']:.1f} dB"
        found.append(Tile(cropped(image, where, exposure), title, caption))
    return found


def report(title: str, table: Mapping[str, Mapping[str, float]]) -> None:
    """Print the scores of all methods."""
    print(f"\n{title}")
    print(f"{'':18}" + "".join(f"{metric:>11}" for metric in next(iter(table.values()))))
    for name, values in table.items():
        print(f"{name:18}" + "".join(f"{value:>11.4g}" for value in values.values()))


def average(tables: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Return method → metric → mean over scenes."""
    first = tables[0]
    return {
        name: {metric: statistics.fmean(table[name][metric] for table in tables) for metric in first[name]}
        for name in first
    }


@torch.inference_mode()
def run(sheet: Path | None = None) -> list[Row]:
    """Return the scores of every scene and their averages; draw the picture that is asked for."""
    frames = FrameSet(SAMPLES["bmfr"])
    tables: dict[str, dict[str, dict[str, float]]] = {}
    shown = []
    for scene in frames.scenes():
        read = clip(frames, scene)
        tables[scene], last = {}, {}
        for name, method in METHODS.items():
            images = list(method(read))
            tables[scene][name], last[name] = scores(images, read), images[-1]
        report(scene, tables[scene])
        shown.append(tiles(scene, last, tables[scene], float(read.buffers[-1]["exposure"])))
    tables["average"] = average(list(tables.values()))
    report("average", tables["average"])
    if sheet:
        page(shown, "last of nine frames with one sample per pixel; scores of the whole frame", sheet)
    return [
        row(f"{scene}, {name}: {metric}", value, UNITS.get(metric, ""))
        for scene, table in tables.items()
        for name, values in table.items()
        for metric, value in values.items()
        if np.isfinite(value)
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path, help="write one crop per scene with all methods side by side")
    run(parser.parse_args().picture)
