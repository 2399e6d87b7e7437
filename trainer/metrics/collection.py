"""Metrics per scene and averaged, right under distributed evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torchmetrics import Metric

from trainer.metrics import functional


@dataclass(frozen=True)
class Measure:
    """A metric as it is logged and tabulated.

    Attributes:
        function: Called with exposed output and reference (B, 3, H, W); returns (B,).
        higher: Larger is better.
        format: How a value is printed.
        source: Whose tables it belongs to, a key of `SOURCES`.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    higher: bool
    format: str
    source: Literal["wskp", "afgsa", "layer"]


METRICS: dict[str, Measure] = {
    "psnr_wskp": Measure(functional.psnr_wskp, True, "{:.2f} dB", "wskp"),
    "ssim_wskp": Measure(functional.ssim_wskp, True, "{:.4f}", "wskp"),
    "ssim_wskp_range1": Measure(functional.ssim_wskp_range1, True, "{:.4f}", "wskp"),
    "relmse_layer": Measure(functional.relmse_layer, False, "{:.4f}", "wskp"),
    "smape_wskp": Measure(functional.smape_wskp, False, "{:.4f}", "wskp"),
    "psnr_afgsa": Measure(functional.psnr_afgsa, True, "{:.2f} dB", "afgsa"),
    "ssim_afgsa": Measure(functional.ssim_afgsa, True, "{:.4f}", "afgsa"),
    "rel_mse_half_afgsa": Measure(functional.rel_mse_half_afgsa, False, "{:.6f}", "afgsa"),
    "psnr_layer": Measure(functional.psnr_layer, True, "{:.2f} dB", "layer"),
    "ssim_layer": Measure(functional.ssim_layer, True, "{:.4f}", "layer"),
}
"""Name in tables and logs → the metric."""

SOURCES: dict[str, str] = {
    "wskp": "PSNR and SSIM on clamp(max(x, 0)^0.454545, 0, 1) of exposed radiance; ssim_wskp uses data range "
    "2 like the published tables, ssim_wskp_range1 uses 1; relmse_layer: mean (o - r)^2 / (r^2 + 1e-4); "
    "smape_wskp: mean |o - r| / (|o| + |r| + 0.01).",
    "afgsa": "as AFGSA and ACFM print them: PSNR and SSIM (Gaussian 11x11 window, range 255) on 8-bit images "
    "of exposed radiance, clamp(x^(1/2.2), 0, 1) * 255 truncated; rel_mse_half_afgsa: "
    '0.5 mean (o - r)^2 / (r^2 + 0.01), their "RMSE".',
    "layer": "as Munkberg and Hasselgren 2020, beside relmse_layer and smape_wskp, which are theirs too: on "
    "clamp(sRGB(log(1 + x)), 0, 1) of exposed radiance, range 1; the window of SSIM (Gaussian 11x11) is not "
    "in the paper.",
}
"""Group of metrics → how they are defined."""


class SceneMetrics(Metric):
    """Mean of every metric over the images of each scene, and the mean of the scenes' means.

    The state is a sum and a count per scene, so that ranks that saw different images agree after reduction.

    Args:
        scenes: Names of all scenes that can occur, the same on every rank.
    """

    full_state_update = False
    totals: Tensor
    counts: Tensor

    def __init__(self, scenes: Sequence[str]) -> None:
        super().__init__()
        self.scenes = tuple(sorted(set(scenes)))
        shape = (len(self.scenes), len(METRICS))
        self.add_state("totals", torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(shape[0], dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, output: Tensor, reference: Tensor, scenes: Sequence[str]) -> None:
        """Add a batch of exposed images (B, 3, H, W); `scenes` names the scene of each.

        Raises:
            ValueError: A scene was not announced.
        """
        unknown = set(scenes) - set(self.scenes)
        if unknown:
            raise ValueError(f"scene {', '.join(sorted(unknown))} is not among {', '.join(self.scenes)}")
        values = torch.stack([m.function(output, reference) for m in METRICS.values()], dim=1)
        for row, scene in enumerate(scenes):
            place = self.scenes.index(scene)
            self.totals[place] += values[row].to(self.totals)
            self.counts[place] += 1

    def compute(self) -> dict[str, dict[str, float]]:
        """Return scene → metric → mean; the entry `average` is the mean over the scenes."""
        seen = [i for i in range(len(self.scenes)) if self.counts[i] > 0]
        table = {
            self.scenes[i]: dict(zip(METRICS, (self.totals[i] / self.counts[i]).tolist(), strict=True))
            for i in seen
        }
        if table:
            rows = list(table.values())
            table["average"] = {name: sum(row[name] for row in rows) / len(rows) for name in METRICS}
        return table
