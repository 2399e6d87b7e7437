"""The manifests are valid by schema and closed.

Built-in kinds are validated strictly against the schemas of `kubernetes-validate`. RayCluster and RayJob are
custom resources of KubeRay, which that tool has no schemas for: their pod templates are validated strictly as
those of pods, and what is around them by the checks in this file.
"""

import re
import shlex
import subprocess
import sys
from importlib import metadata

import kubernetes_validate
import pytest

from tests.infra.manifests import FOLDERS, containers, every_folder, number, of_kind, templates
from tests.stack.compose import ROOT

RAY = {"RayCluster", "RayJob"}


def test_there_are_bases_and_overlays():
    assert {"base/stack", "base/training", "base/serve", "base/ray"} <= set(FOLDERS)
    assert {"overlays/small", "overlays/cluster"} <= set(FOLDERS)


@every_folder
def test_built_in_kinds_follow_their_schemas_strictly(built, folder):
    for document in built[folder]:
        if document["kind"] not in RAY:
            kubernetes_validate.validate(document, "1.34", strict=True)


def test_validation_refuses_a_misspelt_field(built):
    job = of_kind(built["base/training"], "Job")[0]
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate({**job, "spec": {**job["spec"], "paralellism": 2}}, "1.34", strict=True)


@pytest.mark.parametrize("folder", ["base/ray", "overlays/cluster-ray"])
def test_pod_templates_of_custom_resources_follow_the_schema_of_pods(built, folder):
    found = list(templates(built[folder]))
    assert len(found) >= 3
    for name, template in found:
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name} | template["metadata"]}
        kubernetes_validate.validate(pod | {"spec": template["spec"]}, "1.34", strict=True)


@pytest.mark.parametrize("folder", ["base/ray", "overlays/cluster-ray"])
def test_custom_resources_have_what_the_operator_needs(built, folder):
    (cluster,) = of_kind(built[folder], "RayCluster")
    (job,) = of_kind(built[folder], "RayJob")
    assert cluster["apiVersion"] == job["apiVersion"] == "ray.io/v1"
    spec = cluster["spec"]
    assert set(spec) == {"rayVersion", "headGroupSpec", "workerGroupSpecs"}
    assert spec["rayVersion"] == metadata.version("ray")
    assert set(spec["headGroupSpec"]) == {"rayStartParams", "template"}
    for group in spec["workerGroupSpecs"]:
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    assert all(isinstance(value, str) for value in spec["headGroupSpec"]["rayStartParams"].values())
    assert job["spec"]["clusterSelector"] == {"ray.io/cluster": cluster["metadata"]["name"]}
    # Each retry of a RayJob makes a new cluster, which a job on a given cluster must not ask for.
    assert not {"rayClusterSpec", "shutdownAfterJobFinishes", "backoffLimit", "suspend"} & set(job["spec"])


@pytest.mark.parametrize("folder", ["base/ray", "overlays/cluster-ray"])
def test_job_on_ray_uses_options_of_the_command_and_fits_on_its_workers(built, folder):
    (cluster,) = of_kind(built[folder], "RayCluster")
    words = shlex.split(of_kind(built[folder], "RayJob")[0]["spec"]["entrypoint"])
    assert words[:2] == ["trainer", "submit"]
    helped = subprocess.run(
        [sys.executable, "-m", "trainer", "submit", "--help"], capture_output=True, cwd=ROOT
    )
    known = set(re.findall(r"--[a-z-]+", helped.stdout.decode())) | {"--config", "--data.root"}
    given = dict(zip(words[2::2], words[3::2], strict=True))
    assert set(given) <= known
    (group,) = cluster["spec"]["workerGroupSpecs"]
    limits = group["template"]["spec"]["containers"][0]["resources"]["limits"]
    assert int(given["--workers"]) <= group["maxReplicas"]
    assert int(given["--cpus-per-worker"]) <= int(limits["cpu"])
    assert int(given.get("--gpus-per-worker", 0)) <= int(limits.get("nvidia.com/gpu", 0))


@every_folder
def test_pods_are_restricted(built, folder):
    for name, template in templates(built[folder]):
        spec = template["spec"]
        security = spec["securityContext"]
        assert security["runAsNonRoot"] is True, name
        assert security["runAsUser"] > 0
        assert security["seccompProfile"] == {"type": "RuntimeDefault"}
        assert spec["automountServiceAccountToken"] is False
        assert spec["enableServiceLinks"] is False  # TRACKING_PORT=tcp://… would shadow settings
        assert not {"hostNetwork", "hostPID", "hostIPC"} & set(spec)
        assert not [volume for volume in spec.get("volumes", []) if "hostPath" in volume]
        for container in containers(template):
            closed = container["securityContext"]
            assert closed["allowPrivilegeEscalation"] is False
            assert closed["readOnlyRootFilesystem"] is True
            assert closed["capabilities"] == {"drop": ["ALL"]}


def test_namespace_enforces_the_restricted_profile(built):
    (namespace,) = of_kind(built["base/stack"], "Namespace")
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"


@every_folder
def test_containers_have_requests_within_limits_and_a_place_to_write(built, folder):
    for name, template in templates(built[folder]):
        for container in containers(template):
            resources = container["resources"]
            assert {"cpu", "memory"} <= set(resources["requests"]) & set(resources["limits"]), name
            for quantity, asked in resources["requests"].items():
                assert number(asked) <= number(resources["limits"][quantity]), (name, quantity)
            assert "/tmp" in {mount["mountPath"] for mount in container["volumeMounts"]}


@every_folder
def test_everything_is_in_one_namespace(built, folder):
    for document in built[folder]:
        if document["kind"] != "Namespace":
            assert document["metadata"]["namespace"] == "penumbra"
