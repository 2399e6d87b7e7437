import io
import xml.etree.ElementTree as ElementTree

import pytest
from rich.console import Console

from tests.trainer.benchmarking.stand_ins import failure, outcome
from trainer.benchmarking.plots import MEMORY_USE, TIME, plot
from trainer.benchmarking.table import WIDTH, bytes_text, remarks, seconds_text, spread_text, table

LONG = "runs/wskp_bmfr/2026-11-23_02-03-39_a-rather-long-name/checkpoints/best.ckpt"
SVG = "{http://www.w3.org/2000/svg}"


def printed(outcomes):
    stream = io.StringIO()
    Console(file=stream, width=WIDTH).print(table(outcomes))
    return stream.getvalue()


def test_what_differs_is_a_column_and_what_is_the_same_is_said_once():
    text = printed([outcome(mode=mode) for mode in ("eager", "onnx")])
    head = next(line for line in text.splitlines() if "quartiles" in line)
    assert "mode" in head
    assert "precision" not in head
    assert text.count("float32") == 1


def test_the_widest_table_fits_a_page_and_cuts_no_figure():
    rows = [
        outcome(LONG, [10.01, 11.12], kind=kind, batch=batch, precision=precision, mode=mode, peak=2e9)
        for kind in ("inference", "training")
        for batch in (1, 16)
        for precision, mode in (("bfloat16", "torchscript"), ("float32", "eager"))
    ]
    text = printed(rows)
    assert max(map(len, text.splitlines())) <= WIDTH
    assert text.count("10.3–10.8 s") == len(rows)
    assert "…" not in text


@pytest.mark.parametrize("name", ["runs[/old]/best.ckpt", "[bold]WSKP", "runs/:smile:/best.ckpt"])
def test_a_name_is_printed_as_it_is(name):
    assert name in printed([outcome(name)])


def test_a_failed_case_is_a_row_and_its_reason_follows():
    outcomes = [outcome(), failure("NFOR", "it reads sequences")]
    assert "failed" in printed(outcomes)
    assert remarks(outcomes) == ["NFOR: it reads sequences"]


def test_a_busy_machine_is_said():
    assert "40%" in remarks([outcome(others=0.4)])[0]
    assert remarks([outcome(others=0.05)]) == []


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.2345, "1.23 s"),
        (0.99996, "1.00 s"),
        (0.04126, "41.3 ms"),
        (0.000831, "831 µs"),
        (123.4, "123 s"),
        (1e-9, "0.00 µs"),
    ],
)
def test_times_have_three_digits(value, text):
    assert seconds_text(value) == text


def test_both_ends_of_a_spread_have_one_unit():
    assert spread_text(0.95, 1.05) == "0.95–1.05 s"
    assert bytes_text(1.5e9) == "1.50 GB"


def test_bars_are_as_long_as_the_times():
    outcomes = [outcome("A", [1.0, 1.0]), outcome("B", [3.0, 3.0]), failure("C")]
    bars = ElementTree.fromstring(plot(outcomes, TIME)).findall(f"{SVG}rect")[1:]
    widths = [float(bar.get("width")) for bar in bars]
    assert widths[1] == pytest.approx(3 * widths[0], rel=0.01)
    assert len(widths) == 2


def test_several_sizes_are_lines_over_megapixels():
    outcomes = [outcome(model, width=side, height=side) for model in ("A", "B<&>") for side in (64, 128, 256)]
    drawing = ElementTree.fromstring(plot(outcomes, MEMORY_USE))
    assert len(drawing.findall(f"{SVG}path")) == 2
    assert len(drawing.findall(f"{SVG}circle")) == 6
    texts = [text.text for text in drawing.findall(f"{SVG}text")]
    assert "B<&>" in texts
