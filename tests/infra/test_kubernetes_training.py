"""A training on several nodes: its pods agree, what is checked is what is trained, and its commands work."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from tests.end_to_end.conftest import Workplace, cache  # noqa: F401  # a fixture
from tests.infra.manifests import of_kind, plain_environment
from tests.stack.compose import ROOT, image_of
from tests.stack.processes import free_ports

trainings = pytest.mark.parametrize(
    "folder", ["base/training", "overlays/small-training", "overlays/cluster-training"]
)


@trainings
def test_nodes_of_a_training_meet_and_agree_on_their_number(built, folder):
    (job,) = of_kind(built[folder], "Job")
    (service,) = of_kind(built[folder], "Service")
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    arguments = dict(word.split("=", 1) for word in pod["containers"][0]["args"] if "=" in word)
    given = plain_environment(pod["containers"][0])
    trainer = options_of(built[folder])["trainer"]
    assert spec["completionMode"] == "Indexed"
    assert spec["completions"] == spec["parallelism"] == int(given["NODES"]) == trainer["num_nodes"]
    assert int(given["PROCESSES"]) == trainer["devices"]
    assert (arguments["--nnodes"], arguments["--nproc-per-node"]) == ("$(NODES)", "$(PROCESSES)")
    assert trainer["strategy"] == "ddp"
    assert arguments["--node-rank"] == "$(JOB_COMPLETION_INDEX)"
    name, port = service["metadata"]["name"], service["spec"]["ports"][0]["port"]
    assert arguments["--rdzv-endpoint"] == f"{job['metadata']['name']}-0.{name}:{port}"
    assert pod["subdomain"] == name
    assert service["spec"]["clusterIP"] == "None"
    assert service["spec"]["publishNotReadyAddresses"] is True
    assert pod["restartPolicy"] == "Never"  # a pod failure policy needs it
    actions = {rule["action"] for rule in spec["podFailurePolicy"]["rules"]}
    assert actions == {"FailJob", "Ignore"}
    checked = {rule["onExitCodes"]["containerName"] for rule in spec["podFailurePolicy"]["rules"][:1]}
    assert checked <= {container["name"] for container in pod["initContainers"]}
    gpus = pod["containers"][0]["resources"]["limits"].get("nvidia.com/gpu")
    assert gpus is None or gpus == given["PROCESSES"]
    assert (gpus is None) == ("accelerator" not in trainer)


def options_of(documents):
    """Return the options of a training, which its containers read from a file."""
    (options,) = of_kind(documents, "ConfigMap")
    return yaml.safe_load(options["data"]["options.yaml"])


@trainings
def test_what_is_checked_is_what_is_trained(built, folder):
    (job,) = of_kind(built[folder], "Job")
    (options,) = of_kind(built[folder], "ConfigMap")
    pod = job["spec"]["template"]["spec"]
    (volume,) = [volume for volume in pod["volumes"] if "configMap" in volume]
    assert volume["configMap"]["name"] == options["metadata"]["name"]
    check, training = pod["initContainers"][0], pod["containers"][0]
    for container in (check, training):
        (place,) = [m["mountPath"] for m in container["volumeMounts"] if m["name"] == volume["name"]]
        assert f"--config={place}/options.yaml" in container["args"]
    assert check["args"][-1] == "--print_config"
    shared = check["args"][:-1]
    assert training["args"][-len(shared) :] == shared
    assert check["image"] == training["image"]


def test_probe_of_a_training_is_the_health_check_of_its_image(built):
    (job,) = of_kind(built["base/training"], "Job")
    container = job["spec"]["template"]["spec"]["containers"][0]
    image = image_of(container["image"])
    assert container["livenessProbe"]["exec"]["command"] == image.health
    assert f"PENUMBRA_ALIVE={image.health[1]}" in image.last("ENV")
    assert "/tmp" in {mount["mountPath"] for mount in container["volumeMounts"]}


def checked(built, folder, tmp_path, change=""):
    """Run the init container of a training, with a changed text of its options; returns how it ended."""
    (job,) = of_kind(built[folder], "Job")
    (options,) = of_kind(built[folder], "ConfigMap")
    (tmp_path / "options.yaml").write_text(options["data"]["options.yaml"] + change)
    words = job["spec"]["template"]["spec"]["initContainers"][0]["args"]
    words = [word.replace("/etc/penumbra", str(tmp_path)) for word in words]
    return subprocess.run([sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["base/training", "overlays/cluster-training"])
def test_wrong_options_end_a_training_at_once_and_right_ones_do_not(built, folder, tmp_path):
    right = checked(built, folder, tmp_path)
    assert right.returncode == 0, right.stderr
    expected, found = options_of(built[folder]), yaml.safe_load(right.stdout)
    assert expected["trainer"].items() <= found["trainer"].items()
    assert expected.get("data", {}).get("init_args", {}).items() <= found["data"]["init_args"].items()
    wrong = checked(built, folder, tmp_path, "  no_such_option: 1\n")
    assert wrong.returncode == 2, wrong.stderr


@pytest.mark.slow
def test_nodes_of_a_training_train_one_run_together(built, tmp_path, cache):  # noqa: F811
    (job,) = of_kind(built["base/training"], "Job")
    (options,) = of_kind(built["base/training"], "ConfigMap")
    (tmp_path / "options.yaml").write_text(options["data"]["options.yaml"])
    container = job["spec"]["template"]["spec"]["containers"][0]
    place = Workplace(tmp_path, cache)
    place.environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    variables = plain_environment(container) | {"LAUNCH": f"test-{os.getpid()}"}
    meeting = f"127.0.0.1:{free_ports(1)[0]}"
    nodes = []
    for number in range(job["spec"]["completions"]):
        given = variables | {"JOB_COMPLETION_INDEX": str(number)}
        words = [
            re.sub(r"\$\((\w+)\)", lambda match, given=given: given[match[1]], word)
            .replace("training-0.training:29400", meeting)
            .replace("/etc/penumbra", str(tmp_path))
            for word in [*container["args"], "--config=smoke.yaml", "--data.batch_size=2"]
        ]
        nodes.append(
            subprocess.Popen(
                words, cwd=tmp_path, env=place.environment, text=True, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
        )  # fmt: skip
    outputs = [node.communicate(timeout=400)[0] for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], outputs
    (run,) = place.runs  # nodes that knew nothing of each other would make two
    launch = json.loads((run / "launch.json").read_text())["launch"]
    assert launch.startswith(f"torchrun {variables['LAUNCH']} ")
    assert torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 4
