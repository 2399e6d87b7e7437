"""NFOR is its float64 transcription on rendered frames as well, beside lamps far brighter than the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from data.derive import derive
from data.exr import read_frame
from data.root import resolve_root
from models.classical.nfor import NFOR
from models.ops import regression
from tests.models import plain_nfor

pytestmark = pytest.mark.usefixtures("one_thread", "no_gradients")

NAMES = ("normal", "albedo", "depth")
PARTS = ("a", "b", "variance")
ROWS, COLUMNS = slice(20, 44), slice(77, 101)
"""Part of outdoor-000003 with highlights of 17 among shadows of 0.04."""


@pytest.fixture(scope="module")
def crop() -> dict[str, Tensor]:
    names = [f"{name}_{part}" for name in ("color", *NAMES) for part in PARTS]
    frame = derive(read_frame(resolve_root("sample:stills").path / "outdoor-000003" / "f000.exr"), names)
    cut = {name: frame.buffers[name][ROWS, COLUMNS].transpose(2, 0, 1) for name in names}
    return {name: torch.from_numpy(np.ascontiguousarray(array))[None] for name, array in cut.items()}


def image(tensor: Tensor) -> Any:
    return tensor[0].permute(1, 2, 0).double().numpy()


@pytest.fixture(scope="module")
def expected(crop: dict[str, Tensor]) -> plain_nfor.Steps:
    a, b, variance = (image(crop[f"color_{part}"]) for part in PARTS)
    features = [np.concatenate([image(crop[f"{n}_{part}"]) for n in NAMES], -1) for part in PARTS]
    return plain_nfor.nfor(a, b, variance, (features[0], features[1], features[2]))


def differences(found: Tensor, expected: plain_nfor.Steps) -> Any:
    return np.abs(image(found) - expected.color) / (expected.color.max() - expected.color.min())


@pytest.mark.parametrize("fused", [False, True])
def test_pixels_beside_highlights_equal_the_transcription(
    crop: dict[str, Tensor], expected: plain_nfor.Steps, fused: bool
) -> None:
    found = NFOR(fused=fused).details(crop)
    assert np.abs(image(found.selection) - expected.selection).max() < 1e-3  # type: ignore[arg-type]
    assert differences(found.color, expected).max() < 1e-3  # what the ridge makes, see below


def test_what_is_left_is_the_ridge_of_the_solver(
    crop: dict[str, Tensor], expected: plain_nfor.Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regression, "RIDGE", 1e-14)
    monkeypatch.setattr(regression, "NOISE", 1e-9)
    found = NFOR()({name: part.double() for name, part in crop.items()}).color
    assert differences(found, expected).max() < 1e-7
