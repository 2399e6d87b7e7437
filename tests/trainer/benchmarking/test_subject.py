"""What a call does, in this process; and real processes."""

import time

import pytest
import torch

import models
from trainer.benchmarking import cost
from trainer.benchmarking.cases import Case, Effort, Method
from trainer.benchmarking.measuring import exports, measure
from trainer.benchmarking.memory import _Watched, watch
from trainer.benchmarking.subject import Subject
from trainer.export import export

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = {"width": 32, "height": 32, "batch": 1}
SHORT = Effort(3, 1, 5)


def subject(model, *options, **fields):
    return Subject(Case(Method(model, options), **(SMALL | fields)))


def reason(model, *options, **fields):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        subject(model, *options, **fields)
    return str(caught.value)


def test_a_training_step_changes_weights_and_forgetting_releases_what_it_left():
    training = subject("WSKP", kind="training")
    net = training._step.net
    before = [weight.clone() for weight in net.parameters()]
    training()
    assert all((new != old).any() for new, old in zip(net.parameters(), before, strict=True))
    training.forget()
    assert all(weight.grad is None for weight in net.parameters())
    assert not training._step._optimizer.state


def test_weights_are_the_same_in_every_process():
    one, other = (subject("WSKP")._step.model.state_dict() for _ in range(2))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_inference_measures_the_deployed_form():
    measured = sum(weight.numel() for weight in subject("WSKP")._step.model.parameters())
    assert measured == sum(weight.numel() for weight in models.WSKP().deploy().parameters())


def test_recurrent_methods_go_on_with_a_state_of_the_size_of_the_images():
    measured = subject("RAE", "stages=4,5", "tail=6,5", width=96, height=80)
    seen = []
    forward = measured._step.model.forward

    def watched(buffers, state=None):
        seen.append((buffers["albedo"].shape[-2:], None if state is None else state["hidden0"].shape[-2:]))
        return forward(buffers, state)

    measured._step.model.forward = watched
    measured.settle()
    measured()
    measured()
    assert seen == [((64, 64), None), ((64, 64), (64, 64))] + [((80, 96), None)] + 2 * [((80, 96), (80, 96))]


def test_megapixels_count_images_and_frames_of_sequences():
    assert subject("WSKP", batch=3).megapixels == pytest.approx(3 * 32 * 32 / 1e6)
    sequence = subject("NFOR", "frames=1", "features=normal")
    assert sequence.megapixels == pytest.approx(3 * 32 * 32 / 1e6)


def test_what_a_model_cannot_do_is_said():
    assert "no parameters to train" in reason("NFOR", kind="training")
    assert "did you mean WSKP" in reason("WSPK")
    assert "did you mean 'window'" in reason("NLM", "windw=3")
    assert "no such file" in reason("runs/nothing.ckpt")
    assert "are not compiled" in reason("NFOR", "frames=1", mode="compiled")


def test_an_exported_file_runs_in_its_own_mode_in_float32(tmp_path):
    path = str(tmp_path / "filter.ts")
    export(models.JointBilateral(), path, "torchscript")
    subject(path, mode="torchscript")()
    assert subject(path).mode == "torchscript"
    assert "in no other mode" in reason(path, mode="compiled")
    assert "cannot be trained" in reason(path, kind="training")
    assert "float32" in reason(path, mode="torchscript", precision="bfloat16")


@pytest.mark.slow
@pytest.mark.parametrize("name", models.__all__)
def test_every_denoiser_can_be_measured(name):
    for kind in ("inference", "training"):
        if kind == "inference" or next(getattr(models, name)().parameters(), None) is not None:
            measured = subject(name, kind=kind, spp=2)
            measured.settle()
            measured()


def test_memory_is_the_peak_of_what_a_call_takes_and_releases():
    for watched in (watch("cpu", "eager"), _Watched()):
        held = torch.ones(50_000_000, dtype=torch.uint8)
        held += 1
        time.sleep(0.05)
        del held
        assert 45e6 < watched.taken() < 80e6


def test_the_cost_of_a_network_is_taken_in_a_process_of_its_own():
    found = cost("WSKP", size=(256, 128), effort=SHORT)
    low, high = found.spread
    assert 0 < low <= found.seconds_per_megapixel <= high
    assert 50e6 < found.peak_bytes_per_megapixel < 5e9
    assert (found.device, found.calls) == ("cpu", 3)


def test_a_cost_that_cannot_be_taken_is_an_error_with_the_reason():
    with pytest.raises(ValueError, match="did you mean WSKP"):
        cost("WSPK", effort=SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mode", "precision"),
    [
        ("inference", "compiled", "float32"),
        ("inference", "onnx", "float32"),
        ("inference", "torchscript", "float32"),
        ("inference", "eager", "bfloat16"),
        ("inference", "eager", "float16"),
        ("training", "compiled", "float32"),
        ("training", "eager", "bfloat16"),
        ("training", "eager", "float16"),
    ],
)
def test_every_mode_and_precision_has_figures(kind, mode, precision):
    case = Case(Method("WSKP", ("layers=2",)), kind, 64, 64, 2, precision, "cpu", mode)
    with exports() as made:
        found = measure(case, SHORT, made)
    assert found.reason is None
    assert found.median > 0
    assert found.peak_bytes > 0
