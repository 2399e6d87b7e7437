"""Figure 4 of NFOR: quality of the training-free methods on all stills at 4 and 32 samples per pixel.

Every method meets the same buffers (`tests.benchmarks.classical_frames`), once as rendered and once with
fireflies limited beforehand (`models.ops.fireflies`), for all methods alike; a histogram stays as it is.
Another method is one line of `METHODS`; `--lbf` adds a trained one. A method whose buffers a still lacks is
left out there: tables say over how many stills a mean goes, and are repeated over the stills that have all.
Definitions, with output x, reference r and exposure e of the frame:

    MSE       mean (e x - e r)^2
    relMSE    mean (x - r)^2 / (r^2 + 0.01), radiance as rendered
    less ref. relMSE less the reference's own, mean (a - r)(b - r) / (r^2 + 0.01) with the halves a, b of the
              input at 32 samples, which is unbiased for it
    99 %      relMSE without the 1 % of the pixels where this method is worst
    PSNR      of clamp(max(e x, 0)^(1/2.2), 0, 1), peak 1
    SSIM      of the same images, uniform 7x7 window, data range 1

Table 2 of NFOR lists mean time and memory per image; time is here that of all processors together, memory the
growth of what is resident in a call.

    python -m tests.benchmarks.classical_quality [--figure FILE] [--picture FILE] [--only METHOD …]
        [--lbf CHECKPOINT] [--kept DIR]

What is done is kept in `bench/classical/quality`, still by still: a run that was cut off goes on there, and
one with another method computes that alone.

What is seen in the pictures, and why:
- NLM, joint NLM, faintly RDFC: grainy squares of 21x21 pixels around a firefly. It has so large a variance
  that it counts as like everything; each pixel of its window takes some of it.
- Multi-scale NLM, RHF: dark and bright rings around fireflies and lamps. The coarser scale has spread their
  light; what is taken off again at the finer one lies elsewhere. Nothing keeps the sum above 0.
- RHF: blurred at 4 samples per pixel, with lamps spread over their windows: hardly any bin has more than one
  sample of two pixels to tell them apart by.
- RDFC: a bright band some 5 to 10 pixels from a lamp (Cornell box). Features alone take the lamp for ceiling.
  The estimated error of that candidate is a hundred times the others' there, but the choice is smoothed over
  11x11 pixels, and a tenth of a lamp of 70 times white is left.
- WLR, WLR-PF: dark and bright grain at 4 samples per pixel, some left at 32. Shared bandwidths are estimated
  pixel by pixel from noisy trials, and small ones come by chance: on the wall of indoor-000002 (4 samples)
  they are 0.41 in the worst 5 % of the pixels, 0.58 elsewhere. `least_bandwidth=0.5` gains 1 dB there.
- NFOR: black and white rings around fireflies, black spots beside the caustic, black and white glass: a line
  fitted to them goes below 0 where they are not (`models.ops.fireflies` limits them). Haloes in clean ground
  beside noisy objects (the window of indoor-000004): a noisy pixel finds clean ones within its noise, and its
  fit is averaged in there. With a thousandth of the variance the error there is 1.3 % instead of 12.7 %.
- Cross bilateral: lamps and textures blurred into their surroundings; joint bilateral: lamps, and what is
  reflected. The one looks at smoothed colours alone, the other at features alone. Joint bilateral: bright
  dots along the sky, where pixels see two surfaces and their light was divided by the mean of both albedos.
Dots on the wall of indoor-000002 are its texture: the albedo has them.
"""

from __future__ import annotations

import argparse
import inspect
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models import NFOR, NLM, RDFC, RHF, WLR, CrossBilateral, JointBilateral, JointNLM, MultiScaleNLM
from models.denoiser import Denoiser, select
from tests.benchmarks import figure10
from tests.benchmarks.classical_frames import FEATURES, RENDERED, SPP, Still, left_out, limited, stills
from tests.benchmarks.classical_kept import Entry, Kept, described, identity
from tests.benchmarks.classical_tables import INPUT, Result, report, rows_of, scores_of
from tests.benchmarks.crops import Tile, cropped, page, window
from tests.benchmarks.timing import Row
from trainer.benchmarking.memory import watch
from trainer.loading import load_model
from trainer.metrics.functional import psnr_wskp, ssim_wskp_range1

EPSILON = 0.01
OURS = ("NFOR public", "NFOR paper")
KEPT = RENDERED / "quality"
_WARM = 48


class Method(NamedTuple):
    """A denoiser class, or another maker of denoisers, and the options that make it what the table names."""

    denoiser: Callable[..., Any]
    options: Mapping[str, Any] = {}
    compared: bool = True
    """Whether it takes part in figure 10; the bilateral filters have fixed bandwidths and do not."""


METHODS: dict[str, Method] = {
    "NLM": Method(NLM),
    "joint NLM": Method(JointNLM, {"features": FEATURES}),
    "multi-scale NLM": Method(MultiScaleNLM),
    "RDFC": Method(RDFC, {"features": FEATURES}),
    "RHF": Method(RHF, {"threshold": 0.7}),  # as in NFOR's comparison
    "WLR": Method(WLR, {"features": FEATURES}),
    "WLR-PF": Method(WLR, {"features": FEATURES, "prefilter": True}),
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


def trained(checkpoint: Path) -> Method:
    """Return a method that was trained, loaded as `trainer denoise` does."""
    return Method(load_model, {"model": str(checkpoint)})


def build(method: Method, still: Still) -> Denoiser | None:
    """Return the denoiser for the buffers of a still, None where it cannot make anything of them.

    It has those options of the still's noise that its constructor has.
    """
    known = inspect.signature(method.denoiser).parameters
    noise = {name: value for name, value in still.noise.items() if name in known}
    net: Denoiser = method.denoiser(**method.options, **noise).eval()
    if set(net.inputs) <= set(still.buffers):
        return net
    other = net.instead(still.buffers)
    return None if other is None else other[0].eval()


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


class Runner:
    """Runs methods on stills, unless what they do there is kept.

    Args:
        methods: Name → method.
        folder: Where results are kept; None: nowhere.
    """

    def __init__(self, methods: Mapping[str, Method], folder: Path | None) -> None:
        self.methods, self._kept = dict(methods), Kept(folder)
        self._told = {name: described(m.denoiser, m.options) for name, m in methods.items()}
        self._warm: set[str] = set()

    @torch.inference_mode()
    def result(self, block: str, still: Still) -> Result:
        """Return what every method, and the input, did; methods without their buffers are left out."""
        name, exposure = f"{block} {still.name} {still.spp}", still.exposure
        where = window(still.reference * exposure) if still.name.endswith("/0") else None
        told = {INPUT: "", **self._told}
        identities = {each: identity(f"{told[each]} {still.noise}", still.buffers["color"]) for each in told}
        kept = self._kept.load(name, identities)
        entries: dict[str, Entry] = {}
        for each in told:
            if each in kept and (where is None or kept[each].crop is not None):
                entries[each] = kept[each]
            elif (made := self._made(each, still)) is not None:
                crop = cropped(made.color, where, exposure) if where else None
                entries[each] = Entry(scores(made.color, still), made.seconds, made.size, crop)
                self._kept.save(name, {each: entries[each]}, identities)
        reference = cropped(still.reference, where, exposure) if where else None
        return Result(still.name, still.spp, still.reference[0, 0].numel(), entries, reference)

    def _made(self, name: str, still: Still) -> Made | None:
        if name == INPUT:
            return Made(still.buffers["color"])
        net = build(self.methods[name], still)
        if net is None:
            return None
        chosen = select(net, still.buffers)
        if name not in self._warm:  # what is compiled on first use does not count
            net({n: x[..., :_WARM, :_WARM] if x.ndim == 4 else x for n, x in chosen.items()})
            self._warm.add(name)
        memory, began = watch("cpu", "torch"), time.process_time()
        color = net(chosen).color
        return Made(color, time.process_time() - began, memory.taken())


class Made(NamedTuple):
    """An image (1, 3, H, W), seconds of processor time and bytes that it took."""

    color: Tensor
    seconds: float = 0.0
    size: int = 0


def evaluate(block: str, runner: Runner, limit: int | None) -> list[Result]:
    """Run all methods on all stills of a block of `BLOCKS`, and say how far it is."""
    results = []
    for still in (BLOCKS[block](still) for spp in SPP for still in stills(spp, limit)):
        if still is None:
            continue
        began = time.monotonic()
        results.append(runner.result(block, still))
        took = time.monotonic() - began
        print(f"{block}: {still.name}, {still.spp} spp, {took:.0f} s", file=sys.stderr, flush=True)
    return results


def picture(results: Sequence[Result], spp: int, path: Path) -> None:
    """Write one row of crops per scene: input, all methods, reference; nothing where there are none."""
    rows = []
    for result in results:
        if result.spp == spp and result.reference is not None:
            tiles = []
            for name, entry in result.entries.items():
                assert entry.crop is not None
                title = f"{result.still[:-2]}: input" if name == INPUT else name
                caption = f"{entry.scores['PSNR']:.1f} dB, relMSE {entry.scores['relMSE']:.3f}"
                tiles.append(Tile(entry.crop, title, caption))
            rows.append([*tiles, Tile(result.reference, "reference")])
    if rows:
        page(rows, f"{spp} samples per pixel; scores of the whole frame", path)


def run(
    figure: Path | None = None,
    sheet: Path | None = None,
    only: Sequence[str] = (),
    limit: int | None = None,
    *,
    lbf: Path | None = None,
    kept: Path | None = KEPT,
) -> list[Row]:
    """Return the rows of figure 4 and draw what is asked for."""
    methods = METHODS | ({"LBF": trained(lbf)} if lbf else {})
    methods = {name: method for name, method in methods.items() if not only or name in only}
    compared = [name for name, method in methods.items() if method.compared]
    for sentence in left_out():
        print(sentence)
    runner, rows = Runner(methods, kept), []
    blocks: dict[str, list[Mapping[str, Mapping[str, float]]]] = {}
    for block in BLOCKS:
        results = evaluate(block, runner, limit)
        if sheet:
            for spp in SPP:
                name = f"{sheet.stem}_{block.replace(' ', '_')}_{spp}{sheet.suffix}"
                picture(results, spp, sheet.with_name(name))
        blocks[block] = [*scores_of(results)]
        report(block, results, compared, OURS)
        rows += rows_of(block, results, compared, OURS)
    if figure:
        figure10.draw(blocks, compared, figure)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="draw figure 10 into this PNG")
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="write one crop per scene with all methods side by side, a picture for each block and number "
        "of samples, such as FILE_as_rendered_32.png",
    )
    parser.add_argument("--only", nargs="+", choices=(*METHODS, "LBF"), default=(), metavar="METHOD")
    parser.add_argument("--limit", type=int, help="frames of each data set")
    parser.add_argument("--lbf", type=Path, metavar="CHECKPOINT", help="compare this trained LBF too")
    parser.add_argument("--kept", type=Path, default=KEPT, metavar="DIR", help="where results are kept")
    options = parser.parse_args()
    run(
        options.figure,
        options.picture,
        options.only,
        options.limit,
        lbf=options.lbf,
        kept=options.kept,
    )
