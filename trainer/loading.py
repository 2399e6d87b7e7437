"""What `--model MODEL` means, for every command: find the weights and build the denoiser.

MODEL is one of
- a checkpoint of `trainer fit` (`runs/…/best.ckpt`), or the folder of a run;
- an MLflow URI: `models:/wskp/3`, `models:/wskp@champion`, `runs:/ID/export/wskp.onnx`;
- an exported artifact, ONNX or TorchScript;
- a checkpoint that the authors of a paper published;
- the class name of a denoiser without parameters (`JointBilateral`, or `package.module.Class`).
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import tempfile
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch

from models.denoiser import Denoiser
from trainer.building import FORMS, build, class_path_of, find_class
from trainer.configs import UsageError
from trainer.export.artifact import SUFFIXES, Artifact, load_artifact
from trainer.export.description import Source
from trainer.options import options_of, parse

Model = Denoiser | Artifact
RUNS = Path("runs")
"""Where `trainer fit` keeps its runs and the local store."""


@dataclass(frozen=True)
class Loaded:
    """A denoiser in evaluation mode, and where it came from."""

    model: Model
    source: Source

    @cached_property
    def deployed(self) -> Model:
        """The form used for inference, made once."""
        return self.model.deploy().eval()


def load_model(model: str, device: str = "cpu", tracking_uri: str | None = None) -> Model:
    """Return the denoiser that `model` names, in evaluation mode; see `resolve` for the arguments."""
    return resolve(model, device, tracking_uri).model


def resolve(
    model: str,
    device: str = "cpu",
    tracking_uri: str | None = None,
    options: Sequence[str] = (),
    aux: bool = False,
) -> Loaded:
    """Return the denoiser that `model` names, and its source.

    Files are read without pickle. A checkpoint of a run with averaged weights (EMA, SWA) gives the averaged
    ones, which Lightning keeps in `state_dict`.

    Args:
        model: One of the forms that this module lists.
        device: Where it will run: `cpu`, `cuda`, `cuda:1` …
        tracking_uri: MLflow store of a `models:/` or `runs:/` URI; by default `MLFLOW_TRACKING_URI`, or the
            local store `runs/mlflow.db`.
        options: Constructor arguments `KEY=VALUE` of a denoiser that is named by its class.
        aux: Whether it shall return what it made on its way (`Denoised.aux`).

    Raises:
        UsageError: An option is wrong, or the model takes none; or it has nothing to return as `aux`.
        ValueError: The file is damaged or holds another kind of model, the class is unknown or needs weights,
            or the store has no such model.
        FileNotFoundError: Nothing of that name exists; the message lists the forms.
    """
    path, stored = Path(model), re.match(r"(models|runs):/", model)
    if stored or path.exists():
        _refuse(model, options)
        loaded = _from_mlflow(model, device, tracking_uri) if stored else _from_path(path, device)
        return _with_aux(loaded) if aux else loaded
    if _looks_like_path(model):
        raise FileNotFoundError(f"--model {model}: no such file; expected {FORMS}")
    return _from_class_name(model, device, options, aux)


def _refuse(model: str, options: Sequence[str]) -> None:
    """Refuse what only a denoiser that is named by its class can be asked for."""
    if options:
        raise UsageError(
            f"--option {options[0]}: options are for methods that are named by their class, such as NFOR; "
            f"{model} is a file that holds its settings"
        )


def _with_aux(loaded: Loaded) -> Loaded:
    """Let a model of a file return what it makes on its way."""
    if not isinstance(getattr(loaded.model, "aux", None), bool):
        raise UsageError(
            f"--aux: {loaded.source.reference} gives an image and nothing else; checkpoints of "
            "Layer and Optimized give their layers, NFOR its errors and features"
        )
    loaded.model.aux = True  # type: ignore[union-attr]  # checked above
    return loaded


def _looks_like_path(model: str) -> bool:
    suffixes = (".ckpt", ".pt", ".pth", *SUFFIXES.values())
    return "/" in model or model.endswith(suffixes) or not model.replace(".", "").isidentifier()


def _from_path(path: Path, device: str) -> Loaded:
    if path.is_dir():
        return _from_path(_file_of_folder(path), device)
    if path.suffix.lower() == SUFFIXES["onnx"] or _is_torchscript(path):
        artifact = load_artifact(path, device)
        return Loaded(artifact, replace(artifact.description.source, reference=str(path)))
    checkpoint = read_checkpoint(path)
    source = Source(reference=str(path), sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    if "hyper_parameters" in checkpoint:
        denoiser, source = _from_training(checkpoint, path, source)
    elif method := _published_method(checkpoint):
        denoiser, source = _from_authors(method, checkpoint, path, source)
    else:
        held = ", ".join(map(str, list(checkpoint)[:6])) or "nothing"
        raise ValueError(
            f"{path} is not a model that Penumbra knows: it holds {held}; "
            "a checkpoint of `trainer fit` holds hyper_parameters and state_dict"
        )
    return Loaded(_ready(denoiser, device), source)


def _file_of_folder(folder: Path) -> Path:
    """Return the model file of a run folder or of a downloaded MLflow model."""
    names = ("checkpoints/best.ckpt", "checkpoints/last.ckpt", "model.onnx")
    for path in (folder / name for name in names):
        if path.is_file():
            return path
    raise ValueError(f"{folder} holds no model: looked for {', '.join(names)}")


def _is_torchscript(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the dictionary in a file of `torch.save`, read without running code from it.

    Raises:
        ValueError: The file is truncated, not a checkpoint, or holds objects that only pickle could restore.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Detected pickle protocol", UserWarning)  # it is no checkpoint
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        if zipfile.is_zipfile(path):
            reason = (
                "it holds Python objects beside tensors and plain values, which are not loaded for safety"
            )
        else:
            reason = "its content is neither a checkpoint nor an exported model"
        raise ValueError(f"{path} cannot be loaded: {reason}; expected {FORMS}") from error
    except PermissionError:
        raise
    except (RuntimeError, OSError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        first = (str(error).splitlines() or [repr(error)])[0][:160]
        raise ValueError(f"{path} is truncated or not a checkpoint ({first})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}, expected a checkpoint's dictionary")
    return content


def _from_training(checkpoint: dict[str, Any], path: Path, source: Source) -> tuple[Denoiser, Source]:
    tree = checkpoint["hyper_parameters"].get("net")
    if not isinstance(tree, Mapping) or "class_path" not in tree:
        raise ValueError(f"{path} does not say which network it holds (hyper_parameters.net.class_path)")
    arguments = dict(tree.get("init_args") or {})
    try:
        denoiser = build(str(tree["class_path"]), arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error
    weights = {
        name.removeprefix("net."): value
        for name, value in checkpoint.get("state_dict", {}).items()
        if name.startswith("net.")
    }
    _fill(denoiser, weights, path)
    return denoiser, replace(source, class_path=str(tree["class_path"]), init_args=arguments)


def _fill(denoiser: Denoiser, weights: dict[str, Any], path: Path) -> None:
    try:
        denoiser.load_state_dict(weights)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()[1:3]]
        raise ValueError(
            f"{path} does not hold the weights of {type(denoiser).__name__}: {' '.join(lines)[:300]}"
        ) from error


def _published_method(checkpoint: Mapping[str, Any]) -> Literal["wskp", "afgsa"] | None:
    """Return whose published checkpoint this is by the names of its entries, None where it is none."""
    inner: Any = checkpoint
    for wrapper in ("model_state_dict", "state_dict"):
        inner = inner.get(wrapper, inner) if isinstance(inner, Mapping) else inner
    names = {str(name).removeprefix("module.").split(".")[0] for name in inner}
    if names & {"conv_map", "conv_aenc1", "transformer_blocks"}:
        return "afgsa"
    return "wskp" if "conv1_5" in names or "model_state_dict" in checkpoint else None


def _from_authors(
    method: Literal["wskp", "afgsa"], checkpoint: Mapping[str, Any], path: Path, source: Source
) -> tuple[Denoiser, Source]:
    from models.published import load_published

    try:
        denoiser: Denoiser = load_published(method, checkpoint)
    except (ValueError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} is not a published checkpoint that Penumbra knows: {error}") from error
    return denoiser, replace(source, class_path=f"models.{type(denoiser).__name__}")


def _from_class_name(name: str, device: str, options: Sequence[str], aux: bool) -> Loaded:
    class_path = class_path_of(name)
    cls = find_class(class_path)
    arguments = parse(cls, options)
    if aux and "aux" not in options_of(cls):
        raise UsageError(f"--aux: {name} makes nothing on its way that could be shown; NFOR does")
    denoiser = build(class_path, {**arguments, **({"aux": True} if aux else {})})
    if next(denoiser.parameters(), None) is not None:
        raise ValueError(
            f"--model {name}: {name} has weights that must be trained; give a checkpoint of it "
            "(`trainer fit` writes runs/…/checkpoints/best.ckpt), a registered model or an exported file"
        )
    return Loaded(_ready(denoiser, device), Source(name, class_path, arguments))


def _ready(denoiser: Denoiser, device: str) -> Denoiser:
    return denoiser.eval().requires_grad_(False).to(device)


def model_store(tracking_uri: str | None = None) -> str:
    """Return the MLflow store that models are looked up in, without creating one.

    Raises:
        ValueError: None is configured and there is no local one.
    """
    if uri := tracking_uri or os.environ.get("MLFLOW_TRACKING_URI"):
        return uri
    database = RUNS / "mlflow.db"
    if not database.is_file():
        raise ValueError(
            f"no model store: set MLFLOW_TRACKING_URI, or run in the directory that holds {database} "
            f"(this is {Path.cwd()})"
        )
    return f"sqlite:///{database.resolve()}"


def _from_mlflow(uri: str, device: str, tracking_uri: str | None) -> Loaded:
    store = model_store(tracking_uri)
    import mlflow
    from mlflow.exceptions import MlflowException

    from trainer.export.register import using_store
    from trainer.tracking import quiet_mlflow

    quiet_mlflow()
    with tempfile.TemporaryDirectory(prefix="penumbra-") as folder:
        try:
            with using_store(store):
                place = mlflow.artifacts.download_artifacts(artifact_uri=uri, dst_path=folder)
        except (MlflowException, OSError) as error:
            first = (str(error).splitlines() or [repr(error)])[0]
            raise ValueError(f"--model {uri}: {first} (store: {store}; `trainer models` lists it)") from error
        loaded = _from_path(Path(place), device)
    return replace(loaded, source=replace(loaded.source, reference=uri))
