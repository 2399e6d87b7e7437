"""LPIPS with the linear layers that torchmetrics brings and a stand-in for torchvision, of random weights."""

import importlib
import importlib.util
import math
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
import torchmetrics
from torch import nn

from trainer.commands.evaluate import _metrics
from trainer.configs import UsageError
from trainer.metrics import lpips, measures

LINEAR = Path(torchmetrics.__file__).parent / "functional/image/lpips_models/alex.pth"
TAPS = (1, 4, 7, 9, 11)
"""Positions of the rectifiers whose results LPIPS compares."""


def alexnet():
    """The layers of AlexNet up to the last that LPIPS reads."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """The folder of torch.hub, empty."""
    place = tmp_path / "hub" / "checkpoints"
    place.mkdir(parents=True)
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    lpips._network.cache_clear()
    yield place
    lpips._network.cache_clear()


@pytest.fixture
def torchvision(monkeypatch):
    """Stands for torchvision; its network reads the file as torchvision does, with pickle."""
    users = ("torchmetrics.functional.image.lpips", "torchmetrics.image.lpip")
    users = [importlib.import_module(name) for name in users]  # before there is a torchvision
    package, models = (ModuleType(name) for name in ("torchvision", "torchvision.models"))
    package.__spec__ = ModuleSpec("torchvision", None)
    package.models = models
    models.read = []
    default = SimpleNamespace(url=f"https://weights.invalid/models/{lpips.WEIGHTS}")
    models.AlexNet_Weights = SimpleNamespace(DEFAULT=default)

    def load(weights):
        models.read.append(weights)
        features = alexnet()
        path = Path(torch.hub.get_dir(), "checkpoints", weights.url.rpartition("/")[2])
        features.load_state_dict(torch.load(path, weights_only=False))
        return SimpleNamespace(features=features)

    models.alexnet = load
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    for module in users:
        monkeypatch.setattr(module, "_TORCHVISION_AVAILABLE", True)
    return models


@pytest.fixture
def weights(folder):
    """Random weights in the folder of torch.hub."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        state = alexnet().state_dict()
    torch.save(state, folder / lpips.WEIGHTS)
    return state


def images(count=2, height=40, width=52):
    generator = torch.Generator().manual_seed(1)
    reference = 1.5 * torch.rand(count, 3, height, width, generator=generator)
    return reference + 0.3 * torch.randn(reference.shape, generator=generator), reference


def literal(output, reference, state):
    """Equation 1 of Zhang et al., float64: weighted squares of unit vectors, mean over pixels."""
    mean = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64)
    deviation = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64)
    linear = torch.load(LINEAR, map_location="cpu", weights_only=True)
    features = alexnet().double()
    features.load_state_dict(state)
    pair = []
    for image in (output, reference):
        display = image.double().clamp(min=0) ** 0.454545
        x = (2 * display.clamp(max=1) - 1 - mean[:, None, None]) / deviation[:, None, None]
        layers = []
        for position, layer in enumerate(features):
            x = layer(x)
            if position in TAPS:
                layers.append(x / (x.square().sum(0, keepdim=True) + 1e-8).sqrt())
        pair.append(layers)
    total = 0.0
    for number, (a, b) in enumerate(zip(*pair, strict=True)):
        weight = linear[f"lin{number}.model.1.weight"].double().flatten()
        total += ((a - b).square() * weight[:, None, None]).sum(0).mean().item()
    return total


def test_the_distance_is_that_of_the_equation_for_every_image_of_a_batch(torchvision, weights):
    output, reference = images()
    with torch.no_grad():
        found = lpips.lpips_alex_gamma(output, reference)
        expected = [literal(*pair, weights) for pair in zip(output, reference, strict=True)]
    assert found.shape == (2,)
    assert min(expected) > 1e-4
    assert found.tolist() == pytest.approx(expected, rel=1e-4)


def test_the_distance_is_that_of_the_function_of_torchmetrics(torchvision, weights):
    from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

    output, reference = images()
    display = [image.clamp_min(0).pow(0.454545).clamp_max(1) for image in (output, reference)]
    expected = learned_perceptual_image_patch_similarity(*display, "alex", reduction="none", normalize=True)
    assert torch.equal(lpips.lpips_alex_gamma(output, reference), expected)


def test_equal_images_have_the_distance_0_and_extreme_ones_a_finite_one(torchvision, weights):
    _, reference = images()
    assert lpips.lpips_alex_gamma(reference, reference).tolist() == [0, 0]
    extreme = torch.stack([torch.zeros(3, 40, 52), torch.full((3, 40, 52), 65504.0)])
    for type in (torch.float32, torch.bfloat16):
        assert torch.isfinite(lpips.lpips_alex_gamma(extreme.to(type), reference.to(type))).all()


def test_the_network_is_read_once(torchvision, weights):
    for _ in range(3):
        lpips.lpips_alex_gamma(*images(1))
    assert len(torchvision.read) == 1


def test_the_smallest_image_has_31_rows_and_columns(torchvision, weights):
    assert math.isfinite(lpips.lpips_alex_gamma(*images(1, 31, 31)))
    for size in ((30, 31), (31, 30)):
        with pytest.raises(ValueError, match="at least 31x31"):
            lpips.lpips_alex_gamma(*images(1, *size))
        with pytest.raises(RuntimeError):
            alexnet()(torch.zeros(1, 3, *size))


def test_nothing_is_missing_where_both_are_there(torchvision, weights):
    assert lpips.missing() is None


def test_a_missing_file_is_named_and_nothing_is_loaded(torchvision):
    assert lpips.WEIGHTS in lpips.missing()
    with pytest.raises(FileNotFoundError, match=lpips.WEIGHTS):
        lpips.lpips_alex_gamma(*images(1))
    assert torchvision.read == []


def test_another_file_than_expected_is_not_downloaded(torchvision, weights):
    torchvision.AlexNet_Weights.DEFAULT.url = "https://weights.invalid/models/alexnet-owt-00000000.pth"
    with pytest.raises(FileNotFoundError, match="alexnet-owt-00000000"):
        lpips.lpips_alex_gamma(*images(1))
    assert torchvision.read == []


class Harmful:
    def __reduce__(self):
        return (print, ("unpickled",))


@pytest.mark.parametrize("content", [{"weight": Harmful()}, None, b"PK\x03\x04 cut off"])
def test_a_file_that_holds_something_else_is_refused_before_it_is_unpickled(
    torchvision, folder, capsys, content
):
    path = folder / lpips.WEIGHTS
    if isinstance(content, dict):
        torch.save(content, path)
    else:
        path.write_bytes(content or b"")
    with pytest.raises(OSError, match="is damaged"):
        lpips.lpips_alex_gamma(*images(1))
    assert torchvision.read == []
    assert "unpickled" not in capsys.readouterr().out


def test_where_torchvision_is_not_installed_that_is_the_reason(monkeypatch, weights):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "torchvision" else find(name)
    )
    assert lpips.missing() == "torchvision is not installed"


def reloaded(monkeypatch):
    """The measures as another process would see them now."""
    spec = importlib.util.spec_from_file_location("measures_reloaded", measures.__file__)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


def test_where_it_can_be_taken_it_is_a_score_of_which_less_is_better(monkeypatch, torchvision, weights):
    found = reloaded(monkeypatch)
    score = found.SCORES["lpips_alex_gamma"]
    assert not score.higher
    assert score.function is lpips.lpips_alex_gamma
    assert "Zhang et al. 2018" in score.doc
    assert "lpips_alex_gamma" not in found.LEFT_OUT


def test_where_it_cannot_be_taken_its_reason_is_left_out(monkeypatch, torchvision):
    found = reloaded(monkeypatch)
    assert "lpips_alex_gamma" not in found.SCORES
    assert lpips.missing() in found.LEFT_OUT["lpips_alex_gamma"]


@pytest.mark.parametrize("name", ["lpips", "lpips_alex_gamma"])
def test_to_ask_for_it_where_it_cannot_be_taken_is_answered_with_the_reason(monkeypatch, torchvision, name):
    found = reloaded(monkeypatch)
    for part in ("SCORES", "LEFT_OUT"):
        monkeypatch.setattr(measures, part, getattr(found, part))
    with pytest.raises(UsageError, match=f"--metric {name}: .*left out: {lpips.WEIGHTS}"):
        _metrics([name])


def test_where_it_can_be_taken_its_short_name_leads_to_it(monkeypatch, torchvision, weights):
    found = reloaded(monkeypatch)
    for part in ("SCORES", "LEFT_OUT"):
        monkeypatch.setattr(measures, part, getattr(found, part))
    assert _metrics(["lpips_alex_gamma"]) == ("lpips_alex_gamma",)
    with pytest.raises(UsageError, match="see lpips_alex_gamma"):
        _metrics(["lpips"])


def test_the_measures_load_neither_torchvision_nor_networks():
    script = (
        "import sys, trainer.metrics.measures\n"
        "print(sorted({'torchvision', 'torchmetrics', 'torchmetrics.image'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
