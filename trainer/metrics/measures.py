"""All metrics of `trainer evaluate`, by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from trainer.metrics import functional, lpips, temporal
from trainer.metrics.flip import flip_hdr, flip_ldr_srgb


@dataclass(frozen=True)
class Score:
    """A metric of a frame.

    Attributes:
        function: Called with exposed output and reference (B, 3, H, W), returns (B,); raises a ValueError
            where the image is too small. None: a metric of successive frames, of `trainer.metrics.temporal`.
        higher: Larger is better.
        format: How a value is printed.
        doc: Its definition.
    """

    function: Callable[[Tensor, Tensor], Tensor] | None
    higher: bool
    format: str
    doc: str

    @property
    def digits(self) -> str:
        """The format without a unit."""
        return re.sub(r"}.*", "}", self.format)


def _score(function: Callable[..., object], higher: bool, form: str, temporal: bool = False) -> Score:
    doc = " ".join((function.__doc__ or "").split("\n\n", 1)[0].split())
    return Score(None if temporal else function, higher, form, doc)  # type: ignore[arg-type]


_NO_LPIPS = lpips.missing()

SCORES: dict[str, Score] = {
    "psnr_wskp": _score(functional.psnr_wskp, True, "{:.2f} dB"),
    "ssim_wskp": _score(functional.ssim_wskp, True, "{:.4f}"),
    "ssim_wskp_range1": _score(functional.ssim_wskp_range1, True, "{:.4f}"),
    "smape_wskp": _score(functional.smape_wskp, False, "{:.4f}"),
    "psnr_nbgd": _score(functional.psnr_nbgd, True, "{:.2f} dB"),
    "ssim_nbgd": _score(functional.ssim_nbgd, True, "{:.4f}"),
    "rmse_nbgd": _score(functional.rmse_nbgd, False, "{:.4f}"),
    "smape_percent_nbgd": _score(functional.smape_percent_nbgd, False, "{:.2f} %"),
    "relmse_nbgd": _score(functional.relmse_nbgd, False, "{:.4g}"),
    "psnr_afgsa": _score(functional.psnr_afgsa, True, "{:.2f} dB"),
    "ssim_afgsa": _score(functional.ssim_afgsa, True, "{:.4f}"),
    "rel_mse_half_afgsa": _score(functional.rel_mse_half_afgsa, False, "{:.4g}"),
    "psnr_layer": _score(functional.psnr_layer, True, "{:.2f} dB"),
    "ssim_layer": _score(functional.ssim_layer, True, "{:.4f}"),
    "relmse_layer": _score(functional.relmse_layer, False, "{:.4g}"),
    "relmse_tungsten": _score(functional.relmse_tungsten, False, "{:.4g}"),
    "relmse_rousselle": _score(functional.relmse_rousselle, False, "{:.4g}"),
    "relmse_sbmc": _score(functional.relmse_sbmc, False, "{:.4g}"),
    "ms_ssim_gamma": _score(functional.ms_ssim_gamma, True, "{:.4f}"),
    "flip_ldr_srgb": _score(flip_ldr_srgb, False, "{:.4f}"),
    "flip_hdr": _score(flip_hdr, False, "{:.4f}"),
    **({} if _NO_LPIPS else {"lpips_alex_gamma": _score(lpips.lpips_alex_gamma, False, "{:.4f}")}),
    "change_gamma": _score(temporal.change_gamma, False, "{:.5f}", temporal=True),
    "flicker_gamma": _score(temporal.flicker_gamma, False, "{:.5f}", temporal=True),
}
"""Name, which says definition and domain → the metric."""

LEFT_OUT: dict[str, str] = (
    {
        "lpips_alex_gamma": f"left out: {_NO_LPIPS}",
        "lpips": f"taken as lpips_alex_gamma, which is left out: {_NO_LPIPS}",
    }
    if _NO_LPIPS
    else {"lpips": "depends on the network and on the transfer to display values: see lpips_alex_gamma"}
)
"""Metrics that users look for and that are not taken under this name → why."""
