"""What a command line of `trainer fit` means, found out before anything is started for it."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainer import configs
from trainer.configs import UsageError
from trainer.training import TRACKING, TrainingCLI, quiet_libraries

OWN = {
    "trainer.devices": "--workers",
    "trainer.num_nodes": "--workers",
    "trainer.accelerator": "--gpus-per-worker",
}
"""Options of `trainer fit` that the cluster decides, and what decides them there."""

STRATEGIES = {
    "auto": {},
    "ddp": {},
    "ddp_find_unused_parameters_false": {},
    "ddp_find_unused_parameters_true": {"find_unused_parameters": True},
}
"""Names of strategies that run on Ray, and what they mean for `DDPStrategy`."""


@dataclass(frozen=True)
class Training:
    """A training as it is handed to other machines.

    Attributes:
        arguments: Command line of `trainer fit`; files of configurations appear as `{0}`, `{1}` …
        files: Their contents.
        root: Folder of all runs.
        experiment: Name of the experiment.
        tracking_uri: Configured tracking store, None for that of the environment or the local one.
    """

    arguments: tuple[str, ...]
    files: tuple[str, ...]
    root: str
    experiment: str
    tracking_uri: str | None = None

    def restored(self, folder: Path) -> list[str]:
        """Write the configurations into a folder, and return the command line that names them."""
        names = []
        for number, text in enumerate(self.files):
            path = folder / f"config-{number}.yaml"
            path.write_text(text)
            names.append(str(path))
        return [_placed(argument, names) for argument in self.arguments]


class _Checking(TrainingCLI):
    """Parses a command line as `trainer fit` does and stops there."""

    def instantiate_classes(self) -> None:
        """Build nothing."""

    def _restarted(self, config: Any, logger: Any) -> bool:
        """Look for no run to go on with."""
        return False

    def _parse_ckpt_path(self) -> None:
        """Read no checkpoint: it may lie where only the workers see it."""

    def _run_subcommand(self, subcommand: str) -> None:
        """Train nothing."""


def parsed(arguments: Sequence[str]) -> Any:
    """Return the configuration that a command line of `trainer fit` resolves to.

    Raises:
        UsageError: An option or a value is wrong.
    """
    quiet_libraries()
    before = sys.argv
    sys.argv = ["trainer", "fit", *_without_checkpoint(arguments)]
    try:
        cli = _Checking()
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(str(error)) from None
    finally:
        sys.argv = before
    return cli.config["fit"]


def check_training(arguments: Sequence[str]) -> Training:
    """Return the training that a command line of `trainer fit` describes.

    Raises:
        UsageError: An option or a value is wrong, or has no place in a cluster.
    """
    for argument in arguments:
        name = argument.removeprefix("--").partition("=")[0]
        if argument.startswith("--") and name in OWN:
            raise UsageError(f"--{name} is decided by the cluster: use {OWN[name]} instead")
    config = parsed(configs.resolve_arguments(list(arguments)))
    strategy_options(config.trainer.strategy)
    logger = config.trainer.logger
    tracked = getattr(logger, "class_path", None) == TRACKING
    texts: list[str] = []
    shipped = tuple(_taken(configs.resolve_arguments(list(arguments)), texts))
    return Training(
        shipped,
        tuple(texts),
        str(logger.init_args.root) if tracked else "runs",
        str(logger.init_args.experiment) if tracked else "penumbra",
        logger.init_args.tracking_uri if tracked else None,
    )


def strategy_options(given: Any) -> dict[str, Any]:
    """Return the options of `DDPStrategy` that a configured strategy means.

    Args:
        given: A name, a `DDPStrategy`, or its configuration.

    Raises:
        UsageError: It does not run on Ray.
    """
    if isinstance(given, str) and given in STRATEGIES:
        return dict(STRATEGIES[given])
    path = getattr(given, "class_path", None)
    if path is not None and str(path).endswith(".DDPStrategy"):
        return {}
    from lightning.pytorch.strategies import DDPStrategy

    if isinstance(given, DDPStrategy):
        return dict(given._ddp_kwargs)
    raise UsageError(
        f"--trainer.strategy {path or given}: on a cluster trainings run with {', '.join(STRATEGIES)} or a "
        "configured DDPStrategy"
    )


def _without_checkpoint(arguments: Sequence[str]) -> Iterator[str]:
    skip = False
    for argument in arguments:
        if not skip and argument != "--ckpt_path" and not argument.startswith("--ckpt_path="):
            yield argument
        skip = argument == "--ckpt_path"


def _taken(arguments: Sequence[str], texts: list[str]) -> Iterator[str]:
    """Yield the arguments with numbers for configuration files, whose contents are added to a list."""
    expecting = False
    for argument in arguments:
        if expecting or argument.startswith("--config="):
            name = argument.removeprefix("--config=") if not expecting else argument
            texts.append(Path(name).read_text())
            word = f"{{{len(texts) - 1}}}"
            yield word if expecting else f"--config={word}"
            expecting = False
            continue
        expecting = argument in ("--config", "-c")
        yield argument


def _placed(argument: str, names: Sequence[str]) -> str:
    for number, name in enumerate(names):
        if argument in (f"{{{number}}}", f"--config={{{number}}}"):
            return argument.replace(f"{{{number}}}", name)
    return argument
