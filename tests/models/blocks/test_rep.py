"""The multi-branch block convolves once and equals its branches."""

from __future__ import annotations

from typing import cast

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.blocks.rep import RepBlock


def branch_by_branch(block: RepBlock, image: Tensor) -> Tensor:
    total = torch.zeros(()).to(image)
    for module in block.convolutions:
        convolution = cast(nn.Conv2d, module)
        total = total + F.conv2d(image, convolution.weight, convolution.bias, padding=convolution.padding)
    return F.leaky_relu(total + image if block.identity else total, 0.1)


@pytest.mark.parametrize("identity", [False, True])
@pytest.mark.parametrize("bias", [False, True])
def test_one_convolution_gives_the_branches_output_and_gradients(identity: bool, bias: bool) -> None:
    block = RepBlock(6, 6, identity=identity, bias=bias).double()
    image = torch.randn(2, 6, 11, 9, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 6, 11, 9, dtype=torch.float64)
    found = block(image)
    expected = branch_by_branch(block, image)
    torch.testing.assert_close(found, expected)
    targets = [image, *block.parameters()]
    for one, other in zip(
        torch.autograd.grad(found, targets, weights),
        torch.autograd.grad(expected, targets, weights),
        strict=True,
    ):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("identity", [False, True])
@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("batch_norm", [False, True])
@pytest.mark.parametrize("branches", [False, True])
def test_collapsing_keeps_the_output(identity: bool, bias: bool, batch_norm: bool, branches: bool) -> None:
    torch.manual_seed(0)
    block = RepBlock(5, 5, identity=identity, bias=bias, batch_norm=batch_norm, branches=branches)
    for _ in range(3):
        block(torch.randn(2, 5, 12, 12) * 2 + 1)
    block.eval()
    image = torch.randn(2, 5, 12, 12)
    collapsed = block.collapse()
    assert len(collapsed.convolutions) == 1
    assert len(collapsed.norms) == 0
    torch.testing.assert_close(collapsed(image), block(image), rtol=1e-5, atol=1e-5)


def test_batch_norm_in_training_normalises_every_branch() -> None:
    block = RepBlock(4, 4, identity=True, batch_norm=True, activation="none")
    output = block(torch.randn(8, 4, 16, 16) * 5 + 3)
    assert output.mean((0, 2, 3)).abs().max() < 1e-4
    assert output.var((0, 2, 3)).min() > 1.0  # four branches of variance 1, partly correlated


def test_an_identity_between_different_widths_is_refused() -> None:
    with pytest.raises(ValueError, match="equal widths"):
        RepBlock(3, 4, identity=True)


def test_an_unknown_activation_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown activation 'gelu'"):
        RepBlock(3, 4, activation="gelu")  # type: ignore[arg-type]
