"""`trainer denoise` on frames that keep their samples apart, and the pictures of layers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import trainer.loading
from data.derive import derive
from data.exr import read_frame
from data.exr_image import read_exr, write_exr
from data.frame import Frame, Samples
from data.root import resolve_root
from models import NLM, RHF, Layer, PixelGather
from models.denoiser import select
from models.ops.per_sample import sample_counts
from models.tiling import denoise_in_tiles
from trainer.commands import denoise as command
from trainer.configs import UsageError
from trainer.export.description import Source
from trainer.loading import Loaded
from trainer.samples import dropped, fill, sample_tensor

SMALL: dict[str, Any] = {"width": 4, "levels": 2, "kernel_size": 3, "embedding": 6}
FRAME = resolve_root("sample:layers").path / "indoor-000104" / "f000.exr"


def small(kind: type = Layer, **arguments: Any) -> Any:
    torch.manual_seed(3)
    aux = arguments.pop("aux", False)
    model = kind(**{**SMALL, **arguments}).eval()
    if aux:
        model.aux = True
    return model


def denoise(
    monkeypatch: pytest.MonkeyPatch, model: Any, output: Path, *options: str, frame: Path = FRAME
) -> int:
    def resolve(*_: object, aux: bool, **__: object) -> Loaded:
        return Loaded(model, Source("small"))

    monkeypatch.setattr(trainer.loading, "resolve", resolve)
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    arguments = [str(frame), "--model", "small", "--output", str(output), *options]
    return command.run(parser.parse_args(arguments))


def test_frames_with_samples_are_denoised_from_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small(PixelGather)
    assert denoise(monkeypatch, model, tmp_path, "--exposure", "0.25") == 0
    found = read_frame(tmp_path / "f000.exr")
    frame = read_frame(FRAME)
    assert frame.samples is not None
    assert found.samples is None
    values = torch.from_numpy(frame.samples.values.transpose(0, 3, 1, 2).copy())[None]
    batch = {"samples": values, "sample_channels": frame.samples.channels, "exposure": torch.tensor([0.25])}
    with torch.no_grad():
        expected = model(select(model, batch)).color[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(found.buffers["color"], expected, rtol=2e-3, atol=1e-4)


def test_layers_are_written_as_pictures_of_before_after_and_opacity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    denoise(monkeypatch, small(layers=3), tmp_path, "--layers")
    names = {path.name for path in (tmp_path / "f000_layers").iterdir()}
    parts = ("unfiltered", "filtered", "alpha")
    assert names == {
        "composite.png",
        "layers.png",
        *(f"layer{n}_{part}.png" for n in range(3) for part in parts),
    }
    with Image.open(tmp_path / "f000_layers" / "layer1_alpha.png") as alpha:
        assert alpha.size == (64, 64)
    with pytest.raises(ValueError, match="f000"):  # what is there is not overwritten
        denoise(monkeypatch, small(layers=3), tmp_path, "--layers")


def test_layers_of_a_model_without_any_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"--layers shows the layers of .* small is another method"):
        denoise(monkeypatch, small(PixelGather), tmp_path, "--layers")


def test_layers_are_an_exr_too_and_their_front_to_back_composite_is_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    denoise(monkeypatch, small(layers=3, aux=True), tmp_path, "--aux")
    held = read_exr(tmp_path / "f000_aux.exr").channels
    image, light = np.zeros((64, 64)), np.ones((64, 64))
    for layer in range(3):
        image += light * held[f"layer{layer}_filtered.G"]
        light *= 1 - held[f"layer{layer}_alpha.Y"]
    np.testing.assert_allclose(image, held["G"], rtol=2e-3, atol=1e-4)
    sums = sum(held[f"layer{layer}_unfiltered.G"] for layer in range(3))
    frame = read_frame(FRAME)
    assert frame.samples is not None
    mean = frame.samples.values[..., frame.samples.channels.index("radiance.G")].mean(0)
    np.testing.assert_allclose(sums, mean, rtol=2e-3, atol=1e-4)


def test_layers_in_tiles_are_those_of_the_whole_frame() -> None:
    model = small(aux=True)
    buffers = {"samples": sample_tensor(read_frame(FRAME), model)[..., :50, :]}
    with torch.no_grad():
        whole = model(buffers).aux
        tiled = denoise_in_tiles(model, buffers, tile=16).aux
    assert tiled.keys() == whole.keys()
    for name, layer in whole.items():
        assert layer.shape[-2:] == (50, 64)
        torch.testing.assert_close(tiled[name], layer, rtol=0, atol=1e-5 * layer.abs().max().item())


def test_a_frame_without_samples_is_refused_with_what_was_expected() -> None:
    frame = Frame({"color": np.ones((16, 16, 3), np.float32)}, "wall", 0)
    with pytest.raises(ValueError, match=r"wall/frame 0: Layer reads the samples .* s00\.radiance\.R"):
        sample_tensor(frame, small())


def test_a_missing_guide_is_named_with_the_frame_or_filled() -> None:
    parts = {"radiance": np.ones((2, 16, 16, 3), np.float32), "depth": np.ones((2, 16, 16, 1), np.float32)}
    frame = Frame({"color": np.ones((16, 16, 3), np.float32)}, "wall", 0, samples=Samples.of(parts))
    with pytest.raises(ValueError, match="wall/frame 0: the samples have no normal, diffuse_albedo"):
        sample_tensor(frame, small())
    guides = ("normal", "diffuse_albedo", "specular_albedo", "roughness", "motion", "coc", "lens", "time")
    filled = sample_tensor(frame, small(fill=dict.fromkeys(guides, 0.5)))
    assert filled.shape == (1, 2, 20, 16, 16)
    assert (filled[:, :, 7:] == 0.5).all()


def test_dropped_samples_and_pixels_without_any_are_counted() -> None:
    samples = torch.zeros(1, 3, 20, 4, 4)
    assert dropped(samples) is None
    samples[0, :, 4, 1, 2], samples[0, 1, 0, 3, 3] = torch.nan, torch.inf
    assert sample_counts(samples)[0, 0].tolist()[1] == [3, 3, 0, 3]
    lost = dropped(samples)
    assert lost == (4, 2, 1)
    assert lost is not None
    assert lost.text() == (
        "4 samples with NaN or Inf in 2 pixels were dropped; "
        "1 pixel had no other and was filled from around it"
    )


def broken(path: Path) -> None:
    """The frame with one sample, and all of another pixel, not finite."""
    image = read_exr(FRAME)
    image.channels["s03.radiance.G"][4, 5] = np.nan
    for number in range(8):
        image.channels[f"s{number:02d}.radiance.R"][9, 9] = np.inf
    write_exr(path, image.channels, {k: v for k, v in image.attributes.items() if k.startswith("penumbra")})


def test_dropped_samples_are_told_and_recorded_and_change_no_other_pixel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken(tmp_path / "f000.exr")
    denoise(monkeypatch, small(PixelGather), tmp_path / "out", frame=tmp_path / "f000.exr")
    assert (
        "9 samples with NaN or Inf in 2 pixels were dropped; 1 pixel had no other" in capsys.readouterr().err
    )
    denoise(monkeypatch, small(PixelGather), tmp_path / "plain")
    found, plain = (read_frame(tmp_path / name / "f000.exr") for name in ("out", "plain"))
    assert found.notes["denoised"]["dropped"] == {"samples": 9, "pixels": 2, "empty": 1}
    assert "dropped" not in plain.notes["denoised"]
    np.testing.assert_array_equal(found.buffers["color"][40:], plain.buffers["color"][40:])


def without_lens(path: Path) -> None:
    """The frame without the channels of lens and time."""
    image = read_exr(FRAME)
    channels = {n: v for n, v in image.channels.items() if ".lens." not in n and ".time." not in n}
    write_exr(path, channels, {k: v for k, v in image.attributes.items() if k.startswith("penumbra")})


def test_a_lacking_guide_is_named_with_the_option_that_fills_it_and_that_fills_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = tmp_path / "f000.exr"
    without_lens(frame)
    with pytest.raises(ValueError, match=r"samples have no lens, time.*\(--fill lens=0 --fill time=0\)"):
        denoise(monkeypatch, small(), tmp_path / "out", frame=frame)
    denoise(monkeypatch, small(), tmp_path / "out", "--fill", "lens=0", "--fill", "time=0.5", frame=frame)
    found = read_frame(tmp_path / "out" / "f000.exr")
    assert found.notes["denoised"]["filled"] == {"lens": 0, "time": 0.5}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("wind=0", "--fill wind=0: expected QUANTITY=VALUE with one of normal, depth"),
        ("radiance=1", "--fill radiance=1: expected QUANTITY=VALUE"),
        ("lens", "no finite number"),
        ("lens=inf", "no finite number"),
    ],
)
def test_constants_for_what_is_not_read_or_no_numbers_are_refused(text: str, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        fill(small(), [text])


def test_nothing_is_filled_for_models_that_read_no_samples() -> None:
    with pytest.raises(UsageError, match="reads no samples"):
        fill(NLM(), ["lens=0"])


def test_ray_histogram_fusion_reads_histograms_that_follow_from_the_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = RHF(window=2)
    assert denoise(monkeypatch, model, tmp_path) == 0
    frame = derive(read_frame(FRAME), model.inputs)
    tensors = {n: torch.from_numpy(frame.buffers[n].transpose(2, 0, 1).copy())[None] for n in model.inputs}
    with torch.no_grad():
        expected = model(tensors).color[0].permute(1, 2, 0).numpy()
    found = read_frame(tmp_path / "f000.exr").buffers["color"]
    assert np.abs(found - expected).max() <= 1e-3 * np.abs(expected).max()


def test_a_frame_without_samples_and_histograms_is_refused_with_the_commands_that_make_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = resolve_root("sample:stills").path / "indoor-000002" / "f000.exr"
    with pytest.raises(ValueError, match=r"missing buffer 'histogram'.*trainer render stills --histogram"):
        denoise(monkeypatch, RHF(), tmp_path, frame=still)
