"""ZIP files of sequences: accumulation, space-time methods and classical ones, as `trainer denoise` does."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from data.exr import read_frame, write_frame
from models import JointBilateral
from models.denoiser import Denoiser
from tests.trainer.serving.running import Running, limits, picture, small_wskp, zipped
from tests.trainer.serving.test_answers import denoised
from tests.trainer.test_denoise import frame as moving
from tests.trainer.test_denoise_sequences import Smear
from trainer.serving.limits import CHANNELS

COUNT = 5
ZIP = {"Content-Type": "application/zip"}


@pytest.fixture
def clip(tmp_path):
    """Frames of a camera that moves, in a folder of their own."""
    for i in range(COUNT):
        (tmp_path / "clip").mkdir(exist_ok=True)
        write_frame(moving(i), tmp_path / "clip" / f"f{i}.exr")
    return tmp_path / "clip"


def served(model: Denoiser, clip: Path) -> dict[str, np.ndarray]:
    """Return name → colour of what the service makes of all frames."""
    body = zipped({path.name: path.read_bytes() for path in clip.iterdir()})
    with Running(model, limits()) as service:
        answer = service.post(body, ZIP)
        assert answer.status_code == 200, answer.text
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        return {name: picture(archive.read(name), clip.parent) for name in archive.namelist()}


@pytest.mark.parametrize("model", ["JointBilateral", "temporal"])
def test_frames_of_a_sequence_are_accumulated_as_the_command_does(clip, tmp_path, model, one_thread):
    if model == "temporal":
        net = small_wskp()
        net.temporal = True
        model = tmp_path / "net.ckpt"
        arguments = {"layers": 2, "width": 6, "kernel_sizes": [3, 5], "temporal": True}
        weights = {f"net.{name}": value for name, value in net.state_dict().items()}
        tree = {"net": {"class_path": "models.WSKP", "init_args": arguments}}
        torch.save({"hyper_parameters": tree, "state_dict": weights}, model)
    else:
        net = JointBilateral()
    expected = denoised(model, tmp_path / "out", *clip.iterdir())
    found = served(net, clip)
    assert list(found) == [f"f{i}.exr" for i in range(COUNT)]
    for name, image in found.items():
        np.testing.assert_array_equal(image, expected[name])


def test_frames_that_are_held_together_may_not_take_more_than_one_large_frame(clip):
    shown = read_frame(clip / "f0.exr")
    channels = sum(array.shape[-1] for array in shown.buffers.values())
    assert channels < CHANNELS < 3 * channels
    body = zipped({path.name: path.read_bytes() for path in clip.iterdir()})
    with Running(Smear(), limits(megapixels=1.01e-6 * shown.height * shown.width)) as service:
        refused = service.post(body, ZIP)
    assert refused.status_code == 422
    assert "frames at a time" in refused.json()["detail"]


def test_a_space_time_method_sees_all_frames(clip):
    found = served(Smear(), clip)
    frames = [read_frame(clip / f"f{i}.exr").buffers["color"].transpose(2, 0, 1) for i in range(COUNT)]
    expected = Smear().sequence({"color": torch.from_numpy(np.stack(frames))[None]})[0]
    for image, wanted in zip(found.values(), expected.numpy().transpose(0, 2, 3, 1), strict=True):
        np.testing.assert_allclose(image, wanted, rtol=1e-3, atol=1e-5)
