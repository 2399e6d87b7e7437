"""The parts of the manifests fit each other, and the compose file where they overlap."""

import re
import subprocess
import sys

import pytest
import yaml

from tests.infra.manifests import containers, every_folder, labels, of_kind, selects, templates
from tests.stack.compose import ROOT, read_compose

SERVICES = read_compose()["services"]
COMPOSE = {"training": "trainer"}  # name there where it differs
MADE_BY_USERS = {"penumbra", "tracking-certificate", "serve-certificate"}
"""Secrets that infra/README.md tells to make."""


@every_folder
def test_selectors_match_the_pods_they_mean(built, folder):
    documents = built[folder]
    pods = dict(templates(documents))
    for document in documents:
        name, spec = document["metadata"]["name"], document.get("spec", {})
        if document["kind"] == "Service":
            chosen = [pod for pod in pods.values() if selects({"matchLabels": spec["selector"]}, labels(pod))]
            (pod,) = chosen
            ports = {port["name"] for entry in containers(pod) for port in entry.get("ports", [])}
            assert {port["targetPort"] for port in spec["ports"]} <= ports
        elif document["kind"] in ("Deployment", "StatefulSet"):
            assert selects(spec["selector"], labels(spec["template"])), name
        elif document["kind"] == "PodDisruptionBudget" and name != "ray-head":
            assert any(selects(spec["selector"], labels(pod)) for pod in pods.values()), name
            replicas = next(d for d in of_kind(documents, "Deployment") if d["metadata"]["name"] == name)
            assert spec["minAvailable"] < replicas["spec"]["replicas"], "no node could be drained"
        elif document["kind"] == "NetworkPolicy" and spec["podSelector"]:
            meant = [pod for pod in pods.values() if selects(spec["podSelector"], labels(pod))]
            assert meant, name


@every_folder
def test_probes_and_ingresses_name_ports_that_exist(built, folder):
    for _, template in templates(built[folder]):
        for container in containers(template):
            ports = {port["name"] for port in container.get("ports", [])}
            for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
                request = container.get(probe, {}).get("httpGet")
                assert request is None or request["port"] in ports
    services = {document["metadata"]["name"]: document for document in of_kind(built[folder], "Service")}
    for ingress in of_kind(built[folder], "Ingress"):
        for rule in ingress["spec"]["rules"]:
            backend = rule["http"]["paths"][0]["backend"]["service"]
            names = {port["name"] for port in services[backend["name"]]["spec"]["ports"]}
            assert backend["port"]["name"] in names
            assert rule["host"] in ingress["spec"]["tls"][0]["hosts"]


@every_folder
def test_referenced_configurations_secrets_and_volumes_exist(built, folder):
    documents = [*built[folder], *built["base/stack"]]
    maps = {document["metadata"]["name"] for document in of_kind(documents, "ConfigMap")}
    claims = {document["metadata"]["name"] for document in of_kind(documents, "PersistentVolumeClaim")}
    keys = set(read_compose()["secrets"])
    readme = (ROOT / "infra" / "README.md").read_text()
    assert all(name in readme for name in MADE_BY_USERS)
    for _, template in templates(built[folder]):
        volumes = {volume["name"]: volume for volume in template["spec"].get("volumes", [])}
        for volume in volumes.values():
            if "configMap" in volume:
                assert volume["configMap"]["name"] in maps
            if "persistentVolumeClaim" in volume:
                assert volume["persistentVolumeClaim"]["claimName"] in claims
            if "secret" in volume:
                assert volume["secret"]["secretName"] in MADE_BY_USERS
                assert {item["key"] for item in volume["secret"]["items"]} <= keys
        for container in containers(template):
            for entry in container.get("env", []):
                if reference := entry.get("valueFrom", {}).get("secretKeyRef"):
                    assert reference["name"] in MADE_BY_USERS
                    assert reference["key"] in keys
    for ingress in of_kind(built[folder], "Ingress"):
        assert {entry["secretName"] for entry in ingress["spec"]["tls"]} <= MADE_BY_USERS


@every_folder
def test_mounts_have_volumes_and_secret_files_are_mounted(built, folder):
    for document in built[folder]:
        claimed = {
            claim["metadata"]["name"] for claim in document.get("spec", {}).get("volumeClaimTemplates", [])
        }
        for _, template in templates([document]):
            volumes = {volume["name"]: volume for volume in template["spec"].get("volumes", [])}
            for container in containers(template):
                mounted = {mount["name"] for mount in container["volumeMounts"]}
                assert mounted <= set(volumes) | claimed
                text = yaml.safe_dump([container.get("env"), container.get("args")])
                needed = set(re.findall(r"/run/secrets/(\w+)", text))
                given = {
                    item["path"] for item in volumes.get("secrets", {}).get("secret", {}).get("items", [])
                }
                assert needed == (given if "secrets" in mounted else set())


def plain_environment(container):
    return {entry["name"]: entry["value"] for entry in container.get("env", []) if "value" in entry}


@pytest.mark.parametrize("folder", ["base/stack", "base/training", "base/serve"])
def test_images_commands_and_environment_are_those_of_the_compose_file(built, folder):
    for name, template in templates(built[folder]):
        service = SERVICES[COMPOSE.get(name, name)]
        container = template["spec"]["containers"][0]
        assert container["image"] == service["image"]
        expected = {key: str(value) for key, value in service.get("environment", {}).items()}
        expected.pop("PENUMBRA_LAUNCH", None)  # torchrun's identity there
        assert plain_environment(container) == expected
        if name != "training":  # torchrun on several nodes there, one process here
            assert container["args"] == [str(word) for word in service["command"]]


def test_ray_nodes_have_the_trainers_environment_with_secrets_as_variables(built):
    expected = {key.removesuffix("_FILE") for key in SERVICES["trainer"]["environment"]} - {"PENUMBRA_LAUNCH"}
    for name, template in templates(of_kind(built["base/ray"], "RayCluster")):
        given = {entry["name"] for entry in template["spec"]["containers"][0]["env"]}
        assert given - {"RAY_USAGE_STATS_ENABLED"} == expected, name


def test_database_script_is_that_of_the_compose_file(built):
    (scripts,) = of_kind(built["base/stack"], "ConfigMap")
    for name, text in scripts["data"].items():
        assert text == (ROOT / "infra" / "compose" / "database" / name).read_text()


def allows(policies, direction, pod, other, port):
    """Return whether network policies let `pod` (labels) talk to or from `other` on a port."""
    peers = {"Egress": "to", "Ingress": "from"}[direction]
    for policy in policies:
        spec = policy["spec"]
        if direction not in spec["policyTypes"] or not selects(spec["podSelector"], pod):
            continue
        for rule in spec.get(direction.lower(), []):
            chosen = any("podSelector" in p and selects(p["podSelector"], other) for p in rule.get(peers, []))
            ports = {entry["port"] for entry in rule.get("ports", [])}
            if chosen and (not ports or ports & set(port)):
                return True
    return False


def test_network_policies_let_through_what_is_used_and_nothing_else(built):
    documents = [d for folder in ("stack", "training", "serve", "ray") for d in built[f"base/{folder}"]]
    policies = of_kind(documents, "NetworkPolicy")
    pods = dict(templates(documents))
    default = next(p for p in policies if p["metadata"]["name"] == "default-deny")
    assert default["spec"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    servers = {"database": (5432, "postgres"), "storage": (8333, "s3"), "tracking": (5000, "http")}
    for name, template in pods.items():
        text = " ".join(plain_environment(template["spec"]["containers"][0]).values())
        for server, port in servers.items():
            needed = (
                bool(re.search(rf"//{server}:|\b{server}$|^{server}\b| {server} ", text)) and name != server
            )
            for direction, one, other in (("Egress", name, server), ("Ingress", server, name)):
                allowed = allows(policies, direction, labels(pods[one]), labels(pods[other]), port)
                assert allowed is needed, (direction, one, other)
    for name in ("training", "ray-head"):
        pod = labels(pods[name])
        assert allows(policies, "Egress", pod, pod, (40000,))
        assert allows(policies, "Ingress", pod, pod, (40000,))


@pytest.mark.parametrize("folder", ["base/training", "overlays/small-training", "overlays/cluster-training"])
def test_nodes_of_a_training_meet_and_agree_on_their_number(built, folder):
    (job,) = of_kind(built[folder], "Job")
    (service,) = of_kind(built[folder], "Service")
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    arguments = dict(word.split("=", 1) for word in pod["containers"][0]["args"] if "=" in word)
    assert spec["completionMode"] == "Indexed"
    assert spec["completions"] == spec["parallelism"] == int(arguments["--nnodes"])
    assert int(arguments["--trainer.num_nodes"]) == spec["completions"]
    assert arguments["--trainer.devices"] == arguments["--nproc-per-node"]
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
    assert gpus is None or gpus == arguments["--trainer.devices"]


@pytest.mark.slow
def test_wrong_configuration_ends_a_training_at_once(built):
    (job,) = of_kind(built["base/training"], "Job")
    words = job["spec"]["template"]["spec"]["initContainers"][0]["args"]
    assert words[:2] == ["trainer", "fit"]
    done = subprocess.run(
        [sys.executable, "-m", *words[:2], "--config=no_such.yaml", *words[3:]], cwd=ROOT, capture_output=True
    )
    assert done.returncode == 2
