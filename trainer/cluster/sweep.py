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
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from trainer.cluster.board import Board, follow, sending
from trainer.cluster.checked import Training
from trainer.cluster.engine import Cluster, connected, enter, forwarded
from trainer.cluster.fitting import Group, resources
from trainer.cluster.outcome import FAILED, FINISHED, RUNNING, STOPPED, Trial, ranked, table, write_results
from trainer.cluster.space import Range
from trainer.cluster.trials import Sweep, run_trial

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

    def save(self, folder: Path) -> None:
        """Write the search into its folder."""
        (folder / SWEEP_FILE).write_text(json.dumps(asdict(self), indent=1) + "\n")

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


def run_search(search: Search, results: Path, address: str | None, folder: Path, resume: bool) -> int:
    """Run a search on Ray and print how it goes; returns the exit code.

    Args:
        search: What to search.
        results: Folder of the search.
        address: A running Ray, or None for one on this machine.
        folder: Working folder of the trials.
        resume: Go on with the trials that are there.

    Raises:
        ValueError: Ray is missing, or the cluster has another release.
        OSError: The cluster cannot be reached.
        KeyboardInterrupt: Ctrl-C, after the search was stopped.
    """
    group = search.group
    with connected(Cluster(address, group.workers * group.cpus, group.workers * group.gpus)) as ray:
        board = ray.remote(num_cpus=0)(Board).remote()
        head = ray.remote(num_cpus=0)(_Searcher).remote()
        call = head.run.remote(search, str(results), str(folder), forwarded(address), resume, board)
        try:
            code, message = follow(ray, board, call)
        finally:
            ray.kill(head)
    if message:
        print(f"error: {message}", file=sys.stderr)
    return code


class _Searcher:
    """Conducts a search from within the cluster."""

    def run(
        self, search: Search, results: str, folder: str, environment: dict[str, str], resume: bool, board: Any
    ) -> None:
        """Run the trials, and write what they found."""
        import ray

        with sending(board):
            try:
                enter(folder, environment)
                code, message = _conduct(search, Path(results), folder, environment, resume, board), ""
            except (ValueError, OSError) as error:
                code, message = 1, str(error)
        ray.get(board.end.remote(code, message))


def _conduct(
    search: Search, results: Path, folder: str, environment: dict[str, str], resume: bool, board: Any
) -> int:
    from trainer.cluster.parent import ParentRun

    results.mkdir(parents=True, exist_ok=True)
    search.save(results)
    parent = ParentRun.begin(search, results)
    training, group = search.training, search.group
    sweep = Sweep(
        results.name, training, group, folder, environment, search.metric, search.mode, parent.run_id
    )
    threading.Thread(target=_interrupt, args=(board,), daemon=True).start()
    grid = _tuner(search, sweep, results, resume).fit()
    trials = ranked([_trial(result, search) for result in grid], search.mode)
    parent.settle(trials)
    written = write_results(results, trials, search.metric, search.mode)
    print(table(trials, search.metric), flush=True)
    best = next((trial for trial in trials if trial.best), None)
    parent.end(trials, written)
    if any(trial.state == RUNNING for trial in trials):
        print(f"next: trainer tune --resume {_shown(results)}", flush=True)
    print(f"results: {results} ({', '.join(path.name for path in written)})", flush=True)
    if (results / "best.yaml").is_file() and best is not None:
        print(f"next: trainer fit --config {_shown(results / 'best.yaml')}", flush=True)
    return 0 if best is not None else 1


def _interrupt(board: Any) -> None:
    """Interrupt Ray Tune as Ctrl-C does when the submitter asks for it; it then keeps its state."""
    import ray

    while not ray.get(board.cancelled.remote()):
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGINT)


def _shown(path: Path) -> str:
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _tuner(search: Search, sweep: Sweep, results: Path, resume: bool) -> Any:
    from ray import tune
    from ray.tune.search.optuna import OptunaSearch

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
            max_concurrent_trials=search.concurrent or None,
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
    # The processes of a trial reserve their own; this one only waits for them.
    return tune.PlacementGroupFactory([{"CPU": 0.01}])


def _telling(search: Search) -> Any:
    from ray import tune

    class Telling(tune.Callback):
        """Prints a line for what happens to trials."""

        def on_trial_start(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            values = ", ".join(f"{key.rpartition('.')[2]} {_plain(v)}" for key, v in trial.config.items())
            _say(f"{len(trials)}/{search.trials} {trial.trial_id} starts: {values}")

        def on_trial_result(
            self, iteration: int, trials: Any, trial: Any, result: dict[str, Any], **info: Any
        ) -> None:
            _say(
                f"{trial.trial_id} epoch {result['epoch']}/{search.epochs}: {search.metric} "
                f"{result['score']:.4g}, {result['cost']:.0f} ms/Mpx"
            )

        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            state = _state(trial.last_result.get("epoch", 0), search)
            _say(f"{trial.trial_id} {state}")

        def on_trial_error(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            _say(f"{trial.trial_id} failed: {_why(trial)}")

    return Telling()


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _plain(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _why(trial: Any) -> str:
    error = trial.get_error()
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:300] if lines else "its process died"


def _state(epoch: int, search: Search) -> str:
    return FINISHED if epoch >= search.epochs else STOPPED


def _trial(result: Any, search: Search) -> Trial:
    numbers = result.metrics or {}
    trial = Trial(str(numbers.get("trial_id") or Path(str(result.path)).name), dict(result.config or {}))
    if "epoch" in numbers:
        trial = replace(
            trial,
            score=float(numbers["score"]),
            cost=float(numbers["cost"]),
            epoch=int(numbers["epoch"]),
            run=str(numbers["run"]),
            state=_state(int(numbers["epoch"]), search) if numbers.get("done") else RUNNING,
        )
    if result.error is not None:
        return replace(trial, state=FAILED)
    return trial
