"""What SBMC sees of a sample (Gharbi et al. 2019, doi:10.1145/3306346.3322954)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from data.buffers import SAMPLE_BUFFERS
from models.ops.per_sample import Seen, known, seen
from models.ops.precision import wide
from models.ops.tonemap import exposed

GROUPS: dict[str, tuple[str, ...]] = {
    "coordinates": ("offset", "lens", "time"),
    "light": ("diffuse", "specular"),
    "guides": (
        *("first_normal", "normal", "first_depth", "depth"),
        *("visibility", "hit", "first_albedo", "diffuse_albedo"),
    ),
    "probabilities": ("path_probability",),
    "directions": ("light_direction",),
    "bounces": ("bounce",),
}
"""The published features: 5, 6, 16, 24, 12 and 30 channels."""

_LIGHT = ("radiance", "diffuse", "specular")


def seen_samples(samples: Tensor, names: Sequence[str], exposure: Tensor, farthest: Tensor) -> Seen:
    """Return samples as the network sees them.

    Light becomes log(1 + diffuse + specular) / 10 and log(1 + specular) / 10, or log(1 + radiance) / 10;
    other features stay as they are, depths divided.

    Args:
        samples: (B, S, C, H, W), raw.
        names: What the C channels are: quantities in order, with light as in `expanded`.
        exposure: Factor of radiance, (B, 1, 1, 1) or (1, 1, 1, 1).
        farthest: Divisor of depths, likewise.
    """
    clean, counts = known(samples, names)
    parts = dict(
        zip(names, wide(clean).split([len(SAMPLE_BUFFERS[n].letters) for n in names], 2), strict=True)
    )
    parts |= {n: exposed(parts[n], exposure[:, None]) for n in _LIGHT if n in parts}
    if "radiance" in parts:
        radiance = parts["radiance"]
        parts["radiance"] = torch.log1p(radiance) / 10
    else:
        radiance, specular = parts["diffuse"] + parts["specular"], parts["specular"]
        parts |= {"diffuse": torch.log1p(radiance) / 10, "specular": torch.log1p(specular) / 10}
    parts |= {n: parts[n] / farthest[:, None] for n in ("depth", "first_depth") if n in parts}
    return seen(radiance, [parts[name] for name in names], counts)


def averaged(seen: Seen) -> Seen:
    """Return the mean of the samples that count as the only sample."""
    total = seen.counts.sum(1, keepdim=True)
    radiance, features = (part.sum(1, keepdim=True) / total.clamp_min(1.0) for part in seen[:2])
    return Seen(radiance, features, total.clamp_max(1.0))


def expanded(features: Sequence[str]) -> tuple[str, ...]:
    """Return the quantities of groups and single names, each once.

    Raises:
        ValueError: A name is unknown, or light is missing or there twice.
    """
    names = tuple(dict.fromkeys(n for feature in features for n in GROUPS.get(feature, (feature,))))
    unknown = [name for name in names if name not in SAMPLE_BUFFERS]
    if unknown:
        raise ValueError(
            f"features: {', '.join(unknown)} unknown; expected groups ({', '.join(GROUPS)}) or quantities "
            f"({', '.join(SAMPLE_BUFFERS)})"
        )
    if {name for name in _LIGHT if name in names} not in ({"radiance"}, {"diffuse", "specular"}):
        raise ValueError(
            "features must have light once: radiance, or both diffuse and specular (the group light); got "
            f"{', '.join(names) or 'nothing'}"
        )
    return names
