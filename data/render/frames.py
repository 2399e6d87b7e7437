"""From traced samples to frames: what each recipe stores of a view."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from data.buffers import HISTOGRAM, SECOND_ALBEDO
from data.camera import Camera
from data.derive import automatic_exposure
from data.frame import Frame, Image, Samples
from data.render.moments import Moments, at_counts, over_hits
from data.render.ray_histograms import RayHistograms
from data.render.recipe import Recipe
from data.render.spec import SceneSpec

HALVES = (
    "radiance",
    "diffuse",
    "specular",
    "normal",
    "diffuse_albedo",
    "specular_albedo",
    "depth",
    "visibility",
)
"""Quantities of stills that are stored with two halves and the variance of the mean.

Rays that left the scene count as 0 in them, so that a pixel with surface and background has a high variance;
the mean of depth and position is that over the rays that hit.
"""

SECOND_HIT = ("position", SECOND_ALBEDO)
"""The same of a recipe with second hits."""

FOLLOWING = ("color", "specular", "specular_a", "specular_b")
"""Buffers of stills that are left out, since they follow from others: specular is color - diffuse."""

_NAMES = {"radiance": "color"}
_OVER_HITS = ("depth", "position")


class TracedChunk(Protocol):
    """A few samples per pixel of some rows."""

    rows: slice
    values: Mapping[str, NDArray[np.float32]]


class Tracing(Protocol):
    """What is used of `data.render.tracer.Tracer`."""

    spec: SceneSpec
    invalid: int

    def trace(
        self,
        frame: int,
        spp: int,
        seed: int,
        names: Sequence[str],
        motion: Literal["previous", "shutter"] = ...,
        static: bool = ...,
    ) -> Iterator[Any]:
        """Yield chunks that cover all samples of a frame."""
        ...

    def pixel_camera(self, frame: int) -> Camera:
        """Return the camera of a frame."""
        ...


Report = Callable[[int], None]
"""Called with the number of samples traced since the last call."""


def ignored(count: int) -> None:
    """Report nothing."""


def reported(chunks: Iterator[Any], report: Report) -> Iterator[Any]:
    """Yield chunks and report their samples."""
    for chunk in chunks:
        samples, rows, columns, _ = next(iter(chunk.values.values())).shape
        report(samples * rows * columns)
        yield chunk


def noisy_frames(
    tracer: Tracing, view: int, recipe: Recipe, seed: int, report: Report = ignored
) -> Iterator[Frame]:
    """Render the noisy side of a view: a frame per number of samples, without reference and exposure.

    Only one frame is held at a time, since a large image at many counts would fill the memory.

    Args:
        tracer: Of the scene.
        view: Number of the view.
        recipe: What to store.
        seed: Of the samples.
        report: Told what was traced.
    """
    spec = tracer.spec
    traced = tracer.trace(
        view,
        recipe.spp[-1],
        seed,
        recipe.names,
        motion="shutter" if recipe.kind == "samples" else "previous",
        static=recipe.kind == "sequences",
    )
    chunks = reported(traced, report)
    if recipe.kind == "samples":
        buffers, samples = _kept_apart(chunks, recipe)
        frame = _frame(tracer, view, view, recipe.spp[0], buffers)
        frame.samples = samples
        yield frame
        return
    histograms = _histograms(tracer, view, recipe, seed) if recipe.histogram else None
    stream = ((chunk.rows, _with_specular(chunk.values)) for chunk in _counted(chunks, histograms))
    for level, (count, moments) in enumerate(at_counts(stream, recipe.spp, (recipe.height, recipe.width))):
        buffers = _still(moments, recipe.second_hit) if recipe.kind == "stills" else _means(moments)
        frame = _frame(tracer, view, view * len(recipe.spp) + level, count, buffers)
        if len(recipe.spp) > 1 or not spec.path:
            frame.notes["view"] = view
        if histograms is not None:
            frame.buffers[HISTOGRAM] = histograms.take(count)
            frame.notes["checks"] = {"histogram_exposure": histograms.exposure}
        yield frame


def _histograms(tracer: Tracing, view: int, recipe: Recipe, seed: int) -> RayHistograms:
    """Return histograms to fill, exposed as one sample per pixel says that is traced before the others."""
    size = (recipe.height, recipe.width)
    if recipe.histogram_exposure is not None:
        return RayHistograms(recipe.spp, size, recipe.histogram_exposure)
    image = np.zeros((*size, 3), np.float32)
    before = tracer.invalid
    for chunk in tracer.trace(view, 1, seed ^ 1, ("radiance",)):
        image[chunk.rows] = chunk.values["radiance"][0]
    tracer.invalid = before
    return RayHistograms(recipe.spp, size, automatic_exposure(image))


def _counted(chunks: Iterator[Any], histograms: RayHistograms | None) -> Iterator[Any]:
    """Yield chunks, and add their samples to histograms before."""
    for chunk in chunks:
        if histograms is not None:
            histograms.add(chunk.rows, chunk.values["radiance"])
        yield chunk


def noisy_color(frame: Frame) -> Image:
    """Return the noisy radiance of a rendered frame, from its halves where it has them."""
    if "color" in frame.buffers:
        return frame.buffers["color"]
    return np.float32(0.5) * (frame.buffers["color_a"] + frame.buffers["color_b"])


def _frame(tracer: Tracing, view: int, index: int, spp: int, buffers: dict[str, Image]) -> Frame:
    seen = tracer.spec.views[view]
    lens = (seen.aperture, seen.focus if seen.aperture > 0 else 0.0, seen.fov)
    return Frame(buffers, tracer.spec.name, index, tracer.pixel_camera(view), spp=spp, thin_lens=lens)


def _means(moments: Mapping[str, Moments]) -> dict[str, Image]:
    hits = moments["hit"]
    return {
        _NAMES.get(name, name): over_hits(m, hits) if name in _OVER_HITS else m.mean()
        for name, m in moments.items()
    }


def _still(moments: Mapping[str, Moments], second_hit: bool) -> dict[str, Image]:
    """Return means, halves and variances, without those that follow from others."""
    buffers = _means(moments)
    for name in (*HALVES, *SECOND_HIT) if second_hit else HALVES:
        stored = _NAMES.get(name, name)
        for half in "ab":
            buffers[f"{stored}_{half}"] = moments[name].half(half)
        buffers[f"{stored}_variance"] = moments[name].variance()
    return {name: image for name, image in buffers.items() if name not in FOLLOWING}


def _with_specular(values: Mapping[str, NDArray[np.float32]]) -> Mapping[str, NDArray[np.float32]]:
    if "diffuse" not in values:
        return values
    return {**values, "specular": values["radiance"] - values["diffuse"]}


def _kept_apart(chunks: Iterator[Any], recipe: Recipe) -> tuple[dict[str, Image], Samples]:
    parts: dict[int, list[Mapping[str, NDArray[np.float32]]]] = {}
    for chunk in chunks:
        parts.setdefault(chunk.rows.start, []).append(chunk.values)
    bands = [
        {name: np.concatenate([part[name] for part in band]) for name in recipe.names}
        for _, band in sorted(parts.items())
    ]
    whole = {name: np.concatenate([band[name] for band in bands], 1) for name in recipe.names}
    hit = (whole["depth"] > 0).astype(np.float32)
    number = np.maximum(hit.sum(0), 1)
    buffers = {
        "color": whole["radiance"].mean(0),
        "normal": whole["normal"].mean(0),
        "depth": whole["depth"].sum(0) / number,
        "diffuse_albedo": whole["diffuse_albedo"].mean(0),
        "specular_albedo": whole["specular_albedo"].mean(0),
        "hit": hit.mean(0),
    }
    return buffers, Samples.of(whole)
