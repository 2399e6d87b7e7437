"""The multi-branch convolution block of WSKP and KP (a variant of RepVGG), and chains of it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Activation = Literal["leaky_relu", "relu", "none"]

SIZE = 5
"""Size of the collapsed kernel, and of the largest branch."""


class RepBlock(nn.Module):
    """Sum of a 5x5, a 3x3 and a 1x1 convolution and, for equal widths, the identity; then an activation.

    All branches are linear, so their kernels are summed first and the image is convolved once, in training
    too: the output and all gradients are those of separate convolutions (Fan et al. 2021, section 4.1, after
    Ding et al. 2021, RepVGG). Only batch normalisation in training mode needs each branch's own output.

    Args:
        inputs: Channels in.
        outputs: Channels out.
        identity: Add the input; needs `inputs == outputs`.
        activation: `leaky_relu` has slope 0.1.
        bias: Every convolution has a bias.
        batch_norm: Every branch is normalised over the batch before the sum.
        branches: False: only the 5x5 convolution, the collapsed form.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        identity: bool = False,
        activation: Activation = "leaky_relu",
        bias: bool = False,
        batch_norm: bool = False,
        branches: bool = True,
    ) -> None:
        super().__init__()
        if identity and inputs != outputs:
            raise ValueError(f"an identity branch needs equal widths, got {inputs} -> {outputs}")
        if activation not in ("leaky_relu", "relu", "none"):
            raise ValueError(f"unknown activation {activation!r}; expected leaky_relu, relu or none")
        self.inputs, self.outputs, self.activation = inputs, outputs, activation
        self.identity = identity and branches
        sizes = (5, 3, 1) if branches else (5,)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=bias) for size in sizes
        )
        count = (len(sizes) + int(self.identity)) if batch_norm else 0
        self.norms = nn.ModuleList(nn.BatchNorm2d(outputs) for _ in range(count))

    def forward(self, image: Tensor) -> Tensor:
        """Convolve (B, inputs, H, W) to (B, outputs, H, W)."""
        if len(self.norms) > 0 and self.training:
            result = self._branch_by_branch(image)
        else:
            kernel, bias = self.collapsed()
            result = F.conv2d(image, kernel, bias, padding=SIZE // 2)
        return self._activated(result)

    def rows(self, image: Tensor) -> Tensor:
        """Return (B, outputs, h, W) of (B, inputs, h + 4, W): rows of `forward` away from top and bottom.

        Normalisation uses its running statistics.
        """
        kernel, bias = self.collapsed()
        return self._activated(F.conv2d(image, kernel, bias, padding=(0, SIZE // 2)))

    def _activated(self, result: Tensor) -> Tensor:
        if self.activation == "leaky_relu":
            # In place: the convolution needs its input and the activation only signs, so that one copy of
            # every feature map is kept for the backward pass instead of two.
            return F.leaky_relu(result, 0.1, inplace=True)
        return F.relu(result, inplace=True) if self.activation == "relu" else result

    def _branch_by_branch(self, image: Tensor) -> Tensor:
        maps = [convolution(image) for convolution in self.convolutions]
        if self.identity:
            maps.append(image)
        return torch.stack([norm(m) for norm, m in zip(self.norms, maps, strict=True)]).sum(0)

    def collapsed(self) -> tuple[Tensor, Tensor | None]:
        """Return the 5x5 kernel (outputs, inputs, 5, 5) and the bias (outputs,) that equal all branches.

        Differentiable; normalisation enters with its running statistics.
        """
        kernels: list[Tensor] = []
        biases: list[Tensor] = []
        for index, module in enumerate(self.convolutions):
            convolution = cast(nn.Conv2d, module)
            kernel, bias = self._normalised(convolution.weight, convolution.bias, index)
            margin = (SIZE - convolution.kernel_size[0]) // 2
            kernels.append(F.pad(kernel, [margin] * 4) if margin else kernel)
            biases += [] if bias is None else [bias]
        if self.identity:
            weight = cast(nn.Conv2d, self.convolutions[0]).weight
            delta = torch.eye(self.outputs, dtype=weight.dtype, device=weight.device)[:, :, None, None]
            kernel, bias = self._normalised(delta, None, len(self.convolutions))
            kernels.append(F.pad(kernel, [SIZE // 2] * 4))
            biases += [] if bias is None else [bias]
        total = sum(kernels[1:], start=kernels[0])
        return total, sum(biases[1:], start=biases[0]) if biases else None

    def _normalised(self, kernel: Tensor, bias: Tensor | None, index: int) -> tuple[Tensor, Tensor | None]:
        if len(self.norms) == 0:
            return kernel, bias
        norm = cast(nn.BatchNorm2d, self.norms[index])
        mean, variance = cast(Tensor, norm.running_mean), cast(Tensor, norm.running_var)
        scale = norm.weight / torch.sqrt(variance + norm.eps)
        shift = norm.bias - (mean if bias is None else mean - bias) * scale
        return kernel * scale[:, None, None, None], shift

    def collapse(self) -> RepBlock:
        """Return the inference form: one 5x5 convolution with the same output."""
        with torch.no_grad():
            kernel, bias = self.collapsed()
        block = RepBlock(
            self.inputs, self.outputs, activation=self.activation, bias=bias is not None, branches=False
        ).to(kernel)
        convolution = cast(nn.Conv2d, block.convolutions[0])
        convolution.weight = nn.Parameter(kernel)
        if bias is not None:
            convolution.bias = nn.Parameter(bias)
        return block.train(self.training)


def chain(
    widths: Sequence[int], *, activation: Activation, bias: bool, batch_norm: bool, branches: bool
) -> nn.ModuleList:
    """Return the blocks of WSKP's and KP's networks, one after the other.

    All but the first and the last have an identity branch; the last has no activation.

    Args:
        widths: Channels of the input, between blocks, and of the output.
        activation: Of all blocks but the last.
        bias: As for `RepBlock`, like the other options.
    """
    last = len(widths) - 2
    return nn.ModuleList(
        RepBlock(
            before,
            after,
            identity=0 < layer < last,
            activation="none" if layer == last else activation,
            bias=bias,
            batch_norm=batch_norm,
            branches=branches,
        )
        for layer, (before, after) in enumerate(pairwise(widths))
    )
