"""Which tables an evaluation has: the layouts of the papers, and every metric."""

from __future__ import annotations

from trainer.evaluation.cells import Table
from trainer.evaluation.distances import distance_table
from trainer.evaluation.tables import Scored

PAPERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "wskp": ("As tables 1 and 2 of Fan et al. 2021", ("psnr_wskp", "ssim_wskp")),
    "afgsa": ("As table 1 of Yu et al. 2021", ("rel_mse_half_afgsa", "psnr_afgsa", "ssim_afgsa")),
    "layer": (
        "As table 1 of Munkberg and Hasselgren 2020",
        ("relmse_layer", "smape_wskp", "psnr_layer", "ssim_layer"),
    ),
    "nbgd": (
        "As Meng et al. 2020",
        ("psnr_nbgd", "ssim_nbgd", "rmse_nbgd", "smape_percent_nbgd", "relmse_nbgd"),
    ),
    "perception": (
        "Perception and time",
        ("flip_ldr_srgb", "flip_hdr", "ms_ssim_gamma", "change_gamma", "flicker_gamma", "lpips_alex_gamma"),
    ),
    "others": (
        "Other definitions",
        ("relmse_rousselle", "relmse_tungsten", "relmse_sbmc", "ssim_wskp_range1"),
    ),
}
"""Name → title and metrics of the tables with one row per method."""

LEAD = ("relmse_rousselle", "rel_mse_half_afgsa", "psnr_wskp", "ssim_wskp", "flip_ldr_srgb")
"""One metric of each kind, of which plots are drawn and distances to the best method are given."""


def tables_of(scored: Scored) -> list[Table]:
    """Return all tables: overviews as the papers have them, metrics per scene and samples, distances."""
    found = []
    for name, (title, metrics) in PAPERS.items():
        chosen = [
            metric for metric in metrics if metric in scored.metrics and scored.rows[metric].notna().any()
        ]
        if chosen:
            found.append(scored.by_method(chosen, f"overview_{name}", title))
    for metric in scored.metrics:
        if scored.rows[metric].notna().any():
            found.append(scored.by_scene(metric))
            if len(scored.counts) > 1:
                found.append(scored.by_spp(metric))
    for metric in LEAD:
        if metric in scored.metrics and (table := distance_table(scored, metric)) is not None:
            found.append(table)
    return found
