"""What each variant of an ablation trains, found out and checked before anything is trained."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainer import configs
from trainer.ablation.plan import Ablation, Variant
from trainer.cluster.checked import parsed
from trainer.cluster.space import options
from trainer.configs import UsageError
from trainer.runs import SUBMITTED, Launch
from trainer.training import TRACKING

LEFT_OUT = ("ExportBest", "ValidationPictures")
"""Callbacks that variants do without: a model would be registered, and pictures drawn, for each of them."""

_SHOWING = "TrainingProgress"
_ELSEWHERE = ("config", "__default_config__", "ckpt_path", "trainer")
"""Parts of a configuration that say nothing of a training, or are told apart."""


@dataclass(frozen=True)
class Training:
    """One variant as a command line of `trainer fit`.

    Attributes:
        variant: Whose.
        arguments: Of `trainer fit`, without those that are the same for all.
        digest: Tells what is trained from anything else.
        root: Folder of all runs.
        experiment: Of its run.
        tracking_uri: Configured tracking store, None for that of the environment or the local one.
        data: Root of the data set.
        callbacks: As configured, but for those that are left out.
    """

    variant: Variant
    arguments: tuple[str, ...]
    digest: str
    root: Path
    experiment: str
    tracking_uri: str | None
    data: str
    callbacks: tuple[Mapping[str, Any], ...]

    def launch(self, ablation: str) -> Launch:
        """Return the launch by which the run is found again.

        Args:
            ablation: Identifier of the ablation.
        """
        return Launch(f"{SUBMITTED}ablation {ablation} {self.digest}", unfinished=True)

    def command(self, tags: Mapping[str, str]) -> list[str]:
        """Return the arguments of `trainer fit`, with tags for the run."""
        tagging = {"class_path": "trainer.callbacks.RunTags", "init_args": {"tags": dict(tags)}}
        return [*self.arguments, f"--trainer.callbacks={json.dumps([*self.callbacks, tagging])}"]


def trainings_of(ablation: Ablation, rest: Sequence[str]) -> list[Training]:
    """Return what the variants train.

    Args:
        ablation: The variants.
        rest: Options of `trainer fit` for all of them. A variant's own options count where both set a value.

    Raises:
        UsageError: A configuration, an option or a value is wrong; names the variant. Or variants are trained
            on different data, or two of them are the same.
    """
    found: list[Training] = []
    for variant in ablation.variants:
        try:
            found.append(_training(variant, ablation.name, rest))
        except UsageError as error:
            raise UsageError(f"variant {variant.name!r}: {error}") from None
    if len(roots := {training.data: training.variant.name for training in found}) > 1:
        told = ", ".join(f"{root} ({name})" for root, name in roots.items())
        raise UsageError(
            f"variants are compared on one data set, but are trained on {told}; give --data.root"
        )
    seen: dict[str, str] = {}
    for training in found:
        name = training.variant.name
        if (same := seen.setdefault(training.digest, name)) != name:
            raise UsageError(f"variants {same!r} and {name!r} are the same training")
    return found


def _training(variant: Variant, experiment: str, rest: Sequence[str]) -> Training:
    files = [word for name in variant.configs for word in ("--config", configs.resolve(name))]
    own = f"--trainer.logger.init_args.experiment={experiment}"
    # Command lines of `trainer fit` are read from left to right.
    given = configs.resolve_arguments(list(rest))
    common = options(dict(variant.common))
    arguments = [*files, own, *common, *given, *options(dict(variant.options))]
    config = parsed(arguments).as_dict()
    if config.get("ckpt_path") or any(word.startswith("--ckpt_path") for word in rest):
        raise UsageError("--ckpt_path: variants are trained from their beginning; leave the option out")
    logger = _plain(config["trainer"].get("logger"))
    if not isinstance(logger, Mapping) or logger.get("class_path") != TRACKING:
        raise UsageError(
            f"--trainer.logger: runs of variants are found again by {TRACKING}; leave it as it is"
        )
    tracked = logger["init_args"]
    callbacks = [_plain(callback) for callback in config["trainer"].get("callbacks") or []]
    kept = tuple(c for c in callbacks if not c["class_path"].endswith(LEFT_OUT))
    return Training(
        variant,
        tuple(arguments),
        _digest(config, kept),
        Path(tracked["root"]),
        tracked["experiment"],
        tracked["tracking_uri"],
        str(config["data"]["init_args"]["root"]),
        kept,
    )


def _plain(value: Any, otherwise: Callable[[Any], Any] = lambda value: value) -> Any:
    """Return a part of a configuration as mappings and lists."""
    return value.as_dict() if hasattr(value, "as_dict") else otherwise(value)


def _digest(config: Mapping[str, Any], callbacks: Sequence[Mapping[str, Any]]) -> str:
    """Return what stands for a training; not for how it is recorded or shown, nor where its files lie."""
    trainer = {k: v for k, v in config["trainer"].items() if k not in ("logger", "callbacks")}
    told = {
        **{key: part for key, part in config.items() if key not in _ELSEWHERE},
        "trainer": trainer,
        "callbacks": [c for c in callbacks if not c["class_path"].endswith(_SHOWING)],
    }
    text = json.dumps(told, sort_keys=True, default=lambda value: _plain(value, str))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
