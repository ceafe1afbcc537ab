"""The programs accept the settings that docker/ gives them. The images are not built: that needs a container engine."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tensormass_gateway.page_tls import is_loopback
from tensormass_tools import cli

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
DAEMON = ROOT / os.environ.get("BUILD", "build") / "bin/tensormassd"


def shell_default(text: str) -> str:
    """Replaces `${NAME:-default}` by its default, as Compose does if NAME is not set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)


#: Files of Compose, by what they are for.
COMPOSE = {
    "compose": ("compose.yaml", "compose.gpu.yaml"),
    "compose with keys": ("compose.yaml", "compose.keys.yaml"),
    "compose with metrics": ("compose.yaml", "compose.metrics.yaml"),
}
SOURCES = [*COMPOSE, "kubernetes"]


def compose_service(name: str, source: str = "compose") -> dict[str, Any]:
    files = [yaml.safe_load((DOCKER / file).read_text())["services"] for file in COMPOSE[source]]
    service: dict[str, Any] = {}
    for services in files:
        environment = service.get("environment", {}) | services.get(name, {}).get("environment", {})
        service |= services.get(name, {})
        if environment:
            service["environment"] = environment
    return service


def pod_container(name: str) -> dict[str, Any]:
    deployment = next(yaml.safe_load_all((DOCKER / "kubernetes.yaml").read_text()))
    containers = deployment["spec"]["template"]["spec"]["containers"]
    return next(container for container in containers if container["name"] == name)


def settings(source: str) -> tuple[list[str], dict[str, str]]:
    """Returns the arguments and environment that a deployment gives to the daemon."""
    if source in COMPOSE:
        service = compose_service("server", source)
        return service.get("command", []), {
            name: shell_default(value) for name, value in service["environment"].items()
        }
    container = pod_container("server")
    return container["args"], {entry["name"]: entry["value"] for entry in container["env"]}


@pytest.mark.parametrize("source", SOURCES)
def test_daemon_accepts_its_settings(source: str) -> None:
    if not DAEMON.exists():
        pytest.skip(f"{DAEMON.name} is not built")
    arguments, environment = settings(source)
    result = subprocess.run(
        [DAEMON, *arguments, "--check-config"], env=os.environ | environment, capture_output=True, text=True, timeout=20
    )
    assert result.returncode == 0, result.stdout + result.stderr
    for name, value in environment.items():
        assert value in result.stdout, f"{name} has no effect: {result.stdout}"


def unit_lines(unit: str, name: str) -> list[str]:
    return [line.partition("=")[2] for line in unit.splitlines() if line.startswith(f"{name}=")]


def test_the_unit_starts_the_daemon_with_its_state(tmp_path: Path) -> None:
    unit = (DOCKER / "systemd/tensormassd.service").read_text()
    program, *arguments = unit_lines(unit, "ExecStart")[0].split()
    assert program == "/usr/local/bin/tensormassd"
    assert unit_lines(unit, "Type") == ["notify"]
    assert "75" not in unit_lines(unit, "RestartPreventExitStatus"), "a lost GPU starts the daemon again"
    if not DAEMON.exists():
        pytest.skip(f"{DAEMON.name} is not built")
    arguments = [argument.replace("${STATE_DIRECTORY}", str(tmp_path)) for argument in arguments]
    result = subprocess.run([DAEMON, *arguments, "--check-config"], capture_output=True, text=True, timeout=20)
    assert result.returncode == 0, result.stderr
    assert f'state="{tmp_path}"' in result.stdout


def test_systemd_knows_every_setting_of_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not here")
    unit = tmp_path / "tensormassd.service"
    text = (DOCKER / "systemd/tensormassd.service").read_text()
    unit.write_text(text.replace("/usr/local/bin/tensormassd", "/bin/true"))  # which systemd looks for
    result = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    assert unit.name not in result.stderr, result.stderr


@pytest.mark.parametrize("source", SOURCES)
def test_command_accepts_the_viewers_arguments(source: str) -> None:
    arguments = compose_service("viewer", source)["command"] if source in COMPOSE else pod_container("viewer")["args"]
    parsed = cli._parser().parse_args([shell_default(argument) for argument in arguments])
    assert parsed.port == 8080
    assert parsed.server
    # Another machine reaches an address that is not loopback, so there must be keys for it.
    assert (parsed.keys is None) == is_loopback(parsed.host)


def test_secrets_of_the_pod_are_for_the_containers_alone() -> None:
    """The programs refuse keys that every user can read."""
    deployment = next(yaml.safe_load_all((DOCKER / "kubernetes.yaml").read_text()))
    pod = deployment["spec"]["template"]["spec"]
    secrets = {each["name"]: each["secret"] for each in pod["volumes"] if "secret" in each}
    assert {each["secretName"] for each in secrets.values()} == {"tensormass-keys", "tensormass-gateway"}
    assert all(each["defaultMode"] & 0o007 == 0 for each in secrets.values())
    assert pod["securityContext"]["fsGroup"] == pod["securityContext"]["runAsUser"]
    mounted = {mount["name"] for one in pod["containers"] for mount in one.get("volumeMounts", [])}
    assert set(secrets) <= mounted


def test_dockerfile_copies_what_exists() -> None:
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    assert copied
    for source in " ".join(copied).split():
        assert (ROOT / source).exists(), f"{source} is not in the repository"


def test_prometheus_scrapes_the_address_of_the_daemon_and_has_its_rules() -> None:
    configuration = yaml.safe_load((DOCKER / "prometheus.yaml").read_text())
    assert [job["static_configs"] for job in configuration["scrape_configs"]] == [
        [{"targets": [compose_service("server", "compose with metrics")["environment"]["TENSORMASS_METRICS"]]}]
    ]
    mounted = {volume.split(":")[0] for volume in compose_service("prometheus", "compose with metrics")["volumes"]}
    assert {f"./{file}" for file in ("prometheus.yaml", *configuration["rule_files"])} <= mounted
    assert all((DOCKER / file).exists() for file in mounted if file.startswith("./"))


@pytest.mark.parametrize("file", ["compose.yaml", "compose.gpu.yaml", "compose.keys.yaml", "compose.metrics.yaml"])
def test_compose_builds_targets_and_arguments_that_the_dockerfile_has(file: str) -> None:
    dockerfile = (DOCKER / "Dockerfile").read_text()
    targets = set(re.findall(r"^FROM \S+ AS (\w+)$", dockerfile, re.MULTILINE))
    arguments = set(re.findall(r"^ARG (\w+)", dockerfile, re.MULTILINE))
    for service in yaml.safe_load((DOCKER / file).read_text())["services"].values():
        build = service.get("build", {})
        assert set(build) <= {"context", "dockerfile", "target", "args"}
        assert {build.get("target", "server")} <= targets
        assert set(build.get("args", {})) <= arguments
