"""Random requests and mutated files: every answer is a documented one, nothing dies, memory stays."""

from __future__ import annotations

import random
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest

from tests.trainer.serving.mutations import mutated, seeds
from tests.trainer.serving.running import Running, limits, small_wskp

GROWTH = 200 << 20
"""Bytes by which the process may grow over thousands of mutated files."""

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance",
    "response_schema_conformance", "response_headers_conformance", "negative_data_rejection",
    "missing_required_header", "unsupported_method", "ignored_auth",
)  # fmt: skip


@pytest.fixture(scope="module")
def service():
    with Running(small_wskp(), limits(queue=8)) as running:
        yield running


def call_everything(service: Running, folder, examples: int, *options: str) -> None:
    """Have schemathesis call whatever the server describes, rightly and wrongly."""
    ran = subprocess.run(
        [sys.executable, "-m", "schemathesis.cli", "run", f"http://127.0.0.1:{service.port}/openapi.json",
         "--checks", ",".join(CHECKS), "--phases", "coverage,fuzzing", "--max-examples", str(examples),
         "--seed", "1", "--workers", "2", "--no-color", "--generation-database", "none", *options],
        cwd=folder, text=True, capture_output=True,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout[-6000:] + ran.stderr[-2000:]


def send_mutated(service: Running, folder, count: int) -> Counter[int]:
    """Send mutated files, a few at a time, and return how often each status came."""
    originals = seeds(folder)

    def send(number: int) -> int:
        choice = random.Random(number)
        return service.post(mutated(choice.choice(originals), choice)).status_code

    with ThreadPoolExecutor(4) as pool:
        return Counter(pool.map(send, range(count)))


def check_alive(service: Running, folder) -> None:
    for content in seeds(folder):
        assert service.post(content).status_code == 200
    assert service.client.get("/health").json()["status"] == "ok"
    assert service.service.admitted == service.service.sending == 0


def test_random_requests_get_documented_answers(service, tmp_path):
    call_everything(service, tmp_path, 5)


def test_mutated_files_get_an_answer_or_a_reason(service, tmp_path):
    statuses = send_mutated(service, tmp_path, 200)
    assert set(statuses) == {200, 422}
    check_alive(service, tmp_path)


@pytest.mark.slow
def test_many_random_requests_get_documented_answers(tmp_path):
    token = "0123456789abcdef"
    with Running(small_wskp(), limits(queue=8), token=token) as service:
        call_everything(service, tmp_path, 150, "--header", f"Authorization: Bearer {token}")


@pytest.mark.slow
def test_thousands_of_mutated_files_cost_neither_memory_nor_readers(service, tmp_path):
    send_mutated(service, tmp_path, 100)
    before = psutil.Process().memory_info().rss
    statuses = send_mutated(service, tmp_path, 4000)
    assert set(statuses) == {200, 422}
    assert psutil.Process().memory_info().rss - before < GROWTH
    check_alive(service, tmp_path)
