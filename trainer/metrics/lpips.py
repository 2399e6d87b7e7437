"""LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric").

Its network is torchvision's AlexNet with the weights that were trained on ImageNet, and the linear layers of
LPIPS 0.1, which torchmetrics brings. Nothing is downloaded: the metric is taken where torchvision is
installed and its file of weights is where `torch.hub` keeps such files. Both are optional.
"""

from __future__ import annotations

import importlib
import importlib.util
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from trainer.metrics.functional import gamma

WEIGHTS = "alexnet-owt-7be5be79.pth"
"""File of torchvision's AlexNet."""

SMALLEST = 31
"""Rows and columns from which the second pooling of AlexNet has a window."""


def missing() -> str | None:
    """Return why LPIPS cannot be taken, None where it can; imports and reads nothing."""
    if importlib.util.find_spec("torchvision") is None:
        return "torchvision is not installed"
    if not _file(WEIGHTS).is_file():
        return f"{WEIGHTS} is not in the folder checkpoints of torch.hub.get_dir() and is not downloaded"
    return None


def lpips_alex_gamma(output: Tensor, reference: Tensor) -> Tensor:
    """LPIPS 0.1 with AlexNet of `gamma` images scaled to -1..1 (Zhang et al. 2018, eq. 1); 0 where equal.

    Raises:
        ValueError: The image has less than 31 rows or columns.
        FileNotFoundError: Torchvision or its weights are missing; see `missing`.
        OSError: The file of weights is damaged.
    """
    if min(output.shape[-2:]) < SMALLEST:
        raise ValueError(f"LPIPS needs at least {SMALLEST}x{SMALLEST} pixels, got {tuple(output.shape[-2:])}")
    network = _network().to(output.device)
    distance: Tensor = network(gamma(output), gamma(reference), normalize=True)
    return distance.flatten()


def _file(name: str) -> Path:
    return Path(torch.hub.get_dir(), "checkpoints", name)


@lru_cache(maxsize=1)
def _network() -> torch.nn.Module:
    """Return the network, made once: the function of torchmetrics reads 240 MB for every pair of images."""
    if reason := missing():
        raise FileNotFoundError(f"LPIPS cannot be taken: {reason}")
    torchvision: Any = importlib.import_module("torchvision.models")
    # Another version may want another file, and would download it, or unpickle whatever it holds.
    file = _file(torchvision.AlexNet_Weights.DEFAULT.url.rpartition("/")[2])
    try:
        torch.load(file, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise OSError(f"{file} is damaged, or holds something else than weights") from error
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type="alex").net
