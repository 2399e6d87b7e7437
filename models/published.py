"""The authors' published weights → our modules.

The functions take state dicts, not files: load a checkpoint with
`torch.load(path, weights_only=True, map_location="cpu")`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Literal, cast, overload

import torch
from torch import Tensor

from models.afgsa import AFGSA
from models.blocks.rep import RepBlock
from models.denoiser import Denoiser
from models.wskp import WSKP

_WRAPPERS = ("model_state_dict", "state_dict", "model", "G")
"""Under which checkpoints keep the weights, beside the optimiser and the like."""

_BRANCHES = (5, 3, 1)
_PUBLISHED_KERNELS = (3, 5, 7, 9, 11, 13)


@overload
def load_published(name: Literal["wskp"], state_dict: Mapping[str, Any]) -> WSKP: ...
@overload
def load_published(name: Literal["afgsa"], state_dict: Mapping[str, Any]) -> AFGSA: ...
def load_published(name: str, state_dict: Mapping[str, Any]) -> Denoiser:
    """Return a denoiser with weights that the method's authors published.

    Args:
        name: `wskp`: Fan et al. 2021, checkpoints of the authors' repository. `afgsa`: Yu et al. 2021, the
            generator. Both are under the MIT licence.
        state_dict: The checkpoint (a dict with `model_state_dict`, `state_dict`, `model` or `G`), or its
            inner dict of tensors. Names may begin with `module.`, as parallel training writes them.

    Returns:
        The network in evaluation mode, in its training form; its output is the authors' network's.

    Raises:
        ValueError: The name is unknown, or an entry is missing, unexpected or of another shape.
    """
    if name not in _LOADERS:
        raise ValueError(f"no published weights are known for {name!r}; known: {', '.join(_LOADERS)}")
    inner: Any = state_dict
    for wrapper in _WRAPPERS:
        inner = inner.get(wrapper, inner) if isinstance(inner, Mapping) else inner
    if not isinstance(inner, Mapping) or not all(
        isinstance(key, str) and isinstance(value, Tensor) for key, value in inner.items()
    ):
        raise ValueError(f"{name}: expected names and tensors, or a checkpoint with 'model_state_dict'")
    weights = {key.removeprefix("module."): value for key, value in inner.items()}
    return _LOADERS[name](weights)


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
            name = f"{prefix}_{size}.weight"
            _copy(f"wskp: {name}", weights[name], cast(torch.nn.Conv2d, convolution).weight)
    return network.eval()


def _load_afgsa(weights: Mapping[str, Tensor]) -> AFGSA:
    """Entries: conv<k>.0, conv_map.0, conv_a<k>.0, conv_aenc<1, 2>.0, transformer_blocks.<i>…, decoder.<i>.0.

    Width, kernel sizes and blocks are read from the names and shapes. Heads, of half the channels of a row
    table each, are too; blocks and halo are those of the paper with tables of this length.
    """
    table = weights.get("transformer_blocks.0.attention.rel_h")
    if table is None or table.ndim != 4 or "conv_map.0.bias" not in weights:
        listed = ", ".join(list(weights)[:5]) or "nothing"
        raise ValueError(f"afgsa: not the entries of the authors' generator (conv1.0.weight …); got {listed}")
    if table.shape[1] not in _AFGSA_WINDOWS:
        raise ValueError(
            f"afgsa: windows of {table.shape[1]} pixels are not the authors'; expected "
            f"{' or '.join(map(str, _AFGSA_WINDOWS))}"
        )
    block, halo = _AFGSA_WINDOWS[table.shape[1]]
    width, half = weights["conv_map.0.bias"].numel(), max(table.shape[3], 1)
    sizes = sorted(int(m[1]) for m in (re.fullmatch(r"conv(\d+)\.0\.weight", key) for key in weights) if m)
    blocks = len({key.split(".")[1] for key in weights if key.startswith("transformer_blocks.")})
    network = AFGSA(
        width=width, blocks=blocks, heads=width // (2 * half), kernel_sizes=sizes,
        block=block, halo=halo,
    )  # fmt: skip
    targets = network.state_dict()
    names = {_authors_name(key, sizes): key for key in targets}
    _compare("afgsa: missing", set(names) - set(weights))
    _compare("afgsa: unexpected", set(weights) - set(names))
    for name, key in names.items():
        source = weights[name]
        if name.endswith(("rel_h", "rel_w")) and source.ndim == 4:
            # (1, side, 1, channels) and (1, 1, side, channels) there.
            source = source.squeeze(0).squeeze(1 if name.endswith("h") else 0)
        _copy(f"afgsa: {name}", source, targets[key])
    return network.eval()


def _authors_name(key: str, sizes: list[int]) -> str:
    """Return what AFGSA's authors call an entry of our network."""
    for pattern, name in _AFGSA_NAMES:
        found = re.fullmatch(pattern, key)
        if found:
            groups = found.groupdict()
            if "branch" in groups:
                groups["size"] = str(sizes[int(groups["branch"])])
            return name.format(**groups)
    raise KeyError(key)


def _compare(what: str, names: set[str]) -> None:
    if names:
        raise ValueError(f"{what} {', '.join(sorted(names))}")


def _copy(name: str, source: Tensor, target: Tensor) -> None:
    if source.shape != target.shape:
        raise ValueError(f"{name} has shape {tuple(source.shape)}, expected {tuple(target.shape)}")
    with torch.no_grad():
        target.copy_(source)


_AFGSA_WINDOWS = {14: (8, 3), 26: (16, 5)}
"""Blocks and halos of the paper by the side of the window that they make."""

_KIND = "(?P<kind>weight|bias)"
_BLOCK = r"blocks\.(?P<block>\d+)\."
_AFGSA_NAMES = (
    (rf"color_features\.branches\.(?P<branch>\d)\.{_KIND}", "conv{size}.0.{kind}"),
    (rf"color_features\.fusion\.{_KIND}", "conv_map.0.{kind}"),
    (rf"auxiliary_features\.branches\.(?P<branch>\d)\.{_KIND}", "conv_a{size}.0.{kind}"),
    (rf"auxiliary_features\.fusion\.{_KIND}", "conv_aenc1.0.{kind}"),
    (rf"auxiliary_features\.second\.{_KIND}", "conv_aenc2.0.{kind}"),
    (rf"{_BLOCK}attention\.rows", "transformer_blocks.{block}.attention.rel_h"),
    (rf"{_BLOCK}attention\.columns", "transformer_blocks.{block}.attention.rel_w"),
    (rf"{_BLOCK}attention\.fusion\.{_KIND}", "transformer_blocks.{block}.attention.conv_map.0.{kind}"),
    (rf"{_BLOCK}attention\.query\.weight", "transformer_blocks.{block}.attention.q_conv.weight"),
    (rf"{_BLOCK}attention\.key\.weight", "transformer_blocks.{block}.attention.k_conv.weight"),
    (rf"{_BLOCK}attention\.value\.weight", "transformer_blocks.{block}.attention.v_conv.weight"),
    (rf"{_BLOCK}first\.{_KIND}", "transformer_blocks.{block}.feed_forward.0.0.{kind}"),
    (rf"{_BLOCK}second\.{_KIND}", "transformer_blocks.{block}.feed_forward.1.0.{kind}"),
    (rf"decoder\.(?P<layer>\d)\.{_KIND}", "decoder.{layer}.0.{kind}"),
    (rf"residual\.{_KIND}", "decoder.2.0.{kind}"),
)
"""Our entries as patterns, and how the authors of AFGSA call them."""

_LOADERS: dict[str, Callable[[Mapping[str, Tensor]], Denoiser]] = {"wskp": _load_wskp, "afgsa": _load_afgsa}
