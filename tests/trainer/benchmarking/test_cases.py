from tests.trainer.benchmarking.stand_ins import failure, outcome
from trainer.benchmarking.cases import Case, Method, cases_of, spread

CHOSEN = {
    "kind": ["inference"], "size": [], "batch": [], "precision": ["float32"], "device": ["cpu"],
    "mode": ["eager"],
}  # fmt: skip


def test_there_is_a_case_for_every_combination():
    chosen = CHOSEN | {"size": [(64, 32), (128, 64)], "batch": [1, 4], "mode": ["eager", "onnx"]}
    cases = cases_of([Method("WSKP"), Method("AFGSA")], chosen, spp=2)
    assert len(cases) == len(set(cases)) == 16
    assert {(c.width, c.height, c.batch, c.mode, c.spp) for c in cases} >= {(128, 64, 4, "onnx", 2)}


def test_an_exported_file_has_one_case_in_the_mode_of_its_format():
    chosen = CHOSEN | {"mode": ["eager", "compiled", "torchscript"]}
    cases = cases_of([Method("out/wskp.onnx"), Method("wskp.ts")], chosen)
    assert [case.mode for case in cases] == ["onnx", "torchscript"]


def test_sizes_and_batches_that_are_not_given_are_the_usual_ones_of_the_kind():
    inference, training = cases_of([Method("WSKP")], CHOSEN | {"kind": ["inference", "training"]})
    assert (inference.width, inference.height, inference.batch) == (1280, 720, 1)
    assert (training.width, training.height, training.batch) == (128, 128, 8)


def test_quartiles_of_five_values_are_the_second_and_the_fourth():
    assert spread([5.0, 1.0, 3.0, 2.0, 4.0]) == (2.0, 4.0)
    assert spread([7.0]) == (7.0, 7.0)


def test_a_row_holds_every_call_and_figures_per_megapixel():
    row = outcome(seconds=(0.1, 0.4, 0.2), width=1000, height=500, peak=3e6).row()
    assert row["seconds"] == [0.1, 0.4, 0.2]
    assert row["median_seconds"] == 0.2
    assert row["seconds_per_megapixel"] == 0.4
    assert row["peak_bytes_per_megapixel"] == 6e6
    assert row["model"] == "WSKP"


def test_a_failed_case_has_its_reason_and_no_figures():
    row = failure(reason="no CUDA").row()
    assert (row["status"], row["reason"]) == ("failed", "no CUDA")
    assert "median_seconds" not in row


def test_options_are_part_of_the_name():
    assert Method("NFOR", ("window=5", "frames=1")).label == "NFOR window=5 frames=1"
    assert Case(Method("NFOR")).label == "NFOR inference 1280x720 batch 1 float32 cpu eager"
