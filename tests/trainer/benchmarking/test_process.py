import json
import time

import pytest

from tests.trainer.benchmarking.stand_ins import script
from trainer.benchmarking.cases import Case, Effort, Method
from trainer.benchmarking.child import reason_of
from trainer.benchmarking.measuring import exports, measure
from trainer.benchmarking.process import Measuring, MeasuringError

CASE = Case(Method("WSKP"))


def failing(monkeypatch, text, timeout=None):
    script(monkeypatch, text)
    with Measuring(timeout=timeout) as process, pytest.raises(MeasuringError) as caught:
        process.prepare(CASE, 1)
    return str(caught.value)


def test_a_process_that_the_system_kills_is_said_to_lack_memory(monkeypatch):
    assert "memory ran out" in failing(monkeypatch, "os.kill(os.getpid(), 9)")


def test_a_process_that_crashes_is_told_with_its_signal(monkeypatch):
    assert "SIGSEGV" in failing(monkeypatch, "os.kill(os.getpid(), 11)")


def test_a_process_that_ends_is_told_with_the_last_line_that_it_wrote(monkeypatch):
    told = failing(monkeypatch, "sys.stdin.readline(); sys.exit('first\\nlibrary is broken')")
    assert told == "the process ended with exit code 1: library is broken"


def test_a_process_that_takes_too_long_is_ended(monkeypatch):
    began = time.monotonic()
    assert failing(monkeypatch, "time.sleep(60)", timeout=0.3) == "took more than 0.3 s"
    assert time.monotonic() - began < 30


def test_what_a_process_is_at_is_told(monkeypatch):
    script(
        monkeypatch,
        'sys.stdin.readline(); print(\'{"stage": "loading"}\\n{"ready": {"threads": 3}}\', flush=True)',
    )
    stages = []
    with Measuring(tell=stages.append) as process:
        assert process.prepare(CASE, 1) == {"threads": 3}
    assert stages == ["loading"]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError(), "out of memory"),
        (RuntimeError("CUDA out of memory. Tried"), "CUDA out of memory. Tried"),
        (
            RuntimeError("CPUAllocator: can't allocate memory"),
            "out of memory: CPUAllocator: can't allocate memory",
        ),
        (ValueError("\n--device: none\nmore"), "--device: none"),
        (TypeError("two"), "TypeError: two"),
    ],
)
def test_the_reason_is_one_line_that_says_whether_memory_ran_out(error, reason):
    assert reason_of(error) == reason


ANSWERING = """
for line in sys.stdin:
    command = json.loads(line)
    if "calls" in command:
        print(json.dumps({"seconds": [SECONDS] * command["calls"]}), flush=True)
        time.sleep(SECONDS * command["calls"])
    elif "end" in command:
        print(json.dumps({"end": {"peak_bytes": 7, "others": 0.25}}), flush=True)
    else:
        ready = {"first_seconds": 1, "megapixels": 2, "threads": 3, "device_name": None, "mode": "onnx"}
        print(json.dumps({"ready": ready}), flush=True)
"""


def measured(monkeypatch, seconds, effort):
    script(monkeypatch, ANSWERING.replace("SECONDS", str(seconds)))
    with exports() as made:
        return measure(CASE, effort, made)


def test_all_figures_of_a_process_are_in_the_outcome(monkeypatch):
    found = measured(monkeypatch, 0.001, Effort(20, 1, 10))
    assert found.done
    assert len(found.seconds) == 20
    assert found.case.mode == "onnx"
    assert (found.median, found.peak_bytes, found.megapixels, found.others) == (0.001, 7, 2, 0.25)


def test_measuring_stops_when_the_time_is_up_yet_not_before_three_calls(monkeypatch):
    assert len(measured(monkeypatch, 0.05, Effort(1000, 1, 0.01)).seconds) == 3


def test_a_failed_export_is_not_tried_again(monkeypatch, tmp_path):
    script(
        monkeypatch,
        f"open({str(tmp_path / 'starts')!r}, 'a').write('x'); sys.stdin.readline();"
        'print(json.dumps({"failed": "it reads sequences"}), flush=True)',
    )
    with exports() as made:
        cases = [Case(Method("NFOR"), mode="onnx", batch=batch) for batch in (1, 2)]
        outcomes = [measure(case, Effort(), made) for case in cases]
    assert [outcome.reason for outcome in outcomes] == ["it reads sequences"] * 2
    assert (tmp_path / "starts").read_text() == "x"


def test_the_case_arrives_as_it_was_sent(monkeypatch, tmp_path):
    script(
        monkeypatch,
        f"open({str(tmp_path / 'case')!r}, 'w').write(sys.stdin.readline()); print('{{\"ready\": {{}}}}')",
    )
    with Measuring() as process:
        process.prepare(CASE, 4)
    sent = json.loads((tmp_path / "case").read_text())
    assert sent["warmup"] == 4
    assert Case(**{**sent["case"], "method": Method(sent["case"]["method"]["model"])}) == CASE
