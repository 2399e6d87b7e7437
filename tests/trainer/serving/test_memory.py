"""What a service may take is compared with what its container, or the machine, has."""

from __future__ import annotations

import pytest

from tests.trainer.serving.test_serve_command import parsed
from trainer.commands import serve as command
from trainer.serving.batching import Batching
from trainer.serving.limits import Limits
from trainer.serving.memory import available, in_memory, needed, shortages

GB = 10**9


def machine(folder, groups="", mounts="", **files):
    """Return a folder that stands for the root, with `proc` and control groups."""
    (folder / "proc/self").mkdir(parents=True)
    (folder / "proc/self/cgroup").write_text(groups)
    (folder / "proc/self/mounts").write_text(f"overlay / overlay rw 0 0\n{mounts}")
    for path, text in files.items():
        (folder / "sys/fs/cgroup" / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / "sys/fs/cgroup" / path).write_text(f"{text}\n")
    return folder


@pytest.mark.parametrize(
    ("groups", "files"),
    [
        ("0::/\n", {"memory.max": 3 * 2**28}),
        ("0::/a/b\n", {"a/memory.max": 3 * 2**28, "a/b/memory.max": "max"}),
        ("4:cpu:/x\n5:memory:/docker/1\n", {"memory/memory.limit_in_bytes": 3 * 2**28}),
        ("5:memory:/docker/1\n", {"memory/docker/1/memory.limit_in_bytes": 3 * 2**28,
                                 "memory/memory.limit_in_bytes": 2**63 - 4096}),
    ],
)  # fmt: skip
def test_the_limit_of_a_container_counts(tmp_path, groups, files):
    assert available(machine(tmp_path, groups, **files)) == (3 * 2**28, "its control group")


def test_without_a_container_the_machine_counts(tmp_path):
    there, whose = available(machine(tmp_path / "a", "0::/\n", **{"memory.max": "max"}))
    assert (there > 2**28, whose) == (True, "this machine")
    assert available(tmp_path / "absent") == (there, whose)


def test_files_of_a_tmpfs_take_memory(tmp_path):
    root = machine(tmp_path, mounts=f"tmpfs {tmp_path}/some\\040place tmpfs rw 0 0\n")
    assert in_memory(tmp_path / "some place" / "below", root)
    assert not in_memory(tmp_path / "other", root)


def test_what_frames_the_model_and_files_take_is_compared_with_what_there_is(tmp_path):
    limits, batching = Limits(megapixels=1.0, disk=10_000), Batching(memory=GB)
    most = needed(limits, batching.memory)
    assert most > 5 * 4 * 32 * 10**6 + GB
    enough = machine(tmp_path / "enough", "0::/\n", **{"memory.max": most})
    assert shortages(limits, batching, tmp_path, enough) == []
    little = machine(tmp_path / "little", "0::/\n", **{"memory.max": most - 1})
    (text,) = shortages(limits, batching, tmp_path, little)
    assert "--max-megapixels" in text
    assert "its control group" in text
    tmpfs = machine(tmp_path / "t", "0::/\n", f"tmpfs {tmp_path} tmpfs rw 0 0\n", **{"memory.max": most})
    assert "--disk" in shortages(limits, batching, tmp_path, tmpfs)[0]
    (text,) = shortages(Limits(0.1, disk=10**18), Batching(memory=1), tmp_path, tmp_path / "absent")
    assert "TMPDIR" in text


def test_the_command_warns_before_it_serves(capsys, monkeypatch):
    args = parsed("--max-megapixels", "100000")
    command._warn(command._limits(args), Batching(memory=args.memory))
    assert "warning: requests may take up to" in capsys.readouterr().err
    args = parsed("--max-megapixels", "0.01", "--memory", "1MB", "--disk", "1MB")
    command._warn(command._limits(args), Batching(memory=args.memory))
    assert capsys.readouterr().err == ""
