"""KPCN written down step by step from its description: the reference that tests and benchmarks compare with.

Nothing of the product's code is used: loops over channels, `unfold` for the kernels, convolutions without
padding on features that were padded once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

EPSILON = 0.00316


def plain_gather(image: Tensor, logits: Tensor, size: int, border: str = "reflect") -> Tensor:
    """Unfold the image, softmax the logits, multiply, sum."""
    batch, channels, height, width = image.shape
    mode = "reflect" if border == "reflect" else "constant"
    patches = F.unfold(F.pad(image, [size // 2] * 4, mode=mode), size)
    patches = patches.reshape(batch, channels, size * size, height, width)
    return (patches * logits.softmax(1)[:, None]).sum(2)


def differences(image: Tensor) -> list[Tensor]:
    """x differences of every channel, then y differences, one plane each."""
    planes = [image[:, c] for c in range(image.shape[1])]
    result = []
    for plane in planes:
        dx = torch.zeros_like(plane)
        for x in range(1, plane.shape[-1]):
            dx[:, :, x] = plane[:, :, x] - plane[:, :, x - 1]
        result.append(dx)
    for plane in planes:
        dy = torch.zeros_like(plane)
        for y in range(1, plane.shape[-2]):
            dy[:, y] = plane[:, y] - plane[:, y - 1]
        result.append(dy)
    return result


def average(image: Tensor) -> Tensor:
    """Mean over channels, one plane."""
    total = torch.zeros_like(image[:, 0])
    for c in range(image.shape[1]):
        total = total + image[:, c]
    return total / image.shape[1]


def plain_features(
    buffers: Mapping[str, Tensor], light: str, kind: str, slip: bool = False, channels: int = 27
) -> tuple[Tensor, Tensor]:
    """Return the features of one branch and the image that it filters; buffers are clean and not exposed."""
    noisy, variance, albedo = buffers[light], buffers[f"{light}_variance"], buffers["albedo"]
    if kind == "demodulated":
        image = noisy / (albedo + EPSILON)
        squares, addend = (albedo + EPSILON) ** 2, 0.0
    else:
        image = (1 + noisy).log()
        squares, addend = (1 + (image if slip else noisy)) ** 2, 1e-5
    deepest = buffers["depth"].amax((1, 2, 3))[:, None, None]
    depth, depth_variance = buffers["depth"] / deepest[:, None], buffers["depth_variance"][:, 0] / deepest**2
    normal_variance = average(buffers["normal_variance"])
    planes = [image[:, c] for c in range(3)]
    if channels == 27:
        planes += [*differences(buffers["normal"]), normal_variance]
        planes += [*differences(depth), depth_variance]
        planes += [*differences(albedo), average(buffers["albedo_variance"])]
        planes += [*differences(image), average(variance) / (average(squares) + addend)]
    else:
        planes += [variance[:, c] / (squares[:, c] + addend) for c in range(3)]
        planes += [*differences(image), normal_variance, *differences(buffers["normal"])]
        planes += [depth_variance, *differences(depth), *differences(albedo)]
    return torch.stack(planes, 1), image


def plain_branch(
    features: Tensor, image: Tensor, weights: Sequence[tuple[Tensor, Tensor]], size: int, border: str
) -> Tensor:
    """Convolve, filter."""
    maps = F.pad(features, [2 * len(weights)] * 4)
    for weight, bias in weights[:-1]:
        maps = F.conv2d(maps, weight, bias).relu()
    return plain_gather(image, F.conv2d(maps, *weights[-1]), size, border)


def plain_kpcn(
    state: Mapping[str, Tensor],
    buffers: Mapping[str, Tensor],
    size: int,
    border: str = "reflect",
    slip: bool = False,
    channels: int = 27,
) -> Tensor:
    """The whole network with two branches, from a state dict."""
    result = torch.zeros_like(buffers["diffuse"])
    for light, kind in (("diffuse", "demodulated"), ("specular", "log")):
        prefix = f"branches.{light}.convolutions"
        layers = sum(name.startswith(prefix) for name in state) // 2
        weights = [(state[f"{prefix}.{i}.weight"], state[f"{prefix}.{i}.bias"]) for i in range(layers)]
        features, image = plain_features(buffers, light, kind, slip, channels)
        filtered = plain_branch(features, image, weights, size, border)
        result = result + (
            (buffers["albedo"] + EPSILON) * filtered if kind == "demodulated" else filtered.exp() - 1
        )
    return result
