"""Figure 4 of NFOR: quality of the training-free methods on all stills at 4 and 32 samples per pixel.

Every method meets the same buffers (`tests.benchmarks.classical_frames`), once as rendered and once with
fireflies limited beforehand (`models.ops.fireflies`), for all methods alike. Another method is one line of
`METHODS`. Definitions, with output x, reference r and exposure e of the frame:

    MSE       mean (e x - e r)^2
    relMSE    mean (x - r)^2 / (r^2 + 0.01), radiance as rendered
    less ref. relMSE less the reference's own, mean (a - r)(b - r) / (r^2 + 0.01) with the halves a, b of the
              input at 32 samples, which is unbiased for it
    99 %      relMSE without the 1 % of the pixels where this method is worst
    PSNR      of clamp(max(e x, 0)^(1/2.2), 0, 1), peak 1
    SSIM      of the same images, uniform 7x7 window, data range 1

    python -m tests.benchmarks.classical_quality [--figure FILE] [--picture FILE] [--only METHOD …]
"""

from __future__ import annotations

import argparse
import inspect
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from models import NFOR, NLM, CrossBilateral, JointBilateral, JointNLM, MultiScaleNLM
from models.denoiser import Denoiser, select
from tests.benchmarks import figure10
from tests.benchmarks.classical_frames import FEATURES, SPP, Still, left_out, limited, stills
from tests.benchmarks.timing import Row, row
from trainer.metrics.functional import gamma, psnr_wskp, ssim_wskp_range1

EPSILON = 0.01
CROP = 96
OURS = ("NFOR public", "NFOR paper")


class Method(NamedTuple):
    """A denoiser class and the options that make it the method of the table."""

    denoiser: Callable[..., Denoiser]
    options: Mapping[str, Any] = {}
    compared: bool = True
    """Whether it takes part in figure 10; the bilateral filters have fixed bandwidths and do not."""


METHODS: dict[str, Method] = {
    "NLM": Method(NLM),
    "joint NLM": Method(JointNLM, {"features": FEATURES}),
    "multi-scale NLM": Method(MultiScaleNLM),
    "NFOR public": Method(NFOR, {"features": FEATURES}),
    "NFOR paper": Method(NFOR, {"features": FEATURES, "preset": "paper"}),
    "cross bilateral": Method(CrossBilateral, compared=False),
    "joint bilateral": Method(JointBilateral, {"temporal": False}, compared=False),
}


BLOCKS: dict[str, Callable[[Still], Still | None]] = {
    "as rendered": lambda still: still,
    "fireflies limited": limited,
}
"""Title → what happens to the buffers before any method meets them; None leaves the still out."""


def build(method: Method, noise: Mapping[str, str]) -> Denoiser:
    """Return the denoiser, with those options of the noise that its constructor has."""
    known = inspect.signature(method.denoiser).parameters
    return method.denoiser(**method.options, **{n: v for n, v in noise.items() if n in known}).eval()


def scores(output: Tensor, still: Still) -> dict[str, float]:
    """Return metric → value of an image (1, 3, H, W)."""
    x, r, exposure = output.double(), still.reference.double(), still.exposure
    scale = r.square() + EPSILON
    relative = ((x - r).square() / scale).mean(1).flatten()
    kept = relative.sort().values[: relative.numel() - relative.numel() // 100]
    own = (still.reference_error.double() / scale).mean()
    shown = (output.float() * exposure, still.reference * exposure)
    return {
        "MSE": float((x - r).square().mean() * exposure**2),
        "relMSE": float(relative.mean()),
        "less ref.": float(relative.mean() - own),
        "99 %": float(kept.mean()),
        "PSNR": float(psnr_wskp(*shown)),
        "SSIM": float(ssim_wskp_range1(*shown)),
    }


@torch.inference_mode()
def denoised(method: Method, still: Still) -> Tensor | None:
    """Return the output, None where the method cannot make anything of the still's buffers."""
    net = build(method, still.noise)
    if any(name not in still.buffers for name in net.inputs):
        return None
    return net(select(net, still.buffers)).color


class Result(NamedTuple):
    """One still: its scores by method, and crops (H, W, 3) where a picture is wanted."""

    still: str
    spp: int
    scores: dict[str, dict[str, float]]
    crops: dict[str, Tensor]


def evaluate(block: str, methods: Mapping[str, Method], limit: int | None, cropped: bool) -> list[Result]:
    """Run all methods on all stills of a block of `BLOCKS`, and say how far it is."""
    results = []
    for still in (BLOCKS[block](still) for spp in SPP for still in stills(spp, limit)):
        if still is None:
            continue
        began = time.monotonic()
        images = {"input": still.buffers["color"]}
        for name, method in methods.items():
            image = denoised(method, still)
            if image is not None:
                images[name] = image
        crops = _crops(still, images) if cropped and still.spp == max(SPP) else {}
        results.append(Result(still.name, still.spp, {n: scores(x, still) for n, x in images.items()}, crops))
        took = time.monotonic() - began
        print(f"{block}: {still.name}, {still.spp} spp, {took:.0f} s", file=sys.stderr, flush=True)
    return results


def _crops(still: Still, images: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the exposed square of each image where the reference has most contrast, reference last.

    Squares that are mostly white count less, since nothing is seen in them.
    """
    reference = still.reference * still.exposure
    shown = gamma(reference).mean(1, keepdim=True)
    mean, square = (F.avg_pool2d(x, CROP, 8) for x in (shown, shown.square()))
    white = F.avg_pool2d((shown >= 1).float(), CROP, 8)
    place = int(((square - mean.square()) * (1 - white) ** 4).flatten().argmax())
    top, left = 8 * (place // mean.shape[-1]), 8 * (place % mean.shape[-1])
    window = (0, slice(None), slice(top, top + CROP), slice(left, left + CROP))
    exposed = {name: image * still.exposure for name, image in images.items()}
    return {n: x[window].permute(1, 2, 0) for n, x in {**exposed, "reference": reference}.items()}


def picture(results: Sequence[Result], path: Path) -> None:
    """Write one row of crops per scene: input, all methods, reference."""
    from trainer.reports.pictures import Panel, grid, tone_map

    rows = []
    for result in results:
        if result.crops and result.still.endswith("/0"):
            panels = []
            for name, crop in result.crops.items():
                tile = tone_map(crop.numpy())
                tile = tile.resize((2 * CROP, 2 * CROP), Image.Resampling.NEAREST)
                title = f"{result.still[:-2]}: input" if name == "input" else name
                known = result.scores.get(name)
                caption = f"{known['PSNR']:.1f} dB, relMSE {known['relMSE']:.3f}" if known else ""
                panels.append(Panel(tile, title, caption))
            rows.append(panels)
    path.parent.mkdir(parents=True, exist_ok=True)
    grid(rows, f"{max(SPP)} samples per pixel; scores of the whole frame").save(path)


def means(results: Sequence[Result], spp: int) -> dict[str, dict[str, float]]:
    """Return method → metric → mean over the stills of a number of samples per pixel."""
    found: dict[str, list[dict[str, float]]] = {}
    for result in results:
        if result.spp == spp:
            for name, values in result.scores.items():
                found.setdefault(name, []).append(values)
    return {
        name: {metric: statistics.fmean(values[metric] for values in listed) for metric in listed[0]}
        for name, listed in found.items()
    }


def report(block: str, results: Sequence[Result], compared: Sequence[str]) -> None:
    """Print the means, the distances to the best and whether NFOR leads."""
    for spp in SPP:
        table = means(results, spp)
        count = sum(result.spp == spp for result in results)
        if table:
            print(f"\n{block}, {spp} samples per pixel: means of {count} stills")
            print(f"{'':18}" + "".join(f"{metric:>11}" for metric in table["input"]))
        for name, values in table.items():
            print(f"{name:18}" + "".join(f"{value:>11.4g}" for value in values.values()))
    listed = [result.scores for result in results]
    print(f"\n{block}: distance to the best, mean and standard deviation")
    print(f"{'':18}" + "".join(f"{metric + ', ' + kind:>26}" for metric, kind in figure10.METRICS.items()))
    tables = [figure10.summary(listed, metric, compared) for metric in figure10.METRICS]
    for name in compared:
        print(f"{name:18}" + "".join(f"{t[name].mean:>17.3f} ±{t[name].spread:>7.3f}" for t in tables))
    ours = [name for name in OURS if name in compared]
    if ours and len(ours) < len(compared):
        for metric in figure10.METRICS:
            print(figure10.verdict(listed, metric, compared, ours))


def rows_of(block: str, results: Sequence[Result], compared: Sequence[str]) -> list[Row]:
    """Return the means, and NFOR's distances beside the best of the others."""
    rows = []
    for spp in SPP:
        for name, values in means(results, spp).items():
            shown = {"relMSE": "", "PSNR": "dB", "SSIM": ""}
            rows += [row(f"{block}, {spp} spp, {name}: {m}", values[m], unit) for m, unit in shown.items()]
    listed = [result.scores for result in results]
    for metric in figure10.METRICS:
        table = figure10.summary(listed, metric, compared)
        for ours in (name for name in OURS if name in compared):
            others = [entry for name, entry in table.items() if name not in OURS]
            for what in figure10.Distance._fields if others else ():
                ratio = getattr(table[ours], what) / min(getattr(entry, what) for entry in others)
                name = f"{block}, {metric}: {what} of {ours}'s distance / least of the others"
                rows.append(row(name, ratio, "", "<= 1", ratio <= 1))
    return rows


def run(
    figure: Path | None = None,
    sheet: Path | None = None,
    only: Sequence[str] = (),
    limit: int | None = None,
) -> list[Row]:
    """Return the rows of figure 4 and draw what is asked for."""
    methods = {name: method for name, method in METHODS.items() if not only or name in only}
    compared = [name for name, method in methods.items() if method.compared]
    for sentence in left_out():
        print(sentence)
    rows: list[Row] = []
    blocks: dict[str, list[Mapping[str, Mapping[str, float]]]] = {}
    for block in BLOCKS:
        results = evaluate(block, methods, limit, sheet is not None and not blocks)
        if sheet and not blocks:
            picture(results, sheet)
        blocks[block] = [result.scores for result in results]
        report(block, results, compared)
        rows += rows_of(block, results, compared)
    if figure:
        figure10.draw(blocks, compared, figure)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="draw figure 10 into this PNG")
    parser.add_argument("--picture", type=Path, help="write one crop per scene with all methods side by side")
    parser.add_argument("--only", nargs="+", choices=tuple(METHODS), default=(), metavar="METHOD")
    parser.add_argument("--limit", type=int, help="frames of each data set")
    options = parser.parse_args()
    run(options.figure, options.picture, options.only, options.limit)
