"""`--model MODEL`: every form is found, and everything else is a clear error."""

from __future__ import annotations

import logging
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import models
from models import WSKP
from models.denoiser import Buffers, Denoised, Denoiser
from tests.models.test_published import authors_afgsa
from trainer.export import Artifact, Source, export
from trainer.export.entry import example
from trainer.export.register import log_and_register, using_store
from trainer.loading import load_model, model_store, resolve
from trainer.reading import read_checkpoint

ARGUMENTS = {"layers": 2, "width": 6, "kernel_sizes": [3, 5]}
TREE = {"class_path": "models.WSKP", "init_args": ARGUMENTS}
SHARED = Path(__file__).parents[3] / "shared"


class Identity(Denoiser):
    """A method without parameters."""

    inputs = ("color",)

    def forward(self, buffers: Buffers) -> Denoised:
        return Denoised(buffers["color"])


class Gated(Denoiser):
    """Holds another module, as configurations may nest them."""

    inputs = ("color",)

    def __init__(self, gate: nn.Module) -> None:
        super().__init__()
        self.gate = gate

    def forward(self, buffers: Buffers) -> Denoised:
        return Denoised(self.gate(buffers["color"]))


def net(seed: int = 0) -> WSKP:
    torch.manual_seed(seed)
    return WSKP(**ARGUMENTS).eval()  # type: ignore[arg-type]


def checkpoint(path: Path, network: nn.Module, tree: dict[str, Any] | None = None, **more: Any) -> Path:
    """Write what Lightning writes, as far as it matters here."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    torch.save({"hyper_parameters": {"net": tree or TREE}, "state_dict": state, "epoch": 3, **more}, path)
    return path


def test_a_training_checkpoint_gives_the_network_with_its_hyper_parameters_and_weights(
    tmp_path: Path,
) -> None:
    path = checkpoint(tmp_path / "best.ckpt", net())
    loaded = resolve(str(path))
    assert isinstance(loaded.model, WSKP)
    assert loaded.model.kernel_sizes == (3, 5)
    assert not loaded.model.training
    for name, value in net().state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], value)
    assert (loaded.source.class_path, loaded.source.init_args) == ("models.WSKP", ARGUMENTS)
    assert len(loaded.source.sha256) == 64


def test_a_training_checkpoint_tells_the_step_of_its_weights_where_it_says_one(tmp_path: Path) -> None:
    assert resolve(str(checkpoint(tmp_path / "best.ckpt", net(), global_step=120))).source.step == 120
    assert resolve(str(checkpoint(tmp_path / "old.ckpt", net(), global_step="?"))).source.step is None


def test_averaged_weights_win_over_the_current_ones(tmp_path: Path) -> None:
    """Lightning's weight averaging keeps the average in `state_dict`."""
    current = {f"net.{name}": value for name, value in net(1).state_dict().items()}
    path = checkpoint(tmp_path / "ema.ckpt", net(0), current_model_state=current, averaging_state={})
    loaded = load_model(str(path))
    assert isinstance(loaded, WSKP)
    for name, value in net(0).state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)


def test_a_run_folder_means_its_best_checkpoint(tmp_path: Path) -> None:
    checkpoint(tmp_path / "checkpoints" / "last.ckpt", net(1))
    checkpoint(tmp_path / "checkpoints" / "best.ckpt", net(0))
    assert resolve(str(tmp_path)).source.reference.endswith("best.ckpt")


def test_an_empty_folder_is_an_error_that_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no model: looked for checkpoints/best\.ckpt"):
        load_model(str(tmp_path))


def test_nested_modules_of_a_configuration_are_built(tmp_path: Path) -> None:
    gate = {
        "class_path": "torch.nn.Conv2d",
        "init_args": {"in_channels": 3, "out_channels": 3, "kernel_size": 1},
    }
    tree = {"class_path": f"{__name__}.Gated", "init_args": {"gate": gate}}
    path = checkpoint(tmp_path / "gated.ckpt", Gated(nn.Conv2d(3, 3, 1)), tree)
    loaded = load_model(str(path))
    assert type(loaded).__name__ == "Gated"


@pytest.mark.parametrize("suffix", [".onnx", ".ts", ".pt"])
def test_exported_files_load_as_artifacts(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"net{suffix}"
    export(
        net(), path, "onnx" if suffix == ".onnx" else "torchscript", source=Source("a.ckpt", "models.WSKP")
    )
    loaded = resolve(str(path))
    assert isinstance(loaded.model, Artifact)
    assert loaded.source.class_path == "models.WSKP"


def test_a_class_without_parameters_needs_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "Identity", Identity, raising=False)
    monkeypatch.setattr(models, "__all__", [*models.__all__, "Identity"])
    assert type(load_model("Identity")).__name__ == "Identity"
    assert type(load_model(f"{__name__}.Identity")).__name__ == "Identity"


def test_a_class_with_parameters_asks_for_a_checkpoint() -> None:
    with pytest.raises(ValueError, match="give a checkpoint"):
        load_model("WSKP")


@pytest.mark.parametrize("name", ["NoSuchMethod", "no/such/file.ckpt", "missing.onnx"])
def test_what_does_not_exist_is_an_error_that_lists_the_forms(name: str) -> None:
    with pytest.raises(FileNotFoundError, match=r"models:/NAME/VERSION.*\.onnx or \.ts"):
        load_model(name)


def test_a_checkpoint_of_another_network_names_what_does_not_fit(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "other.ckpt", WSKP(layers=2, width=8, kernel_sizes=(3, 5)))
    with pytest.raises(ValueError, match=r"other\.ckpt does not hold the weights of WSKP: size mismatch"):
        load_model(str(path))


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"class_path": "models.Nothing", "init_args": {}}, "unknown class 'models.Nothing'"),
        ({"class_path": "not_installed.Net", "init_args": {}}, "install that package"),
        ({"class_path": "torch.nn.Linear", "init_args": {}}, "not a denoiser"),
        ({"class_path": "os.system", "init_args": {"command": "false"}}, "not a network"),
        ({"class_path": "models.WSKP", "init_args": {"widht": 3}}, "does not take these arguments"),
    ],
)
def test_a_checkpoint_with_an_unusable_class_says_so(
    tmp_path: Path, tree: dict[str, Any], message: str
) -> None:
    path = checkpoint(tmp_path / "odd.ckpt", net(), tree)
    with pytest.raises(ValueError, match=rf"odd\.ckpt: .*{message}"):
        load_model(str(path))


def test_a_truncated_checkpoint_is_an_error(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "cut.ckpt", net())
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ValueError, match=r"cut\.ckpt is truncated"):
        load_model(str(path))


class Evil:
    """Would run code when unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("evil-was-here"),))


def test_a_checkpoint_with_python_objects_is_refused_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Evil()}, tmp_path / "evil.ckpt")
    with pytest.raises(ValueError, match="not loaded for safety"):
        read_checkpoint(tmp_path / "evil.ckpt")
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(ValueError, match=r"evil\.pkl"):
        read_checkpoint(tmp_path / "evil.pkl")
    assert not (tmp_path / "evil-was-here").exists()


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not a model")
    with pytest.raises(ValueError, match=r"notes\.txt cannot be loaded"):
        load_model(str(tmp_path / "notes.txt"))
    torch.save({"weights": torch.zeros(3)}, tmp_path / "odd.pt")
    with pytest.raises(ValueError, match="it holds weights"):
        load_model(str(tmp_path / "odd.pt"))


def test_an_unknown_authors_checkpoint_is_an_error(tmp_path: Path) -> None:
    torch.save({"model_state_dict": {"a": torch.zeros(3)}}, tmp_path / "authors.pt")
    with pytest.raises(ValueError, match="not a published checkpoint that Penumbra knows"):
        load_model(str(tmp_path / "authors.pt"))


@pytest.mark.parametrize("wrapper", [None, "state_dict", "model_state_dict"])
def test_the_checkpoint_of_afgsas_authors_is_known_by_its_entries(
    tmp_path: Path, wrapper: str | None
) -> None:
    weights = {f"module.{name}": value for name, value in authors_afgsa().items()}
    torch.save(weights if wrapper is None else {wrapper: weights, "epoch": 12}, tmp_path / "G.pth")
    loaded = resolve(str(tmp_path / "G.pth"))
    assert isinstance(loaded.model, models.AFGSA)
    assert loaded.source.class_path == "models.AFGSA"
    assert not loaded.model.training
    assert not any(parameter.requires_grad for parameter in loaded.model.parameters())


def test_a_damaged_checkpoint_of_afgsas_authors_is_a_clear_error(tmp_path: Path) -> None:
    weights = authors_afgsa()
    del weights["conv_aenc2.0.bias"]
    torch.save(weights, tmp_path / "G.pth")
    with pytest.raises(ValueError, match=r"G\.pth is not a published .*afgsa: missing conv_aenc2\.0\.bias"):
        load_model(str(tmp_path / "G.pth"))


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.exists(), reason="needs the development data")
def test_the_authors_checkpoint_loads() -> None:
    loaded = resolve(str(SHARED / "published" / "wskp" / "classroom.pt"))
    assert isinstance(loaded.model, WSKP)
    assert loaded.source.class_path == "models.WSKP"


def test_without_a_store_the_error_names_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with pytest.raises(ValueError, match="MLFLOW_TRACKING_URI"):
        load_model("models:/wskp/1")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mlflow.db").touch()
    assert model_store() == f"sqlite:///{tmp_path}/runs/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:1")
    assert model_store() == "http://127.0.0.1:1"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A store with one run and version 1 of the model `tiny`, alias champion; returns its URI and the run."""
    from mlflow.tracking import MlflowClient

    folder = tmp_path_factory.mktemp("store")
    uri = f"sqlite:///{folder}/mlflow.db"
    client = MlflowClient(uri, uri)
    experiment = client.create_experiment("test", artifact_location=(folder / "artifacts").as_uri())
    run = client.create_run(experiment).info.run_id
    export(net(), folder / "tiny.onnx", source=Source("best.ckpt", "models.WSKP", ARGUMENTS))
    client.log_artifact(run, str(folder / "tiny.onnx"), "export")
    client.log_artifact(run, str(checkpoint(folder / "best.ckpt", net())), "checkpoints")
    assert log_and_register(run, folder / "tiny.onnx", "tiny", uri) == "1"
    client.set_registered_model_alias("tiny", "champion", "1")
    client.set_terminated(run)
    return uri, run


def test_registering_is_quiet_but_lets_other_messages_pass(
    store: tuple[str, str], tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlflow.onnx
    from mlflow.tracking import MlflowClient

    uri, run = store
    export(net(), tmp_path / "calm.onnx")
    log = mlflow.onnx.log_model

    def talkative(*arguments: Any, **options: Any) -> Any:
        info = log(*arguments, **options)
        logging.getLogger("mlflow.onnx").warning("a real warning")
        print("Successfully", "finished", file=sys.stderr)
        print("no end of line", end="", file=sys.stderr)
        return info

    capfd.readouterr()
    monkeypatch.setattr(mlflow.onnx, "log_model", talkative)
    for version in ("1", "2"):
        assert log_and_register(run, tmp_path / "calm.onnx", "calm", uri) == version
        printed = capfd.readouterr()
        assert printed.out == ""
        first, *rest = printed.err.splitlines()
        assert first.endswith("a real warning")
        assert rest == ["Successfully finished", "no end of line"]
    MlflowClient(uri, uri).delete_registered_model("calm")


def test_messages_of_onnx_runtime_are_back_after_registering(
    store: tuple[str, str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    import onnxruntime

    assert store
    export(net(), tmp_path / "net.onnx")
    capfd.readouterr()
    onnxruntime.InferenceSession(tmp_path / "net.onnx", providers=["CPUExecutionProvider"])
    assert "Initializer exposure appears in graph inputs" in capfd.readouterr().err


@pytest.mark.parametrize("model", ["models:/tiny/1", "models:/tiny@champion", "runs:/RUN/export/tiny.onnx"])
def test_mlflow_uris_give_the_exported_model(store: tuple[str, str], model: str) -> None:
    uri, run = store
    loaded = resolve(model.replace("RUN", run), tracking_uri=uri)
    buffers = example(("irradiance", "albedo", "normal", "depth"), 1, 18, 25)
    with torch.inference_mode():
        expected = net()(buffers).color
    assert torch.allclose(loaded.model(buffers).color, expected, rtol=1e-4, atol=1e-5)
    assert loaded.source.reference == model.replace("RUN", run)
    assert loaded.source.init_args == ARGUMENTS


def test_a_checkpoint_in_a_run_is_found_by_its_uri(store: tuple[str, str]) -> None:
    uri, run = store
    assert isinstance(load_model(f"runs:/{run}/checkpoints/best.ckpt", tracking_uri=uri), WSKP)


@pytest.mark.parametrize(
    "model", ["models:/tiny/7", "models:/nobody@champion", "runs:/0123456789abcdef/model"]
)
def test_an_unknown_mlflow_uri_names_the_store(store: tuple[str, str], model: str) -> None:
    with pytest.raises(ValueError, match=r"--model .* \(store: sqlite:///.*trainer models"):
        load_model(model, tracking_uri=store[0])


def test_a_registered_model_runs_through_pyfunc(
    store: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlflow

    with using_store(store[0]):
        pyfunc = mlflow.pyfunc.load_model("models:/tiny@champion")
    names = ("irradiance", "albedo", "normal", "depth")
    assert [spec.name for spec in pyfunc.metadata.signature.inputs] == [*names, "exposure"]
    buffers = example(names, 2, 21, 33)
    exposure = torch.tensor([0.1, 2.0])
    feed = {name: value.numpy() for name, value in buffers.items()} | {"exposure": exposure.numpy()}
    found = pyfunc.predict(feed)["color"]
    with torch.inference_mode():
        expected = net()({**buffers, "exposure": exposure}).color.numpy()
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert set(pyfunc.input_example or ()) == {*names, "exposure"}
