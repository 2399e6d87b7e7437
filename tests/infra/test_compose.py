"""The compose file: valid, complete, closed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stack.compose import FOLDER, image_of, read_compose, settings

BIN = Path(sys.executable).parent
DOCUMENT = read_compose()
SERVICES = DOCUMENT["services"]
TEXT = (FOLDER / "compose.yaml").read_text()
every_service = pytest.mark.parametrize("name", sorted(SERVICES))


def test_compose_file_follows_the_published_schema():
    done = subprocess.run(
        [BIN / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", FOLDER / "compose.yaml"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_services_are_those_that_the_documentation_names():
    expected = {"database", "storage", "tracking", "set-up", "trainer", "render", "serve"}
    assert set(SERVICES) == expected


@every_service
def test_service_can_neither_write_to_its_image_nor_gain_rights(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert "privileged" not in service
    assert any(place.split(":")[0] == "/tmp" for place in service["tmpfs"])


@every_service
def test_service_runs_as_an_ordinary_user(name):
    image = image_of(SERVICES[name]["image"])
    user = SERVICES[name].get("user") or image.last("USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)


@every_service
def test_service_has_limits(name):
    limits = SERVICES[name]["deploy"]["resources"]["limits"]
    assert set(limits) == {"memory", "cpus", "pids"}


@every_service
def test_service_has_the_health_check_of_its_image(name):
    check = SERVICES[name]["healthcheck"]
    if name == "set-up":  # it ends by itself
        assert check == {"disable": True}
        return
    assert check["test"][0] == "CMD"
    image = image_of(SERVICES[name]["image"])
    assert image is None or check["test"][1:] == image.health
    assert {"interval", "timeout", "retries", "start_period"} <= set(check)


@every_service
def test_image_is_built_here_or_pinned_by_version(name):
    service = SERVICES[name]
    if image_of(service["image"]) is None:
        assert re.search(r":\d+\.\d+", service["image"])
    elif "build" in service:
        assert (FOLDER / service["build"]["context"] / service["build"]["dockerfile"]).is_file()


@every_service
def test_secrets_are_files_that_the_service_is_given(name):
    service = SERVICES[name]
    environment = service.get("environment", {})
    text = " ".join([*map(str, environment.values()), *service["command"]])
    assert set(re.findall(r"/run/secrets/(\w+)", text)) == set(service.get("secrets", []))
    for key in environment:
        if re.search(r"PASSWORD|SECRET|TOKEN|ACCESS_KEY", key):
            assert key.endswith("_FILE"), f"{key} stands in the compose file"


def test_secrets_are_defined_and_lie_beside_the_file_where_git_ignores_them():
    used = {secret for service in SERVICES.values() for secret in service.get("secrets", [])}
    assert used == set(DOCUMENT["secrets"])
    for name, entry in DOCUMENT["secrets"].items():
        assert entry == {"file": f"./secrets/{name}"}
    assert {"/secrets/", "/.env"} <= set((FOLDER / ".gitignore").read_text().split())


def test_entry_point_reads_every_secret_that_a_program_takes_from_its_environment():
    script = (FOLDER.parents[1] / "docker" / "with-secrets").read_text()
    for service in SERVICES.values():
        if image_of(service["image"]) is None:
            continue  # PostgreSQL's image reads its file itself
        for key, value in service.get("environment", {}).items():
            if str(value).startswith("/run/secrets/"):
                assert re.search(rf"\b{key.removesuffix('_FILE')}\b", script), key


@every_service
def test_ports_are_published_on_the_loopback_interface_unless_told_otherwise(name):
    for port in SERVICES[name].get("ports", []):
        assert port.startswith("127.0.0.1:")


def test_database_is_reached_from_the_tracking_server_only():
    inside = {name for name, service in SERVICES.items() if "storage" in service["networks"]}
    assert inside == {"database", "storage", "tracking"}
    assert DOCUMENT["networks"]["storage"]["internal"] is True
    assert SERVICES["database"]["networks"] == ["storage"]


def test_services_start_after_what_they_use():
    for name, service in SERVICES.items():
        for other, condition in service.get("depends_on", {}).items():
            ended = other == "set-up"
            expected = "service_completed_successfully" if ended else "service_healthy"
            assert condition["condition"] == expected, (name, other)


def test_example_settings_are_the_variables_of_the_file_with_their_defaults():
    used = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", TEXT))
    assert used == settings()
    assert set(re.findall(r"\$\{(\w+)", TEXT)) == set(used)


def test_file_works_without_settings():
    assert read_compose({}) == DOCUMENT


def test_volumes_are_declared():
    named = {
        mount.split(":")[0]
        for service in SERVICES.values()
        for mount in service.get("volumes", [])
        if not mount.startswith(".")
    }
    assert named == set(DOCUMENT["volumes"])
