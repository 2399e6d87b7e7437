"""`trainer tune`: trials proposed by Optuna, stopped early by ASHA, run by Ray Tune.

Score and cost are both objectives of Optuna's search (multi-objective TPE). Optuna's own pruning does not
work with two objectives, and ASHA compares one number, which is the score here: at equal epochs a cheap
network with a lower score may be stopped although nothing that costs as little is better. That is why the
Pareto front is made of trained trials only, and `--no-early-stop` trains all.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from trainer.cluster.board import conduct, reason, sending
from trainer.cluster.checked import Training
from trainer.cluster.engine import Cluster, enter, forwarded
from trainer.cluster.fitting import Group, resources
from trainer.cluster.outcome import (
    FAILED,
    FINISHED,
    RUNNING,
    STOPPED,
    Trial,
    brief,
    ranked,
    table,
    write_results,
)  # fmt: skip
from trainer.cluster.space import Range
from trainer.cluster.trials import Sweep, run_trial
from trainer.outputs import write_whole
from trainer.runs import new_folder
from trainer.spool.journal import shown

STATE = "ray"
SWEEP_FILE = "search.json"


@dataclass(frozen=True)
class Search:
    """A search as it is kept in its folder, so that it can be resumed.

    Attributes:
        training: What is varied.
        space: What of it.
        trials: How many trials.
        group: The processes of each.
        metric: Logged number that is searched for.
        mode: `max` or `min`.
        epochs: Epochs of a whole training.
        grace: Epochs before a trial may be stopped.
        reduction: One in so many trials goes on at each of ASHA's rungs; 0: all are trained to the end.
        seed: Of the search.
        concurrent: Trials at one time, at most; 0: what the cluster has room for.
        folder: Working folder of the trials.
    """

    training: Training
    space: dict[str, Range]
    trials: int
    group: Group
    metric: str
    mode: str
    epochs: int
    grace: int
    reduction: int
    seed: int
    concurrent: int = 0
    folder: str = ""

    def save(self, folder: Path) -> None:
        """Write the search into its folder."""
        write_whole(folder / SWEEP_FILE, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> Search:
        """Read a search.

        Raises:
            ValueError: The folder holds none, or it is damaged.
        """
        path = folder / SWEEP_FILE
        try:
            values = json.loads(path.read_text())
            training = values["training"] | {k: tuple(values["training"][k]) for k in ("arguments", "files")}
            values["training"], values["group"] = Training(**training), Group(**values["group"])
            space = values["space"]
            values["space"] = {k: Range(v["kind"], tuple(v["values"])) for k, v in space.items()}
            return cls(**values)
        except FileNotFoundError:
            raise ValueError(f"--resume {folder}: no search was made there, it has no {SWEEP_FILE}") from None
        except (json.JSONDecodeError, TypeError, KeyError) as error:
            raise ValueError(f"{path} is damaged: {error}") from None


def run_search(search: Search, address: str | None, results: Path | None = None) -> int:
    """Run a search on Ray and print how it goes; returns the exit code.

    Args:
        search: What to search.
        address: A running Ray, or None for one on this machine.
        results: Folder of a search that is resumed; None: a new one is made.

    Raises:
        ValueError: Ray is missing, or the cluster has another release, or too little for a trial.
        OSError: The cluster cannot be reached.
        KeyboardInterrupt: Ctrl-C, after the search was stopped.
    """
    group = search.group
    cluster = Cluster(address, group.workers, group.cpus, group.gpus)
    return conduct(cluster, _Searcher, search, str(results or ""), forwarded(address))


class _Searcher:
    """Conducts a search from within the cluster."""

    def run(self, search: Search, results: str, environment: dict[str, str], board: Any) -> None:
        """Run the trials, and write what they found."""
        import ray

        with sending(board):
            try:
                enter(search.folder, environment)
                code, message = _conduct(search, results, environment, board), ""
            except (ValueError, OSError) as error:
                code, message = 1, str(error)
        ray.get(board.end.remote(code, message))


def _conduct(search: Search, folder: str, environment: dict[str, str], board: Any) -> int:
    from trainer.cluster.parent import ParentRun

    training, group = search.training, search.group
    results = Path(folder) if folder else new_folder(Path(training.root), "tune").absolute()
    search.save(results)
    parent = ParentRun(search, results)
    names = (search.folder, environment, search.metric, search.mode, parent.run_id)
    sweep = Sweep(results.name, training, group, *names)
    threading.Thread(target=_interrupt, args=(board,), daemon=True).start()
    trials: list[Trial] = []
    try:
        grid = _tuner(search, sweep, results, bool(folder)).fit()
        trials = ranked([_trial(result) for result in grid], search.mode)
        return _tell(search, results, trials, parent)
    finally:
        parent.end(trials)


def _tell(search: Search, results: Path, trials: list[Trial], parent: Any) -> int:
    """Print and keep what a search has found; returns its exit code."""
    parent.settle(trials)
    written = write_results(results, trials, search.metric, search.mode)
    print(table(trials, search.metric), flush=True)
    parent.keep(trials, written)
    best = next((trial for trial in trials if trial.best), None)
    if any(trial.state == RUNNING for trial in trials):
        print(f"next: trainer tune --resume {shown(results)}", flush=True)
    print(f"results: {results} ({', '.join(path.name for path in written)})", flush=True)
    if (results / "best.yaml").is_file() and best is not None:
        print(f"next: trainer fit --config {shown(results / 'best.yaml')}", flush=True)
    return 0 if best is not None else 1


def _interrupt(board: Any) -> None:
    """Interrupt Ray Tune when the submitter asks for it; it then keeps its state.

    By the signal that it takes beside Ctrl-C's: processes of a cluster have that one blocked.
    """
    import ray

    while not ray.get(board.cancelled.remote()) or not callable(signal.getsignal(signal.SIGUSR1)):
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGUSR1)


def _tuner(search: Search, sweep: Sweep, results: Path, resume: bool) -> Any:
    import optuna
    from ray import tune
    from ray.tune.search.optuna import OptunaSearch

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    trainable = tune.with_resources(tune.with_parameters(run_trial, sweep=sweep), _resources(search.group))
    state = results / STATE
    if resume and tune.Tuner.can_restore(str(state)):
        return tune.Tuner.restore(
            str(state), trainable, resume_unfinished=True, restart_errored=True, param_space=_domains(search)
        )
    scheduler = None
    if search.reduction:
        scheduler = tune.schedulers.ASHAScheduler(
            time_attr="epoch",
            metric="score",
            mode=search.mode,
            max_t=search.epochs + 1,  # the last epoch is for the training itself to end
            grace_period=search.grace,
            reduction_factor=search.reduction,
        )
    return tune.Tuner(
        trainable,
        param_space=_domains(search),
        tune_config=tune.TuneConfig(
            num_samples=search.trials,
            search_alg=OptunaSearch(metric=["score", "cost"], mode=[search.mode, "min"], seed=search.seed),
            scheduler=scheduler,
            max_concurrent_trials=search.concurrent or _room(search.group),
        ),
        run_config=tune.RunConfig(
            name=STATE,
            storage_path=str(results),
            verbose=0,
            failure_config=tune.FailureConfig(max_failures=search.group.max_failures),
            callbacks=[_telling(search)],
        ),
    )


def _domains(search: Search) -> dict[str, Any]:
    return {key: entry.domain() for key, entry in search.space.items()}


def _resources(group: Group) -> Any:
    from ray import tune

    one = resources(group)
    if group.workers == 1:
        return one
    # The processes of a trial reserve their own, so that this one, which waits for them, must not take a part
    # of a core from them. It has to reserve something: a byte.
    return tune.PlacementGroupFactory([{"memory": 1}])


def _room(group: Group) -> int | None:
    """Return how many trials the cluster has room for at one time, where Ray Tune does not see it itself."""
    if group.workers == 1:
        return None
    import ray

    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    one = resources(group).items()
    places = sum(int(min(node.get(kind, 0) // each for kind, each in one if each)) for node in nodes)
    return max(1, places // group.workers)


def _telling(search: Search) -> Any:
    from ray import tune

    class Telling(tune.Callback):
        """Prints a line for what happens to trials."""

        def on_trial_start(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            values = ", ".join(f"{key.rpartition('.')[2]} {brief(v)}" for key, v in trial.config.items())
            _say(f"{len(trials)}/{search.trials} {trial.trial_id} starts: {values}")

        def on_trial_result(
            self, iteration: int, trials: Any, trial: Any, result: dict[str, Any], **info: Any
        ) -> None:
            _say(
                f"{trial.trial_id} epoch {result['epoch']}/{search.epochs}: {search.metric} "
                f"{result['score']:.4g}, {result['cost']:.0f} ms/Mpx"
            )

        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            _say(f"{trial.trial_id} {_state(trial.last_result)}")

        def on_trial_error(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            _say(f"{trial.trial_id} failed: {_why(trial)}")

    return Telling()


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _why(trial: Any) -> str:
    return reason(trial.get_error() or "its process died")


def _state(numbers: Mapping[str, Any]) -> str:
    """Return what became of a trial that has ended, by its last report."""
    return FINISHED if numbers.get("trained") else STOPPED


def _trial(result: Any) -> Trial:
    numbers = result.metrics or {}
    trial = Trial(str(numbers.get("trial_id") or Path(str(result.path)).name), dict(result.config or {}))
    if "epoch" in numbers:
        trial = replace(
            trial,
            score=float(numbers["score"]),
            cost=float(numbers["cost"]),
            epoch=int(numbers["epoch"]),
            run=str(numbers["run"]),
            state=_state(numbers) if numbers.get("done") or numbers.get("trained") else RUNNING,
        )
    if result.error is not None:
        return replace(trial, state=FAILED)
    return trial
