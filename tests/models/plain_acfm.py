"""ACFM's generator written down literally: the yardstick for `models.ACFM`, in tests and in benchmarks.

Layer after layer, every convolution by itself, everything kept for the backward pass (Xu et al. 2019).
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models import ACFM
from models.acfm import Block, Generator
from models.denoiser import Buffers


class PlainCFM(nn.Module):
    """out = x * (1 + scale) + shift, both made from the condition."""

    def __init__(self, condition: int, width: int) -> None:
        super().__init__()
        self.scale_conv0 = nn.Conv2d(condition, condition, 1)
        self.scale_conv1 = nn.Conv2d(condition, width, 1)
        self.shift_conv0 = nn.Conv2d(condition, condition, 1)
        self.shift_conv1 = nn.Conv2d(condition, width, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, width, H, W) from x of that shape and (B, condition, H, W)."""
        scale = self.scale_conv1(F.leaky_relu(self.scale_conv0(condition), 0.1))
        shift = self.shift_conv1(F.leaky_relu(self.shift_conv0(condition), 0.1))
        return x * (1 + scale) + shift


class PlainBlock(nn.Module):
    """CFM, convolution, ReLU, CFM, convolution, plus the input."""

    def __init__(self, condition: int, width: int) -> None:
        super().__init__()
        self.cfm0 = PlainCFM(condition, width)
        self.conv0 = nn.Conv2d(width, width, 3, 1, 1)
        self.cfm1 = PlainCFM(condition, width)
        self.conv1 = nn.Conv2d(width, width, 3, 1, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, width, H, W)."""
        inner = F.relu(self.conv0(self.cfm0(x, condition)))
        return x + self.conv1(self.cfm1(inner, condition))


class PlainACFM(nn.Module):
    """The network of one component, in log space."""

    def __init__(
        self, blocks: int = 16, width: int = 64, condition_width: int = 128, condition: int = 32
    ) -> None:
        super().__init__()
        self.condition0 = nn.Conv2d(7, condition_width, 3, 1, 1)
        self.condition1 = nn.Conv2d(condition_width, condition_width, 1)
        self.condition2 = nn.Conv2d(condition_width, condition_width, 1)
        self.condition3 = nn.Conv2d(condition_width, condition_width, 1)
        self.condition4 = nn.Conv2d(condition_width, condition, 1)
        self.head = nn.Conv2d(3, width, 3, 1, 1)
        self.blocks = nn.ModuleList(PlainBlock(condition, width) for _ in range(blocks))
        self.cfm = PlainCFM(condition, width)
        self.conv = nn.Conv2d(width, width, 3, 1, 1)
        self.tail0 = nn.Conv2d(width, width, 3, 1, 1)
        self.tail1 = nn.Conv2d(width, 3, 3, 1, 1)

    def forward(self, component: Tensor, guides: Tensor) -> Tensor:
        """(B, 3, H, W) from the noisy component of that shape and the guides (B, 7, H, W)."""
        condition = guides
        for layer in (self.condition0, self.condition1, self.condition2, self.condition3):
            condition = F.leaky_relu(layer(condition), 0.1)
        condition = self.condition4(condition)
        head = self.head(component)
        x = head
        for block in self.blocks:
            x = block(x, condition)
        x = self.conv(self.cfm(x, condition)) + head
        return F.relu(self.tail1(F.relu(self.tail0(x))))


def plain_copy(network: Generator) -> PlainACFM:
    """Return the plain network with the weights of ours."""
    first, last = cast(nn.Conv2d, network.condition[0]), cast(nn.Conv2d, network.condition[-1])
    sizes = (network.head.out_channels, first.out_channels, last.out_channels)
    plain = PlainACFM(len(network.blocks), *sizes)
    pairs: list[tuple[nn.Module, nn.Module]] = [
        *((getattr(plain, f"condition{i}"), network.condition[2 * i]) for i in range(5)),
        (plain.head, network.head),
        (plain.tail0, network.tail),
        (plain.tail1, network.last),
        (plain.conv, network.body.convolution),
        *_modulation(plain.cfm, network.body.modulation),
    ]
    for theirs, block in zip(plain.blocks, network.blocks, strict=True):
        ours = cast(Block, block)
        for i, half in enumerate((ours.first, ours.second)):
            pairs.append((getattr(theirs, f"conv{i}"), half.convolution))
            pairs += _modulation(getattr(theirs, f"cfm{i}"), half.modulation)
    for target, source in pairs:
        target.load_state_dict(source.state_dict())
    return plain.to(network.head.weight.dtype)


def _modulation(theirs: PlainCFM, ours: nn.Module) -> list[tuple[nn.Module, nn.Module]]:
    layers = dict(ours.named_modules())
    return [
        (getattr(theirs, f"{name}_conv{i}"), layers[f"{name}.{2 * i}"])
        for name in ("scale", "shift")
        for i in range(2)
    ]


def plain_logs(network: ACFM, plain: dict[str, PlainACFM], buffers: Buffers) -> dict[str, Tensor]:
    """Return what the plain networks make of raw buffers without exposure, preprocessing written out."""
    albedo = buffers["albedo"]
    component = {
        "diffuse": torch.log(1 + buffers["diffuse"].clamp(min=0) / (albedo + 0.00316)),
        "specular": torch.log(1 + buffers["specular"].clamp(min=0)),
    }
    depth = buffers["depth"] / buffers["depth"].amax((1, 2, 3), keepdim=True)
    made = {}
    for name, noisy in component.items():
        normal = buffers["normal"]
        if network.normal_range == "unit" or name == "specular":
            normal = ((normal + 1) / 2).clamp(0, 1)
        made[name] = plain[name](noisy, torch.cat([normal, depth, albedo], 1))
    return made


def plain_color(made: dict[str, Tensor], albedo: Tensor) -> Tensor:
    """Return both components together: (albedo + 0.00316) (exp D - 1) + (exp S - 1)."""
    return (albedo + 0.00316) * (torch.exp(made["diffuse"]) - 1) + (torch.exp(made["specular"]) - 1)
