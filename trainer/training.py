"""`trainer fit`, `validate` and `test`: LightningCLI with our defaults, messages and resuming."""

from __future__ import annotations

import difflib
import inspect
import logging
import os
import re
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.cli import ArgsType, LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities import rank_zero_only

from data.alive import ALIVE
from models.denoiser import Denoiser
from trainer import configs, runs
from trainer.callbacks.alive import Alive
from trainer.callbacks.mirror import MirrorRun
from trainer.callbacks.recorder import RunRecorder
from trainer.callbacks.same_start import SameStart
from trainer.elastic import heed_failures, join_ranks
from trainer.modules.evaluation import Evaluated
from trainer.tracking import MLflowTracking

TRACKING = "trainer.tracking.MLflowTracking"
TOP_LEVEL = ("model", "data", "trainer", "config", "print_config", "ckpt_path", "seed_everything")


def run_training(verb: str, arguments: list[str]) -> int:
    """Run one of the training verbs with command-line arguments; returns the exit code."""
    quiet_libraries()
    # LightningCLI reads sys.argv, and so do the processes that its DDP launcher starts.
    sys.argv = [sys.argv[0], verb, *configs.resolve_arguments(arguments)]
    try:
        cli = TrainingCLI()
    except AlreadyTrainedError as done:
        if getattr(rank_zero_only, "rank", 0) == 0:
            print(done, file=sys.stderr)
        return 0
    if verb != "fit" and cli.trainer.is_global_zero:
        from trainer.reports.tables import print_scores

        print_scores(cli.trainer.callback_metrics, "val" if verb == "validate" else "test")
    return 0


class AlreadyTrainedError(Exception):
    """A restart came for a training that has ended well."""


def quiet_libraries() -> None:
    """Silence messages that tell a user nothing; everything else stays."""
    for name in ("lightning.pytorch", "lightning.fabric", "torch.onnx", "onnxscript"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message, category in (
        (r".*LeafSpec.*", FutureWarning),  # lightning 2.6 on torch 2.13
        (r".*does not have many workers.*", UserWarning),  # the loader's own choice
        (r"Checkpoint directory .* exists and is not empty", UserWarning),  # a resumed run
        (r".*is smaller than the logging interval.*", UserWarning),
        (r"Grad strides do not match bucket view strides", UserWarning),  # of 1x1 kernels, where both are one
        (
            r"It is recommended to use .*sync_dist=True",
            UserWarning,
        ),  # scores are reduced before they are logged
        (r".*callbacks used to create the checkpoint need to be provided.*", UserWarning),  # test, validate
    ):
        warnings.filterwarnings("ignore", message, category)


class Parser(LightningArgumentParser):
    """Argument parser whose errors name what was probably meant."""

    def error(self, message: str, ex: Exception | None = None) -> None:  # type: ignore[override]
        """Raise instead of printing the usage, which has hundreds of lines here.

        Raises:
            UsageError: Always.
        """
        raise configs.UsageError(explain(message, self.known_names())) from ex

    def known_names(self) -> set[str]:
        """Return every option name and every argument of the classes that can be configured."""
        names: set[str] = set(self.get_defaults(skip_validation=True).keys())
        names |= {part for key in names for part in key.split(".")}
        return names | class_arguments()


def class_arguments() -> set[str]:
    """Return constructor arguments of our modules, networks, losses and callbacks."""
    import data
    import models
    import trainer.callbacks
    import trainer.losses
    import trainer.modules
    import trainer.schedules
    from models.critic import Critic
    from trainer.tracking import MLflowTracking

    classes: list[Any] = [data.Shards, MLflowTracking, Critic]
    for module in (models, trainer.callbacks, trainer.losses, trainer.modules, trainer.schedules):
        classes += [
            value
            for _, value in inspect.getmembers(module, inspect.isclass)
            if value.__module__.split(".")[0] in ("models", "trainer")  # torch.Tensor has no signature
        ]
    return {name for cls in classes for name in inspect.signature(cls).parameters}


def explain(message: str, known: Iterable[str]) -> str:
    """Return jsonargparse's message in short, with the nearest known name where one was misspelt."""
    lines = [line.strip(" -\n") for line in message.splitlines() if line.strip()]
    text = " ".join(dict.fromkeys(lines))
    wrong = re.search(
        r"(?:[Uu]nrecognized arguments: --|Option '|Key '|(?<!Parser )key \"|No such option '?)([\w.+]+)",
        text,
    )
    if wrong is None:
        value = re.search(r"((?:Parser key \"[\w.]+\": )+)Expected (?:an? )?(.+?)\. Got value: (\S+)", text)
        if value is None:
            return text
        option = ".".join(re.findall(r"\"([\w.]+)\"", value.group(1)))
        return f"option {option!r}: expected {value.group(2)}, got {value.group(3)}"
    word = wrong.group(1)
    known = sorted(set(known))
    near = difflib.get_close_matches(word, TOP_LEVEL, n=1) if "." not in word else []
    near = near or difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if not near:
        leaf = difflib.get_close_matches(word.rsplit(".", 1)[-1], known, n=1, cutoff=0.6)
        near = [f"{word.rpartition('.')[0]}.{leaf[0]}".lstrip(".")] if leaf else []
    hint = f"; did you mean {near[0]!r}?" if near else ""
    if not hint:
        return text
    # Where classes are nested jsonargparse tells of every class that was tried.
    return f"unknown option {word!r}{hint}" + ("" if "Does not validate" in text else f" ({text[:300]})")


def refused(message: str) -> str:
    """Return why a class refused its arguments, from jsonargparse's account of everything it tried."""
    if not message.startswith("Does not validate"):
        return message
    reasons = re.findall(r"^ *- (?!Expected a)(.+)$", message.partition("Given value type")[0], re.MULTILINE)
    return "; ".join(dict.fromkeys(reasons)) or message


def net_inputs(net: Denoiser) -> tuple[str, ...]:
    """Return the buffers that the data module must deliver."""
    return net.inputs


def net_targets(net: Denoiser) -> tuple[str, ...]:
    """Return the buffers that training compares with."""
    return net.targets


def net_temporal(net: Denoiser) -> bool:
    """Return whether the network expects accumulated input."""
    return net.temporal


class TrainingCLI(LightningCLI):
    """LightningCLI with shipped defaults, `--ckpt_path last|best`, and continuing the same MLflow run."""

    def __init__(self, args: ArgsType = None) -> None:
        defaults = [str(configs.folder() / configs.DEFAULTS)]
        kwargs: dict[str, Any] = {verb: {"default_config_files": defaults} for verb in self.subcommands()}
        kwargs["allow_abbrev"] = False  # the parsers of the verbs inherit it
        super().__init__(
            LightningModule,
            LightningDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            save_config_callback=RunRecorder,
            save_config_kwargs={"save_to_log_dir": False},
            parser_class=Parser,
            parser_kwargs=kwargs,
            seed_everything_default=1,
            auto_configure_optimizers=False,
            args=args,
        )

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Return the verbs that are Lightning's."""
        verbs = LightningCLI.subcommands()
        return {verb: verbs[verb] for verb in ("fit", "validate", "test")}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Let the data module deliver what the network reads."""
        net = "model.init_args.net"
        parser.link_arguments(net, "data.init_args.buffers", compute_fn=net_inputs, apply_on="instantiate")
        parser.link_arguments(net, "data.init_args.targets", compute_fn=net_targets, apply_on="instantiate")
        parser.link_arguments(net, "data.init_args.temporal", compute_fn=net_temporal, apply_on="instantiate")

    def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
        """Parse, then find the checkpoint that is meant and the run that it belongs to."""
        super().parse_arguments(parser, args)
        config = self.config[self.config.subcommand]
        evaluation = self.config.subcommand != "fit"
        if evaluation:
            config.verbose = False
        logger = config.trainer.logger
        tracked = getattr(logger, "class_path", None) == TRACKING
        if tracked and not evaluation and self._restarted(config, logger.init_args):
            return
        if config.ckpt_path or evaluation:
            root = Path(logger.init_args.root if tracked else "runs")
            experiment = logger.init_args.experiment if tracked else "penumbra"
            find = evaluated if evaluation else runs.find_checkpoint
            config.ckpt_path = str(find(config.ckpt_path or "", root, experiment))
            folder = runs.folder_of_checkpoint(Path(config.ckpt_path))
            if tracked and folder is not None:
                logger.init_args.resume_from = str(folder)
                logger.init_args.evaluation = evaluation
            elif evaluation:
                config.trainer.logger = False
        if evaluation:
            keep = ("TrainingProgress",)
            config.trainer.callbacks = [
                c for c in config.trainer.callbacks or [] if c.class_path.endswith(keep)
            ]

    def _restarted(self, config: Any, logger: Any) -> bool:
        """Continue the run of this launch where it is a restart; returns whether it is.

        A run that was killed before its first checkpoint starts again in the same folder and MLflow run.
        """
        launch = runs.current_launch()
        root, experiment = Path(logger.root), logger.experiment
        folder = launch and runs.run_of_launch(launch, root, experiment)
        if not folder:
            done = launch and runs.finished_by_launch(launch, root, experiment)
            if done:
                raise AlreadyTrainedError(
                    f"restarted: the run {done.name} is finished, nothing is left to do"
                )
            return False
        newest = runs.checkpoint_of_launch(folder)
        config.ckpt_path = str(newest) if newest else None
        logger.resume_from = str(folder)
        if getattr(rank_zero_only, "rank", 0) == 0:  # Lightning sets the attribute on its function
            place = f"from {newest}" if config.ckpt_path else "from its beginning, it has no checkpoint yet"
            print(f"restarted: the run {folder.name} goes on {place}", file=sys.stderr)
        return True

    def _run_subcommand(self, subcommand: str) -> None:
        """Run the verb, and mirror its end, of which no hook of a callback hears."""
        try:
            super()._run_subcommand(subcommand)
        finally:
            for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, MirrorRun):
                    callback.finish()

    def before_fit(self) -> None:
        """Note in the run's folder which launch trains it."""
        self.launch = runs.current_launch()
        logger = self.trainer.logger
        if self.launch and self.trainer.is_global_zero and isinstance(logger, MLflowTracking):
            runs.begin_launch(logger.folder, self.launch, self.config.fit.ckpt_path)

    def after_fit(self) -> None:
        """Note that the run is complete."""
        logger = self.trainer.logger
        if self.launch and self.trainer.is_global_zero and isinstance(logger, MLflowTracking):
            runs.end_launch(logger.folder)

    def instantiate_classes(self) -> None:
        """Build everything, and say early which options of the trainer have no effect."""
        try:
            super().instantiate_classes()
        except ValueError as error:
            raise ValueError(refused(str(error))) from error
        check_manual(self.model, self.trainer)
        if self.config.subcommand != "test":  # there all samples are whole frames
            check_clips(self.model, self.datamodule)
        join_ranks(self.trainer)
        heed_failures(self.trainer)
        more = [SameStart()] * (self.trainer.world_size > 1) + [Alive()] * bool(os.environ.get(ALIVE))
        self.trainer.callbacks.extend(more)  # type: ignore[attr-defined]  # Lightning types it on use

    def _parse_ckpt_path(self) -> None:
        """Compare the checkpoint's network, and a critic that goes on training, with the configured ones.

        Lightning would silently replace the configuration by the checkpoint's.

        Raises:
            ValueError: The checkpoint is damaged or holds another network.
        """
        config = self.config[self.config.subcommand]
        if config.ckpt_path:
            arguments = config.model.init_args
            check_checkpoint(
                Path(config.ckpt_path), arguments.net,
                critics=expected_critics(arguments) if self.config.subcommand == "fit" else None,
            )  # fmt: skip


def evaluated(word: str, root: Path, experiment: str) -> Path:
    """Return the checkpoint that `validate` and `test` score.

    Of a run, the newest one where nothing is named, that is the best by validation, or the last where no
    validation has chosen one.

    Args:
        word: As for `fit`, or empty.
        root: Folder of all runs.
        experiment: Whose runs.

    Raises:
        ValueError: There is none; the message says where it was looked for.
    """
    named = Path(word) if word else None
    if named is not None and not named.is_dir():
        return runs.find_checkpoint(word, root, experiment)
    folders = [named] if named is not None else runs.run_folders(root, experiment)[::-1]
    for folder in folders:
        for name in ("best", "last"):
            path = folder / "checkpoints" / f"{name}.ckpt"
            if path.is_file():
                if name == "last":
                    print(f"note: no validation chose a best checkpoint, scoring {path}", file=sys.stderr)
                return path
    place = named or f"no run of {experiment!r} below {root / experiment}"
    holds = "holds no checkpoint" if named else "has a checkpoint"
    raise ValueError(f"{place} {holds}; train one first with `trainer fit`, or give --ckpt_path FILE")


def check_manual(module: LightningModule, trainer: Trainer) -> None:
    """Raise a ValueError where a module that optimises by hand has options of its own for the trainer's."""
    if module.automatic_optimization:
        return
    name = type(module).__name__
    if trainer.gradient_clip_val:
        raise ValueError(
            f"{name} clips the gradient of each network itself: "
            f"use --model.gradient_clip {trainer.gradient_clip_val:g} and --trainer.gradient_clip_val null"
        )
    if trainer.accumulate_grad_batches != 1:
        raise ValueError(
            f"{name} accumulates gradients itself: use --model.accumulate {trainer.accumulate_grad_batches} "
            "and --trainer.accumulate_grad_batches 1"
        )


def check_clips(module: LightningModule, data: Any) -> None:
    """Raise a ValueError where a module trains on clips and the data are images, or the other way round."""
    frames = getattr(data, "frames", None)
    if not isinstance(module, Evaluated) or not isinstance(frames, int) or module.clips == (frames > 1):
        return
    name = type(module).__name__
    if module.clips:
        raise ValueError(
            f"{name} trains on clips, and the data are single frames: use --data.recipe recurrent, or "
            "--data.frames N with shards of clips"
        )
    raise ValueError(
        f"{name} trains on single frames, and the data are clips of {frames} frames: leave out --data.recipe "
        "recurrent and --data.frames; clips are for networks with a memory, which trainer.modules.Sequence "
        "trains"
    )


def expected_critics(arguments: Any) -> str:
    """Return the critic that a configuration trains with, described, or nothing where it has none."""
    critic = arguments.get("critic")
    return _described(critic.as_dict()) if critic and arguments.get("adversarial_weight") else ""


def check_checkpoint(path: Path, net: Any, critics: str | None = None) -> None:
    """Raise a ValueError unless the checkpoint can be read and holds what is configured.

    Args:
        path: The checkpoint.
        net: The configured network.
        critics: The configured critic, described; empty for a training without; None: does not matter.
    """
    from trainer.reading import network_of, plain, read_checkpoint

    checkpoint = read_checkpoint(path)
    if "hyper_parameters" not in checkpoint:
        raise ValueError(f"{path} is not a checkpoint of `trainer fit`")
    class_path, settings = network_of(checkpoint, path)
    arguments = plain(
        {name: checkpoint["hyper_parameters"].get(name) for name in ("critic", "adversarial_weight")}, path
    )
    held, wanted = _described({"class_path": class_path, "init_args": settings}), _described(net.as_dict())
    if held != wanted:
        raise ValueError(
            f"{path} holds {held}, but the configuration asks for {wanted}; "
            "give the configuration that it was trained with"
        )
    critic = arguments.get("critic") if arguments.get("adversarial_weight") else None
    if critic and not (isinstance(critic, dict) and "class_path" in critic):
        raise ValueError(f"{path} is damaged: its critic is no mapping with a class_path")
    held = _described(critic) if critic else ""
    if critics is not None and held != critics:
        raise ValueError(
            f"{path} was trained with {held or 'no critic'}, but the configuration asks for "
            f"{critics or 'none'}; give the configuration that it was trained with"
        )


def _described(net: dict[str, Any]) -> str:
    arguments = {**(net.get("init_args") or {})}
    return f"{net['class_path']}({', '.join(f'{k}={v}' for k, v in sorted(arguments.items()))})"
