"""The parts of the manifests fit each other, and the compose file where they overlap."""

import argparse
import inspect
import re

import pytest
import yaml

from data import Shards
from tests.infra.manifests import (
    containers,
    every_folder,
    labels,
    number,
    of_kind,
    plain_environment,
    selects,
    templates,
)  # fmt: skip
from tests.stack.compose import ROOT, read_compose
from trainer.commands import serve
from trainer.commands.denoise import size_in_bytes
from trainer.serving.memory import needed

SERVICES = read_compose()["services"]
COMPOSE = {"training": "trainer"}  # name there where it differs
MADE_BY_USERS = {"penumbra", "tracking-certificate", "serve-certificate"}
"""Secrets that infra/README.md tells to make."""


def serve_needs(words):
    """Return the memory that `trainer serve` may take with these words, and its limits."""
    assert words[:2] == ["trainer", "serve"]
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    args = parser.parse_args(words[2:])
    limits = serve._limits(args)
    return needed(limits, args.memory), limits


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


@pytest.mark.parametrize("folder", ["base/stack", "base/training", "base/serve"])
def test_images_commands_and_environment_are_those_of_the_compose_file(built, folder):
    for name, template in templates(built[folder]):
        service = SERVICES[COMPOSE.get(name, name)]
        container = template["spec"]["containers"][0]
        assert container["image"] == service["image"]
        expected = {key: str(value) for key, value in service.get("environment", {}).items()}
        given = plain_environment(container)
        if name == "training":  # torchrun on several nodes, one process there
            expected.pop("PENUMBRA_LAUNCH")
            assert {"NODES", "PROCESSES"} <= given.keys()
            own = {"PENUMBRA_CACHE": "/cache", "NODES": given["NODES"], "PROCESSES": given["PROCESSES"]}
            assert given == expected | own
        else:
            assert given == expected
            assert container["args"] == [str(word) for word in service["command"]]


@pytest.mark.parametrize("folder", ["base/training", "overlays/cluster-training", "base/ray"])
def test_copies_of_shards_lie_on_the_node_itself(built, folder):
    for name, template in templates(built[folder]):
        if name == "training-on-ray":  # only hands the job in
            continue
        (container,) = template["spec"]["containers"]
        place = plain_environment(container)["PENUMBRA_CACHE"]
        mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
        (volume,) = [v for v in template["spec"]["volumes"] if v["name"] == mounts[place]]
        most = inspect.signature(Shards).parameters["cache_gb"].default * 1e9
        assert number(volume["emptyDir"]["sizeLimit"]) > most
        assert "medium" not in volume["emptyDir"]


@pytest.mark.parametrize("folder", ["base/serve", "overlays/small", "overlays/cluster"])
def test_what_requests_may_take_fits_the_memory_and_the_disk_of_the_service(built, folder):
    (deployment,) = [d for d in of_kind(built[folder], "Deployment") if d["metadata"]["name"] == "serve"]
    pod = deployment["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    memory, limits = serve_needs(container["args"])
    assert memory <= number(container["resources"]["limits"]["memory"])
    scratch = next(volume["emptyDir"] for volume in pod["volumes"] if volume["name"] == "scratch")
    assert "medium" not in scratch
    assert limits.disk < number(scratch["sizeLimit"])
    waits = int(container["lifecycle"]["preStop"]["exec"]["command"][1])
    assert waits >= 10
    assert pod["terminationGracePeriodSeconds"] > waits + limits.compute + limits.send


def test_what_requests_may_take_fits_the_memory_of_the_service_on_one_machine():
    service = SERVICES["serve"]
    memory, limits = serve_needs(service["command"])
    allowed = size_in_bytes(service["deploy"]["resources"]["limits"]["memory"].replace("g", "GiB"))
    (temporary,) = service["tmpfs"]  # in the same memory
    assert memory + limits.disk <= allowed
    assert limits.disk < size_in_bytes(temporary.partition("size=")[2].replace("g", "GiB"))
    assert int(service["stop_grace_period"].rstrip("s")) > limits.compute + limits.send


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
