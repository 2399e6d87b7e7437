"""The authors' published weights → our modules.

The functions take state dicts, not files: load a checkpoint with
`torch.load(path, weights_only=True, map_location="cpu")`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from torch import Tensor

from models.blocks.rep import RepBlock
from models.wskp import WSKP

_BRANCHES = (5, 3, 1)
_PUBLISHED_KERNELS = (3, 5, 7, 9, 11, 13)


def load_published(name: str, state_dict: Mapping[str, Any]) -> WSKP:
    """Return a denoiser with weights that the method's authors published.

    Args:
        name: `wskp`: Fan et al. 2021, checkpoints of the authors' repository (MIT licence).
        state_dict: The checkpoint (a dict with `model_state_dict`), or its inner dict of tensors.

    Returns:
        The network in evaluation mode, in its training form; its output is the authors' network's.

    Raises:
        ValueError: The name is unknown, or an entry is missing, unexpected or of another shape.
    """
    if name not in _LOADERS:
        raise ValueError(f"no published weights are known for {name!r}; known: {', '.join(_LOADERS)}")
    inner = state_dict.get("model_state_dict", state_dict)
    if not isinstance(inner, Mapping) or not all(isinstance(v, Tensor) for v in inner.values()):
        raise ValueError(f"{name}: expected names and tensors, or a checkpoint with 'model_state_dict'")
    return _LOADERS[name](cast(Mapping[str, Tensor], inner))


def _load_wskp(weights: Mapping[str, Tensor]) -> WSKP:
    """Entries: conv<layer>_<size>.weight for layers 1 …, conv_final_<size>.weight, sizes 5, 3, 1."""
    middle = {key.split("_")[0] for key in weights if key.startswith("conv") and key[4:5].isdigit()}
    layers = len(middle) + 1
    if layers < 2 or "conv1_5.weight" not in weights:
        listed = ", ".join(list(weights)[:5]) or "nothing"
        raise ValueError(f"wskp: not the authors' entries (conv1_5.weight …); got {listed}")
    width = weights["conv1_5.weight"].shape[0]
    network = WSKP(layers=layers, width=width, kernel_sizes=_PUBLISHED_KERNELS)
    prefixes = [f"conv{layer}" for layer in range(1, layers)] + ["conv_final"]
    expected = {f"{prefix}_{size}.weight" for prefix in prefixes for size in _BRANCHES}
    _compare("wskp: missing", expected - set(weights))
    _compare("wskp: unexpected", set(weights) - expected)
    for prefix, block in zip(prefixes, network.blocks, strict=True):
        convolutions = cast(RepBlock, block).convolutions
        for size, convolution in zip(_BRANCHES, convolutions, strict=True):
            _copy(f"{prefix}_{size}.weight", weights, cast(torch.nn.Conv2d, convolution).weight)
    return network.eval()


def _compare(what: str, names: set[str]) -> None:
    if names:
        raise ValueError(f"{what} {', '.join(sorted(names))}")


def _copy(name: str, weights: Mapping[str, Tensor], target: Tensor) -> None:
    source = weights[name]
    if source.shape != target.shape:
        raise ValueError(f"wskp: {name} has shape {tuple(source.shape)}, expected {tuple(target.shape)}")
    with torch.no_grad():
        target.copy_(source)


_LOADERS: dict[str, Callable[[Mapping[str, Tensor]], WSKP]] = {"wskp": _load_wskp}
