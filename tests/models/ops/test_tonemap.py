"""The display curve that WSKP's network sees."""

from __future__ import annotations

import torch

from models.ops.tonemap import gamma


def test_gamma_is_the_clamped_power_of_the_authors() -> None:
    radiance = torch.tensor([-3.0, 0.0, 1e-6, 0.18, 0.999, 1.0, 7.0, 65504.0])
    expected = radiance.clamp_min(0).double().pow(0.454545).clamp(0, 1).float()
    torch.testing.assert_close(gamma(radiance), expected)
    assert gamma(torch.tensor(0.0)) == 0.0


def test_gamma_has_finite_gradients_at_black_and_white() -> None:
    radiance = torch.tensor([-1.0, 0.0, 1e-30, 1e-12, 0.5, 1.0, 2.0, 1e30], requires_grad=True)
    gamma(radiance).sum().backward()
    assert radiance.grad is not None
    assert radiance.grad.isfinite().all()
    assert radiance.grad[4] > 0


def test_gamma_computes_in_float32_for_half_precision_input() -> None:
    assert gamma(torch.tensor([0.5], dtype=torch.bfloat16)).dtype == torch.float32
