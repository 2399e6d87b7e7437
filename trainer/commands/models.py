"""`trainer models`: list the denoisers and the registered models."""

from __future__ import annotations

import argparse
import inspect
import textwrap
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient
    from rich.console import Console

HELP = "list denoisers and registered models, or the options of denoisers"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="print the options of these denoisers, such as NFOR, instead of the lists",
    )
    parser.add_argument(
        "--tracking-uri",
        metavar="URI",
        help="MLflow store to list (default: MLFLOW_TRACKING_URI, or runs/mlflow.db below this directory)",
    )


def run(args: argparse.Namespace) -> int:
    """Print both lists, or the options of the named denoisers; returns the exit code.

    Raises:
        FileNotFoundError: There is no denoiser of that name.
        ValueError: A store was named and cannot be read.
    """
    from rich.console import Console

    import models
    from trainer.loading import model_store

    console = Console()
    if args.names:
        _print_options(console, args.names)
        return 0
    console.print(denoiser_table())
    for name in models.__all__:
        console.print(f"models.{name}: {reference(getattr(models, name))}", highlight=False)
    console.print("`trainer models NAME` prints the options of a denoiser.\n", highlight=False)
    try:
        store = model_store(args.tracking_uri)
    except ValueError as error:
        console.print(f"No registered models: {error}", highlight=False)
        return 0
    console.print(registered_table(store))
    return 0


def _print_options(console: Console, names: list[str]) -> None:
    from trainer.building import class_path_of, find_class

    for name in names:
        class_path = class_path_of(name.removeprefix("models."), "trainer models")
        cls = find_class(class_path)
        console.print(f"{class_path}: {(inspect.getdoc(cls) or '').splitlines()[0]}", highlight=False)
        for line in option_lines(cls, console.width):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        trained = next(cls().parameters(), None) is not None
        use = (
            "in a configuration: --model.init_args.net.init_args.OPTION VALUE"
            if trained
            else f"trainer denoise --model {name} --option OPTION=VALUE …"
        )
        console.print(f"{use}\n", highlight=False, markup=False)


def option_lines(cls: type, width: int) -> list[str]:
    """Return for every argument of a denoiser's constructor its default, what it may be, what it means."""
    from trainer.options import options_of

    lines = []
    for option in options_of(cls).values():
        lines.append(f"  {option.name}={option.shown_default}   ({option.expected})")
        lines += textwrap.wrap(option.meaning, min(width, 100) - 8, initial_indent=" " * 6,
                               subsequent_indent=" " * 6)  # fmt: skip
    return lines


def denoiser_table() -> Any:
    """Return a table with a row for every denoiser of `models.__all__`, built with its defaults."""
    from rich.table import Table

    import models

    table = Table(title="Denoisers", title_justify="left")
    for title in ("class", "inputs", "parameters", "deployed", "halo", "temporal"):
        right = title in ("parameters", "deployed", "halo")
        table.add_column(title, justify="right" if right else "left", overflow="fold")
    for name in models.__all__:
        cls = getattr(models, name)
        denoiser = cls()
        counts = [sum(p.numel() for p in net.parameters()) for net in (denoiser, denoiser.deploy())]
        table.add_row(
            f"models.{name}",
            ", ".join(denoiser.inputs),
            *(f"{count:,}" if count else "none" for count in counts),
            str(denoiser.halo),
            "yes" if denoiser.temporal else "no",
        )
    return table


def reference(cls: type) -> str:
    """Return the paper of a denoiser.

    That is the paragraph of its module's docstring with a DOI, else the first line of its own docstring.
    """
    module = inspect.getmodule(cls)
    for paragraph in (inspect.getdoc(module) or "").split("\n\n"):
        if "doi:" in paragraph:
            return " ".join(paragraph.split())
    return (inspect.getdoc(cls) or "").split("\n", 1)[0]


def registered_table(store: str) -> Any:
    """Return a table with a row for every registered model version of a store.

    Raises:
        ValueError: The store cannot be read.
    """
    from rich.table import Table

    table = Table(title=f"Registered models in {store}", title_justify="left")
    for title in ("URI", "aliases", "run", "created"):
        table.add_column(title, overflow="fold")
    for row in registered_rows(store):
        table.add_row(*row)
    return table


def registered_rows(store: str) -> list[tuple[str, str, str, str]]:
    """Return URI, aliases, run and date of every registered model version of a store.

    Raises:
        ValueError: The store cannot be read.
    """
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    from trainer.tracking import open_client

    try:
        return _rows(open_client(store))
    except (MlflowException, SQLAlchemyError, OSError) as error:
        first = (str(error).splitlines() or [repr(error)])[0].strip()
        raise ValueError(f"cannot read the model store {store}: {first}") from error


def _rows(client: MlflowClient) -> list[tuple[str, str, str, str]]:
    rows = []
    for model in sorted(client.search_registered_models(), key=lambda m: m.name):
        aliases: dict[str, list[str]] = {}
        for alias, version in client.get_registered_model(model.name).aliases.items():
            aliases.setdefault(str(version), []).append(f"@{alias}")
        versions = client.search_model_versions(f"name = '{model.name}'")
        for version in sorted(versions, key=lambda v: int(v.version)):
            row = (
                f"models:/{model.name}/{version.version}",
                " ".join(aliases.get(str(version.version), [])),
                version.run_id or "",
                _date(version.creation_timestamp),
            )
            rows.append(row)
    return rows


def _date(milliseconds: int | None) -> str:
    from datetime import datetime

    return "" if milliseconds is None else f"{datetime.fromtimestamp(milliseconds / 1000):%Y-%m-%d %H:%M}"
