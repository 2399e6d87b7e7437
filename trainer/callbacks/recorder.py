"""Records what a run was: resolved configuration, parameters, versions, git state, data."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.cli import SaveConfigCallback

from trainer.outputs import write_whole
from trainer.tracking import MLflowTracking

PACKAGES = ("penumbra-denoise", "torch", "lightning", "mlflow", "numpy", "torchmetrics", "jsonargparse",
            "OpenEXR", "onnx", "onnxruntime")  # fmt: skip


class RunRecorder(SaveConfigCallback):
    """Writes `config.yaml` into the run's folder and describes the run in MLflow."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Record everything; called on the first rank only."""
        logger = trainer.logger
        if stage != "fit" or not isinstance(logger, MLflowTracking):
            return
        config = flatten(self.config.as_dict())
        changes = logger.log_params(config)
        self._keep(logger, self.parser.dump(self.config, skip_none=False), changes)
        logger.log_text("\n".join(installed()) + "\n", "packages.txt")
        manifest_hash = getattr(trainer.datamodule, "manifest_hash", None)  # type: ignore[attr-defined]
        tags = {f"version.{name}": version for name, version in versions().items()}
        tags |= git_state(Path.cwd())
        tags |= {"data.manifest_hash": str(manifest_hash), "python": platform.python_version()}
        tags["parameters"] = str(sum(p.numel() for p in pl_module.parameters() if p.requires_grad))
        logger.set_tags(tags)

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Record what lies before a checkpoint before it is saved.

        A run that continues from it does not take these steps again. Lightning saves after a step before it
        logs what the step gave, and logs that once more behind, which the tracking knows.

        Raises:
            OSError: The disk is full.
        """
        logger = trainer.logger
        if not trainer.is_global_zero or not isinstance(logger, MLflowTracking):
            return
        batches: Any = trainer.fit_loop.epoch_loop.batch_progress.current  # declared without `processed`
        numbers = trainer._logger_connector
        if batches.processed > batches.completed and numbers._first_loop_iter is not None:  # behind a step
            numbers.update_train_step_metrics()
        logger.before_checkpoint()

    def _keep(self, logger: MLflowTracking, text: str, changes: dict[str, tuple[str, str]]) -> None:
        """Keep the configuration, and say what is not as it was when the run began.

        MLflow refuses changed parameters: the run's page keeps the first values, and a tag tells the others.
        """
        name = config_name(logger.folder)
        if name != "config.yaml" and same_configuration(logger.folder, text):
            return
        write_whole(logger.folder / name, text)
        logger.log_text(text, name)
        if changes:
            lines = [f"{key}: {first} → {now}" for key, (first, now) in changes.items()]
            logger.set_tags({f"changed.{Path(name).stem}": "\n".join(lines)})
            print(
                f"The run continues with other values than it began with ({logger.folder / name}):",
                *lines, sep="\n  ", file=sys.stderr,
            )  # fmt: skip


def same_configuration(folder: Path, text: str) -> bool:
    """Return whether the newest configuration of a run folder says what a text says."""
    newest = max(folder.glob("config*.yaml"), key=lambda path: (len(path.name), path.name))
    try:
        before, now = yaml.safe_load(newest.read_text()), yaml.safe_load(text)
    except yaml.YAMLError:
        return False
    return isinstance(before, dict) and isinstance(now, dict) and flatten(before) == flatten(now)


def config_name(folder: Path) -> str:
    """Return the file for a configuration: `config.yaml`, or `config-resumed-<n>.yaml` for a continued run.

    The first configuration and those of earlier continuations stay as they are.
    """
    if not (folder / "config.yaml").exists():
        return "config.yaml"
    number = 1
    while (folder / f"config-resumed-{number}.yaml").exists():
        number += 1
    return f"config-resumed-{number}.yaml"


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested configuration as `a.b.c` → value, without empty branches and command options."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if key in ("config", "ckpt_path", "resume_from", "evaluation"):
            continue
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{name}.")
        elif isinstance(value, list) and any(isinstance(v, Mapping) for v in value):
            flat[name] = ", ".join(str(v.get("class_path", v)) if isinstance(v, Mapping) else str(v)
                                   for v in value)  # fmt: skip
        elif value is not None:
            flat[name] = value
    return flat


def versions() -> dict[str, str]:
    """Return the versions of the packages that results depend on."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def installed() -> list[str]:
    """Return every installed distribution as `name==version`, sorted."""
    return sorted({f"{d.metadata['Name']}=={d.version}" for d in metadata.distributions()}, key=str.lower)


def git_state(folder: Path) -> dict[str, str]:
    """Return commit and whether the tree is changed, of the project's checkout or of `folder`; {} without."""
    for place in (Path(__file__).resolve().parent, folder):
        try:
            commit = _git(place, "rev-parse", "HEAD")
            dirty = bool(_git(place, "status", "--porcelain", "--untracked-files=no"))
        except (OSError, subprocess.SubprocessError):
            continue
        return {"git.commit": commit, "git.changed": str(dirty).lower()}
    return {}


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=20
    )
    return done.stdout.strip()
