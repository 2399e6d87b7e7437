"""The recurrent autoencoder, layer by layer in float64, with the weights of `models.RAE`."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from models import RAE


def plain_rae(network: RAE, frames: list[dict[str, Tensor]]) -> list[Tensor]:
    """Denoise a sequence of seven-channel frames whose sides are multiples of 32, (B, 3, H, W) each."""
    w = {name: value.double() for name, value in network.state_dict().items()}

    def conv(x: Tensor, name: str, active: bool = True) -> Tensor:
        y = F.conv2d(x, w[f"{name}.weight"], w[f"{name}.bias"], padding=1)
        return torch.where(y > 0, y, 0.1 * y) if active else y

    hidden: list[Tensor | None] = [None] * 6
    results = []
    for frame in frames:
        depth = frame["depth"].double()
        least, most = frame["depth_range"].double().reshape(-1, 2, 1, 1, 1).unbind(1)
        exposure = frame["exposure"].double().reshape(-1, 1, 1, 1)
        light = (frame["irradiance"].double() * exposure) ** 0.2
        x = torch.cat([light, frame["normal"].double(), (depth - least) / (most - least)], 1)
        x = conv(x, "enter")
        outputs: list[Tensor] = []
        for stage in range(6):
            if stage:
                x = F.max_pool2d(x, 2)
            x = conv(x, f"encoder.{stage}.enter")
            x = conv(x, f"encoder.{stage}.before")
            before = hidden[stage]
            carried = torch.zeros_like(x) if before is None else before
            x = conv(torch.cat([x, carried], 1), f"encoder.{stage}.join")
            x = conv(x, f"encoder.{stage}.after")
            hidden[stage] = x
            outputs.append(x)
        for stage in range(5):
            x = x.repeat_interleave(2, -1).repeat_interleave(2, -2)
            x = torch.cat([x, outputs[4 - stage]], 1)
            x = conv(x, f"decoder.{stage}.first")
            x = conv(x, f"decoder.{stage}.second")
        toned = conv(x, "last", active=False)
        results.append(toned.clamp_min(0) ** 5 / exposure * frame["albedo"].double())
    return results
