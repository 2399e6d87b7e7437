"""The network at every pixel: what it makes, and what its input is normalised by."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from models.blocks.pixel_parameters import LIMIT, PixelParameters
from models.denoiser import select
from models.lbf import LBF
from tests.models.test_lbf import SMALL, training_batch

pytestmark = pytest.mark.usefixtures("one_thread")


def test_it_begins_around_what_it_is_told() -> None:
    torch.manual_seed(0)
    starts = (0.005, 0.05, 2.0)
    with torch.no_grad():
        found = PixelParameters(7, 10, starts)(torch.randn(2, 7, 9, 9)).mean((0, 2, 3))
    assert ((found / torch.tensor(starts)).log().abs() < math.log(1.5)).all()


def test_outputs_are_positive_and_limited() -> None:
    network = PixelParameters(1, 2, (1.0, 1.0)).eval()
    with torch.no_grad():
        network.last.weight.copy_(torch.tensor([[500.0, 500.0], [-20.0, -20.0]])[..., None, None])
        found = network(torch.full((1, 1, 3, 3), 1e6))
    assert found[0, 0].max() == pytest.approx(math.log1p(math.exp(LIMIT)))
    assert (found[0, 1] >= 0).all()


def test_the_first_batch_of_a_training_sets_the_normalisation_and_no_other_does() -> None:
    method, batch = LBF(("albedo",), **SMALL), select(LBF(("albedo",)), training_batch())
    method.eval()
    method(batch)
    assert not method.network.measured
    assert torch.equal(method.network.mean, torch.zeros(8))
    method.train()
    method(batch)
    assert method.network.measured
    seen = method._features(batch, 0.5 * (batch["color_a"] + batch["color_b"])).statistics
    normal = (seen - method.network.mean[:, None, None]) / (method.network.deviation[:, None, None] + 1e-6)
    assert normal.mean((0, 2, 3)).abs().max() < 1e-3
    torch.testing.assert_close(normal[:, :7].std((0, 2, 3)), torch.ones(7), rtol=1e-2, atol=0)
    assert method.network.deviation[7] == 1.0  # 1 / samples per pixel does not vary
    before = method.state_dict()["network.mean"].clone()
    method({name: 2 * image for name, image in batch.items()})
    assert torch.equal(method.network.mean, before)


def test_all_processes_of_a_training_normalise_by_what_all_of_them_see(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = select(LBF(("albedo",)), training_batch())
    alone = LBF(("albedo",), **SMALL)
    alone(whole)
    sums: list[Tensor] = []

    def reduce(mine: Tensor) -> None:
        """Keep what the first process sends, and add it to what the second does."""
        sums.append(mine.clone())
        mine.copy_(torch.stack(sums).sum(0))

    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "all_reduce", reduce)
    for half in (slice(0, 1), slice(1, 2)):
        method = LBF(("albedo",), **SMALL)
        method({name: image[half] for name, image in whole.items()})
    assert len(sums) == 2
    torch.testing.assert_close(method.network.mean, alone.network.mean)
    torch.testing.assert_close(method.network.deviation, alone.network.deviation)


def test_a_resumed_training_keeps_its_normalisation() -> None:
    method, batch = LBF(("albedo",), **SMALL), select(LBF(("albedo",)), training_batch())
    method(batch)
    other = LBF(("albedo",), **SMALL)
    other.load_state_dict(method.state_dict())
    other({name: 2 * image for name, image in batch.items()})
    assert torch.equal(other.network.deviation, method.network.deviation)
