import json
import math

from trainer.cluster.outcome import FAILED, FINISHED, STOPPED, Trial, ranked, table, write_results

TRIALS = [
    Trial("a", {"model.init_args.net.layers": 2, "lr": 0.001}, 25.0, 100.0, 4, FINISHED),
    Trial("b", {"model.init_args.net.layers": 4, "lr": 0.002}, 27.0, 300.0, 4, FINISHED),
    Trial("c", {"model.init_args.net.layers": 4, "lr": 0.01}, 24.0, 300.0, 4, FINISHED),
    Trial("d", {"model.init_args.net.layers": 1, "lr": 0.01}, 29.0, 50.0, 1, STOPPED),
    Trial("e", {"model.init_args.net.layers": 1, "lr": 0.01}, state=FAILED),
]


def test_front_holds_the_trained_trials_that_no_other_beats_in_both():
    assert [trial.name for trial in ranked(TRIALS, "max")] == ["b", "a", "c", "d", "e"]
    assert [trial.name for trial in ranked(TRIALS, "max") if trial.best] == ["b", "a"]


def test_smaller_score_is_better_where_that_is_asked():
    assert [trial.name for trial in ranked(TRIALS, "min") if trial.best] == ["c", "a"]


def test_table_names_keys_shortly_and_leaves_out_what_is_not_known():
    lines = table(ranked(TRIALS, "max"), "val/psnr").splitlines()
    assert lines[0].split() == ["trial", "lr", "layers", "val/psnr", "ms/Mpx", "epochs", "state"]
    assert lines[1].split() == ["*", "b", "0.002", "4", "27", "300", "4", "finished"]
    assert lines[-1].split() == ["e", "0.01", "1", "0", "failed"]


def test_results_hold_the_configuration_of_the_best(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("trainer: {}\n")
    trials = [Trial("a", {}, 25.0, 10.0, 1, FINISHED, str(run)), Trial("b", {}, math.nan)]
    names = [path.name for path in write_results(tmp_path, ranked(trials, "max"), "val/psnr", "max")]
    assert names == ["trials.json", "trials.txt", "pareto.png", "best.yaml"]
    assert json.loads((tmp_path / "trials.json").read_text())["trials"][0]["best"] is True
    assert (tmp_path / "best.yaml").read_text() == "trainer: {}\n"
