"""What a trial reports, and the run that a search has in the tracking store."""

from types import SimpleNamespace

import pytest

from trainer.cluster.checked import Training
from trainer.cluster.fitting import Group
from trainer.cluster.outcome import FINISHED, STOPPED, Trial
from trainer.cluster.parent import ParentRun
from trainer.cluster.space import Range
from trainer.cluster.sweep import Search, _room, _trial
from trainer.cluster.trials import Reporting, Sweep
from trainer.runs import new_folder
from trainer.tracking import open_client


def reports(epochs, every, scores):
    """What a training reports that is validated every few epochs."""
    told = []
    training = Training((), (), "runs", "exp")
    reporting = Reporting(Sweep("s", training, Group(), "", {}, "val/psnr", "max"), "t", told.append)
    trainer = SimpleNamespace(
        max_epochs=epochs, check_val_every_n_epoch=every, sanity_checking=False, callback_metrics={},
        state=SimpleNamespace(fn="fit"),
    )  # fmt: skip
    for epoch in range(epochs):
        trainer.current_epoch = epoch
        if (epoch + 1) % every == 0:
            trainer.callback_metrics = {"val/psnr": scores.pop(0)}
            reporting.on_validation_end(trainer, None)
    trainer.current_epoch = epochs
    reporting.on_fit_end(trainer, None)
    reporting.finish()
    return told


@pytest.mark.parametrize(
    ("every", "scores", "epochs"), [(1, [1, 3, 2, 1, 0], [1, 2, 3, 4, 5]), (2, [1, 3], [2, 5])]
)
def test_trial_that_was_trained_to_the_end_is_finished_whatever_is_validated(every, scores, epochs):
    told = reports(5, every, scores)
    assert [report["epoch"] for report in told] == epochs
    assert [report["trained"] for report in told] == [False] * (len(told) - 1) + [True]
    assert told[-1]["score"] == 3
    result = SimpleNamespace(metrics=told[-1] | {"done": True, "trial_id": "t"}, config={}, error=None)
    assert _trial(result).state == FINISHED
    result.metrics = told[0] | {"done": True}
    result.path = "t"
    assert _trial(result).state == STOPPED


def test_trial_that_is_never_validated_says_what_to_change():
    with pytest.raises(ValueError, match="check_val_every_n_epoch"):
        reports(3, 4, [])


BEST = Trial("a", {}, 2.0, 3.0, 4, FINISHED, best=True)


@pytest.mark.parametrize(
    ("trials", "status"), [([BEST], "FINISHED"), ([BEST, Trial("b", {})], "FAILED"), ([], "FAILED")]
)
def test_run_of_a_search_is_in_the_configured_store_and_ends(tmp_path, monkeypatch, trials, status):
    monkeypatch.chdir(tmp_path)
    uri = f"sqlite:///{tmp_path / 'other.db'}"
    training = Training((), (), "runs", "exp", uri)
    search = Search(training, {"a": Range("int", (1, 2))}, 5, Group(), "val/psnr", "max", 4, 1, 3, 7)
    results = new_folder(tmp_path / "runs", "tune")
    (results / "trials.txt").write_text("a table")
    parent = ParentRun(search, results)
    parent.keep(trials, [results / "trials.txt"])
    parent.end(trials)
    client = open_client(uri)
    run = client.get_run(parent.run_id)
    assert run.info.status == status
    assert run.data.params["a"] == "int [1, 2]"
    assert run.data.metrics == ({"best/score": 2.0, "best/ms_per_megapixel": 3.0} if trials else {})
    assert [file.path for file in client.list_artifacts(parent.run_id)] == ["trials.txt"]
    assert not (tmp_path / "runs" / "mlflow.db").exists()


@pytest.mark.parametrize(
    ("group", "nodes", "room"),
    [
        (Group(workers=1), [{"CPU": 4}], None),
        (Group(workers=2), [{"CPU": 1}, {"CPU": 1}], 1),
        (Group(workers=2, cpus=3), [{"CPU": 8}, {"CPU": 5}, {"CPU": 2}], 1),
        (Group(workers=2, cpus=2, gpus=1), [{"CPU": 16, "GPU": 4}, {"CPU": 16}], 2),
        (Group(workers=4, gpus=0.5), [{"CPU": 16, "GPU": 4}], 2),
        (Group(workers=8), [{"CPU": 2}], 1),
    ],
)
def test_as_many_trials_run_at_one_time_as_the_nodes_have_places_for(monkeypatch, group, nodes, room):
    import ray

    lost = {"Alive": False, "Resources": {"CPU": 64, "GPU": 64}}
    monkeypatch.setattr(ray, "nodes", lambda: [{"Alive": True, "Resources": n} for n in nodes] + [lost])
    assert _room(group) == room
