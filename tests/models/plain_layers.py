"""The networks of Munkberg and Hasselgren 2020, written down literally: loops over pixels, taps, samples.

In float64, straight from the fact sheet and the paper's pseudocode, without anything from `models`. Samples
are (S, 20, H, W) in the order of `CHANNELS`; sides are multiples of the U-Net's grid; exposure is 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

State = dict[str, Tensor]
SLOPE = 0.01
EPSILON = 1e-6

RADIANCE, NORMAL, DEPTH, ALBEDO, SPECULAR, MOTION, LENS = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 7),
    slice(7, 10),
    slice(10, 14),  # with roughness
    slice(14, 17),  # with circle of confusion
    slice(17, 20),  # with time
)
LAYER = (RADIANCE, NORMAL, DEPTH, MOTION, ALBEDO, SPECULAR, LENS)
OTHERS = (RADIANCE, NORMAL, DEPTH, ALBEDO, SPECULAR, LENS, MOTION)


def srgb(value: float) -> float:
    return 1.055 * value ** (1 / 2.4) - 0.055 if value > 0.0031308 else 12.92 * value


def tone(radiance: Tensor) -> Tensor:
    values = [srgb(math.log(1 + min(max(x, 1e-5), 65536.0))) for x in radiance.flatten().tolist()]
    return torch.tensor(values, dtype=torch.float64).reshape(radiance.shape)


def clipped(samples: Tensor) -> Tensor:
    """Samples with radiance in [0, 65535]."""
    made = samples.clone()
    made[:, RADIANCE] = samples[:, RADIANCE].clamp(0, 65535)
    return made


def features(samples: Tensor, order: Sequence[slice], farthest: float) -> Tensor:
    made = samples.clone()
    made[:, RADIANCE] = tone(samples[:, RADIANCE])
    made[:, DEPTH] = samples[:, DEPTH] / farthest
    made[:, 14:16] = samples[:, 14:16] / 128
    made[:, 16] = samples[:, 16] / 2
    return torch.cat([made[:, part] for part in order], 1).clamp(-1000, 1000)


def lrelu(maps: Tensor) -> Tensor:
    return torch.where(maps > 0, maps, SLOPE * maps)


def dense(state: State, name: str, maps: Tensor, linear: bool) -> Tensor:
    """Chain of 1x1 convolutions on (C, H, W), as matrix products at every pixel."""
    keys = [f"{name}.first"]
    keys += sorted({k.rsplit(".", 1)[0] for k in state if k.startswith(f"{name}.others.")})
    for index, key in enumerate(keys):
        weight, bias = state[f"{key}.weight"][:, :, 0, 0], state[f"{key}.bias"]
        maps = torch.einsum("oc,chw->ohw", weight, maps) + bias[:, None, None]
        if index < len(keys) - 1 or not linear:
            maps = lrelu(maps)
    return maps


def unet(state: State, image: Tensor, mode: str = "nearest") -> list[Tensor]:
    """Context (C, H, W) and the decoder's other stages, from fine to coarse."""

    def conv(name: str, maps: Tensor) -> Tensor:
        return F.conv2d(maps, state[f"unet.{name}.weight"], state[f"unet.{name}.bias"], padding=1)

    levels = len({k for k in state if k.startswith("unet.encoder.") and k.endswith("weight")})
    maps = lrelu(conv("entry", image[None]))
    pooled = []
    for level in range(levels):
        maps = F.max_pool2d(lrelu(conv(f"encoder.{level}", maps)), 2)
        pooled.append(maps)
    maps = lrelu(conv("bottleneck", maps))
    stages = []
    for stage in range(levels):
        skip = pooled[levels - 2 - stage] if stage < levels - 1 else image[None]
        if mode == "nearest":
            maps = maps.repeat_interleave(2, 2).repeat_interleave(2, 3)
        else:
            maps = F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
        maps = lrelu(conv(f"join.{stage}", torch.cat([maps, skip], 1)))
        maps = lrelu(conv(f"refine.{stage}", maps))
        stages.append(maps[0])
    return [conv("exit", maps)[0], *stages[-2::-1]]


def splat(images: Tensor, weights: Tensor, size: int) -> Tensor:
    """(N, C, H, W) and (N, K * K, H, W) to the sum (C, H, W): tap (dy, dx) of q goes to q + (dy, dx)."""
    number, channels, height, width = images.shape
    out, reach = torch.zeros(channels, height, width, dtype=torch.float64), size // 2
    for n in range(number):
        for y in range(height):
            for x in range(width):
                for tap in range(size * size):
                    row, column = y + tap // size - reach, x + tap % size - reach
                    if 0 <= row < height and 0 <= column < width:
                        out[:, row, column] += weights[n, tap, y, x] * images[n, :, y, x]
    return out


def layers(
    state: State,
    samples: Tensor,
    size: int,
    compositing: str,
    farthest: float,
    mode: str = "nearest",
) -> Tensor:
    held, contexts = partition(state, samples, farthest, mode)
    return composite(state, "generator", held, contexts[0], size, compositing)


def partition(
    state: State, samples: Tensor, farthest: float, mode: str
) -> tuple[list[tuple[Tensor, Tensor, Tensor]], list[Tensor]]:
    """Radiance, weight and embedding of every layer, and the context."""
    samples, spp = clipped(samples), len(samples)
    embeddings = [dense(state, "reducer", f, linear=False) for f in features(samples, LAYER, farthest)]
    contexts = unet(state, sum(embeddings) / spp, mode)  # type: ignore[arg-type]
    count = len(state["partitioner.others.1.bias"])
    radiance = [torch.zeros_like(samples[0, :3]) for _ in range(count)]
    weight = [torch.zeros_like(samples[0, :1]) for _ in range(count)]
    embedded = [torch.zeros_like(embeddings[0]) for _ in range(count)]
    for sample, embedding in zip(samples, embeddings, strict=True):
        share = dense(state, "partitioner", torch.cat([embedding, contexts[0]]), linear=True)
        share = share.exp() / share.exp().sum(0) / spp
        for j in range(count):
            radiance[j] += share[j] * sample[RADIANCE]
            weight[j] += share[j]
            embedded[j] += share[j] * embedding
    return list(zip(radiance, weight, embedded, strict=True)), contexts


def composite(
    state: State,
    name: str,
    held: list[tuple[Tensor, Tensor, Tensor]],
    context: Tensor,
    size: int,
    compositing: str,
) -> Tensor:
    logits = [dense(state, name, torch.cat([e, context]), linear=True)[: size**2] for _, _, e in held]
    largest = torch.stack([part.amax(0) for part in logits]).amax(0)
    kernels = [(part - largest).exp()[None] for part in logits]
    if compositing == "alpha":
        out, through = torch.zeros_like(held[0][0]), torch.ones_like(held[0][1])
        for j, (radiance, weight, _) in enumerate(held):
            occupied = torch.stack([w for _, w, _ in held[j:]]).sum(0)
            n = splat(occupied[None], kernels[j], size) + EPSILON
            out += through * splat(radiance[None], kernels[j], size) / n
            through = through * (1 - splat(weight[None], kernels[j], size) / n)
        return out
    numerator, denominator = torch.zeros_like(held[0][0]), torch.zeros_like(held[0][1])
    for (radiance, weight, _), kernel in zip(held, kernels, strict=True):
        filtered = splat(weight[None], kernel, size)
        factor = filtered if compositing == "printed" else 1.0
        numerator += factor * splat(radiance[None], kernel, size)
        denominator += filtered
    return numerator / (denominator + EPSILON)


def optimized(state: State, samples: Tensor, size: int, farthest: float) -> Tensor:
    held, contexts = partition(state, samples, farthest, "nearest")
    first = dense(state, "generator.0", torch.cat([held[0][2], contexts[0]]), linear=True)[size**2 :]
    shares = first.exp() / first.exp().sum(0)
    out = torch.zeros_like(samples[0, :3])
    for level in range(3):
        smaller = [tuple(F.avg_pool2d(part[None], 2**level)[0] for part in layer) for layer in held]
        image = composite(state, f"generator.{level}", smaller, contexts[level], size, "alpha")  # type: ignore[arg-type]
        if level:
            image = F.interpolate(image[None], scale_factor=2**level, mode="bilinear", align_corners=False)[0]
        out += shares[level] * image
    return out


def sample_splat(state: State, samples: Tensor, size: int, farthest: float) -> Tensor:
    samples = clipped(samples)
    embeddings = [dense(state, "reducer", f, linear=False) for f in features(samples, OTHERS, farthest)]
    context = unet(state, sum(embeddings) / len(samples))[0]  # type: ignore[arg-type]
    logits = torch.stack([dense(state, "generator", torch.cat([e, context]), True) for e in embeddings])
    kernels = (logits - logits.amax((0, 1))).exp()
    ones = torch.ones_like(samples[:, :1])
    sums = splat(torch.cat([samples[:, RADIANCE], ones], 1), kernels, size)
    return sums[:3] / (sums[3:] + EPSILON)


def pixel_gather(state: State, samples: Tensor, size: int, farthest: float) -> Tensor:
    samples = clipped(samples)
    seen = features(samples, OTHERS, farthest)
    mean = sum(seen) / len(seen)
    variance = sum((f - mean) ** 2 for f in seen) / len(seen)
    embedding = dense(state, "reducer", torch.cat([mean, variance]), linear=False)  # type: ignore[list-item]
    context = unet(state, embedding)[0]
    logits = dense(state, "generator", torch.cat([embedding, context]), True)
    image = samples[:, RADIANCE].mean(0)
    out, (_, height, width), reach = torch.zeros_like(image), image.shape, size // 2
    for y in range(height):
        for x in range(width):
            places = [(tap, y + tap // size - reach, x + tap % size - reach) for tap in range(size * size)]
            inside = [(t, row, col) for t, row, col in places if 0 <= row < height and 0 <= col < width]
            kernel = torch.softmax(torch.stack([logits[tap, y, x] for tap, _, _ in inside]), 0)
            for weight, (_, row, column) in zip(kernel, inside, strict=True):
                out[:, y, x] += weight * image[:, row, column]
    return out
