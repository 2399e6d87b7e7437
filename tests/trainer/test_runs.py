import os
from pathlib import Path

import pytest

from trainer.runs import (
    Launch,
    RunRecord,
    begin_launch,
    checkpoint_of_launch,
    current_launch,
    end_launch,
    find_checkpoint,
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


def test_launch_is_named_by_variable_torchrun_or_slurm():
    assert current_launch({}) is None
    assert current_launch({"PENUMBRA_LAUNCH": "x", "SLURM_JOB_ID": "7"}) == Launch("x", unfinished=True)
    torchrun = {"TORCHELASTIC_RUN_ID": "job", "TORCHELASTIC_RESTART_COUNT": "2"}
    assert current_launch(torchrun) == Launch("torchrun job", restarts=True, unfinished=True)
    assert current_launch({"SLURM_JOB_ID": "7"}) == Launch("slurm 7")
    assert current_launch({"SLURM_JOB_ID": "7", "SLURM_RESTART_COUNT": "1"}) == Launch("slurm 7", True)


def test_torchrun_without_an_identity_is_known_by_its_process_on_one_machine_only():
    one = {"TORCHELASTIC_RUN_ID": "none", "TORCHELASTIC_RESTART_COUNT": "0", "WORLD_SIZE": "2"}
    launch = current_launch({**one, "LOCAL_WORLD_SIZE": "2"})
    assert launch == current_launch({**one, "LOCAL_WORLD_SIZE": "2"})
    assert not launch.restarts
    assert not launch.unfinished
    assert current_launch({**one, "LOCAL_WORLD_SIZE": "1"}) is None
