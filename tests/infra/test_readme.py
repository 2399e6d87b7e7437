"""What infra/README.md tells to do exists: images, services, manifests, options, pictures."""

import re
import shutil
import subprocess
import sys

import pytest

from tests.infra.test_images import STAGES
from tests.stack.compose import ROOT, read_compose
from trainer.cli import COMMANDS, TRAINING

TEXT = (ROOT / "infra" / "README.md").read_text()
CODE = "\n".join(line[4:] for line in TEXT.splitlines() if line.startswith("    ")).replace("\\\n", " ")
SERVICES = read_compose()["services"]
COMPOSED = {"--detach", "--wait", "--no-cache", "--rm", "-T", "--force-recreate"}


def test_images_that_are_built_are_targets_of_the_dockerfiles():
    built = re.findall(r"docker build -f (\S+) (?:--target (\S+) )?-t penumbra/([\w-]+):", CODE)
    assert {image for *_, image in built} == {"train", "train-cuda", "render", "serve", "tracking", "storage"}
    for path, target, image in built:
        assert (ROOT / path).is_file()
        assert (target or image) == image
        assert image in STAGES


def test_services_and_profiles_that_are_started_exist():
    profiles = {profile for service in SERVICES.values() for profile in service.get("profiles", [])}
    for line in CODE.splitlines():
        if not line.startswith("docker compose"):
            continue
        line = line.split("#")[0]
        assert set(re.findall(r"--profile (\S+)", line)) <= profiles
        for words in re.findall(r"\b(?:up|stop|start) ([a-z -]+)", line):
            assert {word for word in words.split() if not word.startswith("-")} <= set(SERVICES)
        for words in re.findall(r"\b(?:exec -T|run --rm) (\w+)", line):
            assert words in SERVICES


def test_paths_exist():
    for path in re.findall(r"`(overlays/[\w-]+)`", TEXT):
        assert (ROOT / "infra" / "kubernetes" / path / "kustomization.yaml").is_file()
    for path in re.findall(r"infra/(?:kubernetes|slurm|compose)/[\w./-]*\w", CODE):
        assert (ROOT / path).exists() or path.startswith("infra/compose/secrets"), path
    volume = re.findall(r"-v (penumbra_\w+):", CODE)
    assert {name.removeprefix("penumbra_") for name in volume} <= set(read_compose()["volumes"])


def test_secrets_of_a_cluster_are_made_where_the_next_command_reads_them_and_git_ignores_them(tmp_path):
    shutil.copytree(ROOT / "infra" / "compose", tmp_path / "infra" / "compose")
    (made,) = re.findall(r"^(infra/compose/make-secrets[^#\n]*)", CODE, re.MULTILINE)
    (read,) = re.findall(r"^kubectl create secret generic .* --from-file (\S+)", CODE, re.MULTILINE)
    subprocess.run(made.split(), cwd=tmp_path, check=True, capture_output=True)
    names = {path.name for path in (tmp_path / read).iterdir()}
    assert names == set(read_compose()["secrets"])
    done = subprocess.run(["git", "check-ignore", "--quiet", f"{read}/x"], cwd=ROOT)
    assert done.returncode == 0


def test_pictures_are_there_and_small():
    pictures = re.findall(r"\]\((pictures/\S+)\)", TEXT)
    assert pictures
    for path in pictures:
        assert (ROOT / "infra" / path).stat().st_size < 250e3


def commands():
    """Return the lines that call `trainer`, each from its verb on."""
    return sorted({found.strip() for found in re.findall(r"\btrainer ([a-z]+ [^`\n#]*)", CODE)})


@pytest.mark.parametrize("line", commands())
def test_verb_exists_and_has_the_options(line):
    verb, *words = line.split()
    if verb == "trainer":  # a service and then its command
        verb, *words = words
    assert verb in TRAINING | COMMANDS
    options = {word for word in words if word.startswith("--")}
    if verb in TRAINING:
        assert options <= {"--config", "--ckpt_path"} | {
            o for o in options if o.startswith(("--trainer.", "--data."))
        }
        return
    kinds = [word for word in words[:1] if not word.startswith("-")]
    helped = ""
    for arguments in ([verb], [verb, *kinds]):
        done = subprocess.run(
            [sys.executable, "-m", "trainer", *arguments, "--help"], cwd=ROOT, capture_output=True, text=True
        )
        helped += done.stdout
    if kinds and verb == "submit":  # passes on what it does not know
        done = subprocess.run(
            [sys.executable, "-m", "trainer", *words[:2], "--help"], cwd=ROOT, capture_output=True, text=True
        )
        helped += done.stdout
    assert options - {"--config"} <= set(re.findall(r"--[a-z-]+", helped)), helped


def test_torchrun_has_the_options():
    torchrun = [line for line in CODE.splitlines() if line.startswith("torchrun")]
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--help"], cwd=ROOT, capture_output=True, text=True
    )
    for line in torchrun:
        options = set(re.findall(r" (--[a-z-]+)", line.split(" -m ")[0]))
        assert options <= set(re.findall(r"--[a-z-]+", done.stdout))
    assert torchrun
