"""A run in a shared folder or an object store."""

import json
import os
import uuid

import pytest
import torch

from trainer.cluster.restoring import kept_files, reached, share_newest, unpack
from trainer.cluster.storage import fetch_checkpoint, fetch_run, send_run, storage_url
from trainer.runs import Launch, RunRecord, begin_launch, find_checkpoint


def make_run(root, step, launch="one"):
    folder = root / "exp" / "20260101-000000"
    RunRecord("exp", folder.name, "sqlite:///x.db", "id").save(folder)
    begin_launch(folder, Launch(launch))
    save(folder, step)
    return folder


def save(folder, step):
    (folder / "checkpoints").mkdir(exist_ok=True)
    partial = folder / "checkpoints" / "partial"
    torch.save({"global_step": step}, partial)
    os.replace(partial, folder / "checkpoints" / "last.ckpt")


@pytest.fixture(params=["folder", "memory"])
def storage(request, tmp_path):
    if request.param == "folder":
        return str(tmp_path / "shared")
    return f"memory://{uuid.uuid4().hex}/runs"


def test_run_is_fetched_where_another_node_has_none(tmp_path, storage):
    folder = make_run(tmp_path / "here", 4)
    send_run(folder, storage_url(storage), {})
    fetched = fetch_run(storage, "one", tmp_path / "there")
    assert fetched == tmp_path / "there" / "exp" / folder.name
    assert RunRecord.load(fetched) == RunRecord.load(folder)
    assert reached(fetched) == (1, 4)
    assert fetch_run(storage, "another", tmp_path / "there") is None


def test_newest_checkpoint_wins_on_both_ways(tmp_path, storage):
    folder, sent = make_run(tmp_path / "here", 4), {}
    send_run(folder, storage_url(storage), sent)
    save(folder, 6)
    send_run(folder, storage_url(storage), sent, everything=False)
    assert fetch_run(storage, "one", tmp_path / "there", newer_than=(1, 6)) is None
    assert reached(fetch_run(storage, "one", tmp_path / "there", newer_than=(1, 4))) == (1, 6)


def test_later_attempt_wins_over_a_later_step(tmp_path, storage):
    folder = make_run(tmp_path / "here", 4)
    begin_launch(folder, Launch("one"))
    send_run(folder, storage_url(storage), {})
    assert reached(fetch_run(storage, "one", tmp_path / "there", newer_than=(1, 8))) == (2, 4)


def test_only_what_changed_is_sent(tmp_path, storage, monkeypatch):
    folder, sent = make_run(tmp_path / "here", 4), {}
    send_run(folder, storage_url(storage), sent)
    monkeypatch.setattr("trainer.cluster.storage.send", None)  # any call would fail
    send_run(folder, storage_url(storage), sent)


def test_checkpoint_at_a_url_brings_its_run(tmp_path, storage, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = make_run(tmp_path / "here", 4)
    send_run(folder, storage_url(storage), {})
    url = f"{storage_url(storage)}/exp/{folder.name}/checkpoints/last.ckpt"
    found = find_checkpoint(url, tmp_path / "there", "exp")
    assert found == tmp_path / "there" / "exp" / folder.name / "checkpoints" / "last.ckpt"
    assert RunRecord.load(found.parent.parent).run_id == "id"
    save(found.parent.parent, 8)
    assert reached(fetch_checkpoint(url, tmp_path / "there").parent.parent) == (1, 8)


def test_lone_checkpoint_at_a_url_goes_into_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    torch.save({"global_step": 1}, tmp_path / "model.ckpt")
    found = fetch_checkpoint((tmp_path / "model.ckpt").as_uri(), tmp_path / "runs")
    assert found.is_relative_to(tmp_path / "cache")
    assert found.read_bytes() == (tmp_path / "model.ckpt").read_bytes()


@pytest.mark.parametrize("name", ["../../evil", "/etc/x", "a/../../b"])
def test_storage_cannot_name_files_outside_of_the_run(tmp_path, name):
    folder = make_run(tmp_path / "here", 4)
    shared = tmp_path / "shared"
    send_run(folder, storage_url(str(shared)), {})
    (shared / "exp" / folder.name / "mirror.json").write_text(json.dumps({"files": [name]}))
    with pytest.raises(ValueError, match="outside"):
        fetch_run(str(shared), "one", tmp_path / "there")


def test_packed_run_is_whole_where_it_is_unpacked(tmp_path):
    folder = make_run(tmp_path / "here", 4)
    files = {name: path.read_bytes() for name, path in kept_files(folder).items()}
    unpack(tmp_path / "there", files)
    assert {n: p.read_bytes() for n, p in kept_files(tmp_path / "there").items()} == files


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """A group of one rank, of a launch that has begun before."""
    monkeypatch.setenv("PENUMBRA_TRAINING", "one")
    torch.distributed.init_process_group("gloo", f"file://{tmp_path}/group", rank=0, world_size=1)
    yield
    torch.distributed.destroy_process_group()


def test_unreachable_storage_does_not_end_a_restart_with_a_checkpoint_here(tmp_path, alone, capsys):
    make_run(tmp_path / "here", 4)
    (tmp_path / "file").write_text("")
    unreachable = str(tmp_path / "file" / "below")
    (tmp_path / "empty").mkdir()
    share_newest(tmp_path / "here", "exp", unreachable)
    said = capsys.readouterr().err
    assert "warning: cannot read" in said
    assert "goes on from the checkpoint of step 4" in said
    with pytest.raises(OSError, match="cannot read"):
        share_newest(tmp_path / "empty", "exp", unreachable)


def test_damaged_checkpoint_is_no_run_to_go_on_from(tmp_path):
    folder = make_run(tmp_path / "here", 4)
    (folder / "checkpoints" / "last.ckpt").write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(ValueError, match="truncated"):
        reached(folder)
