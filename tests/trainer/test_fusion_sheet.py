"""Pictures of kernels: colours, ranges, and the sheet of all of them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import ImageDraw

from trainer.reports import fusion
from trainer.reports.fusion import (
    fusion_sheet,
    importance_map,
    importance_range,
    is_fused,
    kernel_pictures,
    kernels_of,
)
from trainer.reports.pictures import Panel, colors, font, tone_map

Layers = dict[str, np.ndarray]


def layers(*names: str) -> Layers:
    """Views of kernels; the n-th has weight 0.1 n, and importance from -n to n."""
    made: Layers = {}
    for number, name in enumerate(names, start=1):
        made[f"{name}_filtered"] = np.full((20, 24, 3), 0.1 * number, np.float32)
        made[f"{name}_weight"] = np.full((20, 24, 1), 0.1 * number, np.float32)
        made[f"{name}_importance"] = np.linspace(-number, number, 480, dtype=np.float32).reshape(20, 24, 1)
    return made


SINGLE = layers("kernel03", "kernel13")
SEVERAL = {
    **layers("x1_kernel03", "x1_kernel05", "x2_kernel03", "x2_kernel05", "x4_kernel03", "x4_kernel05"),
    "x1_alpha": np.full((20, 24, 1), 0.25, np.float32),
    "x2_alpha": np.full((20, 24, 1), 0.75, np.float32),
}


def rows_of(monkeypatch: pytest.MonkeyPatch, views: Layers) -> list[list[Panel]]:
    """Return the panels that make up the sheet."""
    kept: list[list[Panel]] = []
    grid = fusion.grid
    monkeypatch.setattr(fusion, "grid", lambda rows, title: (kept.extend(rows), grid(rows, title))[1])
    images = {title: np.full((20, 24, 3), 0.3, np.float32) for title in ("noisy", "fused", "reference")}
    fusion_sheet(images, views, 2.0, "here")
    return kept


def test_views_of_kernels_are_told_from_other_layers() -> None:
    assert is_fused(SINGLE)
    assert is_fused(SEVERAL)
    assert not is_fused({})
    assert not is_fused({**SINGLE, "selection": SINGLE["kernel03_weight"]})
    assert not is_fused({"layer0_filtered": SINGLE["kernel03_filtered"]})


def test_kernels_are_called_by_size_number_and_resolution() -> None:
    assert [kernel.title for kernel in kernels_of(SINGLE)] == ["3x3", "13x13"]
    titles = [kernel.title for kernel in kernels_of(SEVERAL)]
    assert titles == ["3x3", "5x5", "3x3 at 1/2", "5x5 at 1/2", "3x3 at 1/4", "5x5 at 1/4"]
    assert [k.title for k in kernels_of(layers("kernel13_1", "kernel13_2"))] == ["13x13 (1)", "13x13 (2)"]


def test_black_and_white_of_importance_are_its_percentiles_rounded_outwards() -> None:
    values = np.arange(101, dtype=np.float32).reshape(1, 101, 1) / 10 - 5.01
    assert importance_range(values) == (-5.0, 4.9)  # percentiles are -4.91 and 4.89
    picture = np.asarray(importance_map(values))[0, :, 0]
    assert picture[0] == 0
    assert picture[-1] == 255
    expected = 255 * (values[0, 50, 0] + 5.0) / 9.9
    assert picture[50] == pytest.approx(expected, abs=1)
    assert (np.diff(picture.astype(int)) >= 0).all()


@pytest.mark.parametrize("value", [0.0, -3.2, 1e4])
def test_a_constant_importance_has_a_range_too(value: float) -> None:
    low, high = importance_range(np.full((4, 4, 1), value, np.float32))
    assert low <= value + 1e-2
    assert high >= low + 0.09
    assert not str(low).startswith("-0.0")


def test_every_layer_is_a_picture_of_its_size_and_importance_says_its_range() -> None:
    pictures = kernel_pictures({**SINGLE, "x1_alpha": SEVERAL["x1_alpha"]}, 2.0)
    assert set(pictures) == {
        "kernel03_filtered", "kernel03_weight", "kernel03_importance_-1.0_to_1.0",
        "kernel13_filtered", "kernel13_weight", "kernel13_importance_-2.0_to_2.0", "x1_alpha",
    }  # fmt: skip
    assert {picture.size for picture in pictures.values()} == {(24, 20)}
    filtered = np.asarray(pictures["kernel13_filtered"])
    assert (filtered == np.asarray(tone_map(SINGLE["kernel13_filtered"], 2.0))).all()
    assert (np.asarray(pictures["kernel13_weight"]) == colors()[51]).all()
    assert (np.asarray(pictures["x1_alpha"]) == colors()[64]).all()


def test_the_sheet_has_a_column_for_each_kernel_below_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    images, filtered, weights, importance = rows_of(monkeypatch, SINGLE)
    assert [panel.title for panel in images] == ["noisy", "fused", "reference"]
    assert [panel.title for panel in filtered] == ["3x3 alone", "13x13 alone"]
    assert [panel.title for panel in weights[:2]] == ["weight of 3x3", "weight of 13x13"]
    assert [panel.caption for panel in weights[:2]] == ["mean 0.100", "mean 0.200"]
    assert [panel.title for panel in importance[:2]] == ["log-importance, 3x3", "log-importance, 13x13"]
    assert importance[1].caption == "black -2.0, white 2.0"
    assert len(weights) == len(importance) == 3  # and what colours mean


def test_shares_of_coarser_results_stand_below_the_first_kernel_of_their_resolution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    *_, shares = rows_of(monkeypatch, SEVERAL)
    assert [panel.title for panel in shares] == ["share of 1/2", "", "share of 1/4 in 1/2", "", "", "", ""]
    assert [shares[0].caption, shares[2].caption] == ["mean 0.250", "mean 0.750"]
    one = layers("x1_kernel03", "x1_kernel05")  # with one resolution there are none
    assert len(rows_of(monkeypatch, one)) == 4


def test_texts_are_not_wider_than_the_pictures_above_them(monkeypatch: pytest.MonkeyPatch) -> None:
    views = {name: 60 * layer if "importance" in name else layer for name, layer in SEVERAL.items()}
    for panel in (panel for row in rows_of(monkeypatch, views) for panel in row):
        draw = ImageDraw.Draw(panel.picture)
        for text, size in ((panel.title, 15), (panel.caption, 14)):
            assert draw.textlength(text, font(size)) <= panel.picture.width, text
