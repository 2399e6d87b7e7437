"""All that is made of the rows of an evaluation: tables, plots, pictures, its runs in MLflow, the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from trainer.evaluation.cells import Table
from trainer.evaluation.costs import cost_table, costs_of
from trainer.evaluation.plan import Setting
from trainer.evaluation.plots import write_plots
from trainer.evaluation.record import write_record, write_rows, write_tables
from trainer.evaluation.running import Outcome
from trainer.evaluation.scoring import PROCESSES, quiet
from trainer.evaluation.sheets import write_sheets
from trainer.evaluation.tables import Scored
from trainer.evaluation.tracking import EXPERIMENT, Tracked, keep_files, track, training_url
from trainer.reports.comparison import write_page
from trainer.spool.store import described, tracking_uri

Say = Callable[[str], None]


def write_results(
    outcomes: Sequence[Outcome],
    rows: pd.DataFrame,
    setting: Setting,
    say: Say,
    costs: bool = True,
    record: bool = True,
) -> tuple[list[Table], Tracked | None]:
    """Write everything, and record numbers; what costs most to make again comes first.

    Args:
        outcomes: Of the input and of all methods.
        rows: One per frame and method.
        setting: How they were made.
        say: Told what takes time, and where it is recorded.
        costs: Whether time and memory of the methods are measured.
        record: Whether it is recorded in MLflow; a store that cannot be used is told and loses nothing.

    Returns:
        The tables, and the runs in MLflow, which lack the files yet.

    Raises:
        OSError: A file cannot be read or written.
        ValueError: A picture is damaged.
    """
    labels, folder = [outcome.method.label for outcome in outcomes], setting.folder
    write_rows(rows, folder)
    measured = costs_of(outcomes, rows, setting, say) if costs else {}
    table = cost_table(measured, outcomes)
    tables = write_tables(rows, labels, setting, [table] if table else [])
    plots = partial(write_plots, folder, rows, Scored(rows, labels, setting.metrics), measured)
    with _drawn(plots, partial(write_sheets, folder, rows, outcomes)):
        tracked = _tracked(outcomes, rows, setting, say) if record else None
        write_record(outcomes, rows, setting, measured, _pages(outcomes, tracked))
        write_page(folder)
    return tables, tracked


@contextmanager
def _drawn(*tasks: Callable[[], Any]) -> Iterator[None]:
    """Draw in other processes meanwhile, and here where one was killed; raises as the tasks."""
    with ProcessPoolExecutor(len(tasks), PROCESSES, initializer=quiet) as pool:
        drawing = [pool.submit(task) for task in tasks]
        yield
        for task, drawn in zip(tasks, drawing, strict=True):
            try:
                drawn.result()
            except BrokenExecutor:
                task()


def record_files(tracked: Tracked, folder: Path, say: Say) -> None:
    """Record the files, and say where; a store that cannot be used is told and loses nothing."""
    with _telling(tracked.uri, say):
        keep_files(tracked, folder)
        page = f": {tracked.url()}" if tracked.url() else ""
        say(f"recorded in {described(tracked.uri)}, experiment {EXPERIMENT}{page}")


@contextmanager
def _telling(uri: str, say: Say) -> Iterator[None]:
    """Tell of a store that cannot be used."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (MlflowException, SQLAlchemyError, OSError) as error:
        first = (str(error).splitlines() or [repr(error)])[0]
        say(f"note: not recorded in {described(uri)}: {first}; run the command again to do so")


def _tracked(outcomes: Sequence[Outcome], rows: pd.DataFrame, setting: Setting, say: Say) -> Tracked | None:
    """Record what methods reached; None where the store cannot be used."""
    try:
        uri = tracking_uri(None)
    except OSError as error:
        say(f"note: not recorded in MLflow: {error}")
        return None
    with _telling(uri, say):
        return track(setting.folder, outcomes, rows, setting.metrics, uri)
    return None


def _pages(outcomes: Sequence[Outcome], tracked: Tracked | None) -> dict[str, dict[str, str | None]]:
    """Return label → the pages of its runs in MLflow; that of the evaluation under the empty label."""
    if tracked is None:
        return {}
    found: dict[str, dict[str, str | None]] = {"": {"run_url": tracked.url()}}
    for outcome in outcomes:
        label, model = outcome.method.label, outcome.method.model
        found[label] = {"run_url": tracked.url(label), "training_url": training_url(model, tracked.uri)}
    return found
