"""`trainer denoise` with space-time methods: chunks with context give what the whole clip gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import models
from data.exr import read_exr, read_frame
from models import NFOR
from models.denoiser import Buffers, Denoised, Denoiser
from models.pace import tick
from tests.trainer.test_denoise_classical import COLOR, frame, run, write
from trainer.sequences import Chunks, plan

SIZE = (16, 18)
COUNT = 7
NARROW = ("features=", "frames=1", "window=1", "patch=0", "fused=false")


class Smear(Denoiser):
    """Averages over three frames and 3x3 pixels, twice; frames count by their colour."""

    inputs = ("color",)
    frames = 1
    frame_halo = 2
    halo = 2
    bytes_per_pixel = 10
    fused = None
    seen: tuple[tuple[int, ...], ...] = ()

    def __init__(self, aux: bool = False) -> None:
        super().__init__()
        self.aux = aux

    def sequence(self, buffers: Buffers) -> Tensor:
        return self.clip(buffers).color

    def clip(self, buffers: Buffers) -> Denoised:
        color = buffers["color"].transpose(1, 2)
        Smear.seen = (*Smear.seen, tuple(color.shape))
        for _ in range(2):
            tick(0.5)
            color = (_sum(color) / _sum(torch.ones_like(color))).square()
        color = color.transpose(1, 2)
        return Denoised(color, aux={"square": color.square()} if self.aux else None)


def _sum(color: Tensor) -> Tensor:
    return 27 * torch.nn.functional.avg_pool3d(torch.nn.functional.pad(color, [1] * 6), 3, 1)


@pytest.fixture(autouse=True)
def smear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "Smear", Smear, raising=False)
    monkeypatch.setattr(models, "__all__", [*models.__all__, "Smear"])
    monkeypatch.setattr(Smear, "seen", ())


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Frames of one surface under noise of their own."""
    for i in range(COUNT):
        made, rng = frame(*COLOR, size=SIZE, index=i), np.random.default_rng(i)
        for name in ("color", "color_a", "color_b"):
            made.buffers[name] *= rng.normal(1, 0.1, made.buffers[name].shape).astype(np.float32)
        write(tmp_path / "clip" / f"f{i:03d}.exr", made)
    return tmp_path / "clip"


def sequence(folder: Path, method: Denoiser) -> dict[str, Tensor]:
    """Return what a method reads of a clip, (1, T, C, H, W)."""
    frames = [read_frame(path).buffers for path in sorted(folder.glob("*.exr"))]
    stacked = {n: np.stack([f[n].transpose(2, 0, 1) for f in frames]) for n in method.inputs}
    return {n: torch.from_numpy(array)[None] for n, array in stacked.items()}


def denoise(source: Path, output: Path, *arguments: str, model: str = "Smear") -> np.ndarray:
    options = NARROW if model == "NFOR" else ()
    assert run(source, "--model", model, "--output", output, *arguments, options=options) == 0
    found = sorted(p for p in output.rglob("*.exr") if not p.stem.endswith("_aux"))
    return np.stack([read_frame(path).buffers["color"] for path in found])


def cut(monkeypatch: pytest.MonkeyPatch, length: int) -> None:
    """Make chunks of this length, whatever the budget."""
    monkeypatch.setattr("trainer.sequences.plan", lambda model, *rest: Chunks(length, model.frame_halo, 1.0))


def close(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("model", ["Smear", "NFOR"])
def test_a_clip_is_denoised_as_a_whole(clip: Path, tmp_path: Path, model: str) -> None:
    narrow = {"features": (), "window": 1, "patch": 0, "fused": False}
    method = Smear() if model == "Smear" else NFOR(frames=1, **narrow)
    buffers = sequence(clip, method)
    with torch.inference_mode():
        expected = method.sequence(buffers)[0].permute(0, 2, 3, 1).numpy()
        alone = method.sequence({n: t[:, 3:4] for n, t in buffers.items()})[0, 0].permute(1, 2, 0).numpy()
    found = denoise(clip, tmp_path / "out", model=model)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3)
    assert np.abs(found[3] - alone).max() > 0.05


@pytest.mark.slow
def test_chunks_of_nfor_change_nothing(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = denoise(clip, tmp_path / "whole", model="NFOR")
    cut(monkeypatch, 2)
    close(denoise(clip, tmp_path / "parts", model="NFOR"), whole)


@pytest.mark.parametrize("length", [1, 2, 3])
def test_chunks_change_neither_results_nor_layers(
    clip: Path, tmp_path: Path, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = denoise(clip, tmp_path / "whole", "--aux")
    assert [shape[2] for shape in Smear.seen] == [COUNT]
    monkeypatch.setattr(Smear, "seen", ())
    cut(monkeypatch, length)
    close(denoise(clip, tmp_path / "parts", "--aux"), whole)
    lengths = [shape[2] for shape in Smear.seen]
    assert length + Smear.frame_halo <= max(lengths) <= length + 2 * Smear.frame_halo
    for i in range(COUNT):
        first, second = (read_exr(tmp_path / o / f"f{i:03d}_aux.exr").channels for o in ("whole", "parts"))
        close(second["square.G"], first["square.G"])


def test_the_budget_bounds_the_frames_that_are_held() -> None:
    halo, size, count = Smear.frame_halo, (64, 64), 100
    held = 4 * 3 * size[0] * size[1]
    for frames in (2 * halo + 1, 2 * halo + 7, 50):
        chunks = plan(Smear(), size, count, 2 * frames * held)
        assert chunks.length + 2 * halo <= frames
        assert chunks.cost >= (chunks.length + 2 * halo) / chunks.length
    assert plan(Smear(), size, count, 20 * count * held) == Chunks(count, halo, 1.0)
    assert plan(Smear(), size, 1, 20 * count * held) == Chunks(1, halo, 1.0)


def test_longer_chunks_are_taken_where_there_is_memory() -> None:
    costs = [plan(NFOR(frames=2), (180, 320), 60, budget * 10**6).cost for budget in (400, 1000, 8000)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 0.5 * costs[0]


def test_a_budget_too_small_for_a_tile_says_how_much_is_needed() -> None:
    with pytest.raises(ValueError, match=r"a memory budget of 0\.0 MB is too small .* expected at least"):
        plan(Smear(), (64, 64), 20, 10_000)


def test_a_small_budget_says_what_it_costs(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    denoise(clip, tmp_path / "parts", "--memory", f"{2 * 12 * SIZE[0] * SIZE[1] * 5}B")
    assert "note: chunks of 1 frame with 2 more on each side: every frame is" in capsys.readouterr().err


def test_a_single_frame_is_a_clip_of_one_and_it_is_said(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    denoise(clip / "f003.exr", tmp_path / "out")
    assert "a single frame: Smear denoises it as a sequence of one" in capsys.readouterr().err
    assert [shape[2] for shape in Smear.seen] == [1]


def test_frames_that_do_not_follow_one_another_are_sequences_of_their_own(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = denoise(clip / "f000.exr", tmp_path / "first")[0]
    (clip / "f001.exr").unlink()
    found = denoise(clip, tmp_path / "out")
    assert "f002.exr does not continue the frames before it" in capsys.readouterr().err
    close(found[0], first)
    assert len(found) == COUNT - 1


def test_independent_views_are_denoised_alone_and_it_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    denoise(Path("sample:stills"), tmp_path / "out", "--split", "train")
    assert "independent views: Smear denoises each alone" in capsys.readouterr().err
    assert {shape[2] for shape in Smear.seen} == {1}


def test_progress_moves_within_a_chunk(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[float] = []
    monkeypatch.setattr("trainer.progress.FrameProgress.within", lambda self, frames: moved.append(frames))
    monkeypatch.setattr("trainer.denoising.LARGE", 1)
    denoise(clip, tmp_path / "out")
    assert sum(moved) == pytest.approx(COUNT)
    assert len(moved) == 3
    assert min(moved) >= 0
