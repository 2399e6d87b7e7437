"""`trainer serve`: options are checked before a model is loaded."""

from __future__ import annotations

import argparse
import socket
import sys

import pytest

from trainer import cli
from trainer.commands import serve as command


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="trainer serve")
    command.add_arguments(parser)
    return parser.parse_args(["--model", "JointBilateral", *arguments])


def run(*arguments: str) -> int:
    return command.run(parsed(*arguments))


@pytest.mark.parametrize(
    ("option", "value"),
    [("--port", "70000"), ("--port", "x"), ("--max-megapixels", "0"), ("--timeout", "nan"), ("--batch", "0"),
     ("--tile", "8"), ("--memory", "much"), ("--queue", "-1"), ("--disk", "0")],
)  # fmt: skip
def test_wrong_numbers_are_wrong_usage(option, value, capsys):
    with pytest.raises(SystemExit) as ended:
        run(option, value)
    assert ended.value.code == 2
    assert option in capsys.readouterr().err


def test_a_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        with pytest.raises(OSError, match=f"port {port}: Address already in use; choose another --port"):
            run("--port", port)


def test_an_address_of_no_machine_is_named():
    with pytest.raises(OSError, match="--host no\\.such\\.host\\.invalid"):
        run("--host", "no.such.host.invalid", "--port", "0")


@pytest.mark.parametrize("token", ["", "short", "with a space in the middle", "ünïcödé-token-0123456789"])
def test_a_weak_or_broken_token_is_refused(tmp_path, token):
    path = tmp_path / "token"
    path.write_text(token, "utf-8")
    with pytest.raises(ValueError, match="--token-file"):
        run("--token-file", str(path), "--port", "0")


def test_the_token_of_a_file_goes_before_that_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_TOKEN", "environment-0123456789")
    assert command._token(None) == "environment-0123456789"
    (tmp_path / "token").write_text("file-0123456789abcdef\n")
    assert command._token(tmp_path / "token") == "file-0123456789abcdef"
    monkeypatch.setenv("PENUMBRA_TOKEN", "short")
    with pytest.raises(ValueError, match="PENUMBRA_TOKEN"):
        command._token(None)


def test_a_model_that_is_not_there_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["trainer", "serve", "--model", "none.ckpt", "--port", "0"])
    assert cli.main() == 1
    assert "none.ckpt: no such file" in capsys.readouterr().err


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setattr(command, "_EXTRA", ("no_such_package",))
    with pytest.raises(ValueError, match=r'pip install "penumbra-denoise\[serve\]"'):
        run()
