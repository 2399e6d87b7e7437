"""Metrics per scene and averaged, right under distributed evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torchmetrics import Metric

from trainer.metrics.functional import psnr_wskp, relmse_layer, smape_wskp, ssim_wskp, ssim_wskp_range1

METRICS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "psnr_wskp": psnr_wskp,
    "ssim_wskp": ssim_wskp,
    "ssim_wskp_range1": ssim_wskp_range1,
    "relmse_layer": relmse_layer,
    "smape_wskp": smape_wskp,
}
"""Name in tables and logs → function of exposed output and reference."""

HIGHER_IS_BETTER = {"psnr_wskp": True, "ssim_wskp": True, "ssim_wskp_range1": True, "relmse_layer": False,
                    "smape_wskp": False}  # fmt: skip


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
        values = torch.stack([metric(output, reference) for metric in METRICS.values()], dim=1)
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
