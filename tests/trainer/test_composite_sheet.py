import numpy as np
import pytest

from trainer.reports import composite
from trainer.reports.composite import composite_sheet, is_layered
from trainer.reports.pictures import Panel


def layers(count: int) -> dict[str, np.ndarray]:
    made = {}
    for number in range(count):
        made[f"layer{number}_unfiltered"] = np.full((20, 24, 3), 0.2 * 4.0**-number, np.float32)
        made[f"layer{number}_alpha"] = np.full((20, 24, 1), 0.25 * (number + 1), np.float32)
        made[f"layer{number}_filtered"] = np.full((20, 24, 3), 0.1 * (number + 1), np.float32)
    return made


def rows_of(monkeypatch: pytest.MonkeyPatch, count: int) -> list[list[Panel]]:
    """Return the panels that make up the sheet."""
    kept: list[list[Panel]] = []
    grid = composite.grid
    monkeypatch.setattr(composite, "grid", lambda rows, title: (kept.extend(rows), grid(rows, title))[1])
    images = {title: np.full((20, 24, 3), 0.3, np.float32) for title in ("input", "composite", "reference")}
    composite_sheet(images, layers(count), 2.0, "here")
    return kept


def test_every_layer_has_a_row_below_the_images_and_captions_tell_its_share_of_the_light(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images, front, back = rows_of(monkeypatch, 2)
    assert [panel.title for panel in images] == ["input", "composite", "reference"]
    assert [panel.title for panel in front] == [
        f"layer 0 (front), {part}" for part in ("unfiltered", "alpha", "filtered")
    ]
    assert [panel.caption for panel in (*front[:2], *back[:2])] == [
        "times its weight: 80% of the light",
        "white: opaque; mean 0.25",
        "times its weight: 20% of the light",
        "white: opaque; mean 0.50",
    ]
    assert back[0].title == "layer 1 (back), unfiltered"
    assert rows_of(monkeypatch, 3)[2][0].title == "layer 1, unfiltered"


def test_captions_are_not_wider_than_the_pictures_above_them(monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import ImageDraw

    from trainer.reports.pictures import font

    for panel in (panel for row in rows_of(monkeypatch, 3) for panel in row):
        draw = ImageDraw.Draw(panel.picture)
        for text, size in ((panel.title, 15), (panel.caption, 14)):
            assert draw.textlength(text, font(size)) <= panel.picture.width, text


def test_only_layers_make_a_layered_result() -> None:
    assert is_layered(layers(2))
    assert not is_layered({})
    assert not is_layered({**layers(2), "selection": np.zeros((20, 24, 1), np.float32)})
