import itertools
import math

import pytest
import torch

from trainer.losses import L1, SMAPE, Recurrent, RelativeL2, TonemappedL2, laplacian_of_gaussian


def test_smape_is_the_mean_of_the_written_ratio():
    output, target = torch.tensor([[1.0, 0.0]]), torch.tensor([[3.0, 0.5]])
    expected = (2 / 4.01 + 0.5 / 0.51) / 2
    assert float(SMAPE()(output, target)) == pytest.approx(expected, rel=1e-6)


def test_smape_gradient_flows_through_the_denominator():
    output = torch.tensor([1.0], requires_grad=True)
    SMAPE()(output, torch.tensor([3.0])).backward()
    # d/do |o-t| / (o+t+e) = (-(o+t+e) - (t-o)) / (o+t+e)^2
    assert float(output.grad) == pytest.approx((-4.01 - 2.0) / 4.01**2, rel=1e-6)


def test_relative_l2_divides_by_target_or_by_detached_output():
    output, target = torch.tensor([2.0], requires_grad=True), torch.tensor([1.0])
    assert RelativeL2(epsilon=0.0)(output, target).item() == pytest.approx(1.0)
    loss = RelativeL2(epsilon=0.0, symmetric=True)(output, target)
    loss.backward()
    assert loss.item() == pytest.approx(0.25)
    assert float(output.grad) == pytest.approx(0.5)


@pytest.mark.parametrize("loss", [SMAPE(), L1(), RelativeL2(), RelativeL2(symmetric=True)])
def test_losses_compute_in_float32_and_stay_finite_on_half_maximum(loss):
    output = torch.full((1, 3, 4, 4), 65504.0, dtype=torch.bfloat16)
    value = loss(output, torch.zeros(1, 3, 4, 4, dtype=torch.bfloat16))
    assert value.dtype == torch.float32
    assert torch.isfinite(value)


def test_tonemapped_l2_compares_srgb_of_the_logarithm():
    output, target = torch.tensor([0.0, 0.5, 7.0]), torch.tensor([0.001, 0.25, 70000.0])
    curve = [
        1.055 * v ** (1 / 2.4) - 0.055 if v > 0.0031308 else 12.92 * v
        for v in (math.log(1 + min(x, 65536.0)) for x in (*output.tolist(), *target.tolist()))
    ]
    expected = sum((a - b) ** 2 for a, b in zip(curve[:3], curve[3:], strict=True)) / 3
    assert TonemappedL2()(output, target).item() == pytest.approx(expected, rel=1e-5)


def test_tonemapped_l2_has_a_gradient_where_the_output_is_black():
    output = torch.zeros(3, requires_grad=True)
    TonemappedL2()(output, torch.full((3,), 0.5)).backward()
    assert (output.grad < 0).all()


def test_the_recurrent_loss_weighs_seven_frames_as_the_paper_does():
    target = torch.zeros(1, 7, 3, 12, 12)
    found = []
    for frame in range(7):
        output = target.clone()
        output[:, frame] = 1.0
        found.append(Recurrent(spatial=1.0, edges=0.0, changes=0.0)(output, target).item())
    listed = [0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0]
    assert [value / found[-1] for value in found] == pytest.approx(listed, abs=6e-4)
    assert sum(found) == pytest.approx(1.0)


def test_the_recurrent_loss_of_changes_sees_differences_of_frames_only():
    loss = Recurrent(spatial=0.0, edges=0.0, changes=1.0)
    target = torch.rand(2, 3, 3, 8, 8)
    assert loss(target + 5.0, target).item() == pytest.approx(0.0, abs=1e-5)
    output = target.clone()
    output[:, 1] += 1.0  # changes by 1 from the first frame and by -1 to the last
    assert loss(output, target).item() == pytest.approx(1.0, rel=1e-5)


def test_the_recurrent_loss_of_edges_is_the_filtered_difference():
    output = torch.rand(1, 1, 3, 20, 16, dtype=torch.float64)
    found = Recurrent(spatial=0.0, edges=1.0, changes=0.0)(output, torch.zeros_like(output)).item()
    kernel = laplacian_of_gaussian(9, 1.5).double()
    assert kernel.sum().abs() < 1e-6
    image, total = output[0, 0], 0.0
    for channel, y, x in itertools.product(range(3), range(20), range(16)):
        value = 0.0
        for dy, dx in itertools.product(range(-4, 5), repeat=2):
            row, column = min(max(y + dy, 0), 19), min(max(x + dx, 0), 15)
            value += kernel[dy + 4, dx + 4] * image[channel, row, column]
        total += abs(float(value))
    assert found == pytest.approx(total / (3 * 20 * 16), rel=1e-4)
    flat = torch.full((1, 2, 3, 9, 9), 7.0)
    assert Recurrent(0.0, 1.0, 0.0)(flat, torch.zeros_like(flat)).item() < 1e-5


def test_impossible_recurrent_losses_are_refused():
    with pytest.raises(ValueError, match="odd size"):
        Recurrent(size=8)
    with pytest.raises(ValueError, match="weights -1"):
        Recurrent(spatial=-1)
