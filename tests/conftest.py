"""Fixtures of the tests of networks and filters, for which a module asks with `pytestmark`; Triton's mode."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is first imported, by whichever test


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Compute in one thread, as suits tiny images: a second one only waits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def no_gradients() -> Iterator[None]:
    """Compute as inference does, without a graph."""
    with torch.no_grad():
        yield


def pytest_collection_modifyitems(items):
    """Mark what starts Ray clusters, or runs all of the README's page: a quarter of an hour."""
    for item in items:
        place = item.path.as_posix()
        if item.get_closest_marker("slow") and (
            "/trainer/cluster/" in place or place.endswith("stack/test_page.py")
        ):
            item.add_marker(pytest.mark.cluster)
