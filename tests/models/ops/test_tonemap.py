"""The tone curves that networks see, and their way back."""

from __future__ import annotations

import pytest
import torch

from models.ops.tonemap import LARGEST, exposed, filmic, gamma, radiance_of


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


def test_exposed_radiance_is_finite_and_not_negative() -> None:
    radiance = torch.tensor([2.0, -3.0, float("nan"), float("inf"), -float("inf"), 65504.0, 1e30])
    found = exposed(radiance, torch.tensor(4.0))
    expected = torch.tensor([8.0, 0.0, 0.0, LARGEST, 0.0, 4 * 65504.0, LARGEST])
    assert torch.equal(found, expected)


def test_exposure_is_applied_before_half_precision_overflows() -> None:
    found = exposed(torch.tensor([60000.0]).half(), torch.tensor([4.0]).half())
    assert found.dtype == torch.float32
    assert found.item() == 4 * torch.tensor(60000.0).half().item()


LOGS = torch.tensor([-2.0, 0.0, 1e-7, 1e-3, 0.5, 1.0, 3.0, 11.1, 27.0, 28.0, 500.0])


@pytest.mark.parametrize("recorded", [False, True])
def test_radiance_of_a_logarithm_is_its_inverse_also_in_recorded_graphs(
    recorded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("models.ops.tonemap.exporting", lambda: recorded)
    logs = LOGS.clone().requires_grad_()
    found = radiance_of(logs)
    expected = torch.expm1(LOGS.double().clamp_min(0)).clamp_max(LARGEST).float()
    torch.testing.assert_close(found, expected, rtol=2e-6, atol=0)
    found.sum().backward()
    assert logs.grad is not None
    torch.testing.assert_close(logs.grad[1:9], LOGS[1:9].exp(), rtol=2e-6, atol=0)
    assert logs.grad[0] == logs.grad[-1] == 0


def test_filmic_is_the_curve_as_printed_and_0_up_to_its_toe() -> None:
    radiance = torch.tensor([-3.0, 0.0, 0.004, 0.01, 0.18, 1.0, 20.0, 65504.0, 1e9])
    t = (radiance.double() - 0.004).clamp_min(0)
    expected = (t * (6.2 * t + 0.5) / (t * (6.2 * t + 1.7) + 0.06)).float()
    torch.testing.assert_close(filmic(radiance), expected)
    assert (filmic(radiance[:3]) == 0).all()
    assert filmic(torch.tensor(1.004)).item() == pytest.approx(6.7 / 7.96)
    assert filmic(torch.tensor([0.2], dtype=torch.bfloat16)).dtype == torch.float32


def test_filmic_stays_within_1_with_finite_gradients() -> None:
    radiance = torch.tensor([-1.0, 0.0, 0.004, 0.5, 65504.0, 1e12, 1e30, torch.inf], requires_grad=True)
    found = filmic(radiance)
    assert ((found >= 0) & (found <= 1)).all()
    found.sum().backward()
    assert radiance.grad is not None
    assert radiance.grad.isfinite().all()
    assert radiance.grad[3] > 0
