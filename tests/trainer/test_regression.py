"""Clipping of gradients in supervised training."""

from __future__ import annotations

import pytest
import torch

from models import SBMC, WSKP
from trainer.losses import RelativeL2
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


def test_pairs_are_compared_where_the_paper_compares_them() -> None:
    torch.manual_seed(1)
    net = SBMC(features=("radiance",), camera=False, width=4, rounds=1, levels=1, kernel_size=3)
    samples, reference = torch.rand(1, 2, 3, 12, 10), torch.rand(1, 3, 12, 10)
    exposure = torch.tensor([0.5])
    batch = {"samples": samples, "reference": reference, "exposure": exposure}
    module = Regression(net, RelativeL2(epsilon=0.01, factor=0.5), pairs=True)
    module.log = lambda *_, **__: None  # type: ignore[method-assign]
    color, target = ((x * 0.5)[..., 1:-1, 1:-1].double() for x in (net(batch).color, reference))
    shown, wanted = color / (1 + color), target / (1 + target)
    expected = 0.5 * ((shown - wanted) ** 2 / (wanted**2 + 0.01)).mean()
    assert module.training_step(batch, 0).item() == pytest.approx(expected.item(), rel=1e-4)
    assert module.validation_loss(batch, color, target).item() == pytest.approx(expected.item(), rel=1e-4)
    plain = Regression(net, RelativeL2()).validation_loss(batch, color, target)
    assert plain.item() == pytest.approx(((color - target) ** 2 / (target**2 + 0.01)).mean().item(), rel=1e-4)


def test_clips_must_be_positive() -> None:
    with pytest.raises(ValueError, match="clip_value is 0"):
        Regression(WSKP(), clip_value=0)
