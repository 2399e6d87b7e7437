"""`trainer denoise --weights`: pictures of what every kernel makes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from data.derive import derive
from data.exr import read_frame
from data.exr_image import read_exr
from models import WSKP, MultiResolutionWSKP
from models.denoiser import Denoiser
from tests.trainer.test_denoise import folder_of, frame, run
from trainer.configs import UsageError
from trainer.export import export
from trainer.reports.fusion import kernel_pictures

FORMS: dict[str, tuple[type, dict[str, Any]]] = {
    "WSKP": (WSKP, {"layers": 2, "width": 6, "kernel_sizes": [3, 5], "temporal": False}),
    "MultiResolutionWSKP": (
        MultiResolutionWSKP,
        {"width": 4, "levels": 2, "resolutions": 2, "kernel_sizes": [3, 5]},
    ),
}


def network(name: str) -> Denoiser:
    kind, arguments = FORMS[name]
    torch.manual_seed(5)
    made: Denoiser = kind(**arguments).eval()
    for parameter in made.parameters():
        torch.nn.init.uniform_(parameter, -0.4, 0.4)
    return made


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("models")
    for name, (_, arguments) in FORMS.items():
        tree = {"class_path": f"models.{name}", "init_args": arguments}
        weights = {f"net.{key}": value for key, value in network(name).state_dict().items()}
        torch.save({"hyper_parameters": {"net": tree}, "state_dict": weights}, folder / f"{name}.ckpt")
    return {name: folder / f"{name}.ckpt" for name in FORMS}


def shown(folder: Path) -> dict[str, np.ndarray]:
    return {path.stem: np.asarray(Image.open(path)).astype(int) for path in sorted(folder.iterdir())}


def views_of(name: str, path: Path) -> dict[str, np.ndarray]:
    """What the kernels of a network make of a frame."""
    net = network(name)
    net.aux = True  # type: ignore[assignment]
    stored = derive(read_frame(path), net.inputs)
    images = {key: torch.from_numpy(stored.buffers[key]).permute(2, 0, 1)[None] for key in net.inputs}
    with torch.no_grad():
        aux = net({**images, "exposure": torch.tensor([0.25])}).aux
    assert aux is not None
    return {key: view[0].permute(1, 2, 0).numpy() for key, view in aux.items()}


@pytest.mark.parametrize("name", FORMS)
def test_every_kernel_is_pictured_beside_the_result_and_a_sheet_of_all(
    name: str, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = folder_of(tmp_path / "in", frame(0), frame(1))
    assert run("--model", checkpoints[name], folder, "--weights", "--output", tmp_path / "out") == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "f000.exr", "f000_weights", "f001.exr", "f001_weights",
    ]  # fmt: skip
    found = shown(tmp_path / "out" / "f001_weights")
    expected = kernel_pictures(views_of(name, folder / "f001.exr"), 0.25)
    assert set(found) == {*expected, "fused", "kernels"}
    for key, picture in expected.items():
        wanted = np.asarray(picture).astype(int)
        assert found[key].shape == wanted.shape == (26, 38, 3)
        assert np.abs(found[key] - wanted).max() <= 6, key  # neighbours in a map of colours
    assert found["kernels"].shape[1] > 2 * 256


def test_pictures_made_in_tiles_are_those_of_the_whole_frame(
    checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    net = network("WSKP")
    net.aux = True  # type: ignore[assignment]
    least = (min(16 + 2 * net.halo, 26), min(16 + 2 * net.halo, 38))
    assert least[0] * least[1] < 26 * 38
    for memory, output in (("2GB", "whole"), (f"{least[0] * least[1] * net.bytes_per_pixel}", "tiled")):
        options = ("--weights", "--output", tmp_path / output, "--memory", memory)
        run("--model", checkpoints["WSKP"], folder, *options)
    whole, tiled = (shown(tmp_path / output / "f000_weights") for output in ("whole", "tiled"))
    assert whole.keys() == tiled.keys()
    for key, picture in whole.items():
        assert np.abs(picture - tiled[key]).max() <= 6, key


def test_weights_as_an_exr_add_up_to_the_image(checkpoints: dict[str, Path], tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    run("--model", checkpoints["WSKP"], folder, "--aux", "--png", "--output", tmp_path)
    held = read_exr(tmp_path / "f000_aux.exr").channels
    weights = {size: held[f"kernel{size}_weight.Y"] for size in ("03", "05")}
    np.testing.assert_allclose(sum(weights.values()), 1, atol=2e-3)
    for letter in "RGB":
        found = sum(weights[size] * held[f"kernel{size}_filtered.{letter}"] for size in weights)
        np.testing.assert_allclose(found, held[letter], rtol=5e-3, atol=1e-3)
    assert held["kernel05_importance.Y"].std() > 0
    with Image.open(tmp_path / "f000_aux.png") as sheet:
        assert sheet.width > 3 * 256


def test_pictures_are_kept_unless_force_replaces_all_of_them(
    checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    options = (folder, "--weights", "--output", tmp_path / "out")
    run("--model", checkpoints["MultiResolutionWSKP"], *options)
    (tmp_path / "out" / "f000.exr").unlink()
    with pytest.raises(ValueError, match=r"f000_weights already there"):
        run("--model", checkpoints["WSKP"], *options)
    run("--model", checkpoints["WSKP"], *options, "--force")
    assert not list((tmp_path / "out" / "f000_weights").glob("x1_*"))


def test_models_that_fuse_no_kernels_are_refused_before_a_frame_is_denoised(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "in", frame(0))
    options = (folder, "--output", tmp_path / "out", "--weights")
    needed = r"--weights needs a checkpoint of WSKP or MultiResolutionWSKP; "
    exported = r".*net\.ts is an exported file.*checkpoint it was made from"
    with pytest.raises(UsageError, match=needed + r"JointBilateral holds JointBilateral, which fuses no"):
        run("--model", "JointBilateral", *options)
    export(network("WSKP"), tmp_path / "net.ts", "torchscript")
    with pytest.raises(UsageError, match=needed + exported):
        run("--model", tmp_path / "net.ts", *options)
    assert not list((tmp_path / "out").iterdir())
