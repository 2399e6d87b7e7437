import os
from pathlib import Path

import pytest

from trainer import configs, runs
from trainer.runs import (
    Launch,
    RunRecord,
    begin_launch,
    checkpoint_of_launch,
    current_launch,
    end_launch,
    find_checkpoint,
    finished_by_launch,
    folder_of_checkpoint,
    new_folder,
    run_of_launch,
)
from trainer.training import evaluated


def make_run(root, name, *checkpoints):
    folder = root / "exp" / name
    RunRecord("exp", name, "sqlite:///x", "id").save(folder)
    (folder / "checkpoints").mkdir()
    for checkpoint in checkpoints:
        (folder / "checkpoints" / f"{checkpoint}.ckpt").write_bytes(b"x")
    return folder


def test_last_is_taken_from_the_newest_run_that_has_it(tmp_path):
    older = make_run(tmp_path, "20260101-000000", "last", "best")
    make_run(tmp_path, "20260102-000000", "best")
    assert find_checkpoint("last", tmp_path, "exp") == older / "checkpoints" / "last.ckpt"


def test_missing_checkpoint_names_the_folder_that_was_searched(tmp_path):
    with pytest.raises(ValueError, match="no run of 'exp' below"):
        find_checkpoint("last", tmp_path, "exp")
    with pytest.raises(ValueError, match="no such file"):
        find_checkpoint(str(tmp_path / "none.ckpt"), tmp_path, "exp")


def test_run_folder_stands_for_its_last_checkpoint(tmp_path):
    folder = make_run(tmp_path, "20260101-000000", "last")
    path = find_checkpoint(str(folder), tmp_path, "exp")
    assert path == folder / "checkpoints" / "last.ckpt"
    assert folder_of_checkpoint(path) == folder.resolve()


def test_evaluation_takes_the_best_checkpoint_of_the_newest_run_or_its_last(tmp_path, capsys):
    older = make_run(tmp_path, "20260101-000000", "last", "best") / "checkpoints"
    assert evaluated("", tmp_path, "exp") == older / "best.ckpt"
    assert evaluated("last", tmp_path, "exp") == older / "last.ckpt"
    assert evaluated(str(older.parent), tmp_path, "exp") == older / "best.ckpt"
    assert capsys.readouterr().err == ""
    newer = make_run(tmp_path, "20260102-000000", "last")
    make_run(tmp_path, "20260103-000000")  # has just begun
    assert evaluated("", tmp_path, "exp") == newer / "checkpoints" / "last.ckpt"
    assert f"scoring {newer / 'checkpoints' / 'last.ckpt'}" in capsys.readouterr().err


def test_evaluation_without_a_checkpoint_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"no run of 'exp' below .* has a checkpoint; train one first"):
        evaluated("", tmp_path, "exp")
    empty = make_run(tmp_path, "20260101-000000")
    with pytest.raises(ValueError, match=r"20260101-000000 holds no checkpoint; train one first"):
        evaluated(str(empty), tmp_path, "exp")


def test_checkpoint_outside_a_run_has_no_folder(tmp_path):
    path = tmp_path / "moved.ckpt"
    path.write_bytes(b"x")
    assert folder_of_checkpoint(path) is None


def test_runs_that_start_in_the_same_second_get_different_folders(tmp_path):
    assert len({new_folder(tmp_path, "exp") for _ in range(3)}) == 3


def test_damaged_record_is_named(tmp_path):
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ValueError, match=r"run\.json is damaged"):
        RunRecord.load(tmp_path)


def test_restarted_launch_finds_its_run_and_no_other(tmp_path):
    mine, other = make_run(tmp_path, "20260101-000000"), make_run(tmp_path, "20260102-000000")
    begin_launch(mine, Launch("a"))
    begin_launch(other, Launch("b"))
    make_run(tmp_path, "20260103-000000")
    assert run_of_launch(Launch("a", restarts=True), tmp_path, "exp") == mine
    assert run_of_launch(Launch("a", unfinished=True), tmp_path, "exp") == mine
    assert run_of_launch(Launch("a"), tmp_path, "exp") is None
    assert run_of_launch(Launch("c", restarts=True), tmp_path, "exp") is None


def test_finished_run_is_not_continued_by_its_launch(tmp_path):
    folder = make_run(tmp_path, "20260101-000000")
    begin_launch(folder, Launch("a"))
    end_launch(folder)
    assert run_of_launch(Launch("a", restarts=True, unfinished=True), tmp_path, "exp") is None


@pytest.mark.parametrize(
    ("launch", "once"),
    [(Launch("a", restarts=True), True), (Launch("a", unfinished=True), False), (Launch("submit a"), True)],
)
def test_restart_of_a_finished_training_has_nothing_left_to_do(tmp_path, launch, once):
    run = make_run(tmp_path, "20260101-000000")
    begin_launch(run, launch)
    assert finished_by_launch(launch, tmp_path, "exp") is None
    end_launch(run)
    assert finished_by_launch(launch, tmp_path, "exp") == (run if once else None)
    assert finished_by_launch(Launch("b", restarts=True), tmp_path, "exp") is None


def test_restart_does_not_take_the_run_of_an_earlier_launch_of_its_name_for_its_own(tmp_path):
    run = make_run(tmp_path, "20260101-000000")
    begin_launch(run, Launch("a"))
    end_launch(run)
    ended = (run / "launch.json").stat().st_mtime
    assert finished_by_launch(Launch("a", restarts=True, since=ended - 60), tmp_path, "exp") == run
    assert finished_by_launch(Launch("a", restarts=True, since=ended + 60), tmp_path, "exp") is None


@pytest.mark.parametrize(
    "environment",
    [
        {"PENUMBRA_LAUNCH": "a", "TORCHELASTIC_RUN_ID": "none"},
        {"TORCHELASTIC_RUN_ID": "7"},
        {"SLURM_JOB_ID": "7"},
    ],
)
def test_only_a_restart_takes_a_finished_training_for_its_own(environment):
    assert not current_launch(environment, []).once
    assert current_launch(environment | {"TORCHELASTIC_RESTART_COUNT": "1"}, []).once


def test_restart_goes_on_from_what_its_launch_saved_or_started_from(tmp_path):
    folder = make_run(tmp_path, "20260101-000000")
    last = folder / "checkpoints" / "last.ckpt"
    begin_launch(folder, Launch("a"))
    assert checkpoint_of_launch(folder) is None
    begin_launch(folder, Launch("a"), "elsewhere/best.ckpt")
    assert checkpoint_of_launch(folder) == Path("elsewhere/best.ckpt")
    last.write_bytes(b"x")
    assert checkpoint_of_launch(folder) == last


def test_restart_does_not_take_the_last_checkpoint_that_was_there_before_its_launch(tmp_path):
    folder = make_run(tmp_path, "20260101-000000", "last", "best")
    checkpoints = folder / "checkpoints"
    begin_launch(folder, Launch("a"), str(checkpoints / "best.ckpt"))
    assert checkpoint_of_launch(folder) == checkpoints / "best.ckpt"
    os.utime(checkpoints / "last.ckpt", ns=(1, 1))  # saved anew
    assert checkpoint_of_launch(folder) == checkpoints / "last.ckpt"


def test_damaged_note_of_a_launch_is_no_launch(tmp_path):
    folder = make_run(tmp_path, "20260101-000000")
    (folder / "launch.json").write_text('{"launch"')
    assert run_of_launch(Launch("a", restarts=True), tmp_path, "exp") is None


TORCHRUN = {"TORCHELASTIC_RUN_ID": "none", "TORCHELASTIC_RESTART_COUNT": "0", "WORLD_SIZE": "2", "RANK": "0"}


def launch(*arguments, **environment):
    found = current_launch(environment, arguments)
    return found and (found.identity.rsplit(" ", 1)[0], found.restarts, found.unfinished)


def test_launch_is_named_by_variable_torchrun_or_slurm():
    assert launch() is None
    assert launch(PENUMBRA_LAUNCH="x", SLURM_JOB_ID="7") == ("x", False, True)
    torchrun = {"TORCHELASTIC_RUN_ID": "job", "TORCHELASTIC_RESTART_COUNT": "2"}
    assert launch(**torchrun, SLURM_JOB_ID="7") == ("torchrun job", True, True)
    assert launch(SLURM_JOB_ID="7") == ("slurm 7", False, False)
    assert launch(SLURM_JOB_ID="7", SLURM_RESTART_COUNT="1") == ("slurm 7", True, False)


def test_torchrun_without_an_identity_in_a_job_of_slurm_has_that_of_the_job():
    for local in ("1", "2"):
        nameless = TORCHRUN | {"LOCAL_WORLD_SIZE": local, "SLURM_JOB_ID": "7"}
        assert launch(**nameless) == ("slurm 7", False, False)
        assert launch(**nameless | {"TORCHELASTIC_RESTART_COUNT": "1"}) == ("slurm 7", True, False)
        assert launch(**nameless | {"SLURM_RESTART_COUNT": "1"}) == ("slurm 7", True, False)


@pytest.mark.parametrize(
    "environment",
    [
        {"PENUMBRA_LAUNCH": "x"},
        {"TORCHELASTIC_RUN_ID": "job"},
        TORCHRUN | {"LOCAL_WORLD_SIZE": "2"},
        {"SLURM_JOB_ID": "7"},
    ],
)
def test_trainings_of_one_launch_are_told_apart_by_their_command_lines(environment):
    first = current_launch(environment, ["fit", "--config", "a.yaml"])
    assert first == current_launch(environment, ["fit", "--config", "a.yaml"])
    assert first.identity != current_launch(environment, ["fit", "--config", "b.yaml"]).identity
    assert first.identity != current_launch(environment, ["fit", "--config a.yaml"]).identity


def test_place_of_installation_does_not_matter_to_a_launch(tmp_path, monkeypatch):
    def resolved(name, place):
        monkeypatch.setattr(configs, "folder", lambda: place)
        return current_launch({"PENUMBRA_LAUNCH": "x"}, ["fit", f"--config={place / name}"])

    one = resolved("wskp.yaml", tmp_path / "a")
    assert resolved("wskp.yaml", tmp_path / "b") == one
    assert resolved("kpcn.yaml", tmp_path / "b") != one


def test_named_training_is_the_same_whatever_its_command_line():
    environment = {"PENUMBRA_TRAINING": "submit 1", "PENUMBRA_LAUNCH": "x", "TORCHELASTIC_RUN_ID": "job"}
    for arguments in ([], ["fit", "--config", "scratch/a.yaml"]):
        assert current_launch(environment, arguments) == Launch("submit 1", unfinished=True)


def test_torchrun_without_an_identity_is_known_by_its_process_on_one_machine_only(capsys):
    one = launch(**TORCHRUN, LOCAL_WORLD_SIZE="2")
    assert one == launch(**TORCHRUN, LOCAL_WORLD_SIZE="2")
    assert one[1:] == (False, False)
    assert capsys.readouterr().err == ""


def test_torchrun_without_an_identity_on_several_machines_says_once_what_to_do(capsys):
    runs._warn_of_nameless_launch.cache_clear()
    assert launch(**TORCHRUN | {"RANK": "1"}, LOCAL_WORLD_SIZE="1") is None
    assert capsys.readouterr().err == ""
    for _ in range(2):
        assert launch(**TORCHRUN, LOCAL_WORLD_SIZE="1") is None
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "--rdzv-id" in said
    assert "PENUMBRA_LAUNCH" in said
