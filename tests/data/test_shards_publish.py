"""`trainer prepare --output URL`: what is at the URL after each way it can end, and how it goes on."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from data import remote, remote_patience
from data.module import Shards
from data.remote_systems import system_of
from data.shards import publish as publishing
from data.shards.index import Index
from data.shards.prepare import prepare
from data.shards.publish import publish
from tests.data.remote_servers import S3Server, WebServer
from tests.data.small_sets import OPTIONS, write_set
from tests.data.test_shards_remote import assert_same, batches
from trainer.commands import prepare as command


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set") / "frames")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(remote_patience, "FIRST_PAUSE_S", 0.01)
    return tmp_path / "cache"


@pytest.fixture
def web(tmp_path: Path) -> Iterator[WebServer]:
    with WebServer(tmp_path / "web") as server:
        yield server


@pytest.fixture
def memory() -> Iterator[str]:
    yield "memory://bucket/shards"
    system_of("memory://x").store.clear()


def content(url: str) -> dict[str, bytes]:
    return {name: remote.read_bytes(remote.join(url, name), 1 << 24) for name in remote.listing(url) or ()}


def test_the_set_at_the_url_is_the_one_made_on_this_machine_and_nothing_is_left_here(
    frames, memory, cache, tmp_path
):
    index = publish(frames, memory, OPTIONS)
    local = prepare(frames, tmp_path / "local", OPTIONS)
    assert index.shards == local.shards
    assert content(memory) == {path.name: path.read_bytes() for path in local.root.iterdir()}
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_shards_that_are_there_need_force_which_removes_what_is_left_over(frames, memory):
    publish(frames, memory, OPTIONS)
    with pytest.raises(
        ValueError, match=r"memory://bucket/shards holds shards already; --force replaces them"
    ):
        publish(frames, memory, OPTIONS)
    fewer = type(OPTIONS)(**{**vars(OPTIONS), "samples_per_shard": 16})
    index = publish(frames, memory, fewer, force=True)
    assert content(memory).keys() == {"index.json", *(shard.file for shard in index.shards)}


def test_an_interrupted_upload_continues_and_sends_only_what_is_missing_or_wrong(
    frames, memory, monkeypatch, capsys
):
    sent: list[str] = []
    send = remote.send

    def limited(path: Path, url: str, **options: Any) -> None:
        if len(sent) == 6:
            raise KeyboardInterrupt
        sent.append(path.name)
        send(path, url, **options)

    monkeypatch.setattr(publishing, "TOGETHER", 1)
    monkeypatch.setattr(publishing.remote, "send", limited)
    with pytest.raises(KeyboardInterrupt):
        publish(frames, memory, OPTIONS)
    there = content(memory)
    assert "index.json" not in there
    assert len(there) == 6
    with pytest.raises(ValueError, match="is not finished, its upload was interrupted; continue it with"):
        Shards(memory).setup("fit")
    first = min(name for name in there if name.endswith(".tar"))
    wrong = there[first][:-1] + b"x"
    system_of(memory).pipe_file(remote.join(memory, first), wrong)
    sent.clear()
    monkeypatch.setattr(publishing.remote, "send", lambda p, u, **o: (sent.append(p.name), send(p, u, **o)))
    capsys.readouterr()
    index = publish(frames, memory, OPTIONS)
    assert "are made in" not in capsys.readouterr().err, "they are made already"
    assert sent[0] == "upload.json"
    assert sent[-1] == "index.json"
    kept = {name for name in there if name.endswith(".tar")} - {first}
    assert sorted(sent[1:-1]) == sorted(shard.file for shard in index.shards if shard.file not in kept)


def test_the_beginning_of_other_shards_is_not_mixed_with_these(frames, memory, monkeypatch):
    send = remote.send

    def broken(path: Path, url: str, **options: Any) -> None:
        if path.name == "index.json":
            raise PermissionError("no")
        send(path, url, **options)

    monkeypatch.setattr(publishing.remote, "send", broken)
    with pytest.raises(PermissionError):
        publish(frames, memory, OPTIONS)
    monkeypatch.undo()
    other = type(OPTIONS)(**{**vars(OPTIONS), "patch_size": 8})
    with pytest.raises(ValueError, match="holds the beginning of shards from other frames or options"):
        publish(frames, memory, other)


def test_a_folder_with_other_files_is_refused_before_anything_is_written(frames, memory):
    system_of(memory).pipe_file(f"{memory}/thesis.pdf", b"x")
    with pytest.raises(ValueError, match=r"holds other files \(thesis.pdf …\); name a new folder"):
        publish(frames, memory, OPTIONS, force=True)
    assert content(memory).keys() == {"thesis.pdf"}


def test_shards_that_training_has_made_already_are_sent_and_stay(frames, memory, tmp_path):
    from data.shards.prepare import prepare_cached

    made = prepare_cached(frames, OPTIONS)
    publish(frames, memory, OPTIONS)
    assert Index.read(made.root).shards == made.shards


def call(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(a) for a in arguments]))


def test_the_command_sends_over_http_and_tells_what_it_does(frames, web, capsys):
    options = ("--patch-size", 16, "--train-patches", 4000, "--processes", 1)
    assert call(frames, "--output", f"{web.url}/a/b", *options) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{web.url}/a/b: 13 shards, ")
    assert "are made in" in printed.err
    assert f"sending to {web.url}/a/b: 1/1 MB" in printed.err
    with pytest.raises(ValueError, match="holds shards already; --force"):
        call(frames, "--output", f"{web.url}/a/b", *options)
    with pytest.raises(ValueError, match="expected s3://BUCKET/PATH"):
        call(frames, "--output", "s3:/b/x", *options)
    assert json.loads((web.folder / "a" / "b" / "index.json").read_text())["format"] == "penumbra-shards"


@pytest.mark.slow
def test_a_killed_upload_continues_and_reading_outlives_an_s3_server_that_is_killed(
    frames, tmp_path, monkeypatch, capfd
):
    server = S3Server(tmp_path / "server")
    server.start()
    try:
        server.make_bucket("bucket")
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        url = "s3://bucket/shards"
        arguments = [sys.executable, "-m", "trainer", "prepare", str(frames), "--output", url]
        arguments += ["--patch-size", "16", "--train-patches", "4000", "--samples-per-shard", "4"]
        process = subprocess.Popen(
            arguments, env=os.environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        while process.poll() is None and len(remote.listing(url) or ()) < 3:
            time.sleep(0.02)
        process.kill()
        process.communicate()
        if not remote.exists(f"{url}/index.json"):
            subprocess.run(arguments, env=os.environ, check=True, capture_output=True)
        options = {"buffers": ("color",), "batch_size": 4}
        data = Shards(url, workers=2, **options)
        index = data.index
        loader = data.train_dataloader()
        server.stop()
        waker = threading.Timer(5, server.start)
        waker.start()
        first = list(loader)
        waker.join()
        local = prepare(frames, tmp_path / "local", publishing_options())
        assert index.shards == local.shards
        assert_same(first, batches(Shards(str(local.root), workers=0, **options))[: len(first)])
        assert "trying again for up to" in capfd.readouterr().err
        data.teardown("fit")
    finally:
        server.stop()


def publishing_options() -> Any:
    return type(OPTIONS)(patch_size=16, train_patches=4000, samples_per_shard=4)
