"""Registered model versions: an exported ONNX file that MLflow can load, list and serve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx

from data.buffers import buffer
from trainer.export.artifact import Artifact, load_artifact
from trainer.export.entry import example

EXAMPLE_SIZE = (24, 32)
"""Height and width of the input example."""


def log_and_register(run_id: str, onnx_path: Path | str, name: str, tracking_uri: str) -> str:
    """Log an exported ONNX file with a run and register it as a new version of a model.

    The signature lists the buffers with free batch, height and width, and `exposure`: MLflow drops inputs
    that a signature does not list, and an exposure that is silently dropped gives a wrong picture. The depth
    range is left to the model, which measures it from the image. `mlflow.pyfunc.load_model(uri).predict`
    takes a dictionary of float32 arrays and returns `{"color": …}`.

    Args:
        run_id: Run that the model belongs to.
        onnx_path: What `trainer.export.export` wrote.
        name: Name of the registered model.
        tracking_uri: Store of the run and of the registry.

    Returns:
        The new version's number, as in `models:/<name>/<version>`.

    Raises:
        ValueError: The file is not an exported ONNX file.
    """
    import mlflow
    import mlflow.onnx

    from trainer.tracking import quiet_mlflow

    quiet_mlflow()
    artifact = load_artifact(onnx_path)
    before = mlflow.get_tracking_uri(), mlflow.get_registry_uri()
    mlflow.set_tracking_uri(tracking_uri)
    mlflow.set_registry_uri(tracking_uri)
    try:
        info = mlflow.onnx.log_model(
            onnx.load(str(onnx_path)),
            name=name,
            signature=_signature(artifact),
            input_example=_example(artifact),
            registered_model_name=name,
            pip_requirements=[f"onnxruntime>={artifact.description.versions['onnxruntime']}", "numpy"],
            save_as_external_data=False,
            run_id=run_id,
        )
    finally:
        mlflow.set_tracking_uri(before[0])
        mlflow.set_registry_uri(before[1])
    return str(info.registered_model_version)


def _signature(artifact: Artifact) -> Any:
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    single = np.dtype(np.float32)
    inputs: list[Any] = [
        TensorSpec(single, (-1, buffer(name).channels, -1, -1), name) for name in artifact.inputs
    ]
    if "exposure" in artifact.frame_numbers:
        inputs.append(TensorSpec(single, (-1,), "exposure"))
    return ModelSignature(
        inputs=Schema(inputs), outputs=Schema([TensorSpec(single, (-1, 3, -1, -1), "color")])
    )


def _example(artifact: Artifact) -> dict[str, Any]:
    arrays = {name: value.numpy() for name, value in example(artifact.inputs, 1, *EXAMPLE_SIZE).items()}
    if "exposure" in artifact.frame_numbers:
        arrays["exposure"] = np.ones(1, np.float32)
    return arrays
