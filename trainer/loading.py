"""What `--model MODEL` means, for every command: find the weights and build the denoiser.

MODEL is one of
- a checkpoint of `trainer fit` (`runs/…/best.ckpt`), or the folder of a run;
- an MLflow URI: `models:/wskp/3`, `models:/wskp@champion`, `runs:/ID/export/wskp.onnx`;
- an exported artifact, ONNX or TorchScript;
- a checkpoint that the authors of a paper published;
- the class name of a denoiser without parameters (`JointBilateral`, or `package.module.Class`).
"""

from __future__ import annotations

import os
import re
import struct
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch

from data.manifest import file_sha256
from data.remote_patience import shown
from models.denoiser import Denoiser
from trainer.building import FORMS, build, class_path_of, find_class, outlined
from trainer.configs import UsageError
from trainer.export.artifact import SUFFIXES, Artifact, load_artifact
from trainer.export.description import Source
from trainer.options import options_of, parse
from trainer.reading import network_of, read_checkpoint

Model = Denoiser | Artifact
RUNS = Path("runs")
"""Where `trainer fit` keeps its runs and the local store."""

_SPARE = 16 << 20


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
    check_named(model, options)
    if _is_stored(model):
        loaded = _from_mlflow(model, device, tracking_uri)
    elif Path(model).exists():
        loaded = _from_path(Path(model), device)
    else:
        return _from_class_name(model, device, options, aux)
    return _with_aux(loaded) if aux else loaded


def check_named(model: str, options: Sequence[str] = ()) -> None:
    """Find out, without loading anything, whether there is what a user has named; arguments as of `resolve`.

    Raises:
        UsageError: An option is wrong, or the model takes none.
        ValueError: The class cannot be imported, or is something else.
        FileNotFoundError: Nothing of that name exists; the message lists the forms.
    """
    if _is_stored(model) or Path(model).exists():
        _refuse(model, options)
    elif _looks_like_path(model):
        raise FileNotFoundError(f"--model {model}: no such file; expected {FORMS}")
    else:
        parse(find_class(class_path_of(model)), options)


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
            "Layer and Optimized give their layers, those of WSKP what each kernel makes, NFOR its errors "
            "and features"
        )
    loaded.model.aux = True  # type: ignore[union-attr]  # checked above
    return loaded


def _is_stored(model: str) -> bool:
    return re.match(r"(models|runs):/", model) is not None


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
    source = Source(reference=str(path), sha256=file_sha256(path))
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
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith("/constants.pkl") for name in archive.namelist())
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OverflowError, struct.error):
        return False


def _from_training(checkpoint: dict[str, Any], path: Path, source: Source) -> tuple[Denoiser, Source]:
    class_path, arguments = network_of(checkpoint, path)
    weights = _weights(checkpoint.get("state_dict", {}), path)
    try:
        with outlined(len(weights)):
            outline = _outline(class_path, arguments)
        if outline is not None:
            _fill(outline, weights, path, assign=True)
            _check_size(outline, weights, path)
        denoiser = build(class_path, arguments, foreign=True)
    except (TypeError, AttributeError, ArithmeticError, LookupError, RuntimeError, ValueError) as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    _fill(denoiser, weights, path)
    step = checkpoint.get("global_step")
    trained = step if isinstance(step, int) else None
    return denoiser, replace(source, class_path=class_path, init_args=arguments, step=trained)


def _outline(class_path: str, arguments: dict[str, Any]) -> Denoiser | None:
    """Return a network without memory; None for one from elsewhere that cannot be without."""
    try:
        return build(class_path, arguments, foreign=True)
    except NotImplementedError:
        if class_path.startswith("models."):
            raise
    return None


def _weights(state: Any, path: Path) -> dict[str, torch.Tensor]:
    """Return the weights of the network in the state of a training module."""
    if not isinstance(state, Mapping) or not all(isinstance(name, str) for name in state):
        raise ValueError(f"{path} is damaged: its state_dict is no mapping of names to tensors")
    weights = {name.removeprefix("net."): value for name, value in state.items() if name.startswith("net.")}
    if not all(isinstance(value, torch.Tensor) for value in weights.values()):
        raise ValueError(f"{path} is damaged: its state_dict holds something else than tensors")
    return weights


def _check_size(outline: Denoiser, weights: Mapping[str, torch.Tensor], path: Path) -> None:
    """Refuse a network before memory is taken for it, where it takes much more than is stored of it."""
    storages = [tensor.untyped_storage() for tensor in weights.values()]
    held = sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())
    size = sum(tensor.nbytes for tensor in (*weights.values(), *(b for b in outline.buffers() if b.is_meta)))
    if size > 4 * held + _SPARE:
        raise ValueError(f"{path}: the network takes {size >> 20} MiB, far more than is stored of it")


def _fill(denoiser: Denoiser, weights: Mapping[str, torch.Tensor], path: Path, assign: bool = False) -> None:
    try:
        denoiser.load_state_dict(weights, assign=assign)
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
    if not isinstance(inner, Mapping):
        return None
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
            told = first.replace(store, shown(store))  # which may hold a password
            raise ValueError(
                f"--model {uri}: {told} (store: {shown(store)}; `trainer models` lists it)"
            ) from error
        loaded = _from_path(Path(place), device)
    return replace(loaded, source=replace(loaded.source, reference=uri))
