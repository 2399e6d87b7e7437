"""Reading and writing at URLs, from servers that fail in every way."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from data import remote, remote_patience, remote_systems
from data.remote_failures import ContentError, Judgement, judge
from data.remote_systems import system_of
from tests.data.remote_servers import Handler, S3Server, WebServer, free_ports

DATA = bytes(range(256)) * 5000


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_patience, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(remote_patience, "LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(remote_patience, "NOTICE_AFTER_S", 0.0)
    monkeypatch.setattr(remote_patience, "_told", {})
    monkeypatch.setattr(remote_patience, "_reached", set())
    monkeypatch.setenv(remote_patience.PATIENCE, "20")


@pytest.fixture
def web(tmp_path: Path) -> Iterator[WebServer]:
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "file").write_bytes(DATA)
    with WebServer(tmp_path / "web") as server:
        yield server


@pytest.fixture(scope="module")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[S3Server]:
    server = S3Server(tmp_path_factory.mktemp("s3") / "server")
    server.start()
    try:
        server.make_bucket("bucket")
        yield server
    finally:
        server.stop()


@pytest.fixture
def bucket(s3: S3Server, monkeypatch: pytest.MonkeyPatch) -> str:
    for name, value in s3.environment.items():
        monkeypatch.setenv(name, value)
    return "s3://bucket"


def failing(times: int, status: int = 500) -> Any:
    """Return a fault of the web server that answers so many requests with a status."""
    left = [times]

    def fault(handler: Handler, data: bytes) -> bool:
        left[0] -= 1
        if left[0] < 0:
            return False
        handler.answer(status, b"no")
        return True

    return fault


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("s3://b/x/", "s3://b/x"),
        ("HTTPS://host/a", "https://host/a"),
        ("http://h/a?token=1", "http://h/a?token=1"),
        ("folder", None),
        ("sample:bmfr", None),
        ("C:/x", None),
    ],
)
def test_urls_and_paths_are_told_apart(text: str, url: str | None):
    assert remote.url_of(text) == url


@pytest.mark.parametrize("text", ["s3:/b/x", "s3://", "gs://b/x", "https://", "s3:x"])
def test_what_looks_like_a_url_but_is_none_is_refused(text: str):
    with pytest.raises(ValueError, match=r"expected s3://BUCKET/PATH or https://HOST/PATH"):
        remote.url_of(text)


def test_names_go_before_what_follows_a_question_mark_and_secrets_are_not_shown():
    url = remote.join("https://me:secret@host/a?sig=1", "f.tar")
    assert url == "https://me:secret@host/a/f.tar?sig=1"
    assert remote.shown(url) == "https://host/a/f.tar"


@pytest.mark.parametrize("scheme", ["memory", "s3", "http"])
def test_what_was_sent_comes_back(scheme: str, web: WebServer, bucket: str, tmp_path: Path):
    folder = {"memory": "memory://a", "s3": f"{bucket}/a/b", "http": f"{web.url}/a/b"}[scheme]
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(DATA)
    url = remote.join(folder, "file")
    assert not remote.exists(url)
    remote.send(source, url)
    assert remote.exists(url)
    assert not remote.exists(folder)
    assert remote.size_of(url) == len(DATA)
    assert remote.sha256_of(url, len(DATA)) == remote.file_sha256(source)
    pieces: list[int] = []
    remote.fetch(url, target, size=len(DATA), sha256=remote.file_sha256(source), report=pieces.append)
    assert target.read_bytes() == DATA
    assert sum(pieces) == len(DATA)
    assert remote.read_bytes(url, len(DATA)) == DATA
    assert remote.read_range(url, 1000, 300) == DATA[1000:1300]
    assert remote.listing(folder) == (None if scheme == "http" else {"file": len(DATA)})
    remote.remove(url)
    remote.remove(url)
    assert not remote.exists(url)
    assert remote.listing(folder) == (None if scheme == "http" else {})


def test_no_more_is_read_for_a_checksum_than_the_file_should_have(web: WebServer):
    read = 0

    def endless(handler: Handler, data: bytes) -> bool:
        nonlocal read
        handler.send_response(200)
        handler.end_headers()
        with contextlib.suppress(OSError):
            while read < 1 << 30:
                read += handler.wfile.write(bytes(1 << 16))
        handler.close_connection = True
        return True

    web.fault = endless
    assert remote.sha256_of(f"{web.url}/file", 1000) is None
    assert read < 1 << 28


def test_a_missing_bucket_is_no_missing_file(monkeypatch):
    judged = Judgement("no bucket", "status 404")
    monkeypatch.setattr(remote_patience, "judge", lambda error: judged)
    monkeypatch.setattr(remote, "_size", lambda url: {}["x"])
    with pytest.raises(remote_patience.NoBucketError, match="has no bucket 'b'"):
        remote.exists("s3://b/x")
    judged = Judgement("missing", "status 404")
    assert not remote.exists("s3://b/x")


def test_a_large_file_goes_to_s3_and_back_in_pieces(bucket: str, tmp_path: Path):
    source = tmp_path / "source"
    source.write_bytes(os.urandom(1 << 20) * 110)
    remote.send(source, f"{bucket}/large")
    sha256 = remote.sha256_of(f"{bucket}/large", source.stat().st_size)
    remote.fetch(f"{bucket}/large", tmp_path / "target", sha256=sha256)
    assert remote.file_sha256(tmp_path / "target") == remote.file_sha256(source)


def test_a_server_that_fails_for_a_while_is_waited_for_with_a_line(web: WebServer, capsys, tmp_path: Path):
    web.fault = failing(4, 503)
    remote.fetch(f"{web.url}/file", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == DATA
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2
    assert "fails (status 503" in told[0]
    assert "trying again for up to" in told[0]
    assert "answers again after" in told[1]


def cut(handler: Handler, data: bytes) -> bool:
    handler.answer(200, data[:700], claimed=len(data))
    handler.close_connection = True
    handler.connection.shutdown(socket.SHUT_RDWR)
    return True


def reset(handler: Handler, data: bytes) -> bool:
    handler.close_connection = True
    handler.connection.close()
    return True


@pytest.mark.parametrize("broken", [cut, reset])
def test_a_cut_answer_is_asked_for_again(web: WebServer, tmp_path: Path, broken: Any):
    faults = iter([broken, broken])
    web.fault = lambda handler, data: next(faults, lambda h, d: False)(handler, data)
    remote.fetch(f"{web.url}/file", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == DATA


def test_a_cut_part_is_asked_for_again(web: WebServer):
    def short(handler: Handler, data: bytes) -> bool:
        handler.answer(206, data[:10])
        return True

    faults = iter([short])
    web.fault = lambda handler, data: next(faults, lambda h, d: False)(handler, data)
    assert remote.read_range(f"{web.url}/file", 0, 100) == DATA[:100]


def test_a_server_that_never_recovers_is_left_with_address_attempts_and_time(
    web: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv(remote_patience.PATIENCE, "0.2")
    web.fault = failing(1000)
    with pytest.raises(
        ConnectionError, match=rf"cannot read {web.url}/file: status 500.*tried \d+ times in 0:0"
    ):
        remote.fetch(f"{web.url}/file", tmp_path / "f")
    assert not list(tmp_path.glob("*f*"))
    address = f"http://127.0.0.1:{free_ports(1)[0]}"
    for name, value in (("ENDPOINT_URL", address), ("ACCESS_KEY_ID", "k"), ("SECRET_ACCESS_KEY", "s")):
        monkeypatch.setenv(f"AWS_{name}", value)
    with pytest.raises(ConnectionError, match=r"s3://b/x \(the S3 server http.*connection refused; tried"):
        remote.exists("s3://b/x")


def test_a_silent_server_counts_as_failing(web: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(remote_systems, "READ_TIMEOUT_S", 0.2)
    monkeypatch.setattr(remote_systems, "_systems", {})

    def silent(handler: Handler, data: bytes) -> bool:
        time.sleep(0.6)
        return False

    faults = iter([silent])
    web.fault = lambda handler, data: next(faults, lambda h, d: False)(handler, data)
    remote.fetch(f"{web.url}/file", tmp_path / "f")
    assert web.asked["GET /file"] == 2


@pytest.mark.parametrize(
    ("status", "kind"),
    [(403, PermissionError), (404, FileNotFoundError), (401, PermissionError), (400, OSError)],
)
def test_refusals_are_told_at_once(web: WebServer, tmp_path: Path, status: int, kind: type[OSError]):
    web.fault = failing(1000, status)
    with pytest.raises(kind, match=f"cannot read {web.url}/file: (status {status}|there is no)"):
        remote.fetch(f"{web.url}/file", tmp_path / "f")
    assert web.asked["GET /file"] == 1


@pytest.mark.parametrize(
    ("code", "status", "told"),
    [
        ("ExpiredToken", 400, "the credentials have expired; renew AWS_ACCESS_KEY_ID"),
        ("RequestTimeTooSkewed", 403, "the clock of this machine and that of the S3 server .* differ"),
        ("InvalidAccessKeyId", 403, "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_ENDPOINT_URL"),
    ],
)
def test_refused_credentials_say_what_is_wrong_with_them(
    web: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: str, status: int, told: str
):
    def refuse(handler: Handler, data: bytes) -> bool:
        body = f"<Error><Code>{code}</Code><Message>no</Message></Error>"
        handler.answer(status, body.encode(), Content_Type="application/xml")
        return True

    web.fault = refuse
    for name, value in {
        "AWS_ENDPOINT_URL": web.url,
        "AWS_ACCESS_KEY_ID": "k",
        "AWS_SECRET_ACCESS_KEY": "s",
    }.items():
        monkeypatch.setenv(name, value)
    (web.folder / "bucket").mkdir()
    (web.folder / "bucket" / "file").write_bytes(DATA)
    with pytest.raises(PermissionError, match=f"cannot read s3://bucket/file: .*{told}"):
        remote.fetch("s3://bucket/file", tmp_path / "f")


def test_throttling_of_s3_is_waited_out(web: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (web.folder / "bucket").mkdir()
    (web.folder / "bucket" / "file").write_bytes(DATA)
    for name, value in {
        "AWS_ENDPOINT_URL": web.url,
        "AWS_ACCESS_KEY_ID": "k",
        "AWS_SECRET_ACCESS_KEY": "s",
    }.items():
        monkeypatch.setenv(name, value)
    busy = failing(3, 503)
    web.fault = busy
    remote.fetch("s3://bucket/file", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == DATA


def test_a_missing_bucket_and_missing_credentials_are_named(bucket: str, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(
        FileNotFoundError, match=r"http://127.0.0.1:\d+ has no bucket 'nothing'; .*make the bucket"
    ):
        remote.listing("s3://nothing/x")
    monkeypatch.setattr(remote_systems, "_systems", {})
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(PermissionError, match=r"signature.*check AWS_ACCESS_KEY_ID"):
        remote.listing("s3://bucket/x")
    monkeypatch.setattr(remote_systems, "_systems", {})
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nowhere")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    with pytest.raises(PermissionError, match="no credentials were found"):
        remote.listing("s3://bucket/x")


def test_other_content_is_read_three_times_and_then_refused(web: WebServer, tmp_path: Path):
    for wrong in ({"size": 7}, {"sha256": "0" * 64}):
        web.asked.clear()
        with pytest.raises(ValueError, match=r"file is not what it should be: it"):
            remote.fetch(f"{web.url}/file", tmp_path / "f", **wrong)
        assert web.asked["GET /file"] == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["web"]


def test_no_more_is_read_than_the_limit(web: WebServer):
    def endless(handler: Handler, data: bytes) -> bool:
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        try:
            while True:
                handler.wfile.write(b"10000\r\n" + bytes(65536) + b"\r\n")
        except OSError:
            handler.close_connection = True
        return True

    web.fault = endless
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        remote.read_bytes(f"{web.url}/file", 1000)
    web.fault = None
    with pytest.raises(ValueError, match=f"has {len(DATA)} bytes, expected at most 1000"):
        remote.read_bytes(f"{web.url}/file", 1000)


def test_a_server_without_ranges_is_noticed(web: WebServer):
    web.ranges = False
    assert remote.read_range(f"{web.url}/file", 10, 10) is None


def _child(url: str, results: Any) -> None:
    results.put(remote.read_range(url, 5, 20))


@pytest.mark.parametrize("kind", ["http", "s3"])
def test_a_forked_process_reads_after_its_parent_has(kind: str, web: WebServer, bucket: str, tmp_path: Path):
    url = f"{web.url}/file" if kind == "http" else f"{bucket}/forked"
    if kind == "s3":
        remote.send(web.folder / "file", url)
    assert remote.read_range(url, 5, 20) == DATA[5:25]
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    children = [context.Process(target=_child, args=(url, results)) for _ in range(2)]
    for child in children:
        child.start()
    assert [results.get(timeout=60) for _ in children] == [DATA[5:25]] * 2
    for child in children:
        child.join()
    assert remote.read_range(url, 5, 20) == DATA[5:25]


def test_a_full_disk_is_not_taken_for_the_server(
    web: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def full(*args: Any, **options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(system_of(web.url), "get_file", full)
    with pytest.raises(OSError, match=r"cannot read .*: No space left on device; make room"):
        remote.fetch(f"{web.url}/file", tmp_path / "f")


def test_bugs_are_not_waited_for():
    assert judge(KeyError("x")) is None
    with pytest.raises(KeyError):
        remote_patience.patiently("read", "s3://b/x", lambda: {}["x"])
    assert judge(ContentError("cut")) is not None


@pytest.mark.parametrize("text", ["soon", "-1", "nan", "inf"])
def test_a_patience_that_is_no_number_is_refused(monkeypatch: pytest.MonkeyPatch, text: str):
    monkeypatch.setenv(remote_patience.PATIENCE, text)
    with pytest.raises(ValueError, match=r"PENUMBRA_REMOTE_PATIENCE is .*expected seconds"):
        remote_patience.patience_s()


def test_a_missing_extra_names_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(remote_systems, "_systems", {})
    monkeypatch.setattr(remote_systems.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r's3:// needs the package s3fs: pip install "penumbra-denoise\[remote\]"'
    ):
        remote.exists("s3://b/x")
