"""Exported files of networks that read the samples of each pixel."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

import models
from data.buffers import sample_channels
from data.exr import read_frame
from data.root import resolve_root
from models.denoiser import Denoiser
from models.ops import loops
from models.tiling import denoise_tiled
from tests.conformance.test_denoisers import ARGUMENTS
from tests.trainer.test_loading import checkpoint
from trainer.cli import main
from trainer.export import SUFFIXES, Artifact, export, load_artifact
from trainer.export import description as descriptions
from trainer.export.description import Description, describe
from trainer.export.entry import Sampled, example
from trainer.export.parity import COUNTS, LIMIT, relative_error
from trainer.export.register import _example, _signature, log_and_register, using_store

FORMATS = ("onnx", "torchscript")
METHODS = ("Layer", "SBMC")
"""One that sums over strips of rows, and one that merges them by their maximum."""
FRAME = resolve_root("sample:layers").path / "indoor-000104" / "f000.exr"


def net(name: str) -> Denoiser:
    torch.manual_seed(11)
    made: Denoiser = getattr(models, name)(**{**ARGUMENTS[name], "levels": 3 if name == "Optimized" else 2})
    return made.eval().requires_grad_(False)


def samples_of(reader: Any, count: int, batch: int = 2, height: int = 23, width: int = 18) -> Tensor:
    return example(reader.inputs, batch, height, width, 4, Sampled(reader.samples, count))["samples"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Path]:
    folder = tmp_path_factory.mktemp("export")
    paths = {(n, f): folder / f"{n}{SUFFIXES[f]}" for n in METHODS for f in FORMATS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops, "CHUNK", 100_000)  # several strips even in small images
        for (name, format), path in paths.items():
            export(net(name), path, format)  # type: ignore[arg-type]
    return paths


@pytest.fixture(params=[(n, f) for n in METHODS for f in FORMATS], ids="-".join)
def both(request: pytest.FixtureRequest, files: dict[tuple[str, str], Path]) -> tuple[Artifact, Denoiser]:
    return load_artifact(files[request.param]), net(request.param[0])


def test_any_number_of_samples_gives_what_eager_gives_nan_samples_and_empty_pixels_included(
    both: tuple[Artifact, Denoiser],
) -> None:
    artifact, network = both
    for count in (1, 3, 8):
        buffers = {"samples": samples_of(network, count)}
        assert buffers["samples"].isnan().any()
        assert relative_error(artifact(buffers).color, network(buffers).color) < LIMIT


def test_a_sample_with_nan_or_inf_is_as_if_it_were_not_there(both: tuple[Artifact, Denoiser]) -> None:
    artifact, _ = both
    samples = samples_of(artifact, 3).nan_to_num(0.0, 0.0)
    lost = samples.clone()
    lost[:, 2, 5], lost[:, 2, 0, ::2] = torch.nan, torch.inf
    numbers = {"depth_range": torch.tensor([[0.0, 40.0]])}
    found = artifact({"samples": lost, **numbers}).color
    assert relative_error(found, artifact({"samples": samples[:, :2], **numbers}).color) < 1e-5


def test_depth_is_measured_as_eager_does(both: tuple[Artifact, Denoiser]) -> None:
    artifact, network = both
    buffers = {"samples": samples_of(network, 3)}
    assert torch.equal(artifact.measure(buffers)["depth_range"], network.measure(buffers)["depth_range"])


def test_tiles_of_an_artifact_are_those_of_the_whole_image(both: tuple[Artifact, Denoiser]) -> None:
    artifact, _ = both
    buffers = {"samples": samples_of(artifact, 2, 1, 61, 75)}
    assert relative_error(denoise_tiled(artifact, buffers, tile=32), artifact(buffers).color) < 1e-4


def test_other_channels_are_refused_with_those_that_were_expected(both: tuple[Artifact, Denoiser]) -> None:
    artifact, network = both
    expected = r"expected \(B, S, 20, H, W\) with at least one sample and the channels radiance\.R, .*time\.Z"
    wrong = (samples_of(network, 2)[:, :, :19], samples_of(network, 2)[:, 0], samples_of(network, 2)[:, :0])
    for samples in wrong:
        with pytest.raises(ValueError, match=expected):
            artifact({"samples": samples})


def test_files_name_the_channels_for_readers_without_penumbra(files: dict[tuple[str, str], Path]) -> None:
    channels = sample_channels(*net("Layer").samples)
    model = onnx.load(files["Layer", "onnx"])
    assert f"in this order: {', '.join(channels)}." in model.doc_string
    shape = [d.dim_param or d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim]
    assert shape == ["batch", "samples", 20, "height", "width"]
    module = torch.jit.load(str(files["Layer", "torchscript"]))
    assert tuple(module.sample_channels) == channels
    with pytest.raises(torch.jit.Error, match=r"samples must be .* with the channels radiance\.R, "):
        module({"samples": torch.zeros(1, 2, 19, 16, 16)})


def test_the_description_holds_quantities_constants_memory_and_what_was_compared(tmp_path: Path) -> None:
    network = models.PixelGather(**{**ARGUMENTS["PixelGather"], "levels": 2}, fill={"lens": 0.5})
    export(network, tmp_path / "a.onnx")
    artifact = load_artifact(tmp_path / "a.onnx")
    assert (artifact.samples, artifact.fill, artifact.per_sample) == (network.samples, {"lens": 0.5}, True)
    assert artifact.bytes_per_pixel >= network.bytes_per_pixel
    assert artifact.bytes_once > 0
    assert artifact.description.parity is not None
    assert artifact.description.parity.counts == COUNTS


def test_a_description_of_the_first_version_is_read() -> None:
    old = json.loads(describe(models.WSKP(layers=2, width=6, kernel_sizes=(3,)), "onnx", None).to_json())
    for name in ("samples", "fill", "bytes_per_pixel", "bytes_once"):
        del old[name]
    parity = {"error": 1e-6, "limit": 1e-4, "sizes": [[1, 17, 31]], "runtime": "torch", "rounding": 0.0}
    read = Description.from_json(json.dumps({**old, "version": 1, "parity": parity}))
    assert (read.samples, read.fill, read.bytes_per_pixel, read.bytes_once) == ((), {}, 500, 0)
    assert read.parity is not None
    assert read.parity.counts == ()


def test_a_reader_of_the_first_version_asks_for_an_update(monkeypatch: pytest.MonkeyPatch) -> None:
    new = describe(net("Layer"), "onnx", None).to_json()
    monkeypatch.setattr(descriptions, "FORMAT_VERSION", 1)
    with pytest.raises(ValueError, match="version 3, known up to 1; update penumbra-denoise"):
        Description.from_json(new)


def test_the_signature_of_a_registered_model_leaves_the_number_of_samples_free(
    files: dict[tuple[str, str], Path],
) -> None:
    artifact = load_artifact(files["SBMC", "onnx"])
    specs = {spec.name: spec.shape for spec in _signature(artifact).inputs}
    assert specs == {"samples": (-1, -1, 20, -1, -1), "exposure": (-1,), "thin_lens": (-1, 3)}
    made = {name: torch.from_numpy(value) for name, value in _example(artifact).items()}
    assert artifact(made).color.isfinite().all()


def test_a_checkpoint_is_exported_and_denoises_frames_with_samples_as_it_does_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["trainer", *words])
        return main()

    tree = {"class_path": "models.Layer", "init_args": {**ARGUMENTS["Layer"], "levels": 2}}
    trained = str(checkpoint(tmp_path / "best.ckpt", net("Layer"), tree))
    assert run("export", "--model", trained, "--format", "onnx", "--output", str(tmp_path)) == 0
    assert "3, 8, 1, 2, 5 samples per pixel" in " ".join(capsys.readouterr().out.split())
    colors = []
    for name, model in (("eager", trained), ("file", str(tmp_path / "layer.onnx"))):
        assert run("denoise", "--model", model, str(FRAME), "--output", str(tmp_path / name)) == 0
        colors.append(read_frame(tmp_path / name / "f000.exr").buffers["color"])
    np.testing.assert_allclose(colors[1], colors[0], rtol=2e-3, atol=1e-4)


@pytest.mark.slow
def test_a_registered_model_predicts_from_samples_through_pyfunc(
    files: dict[tuple[str, str], Path], tmp_path: Path
) -> None:
    import mlflow
    from mlflow.tracking import MlflowClient

    uri = f"sqlite:///{tmp_path}/mlflow.db"
    client = MlflowClient(uri, uri)
    place = client.create_experiment("test", artifact_location=(tmp_path / "artifacts").as_uri())
    version = log_and_register(client.create_run(place).info.run_id, files["SBMC", "onnx"], "tiny", uri)
    with using_store(uri):
        model = mlflow.pyfunc.load_model(f"models:/tiny/{version}")
    feed = {"samples": samples_of(net("SBMC"), 5), "exposure": torch.tensor([0.1, 2.0])}
    feed["thin_lens"] = torch.tensor([[0.0, 3.0, 40.0], [0.1, 5.0, 60.0]])
    found = model.predict({name: value.numpy() for name, value in feed.items()})["color"]
    assert relative_error(torch.from_numpy(found), net("SBMC")(feed).color) < LIMIT
