"""Clipping of gradients in supervised training."""

from __future__ import annotations

import pytest
import torch

from models import WSKP
from trainer.modules import Regression


def clipped(gradient: list[float], **arguments: float) -> list[float]:
    """What becomes of a gradient that is 0 but for some numbers."""
    module = Regression(WSKP(), **arguments)  # type: ignore[arg-type]
    parameters = list(module.net.parameters())
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    first = parameters[0].grad
    assert first is not None
    first.view(-1)[: len(gradient)] = torch.tensor(gradient)
    module.configure_gradient_clipping(torch.optim.SGD(module.net.parameters(), 0.1))
    found: list[float] = first.view(-1)[: len(gradient)].tolist()
    return found


def test_the_norm_is_clipped_before_the_values() -> None:
    assert clipped([3.0, 4.0], clip_norm=1.0, clip_value=0.7) == pytest.approx([0.6, 0.7], rel=1e-4)
    assert clipped([3.0, 4.0], clip_norm=1.0) == pytest.approx([0.6, 0.8], rel=1e-4)
    assert clipped([3.0, -4.0], clip_value=0.25) == [0.25, -0.25]


def test_small_gradients_stay_as_they_are() -> None:
    assert clipped([0.003, 0.004], clip_norm=1.0, clip_value=0.25) == pytest.approx([0.003, 0.004])


def test_clipping_by_module_and_trainer_at_once_is_refused() -> None:
    module = Regression(WSKP(), clip_norm=1.0)
    with pytest.raises(ValueError, match=r"clipped twice: use --trainer\.gradient_clip_val null"):
        module.configure_gradient_clipping(torch.optim.SGD(module.net.parameters(), 0.1), 1.0, "norm")


def test_clips_must_be_positive() -> None:
    with pytest.raises(ValueError, match="clip_value is 0"):
        Regression(WSKP(), clip_value=0)
