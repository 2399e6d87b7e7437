"""Registered model versions: an exported ONNX file that MLflow can load, list and serve."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
import onnx
import torch
from torch import nn

from data.buffers import SAMPLES, buffer, sample_channels
from trainer.export.artifact import Artifact, load_artifact
from trainer.export.entry import Sampled, default, example, first_state
from trainer.export.onnx import following

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

EXAMPLE_SIZE = (24, 32)
"""Height and width of the input example."""

EXAMPLE_SAMPLES = 4
"""Samples per pixel, where they are kept apart."""


WEIGHTS_TAG = "penumbra.weights"
"""Tag of a logged model that tells which weights it has."""


def log_and_register(
    run_id: str, onnx_path: Path | str, name: str, tracking_uri: str, weights: str = ""
) -> str:
    """Log an exported ONNX file with a run and register it as a new version of a model.

    The signature lists the buffers with free batch, height, width and number of samples, and `exposure`:
    MLflow drops inputs that a signature does not list, and an exposure that is silently dropped gives a wrong
    picture; the same goes for `thin_lens`. The depth range is left to the model, which measures it from the
    image. Maps of a recurrent method's state are inputs and, with other names, outputs.
    `mlflow.pyfunc.load_model(uri).predict` takes a dictionary of float32 arrays and returns `{"color": …}`.

    Args:
        run_id: Run that the model belongs to.
        onnx_path: What `trainer.export.export` wrote.
        name: Name of the registered model.
        tracking_uri: Store of the run and of the registry.
        weights: Which weights these are, as `weights_of` says it; `registered_version` finds them.

    Returns:
        The new version's number, as in `models:/<name>/<version>`.

    Raises:
        ValueError: The file is not an exported ONNX file.
    """
    import mlflow.onnx

    from trainer.spool.store import quiet_mlflow

    quiet_mlflow()
    artifact = load_artifact(onnx_path)
    with using_store(tracking_uri), _quiet(), warnings.catch_warnings():
        # MLflow's own classes, at the first import of mlflow.pyfunc.
        warnings.filterwarnings("ignore", ".*Any type hint is inferred as AnyType", UserWarning)
        info = mlflow.onnx.log_model(
            onnx.load(str(onnx_path)),
            name=name,
            signature=_signature(artifact),
            input_example=_example(artifact),
            registered_model_name=name,
            pip_requirements=[f"onnxruntime>={artifact.description.versions['onnxruntime']}", "numpy"],
            save_as_external_data=False,
            run_id=run_id,
            model_id=_logged_model(run_id, name, weights),
        )
    return str(info.registered_model_version)


def registered_version(client: MlflowClient, run_id: str, name: str, weights: str) -> str | None:
    """Return the version of a registered model that a run made of these weights, None if there is none."""
    for version in client.search_model_versions(f"name = '{name}' and run_id = '{run_id}'"):
        model = version.model_id or (version.source or "").removeprefix("models:/")
        if client.get_logged_model(model).tags.get(WEIGHTS_TAG) == weights:
            return str(version.version)
    return None


def weights_of(net: nn.Module) -> str:
    """Return a name for a network's weights: the same for the same numbers."""
    digest = hashlib.sha256()
    for key, value in sorted(net.state_dict().items()):
        digest.update(key.encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:32]


_REGISTERED = re.compile(
    r"(Successfully registered model|Registered model '.*' already exists|Created version '.*' of model).*",
    re.DOTALL,
)
"""What MLflow prints about a registration; the caller says it in its own words."""

_ORT_WARNING, _ORT_ERROR = 2, 3
"""Severities of ONNX Runtime: the one it starts with, and the next, which leaves its warnings out."""


class _Sieve:
    """A stream without the lines that tell of a registration, which `print` writes in two parts."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._dropped = False

    def write(self, text: str) -> int:
        """Pass text on unless it tells of a registration, or ends the line of one that did."""
        drop = _REGISTERED.fullmatch(text) is not None or (self._dropped and text == "\n")
        self._dropped = drop and not text.endswith("\n")
        return len(text) if drop else self._stream.write(text)

    def flush(self) -> None:
        """Flush the stream."""
        self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _not_providers(record: logging.LogRecord) -> bool:
    return "declares execution providers" not in str(record.msg)


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out what MLflow and ONNX Runtime say about every registration; other messages and errors pass.

    MLflow opens the logged model once to try its example. It then misses a GPU that nobody asked for, and
    ONNX Runtime warns that inputs with a default, the frame numbers, are no constants.
    """
    import onnxruntime

    logger = logging.getLogger("mlflow.onnx")
    logger.addFilter(_not_providers)
    onnxruntime.set_default_logger_severity(_ORT_ERROR)
    try:
        with redirect_stderr(_Sieve(sys.stderr)):
            yield
    finally:
        onnxruntime.set_default_logger_severity(_ORT_WARNING)
        logger.removeFilter(_not_providers)


@contextmanager
def using_store(uri: str) -> Iterator[None]:
    """Make a store MLflow's current one: several of its functions ignore the URIs that they are given."""
    import mlflow

    # Setting a URI also sets a variable of the environment, which would outlive this block.
    variables = {name: os.environ.get(name) for name in ("MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI")}
    mlflow.set_tracking_uri(uri)
    mlflow.set_registry_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(variables["MLFLOW_TRACKING_URI"] or "")
        mlflow.set_registry_uri(variables["MLFLOW_REGISTRY_URI"] or "")
        for name, value in variables.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _logged_model(run_id: str, name: str, weights: str) -> str:
    """Create the model's entry in the experiment of its run; MLflow would take the default experiment.

    An entry that an interrupted registration left is removed.
    """
    from mlflow.tracking import MlflowClient

    client = MlflowClient()
    run = client.get_run(run_id)
    experiment = run.info.experiment_id
    tags = {WEIGHTS_TAG: weights} if weights else {}
    if weights:
        found = f"source_run_id = '{run_id}' AND tags.`{WEIGHTS_TAG}` = '{weights}'"
        for stale in client.search_logged_models([experiment], found):
            client.delete_logged_model(stale.model_id)
    model = client.create_logged_model(
        experiment, name=name, source_run_id=run_id, params=dict(run.data.params), tags=tags
    )
    return str(model.model_id)


def _signature(artifact: Artifact) -> Any:
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    single = np.dtype(np.float32)
    inputs: list[Any] = [TensorSpec(single, _shape(name, artifact), name) for name in artifact.inputs]
    for name in _listed(artifact):
        inputs.append(TensorSpec(single, (-1, *default(name).shape[1:]), name))
    outputs: list[Any] = [TensorSpec(single, (-1, 3, -1, -1), artifact.description.output)]
    for name, (channels, _) in artifact.state_maps.items():
        inputs.append(TensorSpec(single, (-1, channels, -1, -1), name))
        outputs.append(TensorSpec(single, (-1, channels, -1, -1), following(name)))
    return ModelSignature(inputs=Schema(inputs), outputs=Schema(outputs))


def _shape(name: str, artifact: Artifact) -> tuple[int, ...]:
    """Return the shape of an input, -1 for what is free: images, samples per pixel, rows, columns."""
    if name == SAMPLES:
        return (-1, -1, len(sample_channels(*artifact.samples)), -1, -1)
    return (-1, buffer(name).channels, -1, -1)


def _example(artifact: Artifact) -> dict[str, Any]:
    made = example(artifact.inputs, 1, *EXAMPLE_SIZE, samples=Sampled(artifact.samples, EXAMPLE_SAMPLES))
    made |= first_state(artifact.state_maps, 1, *EXAMPLE_SIZE, artifact.multiple)
    arrays = {name: value.numpy() for name, value in made.items()}
    return arrays | {name: default(name).numpy() for name in _listed(artifact)}


def _listed(artifact: Artifact) -> list[str]:
    """Return the frame numbers that callers must give: those that the model cannot measure."""
    return [name for name in artifact.frame_numbers if name != "depth_range"]
