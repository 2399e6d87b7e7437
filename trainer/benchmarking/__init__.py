"""What a method costs: time and memory of inference and training, each case in a process of its own.

`cost` measures one method; `trainer benchmark` whole tables, and two methods or revisions against each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trainer.benchmarking.cases import MEMORY, Case, Effort, Method
from trainer.benchmarking.measuring import exports, measure

__all__ = ["Cost", "cost"]


@dataclass(frozen=True)
class Cost:
    """What inference costs per megapixel.

    Attributes:
        seconds_per_megapixel: Median over calls.
        spread: Lower and upper quartile of the same.
        peak_bytes_per_megapixel: Memory beside the loaded model and the image.
        device: Where.
        threads: Of PyTorch, on the CPU.
        calls: That were measured, after warm-up.
        others: Share of all cores that other programs took meanwhile; times are too long where it is large.
    """

    seconds_per_megapixel: float
    spread: tuple[float, float]
    peak_bytes_per_megapixel: float
    device: str
    threads: int
    calls: int
    others: float


def cost(
    model: str,
    options: Sequence[str] = (),
    size: tuple[int, int] = (1280, 720),
    device: str = "cpu",
    *,
    spp: int = 8,
    memory: int = MEMORY,
    effort: Effort = Effort(repeat=7, warmup=1, seconds=20.0),  # noqa: B008 - frozen
    timeout: float | None = None,
) -> Cost:
    """Return what denoising an image costs, measured warm in a fresh process on a made-up image.

    Args:
        model: As `--model` names it; a class with weights gets random ones.
        options: Its constructor arguments `KEY=VALUE`, where it is a class.
        size: Width and height of the image.
        device: `cpu`, `cuda`, `cuda:1` …
        spp: Samples per pixel of methods that read them.
        memory: Bytes that one call may take before the image is cut into tiles.
        effort: How long to measure.
        timeout: Seconds that loading, or any one call, may take.

    Raises:
        ValueError: It cannot be measured; says why.
    """
    method = Method(model, tuple(options))
    mode = method.format or "eager"
    case = Case(method, "inference", *size, device=device, mode=mode, spp=spp, memory=memory)
    with exports() as made:
        found = measure(case, effort, made, timeout=timeout)
    if found.reason is not None:
        raise ValueError(found.reason)
    low, high = (value / found.megapixels for value in found.quartiles)
    return Cost(
        found.median / found.megapixels,
        (low, high),
        found.peak_bytes / found.megapixels,
        device,
        found.threads,
        len(found.seconds),
        found.others,
    )
