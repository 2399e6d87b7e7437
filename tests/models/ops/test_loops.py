"""Loops over strips of rows in recorded graphs."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.ops import loops
from models.ops.loops import looped, overlapped

SIZES = ((1, 2, 5, 9), (2, 3, 17, 6), (3, 1, 1, 4))
"""Images, samples, rows, columns; the graph was recorded with others."""


class Pointwise(nn.Module):
    """A pixelwise sum over samples, of which a network sees an image and numbers of the frame too."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(5, 4, 1).requires_grad_(False)
        self.before = nn.Conv2d(3, 2, 3, padding=1).requires_grad_(False)

    def forward(self, samples: Tensor, factor: Tensor) -> Tensor:
        context = self.before(samples[:, 0])
        factor = factor.reshape(-1, 1, 1, 1, 1) * 2

        def function(samples: Tensor, context: Tensor, factor: Tensor) -> Tensor:
            spread = context[:, None].expand(-1, samples.shape[1], -1, -1, -1)
            maps = self.layer(torch.cat([samples * factor, spread], 2).flatten(0, 1))
            return maps.reshape(*samples.shape[:2], *maps.shape[1:]).relu().sum(1)

        if torch.jit.is_tracing():
            return looped(function, [samples, context], [factor], samples.shape[1] * 5)
        return function(samples, context, factor)


class Spread(nn.Module):
    """What every row brings to the two above and below, summed, or the largest of it."""

    def __init__(self, largest: bool) -> None:
        super().__init__()
        self.largest = largest

    def forward(self, samples: Tensor, factor: Tensor) -> Tensor:
        image = samples.sum(1) * factor.reshape(-1, 1, 1, 1)

        def function(image: Tensor) -> Tensor:
            if self.largest:
                return F.max_pool2d(F.pad(image, (0, 0, 4, 4), value=-100.0), (5, 1), 1)
            return F.conv2d(image, torch.arange(1.0, 46.0).reshape(3, 3, 5, 1), padding=(4, 0))

        if not torch.jit.is_tracing():
            return function(image)
        return overlapped(function, [image], [], 3, 2, torch.maximum if self.largest else torch.add)


class Rows(nn.Module):
    """How many rows the strip of each pixel has."""

    def forward(self, samples: Tensor, factor: Tensor) -> Tensor:
        def function(samples: Tensor) -> Tensor:
            return samples[:, 0] * 0 + samples.shape[-2]

        return looped(function, [samples], [], samples.shape[1]) + factor.sum() * 0


def inputs(size: tuple[int, ...], seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    batch, count, height, width = size
    return (
        torch.rand(batch, count, 3, height, width, generator=generator),
        torch.rand(batch, generator=generator),
    )


def recorded(module: nn.Module) -> Callable[..., Tensor]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(module, inputs((2, 3, 8, 7)), check_trace=False)
        stream = io.BytesIO()
        torch.jit.save(traced, stream)
        stream.seek(0)
        return torch.jit.load(stream)  # type: ignore[no-any-return]  # a script module


def exported(module: nn.Module) -> Callable[..., Tensor]:
    free = {0: "b", 1: "s", 3: "h", 4: "w"}
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module, inputs((2, 3, 8, 7)), stream, dynamo=False, opset_version=17,
            input_names=["x", "e"], output_names=["y"], dynamic_axes={"x": free, "e": {0: "b"}},
        )  # fmt: skip
    session = onnxruntime.InferenceSession(stream.getvalue())

    def run(samples: Tensor, factor: Tensor) -> Tensor:
        feed: dict[str, np.ndarray[Any, Any]] = {"x": samples.numpy(), "e": factor.numpy()}
        return torch.from_numpy(session.run(None, feed)[0])

    return run


@pytest.fixture(params=[recorded, exported])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(loops, "CHUNK", 150)  # strips of 1 to 7 rows
    return request.param


def test_a_recorded_loop_computes_what_the_function_does_at_any_size(form: Any) -> None:
    torch.manual_seed(1)
    module = Pointwise()
    run = form(module)
    for size in SIZES:
        torch.testing.assert_close(run(*inputs(size)), module(*inputs(size)), rtol=1e-5, atol=1e-6)


def test_more_samples_per_pixel_make_strips_of_fewer_rows(form: Any) -> None:
    run = form(Rows())
    for count, rows in ((1, 15), (5, 3), (100, 1)):
        assert (run(*inputs((1, count, 30, 10))) == rows).all()


@pytest.mark.parametrize("largest", [False, True])
def test_strips_are_joined_where_they_overlap(form: Any, largest: bool) -> None:
    module = Spread(largest)
    run = form(module)
    for size in SIZES:
        torch.testing.assert_close(run(*inputs(size)), module(*inputs(size)), rtol=1e-5, atol=1e-6)


def test_the_graph_holds_a_loop_and_no_copies_of_its_body_for_each_strip(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    texts = []
    for chunk in (10, 10_000):
        monkeypatch.setattr(loops, "CHUNK", chunk)
        texts.append(recorded(Pointwise()).graph_for(*inputs((1, 2, 8, 7))))  # type: ignore[attr-defined]  # a script module
    counts = [str(text).count("aten::relu") for text in texts]
    assert counts[0] == counts[1]
