"""The shell scripts of images and of the compose folder, run for real."""

import os
import re
import shutil
import stat
import subprocess
import time
from pathlib import Path

import pytest

from tests.stack.compose import FOLDER, ROOT, image_of, read_compose

SCRIPTS = [
    ROOT / "docker" / "with-secrets",
    ROOT / "docker" / "with-progress-of",
    FOLDER / "make-secrets",
    ROOT / "infra" / "slurm" / "train.sbatch",
]


def run(name, *arguments, **environment):
    script = next(path for path in SCRIPTS if path.name == name)
    return subprocess.run(
        [script, *arguments], env={"PATH": os.environ["PATH"]} | environment, capture_output=True, text=True
    )


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_script_is_executable_and_free_of_known_mistakes(path):
    assert path.stat().st_mode & stat.S_IXUSR
    shell = "bash" if "bash" in path.read_text().splitlines()[0] else "sh"
    assert subprocess.run([shell, "-n", path]).returncode == 0
    if linter := shutil.which("shellcheck"):
        done = subprocess.run([linter, path], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def test_secret_is_read_from_its_file_without_the_line_end(tmp_path):
    (tmp_path / "password").write_text("a b$c'd\"\n")
    done = run("with-secrets", "env", PGPASSWORD_FILE=str(tmp_path / "password"))
    assert "PGPASSWORD=a b$c'd\"" in done.stdout.splitlines()
    assert "PGPASSWORD_FILE" not in done.stdout


def test_other_files_are_left_alone(tmp_path):
    (tmp_path / "bundle").write_text("certificate")
    done = run("with-secrets", "env", SSL_CERT_FILE=str(tmp_path / "bundle"))
    assert f"SSL_CERT_FILE={tmp_path / 'bundle'}" in done.stdout.splitlines()
    assert "SSL_CERT=" not in done.stdout


@pytest.mark.parametrize("content", [None, ""], ids=["absent", "empty"])
def test_secret_that_is_not_there_ends_the_start_with_its_name(tmp_path, content):
    path = tmp_path / "password"
    if content is not None:
        path.write_text(content)
    done = run("with-secrets", "env", PGPASSWORD_FILE=str(path))
    assert done.returncode == 1
    assert "PGPASSWORD_FILE" in done.stderr
    assert str(path) in done.stderr


def test_secret_given_twice_ends_the_start(tmp_path):
    (tmp_path / "password").write_text("x")
    done = run("with-secrets", "env", PGPASSWORD="y", PGPASSWORD_FILE=str(tmp_path / "password"))
    assert done.returncode == 1
    assert "both" in done.stderr


def test_command_takes_the_place_of_the_script_and_gives_its_status():
    done = run("with-secrets", "sh", "-c", "exit 7")
    assert done.returncode == 7
    assert run("with-secrets").returncode == 1


def test_secrets_are_random_made_once_and_those_of_the_compose_file(tmp_path):
    folder = tmp_path / "secrets"
    assert run("make-secrets", str(folder)).returncode == 0
    first = {path.name: path.read_text() for path in folder.iterdir()}
    assert set(first) == set(read_compose()["secrets"])
    assert len(set(first.values())) == len(first)
    assert all(len(text) == 40 for text in first.values())
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (folder / "tracking_password").unlink()
    run("make-secrets", str(folder))
    second = {path.name: path.read_text() for path in folder.iterdir()}
    assert second.pop("tracking_password") != first.pop("tracking_password")
    assert second == first


def health(tmp_path, age_s, **variables):
    """Run the health check of a job that is so old."""
    started = (float(Path("/proc/uptime").read_text().split()[0]) - age_s) * os.sysconf("SC_CLK_TCK")
    stat = tmp_path / "stat"
    stat.write_text("1 (a (b) c) S " + " ".join(["0"] * 18 + [f"{started:.0f}", "0"]))
    return run("with-progress-of", str(tmp_path / "alive"), JOB_STAT=str(stat), **variables)


def test_job_is_healthy_while_it_is_young_or_works(tmp_path):
    assert health(tmp_path, 60).returncode == 0
    assert health(tmp_path, 3600).returncode == 1
    assert "no batch, sample or frame for 30 minutes" in health(tmp_path, 3600).stderr
    (tmp_path / "alive").touch()
    assert health(tmp_path, 3600).returncode == 0
    age_minutes(tmp_path / "alive", 60)
    assert health(tmp_path, 3600).returncode == 1
    assert health(tmp_path, 3600, STALL_MINUTES="90").returncode == 0


def test_files_of_others_do_not_make_a_job_that_hangs_healthy(tmp_path):
    (tmp_path / "alive").touch()
    age_minutes(tmp_path / "alive", 60)
    (tmp_path / "metrics of another run").touch()
    assert health(tmp_path, 3600).returncode == 1


def age_minutes(path, minutes):
    then = time.time() - 60 * minutes
    os.utime(path, (then, then))


def test_health_of_no_file_is_an_error():
    assert "no file is given" in run("with-progress-of").stderr


def test_what_touches_the_file_and_what_looks_at_it_agree():
    for name in ("trainer", "render"):
        service = read_compose()["services"][name]
        (place,) = re.findall(r"PENUMBRA_ALIVE=(\S+)", image_of(service["image"]).last("ENV") or "") or [""]
        assert service["healthcheck"]["test"] == ["CMD", "with-progress-of", place]
