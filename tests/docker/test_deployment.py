"""The programs accept the settings that docker/ gives them. The images are not built: that needs a container engine."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tensormass_tools import cli

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
DAEMON = ROOT / os.environ.get("BUILD", "build") / "bin/tensormassd"


def shell_default(text: str) -> str:
    """Replaces `${NAME:-default}` by its default, as Compose does if NAME is not set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)


def compose_service(name: str) -> dict[str, Any]:
    files = [yaml.safe_load((DOCKER / file).read_text())["services"] for file in ("compose.yaml", "compose.gpu.yaml")]
    service: dict[str, Any] = {}
    for services in files:
        service |= services.get(name, {})
    return service


def pod_container(name: str) -> dict[str, Any]:
    deployment = next(yaml.safe_load_all((DOCKER / "kubernetes.yaml").read_text()))
    containers = deployment["spec"]["template"]["spec"]["containers"]
    return next(container for container in containers if container["name"] == name)


def settings(source: str) -> tuple[list[str], dict[str, str]]:
    """Returns the arguments and environment that a deployment gives to the daemon."""
    if source == "compose":
        service = compose_service("server")
        return service["command"], {name: shell_default(value) for name, value in service["environment"].items()}
    container = pod_container("server")
    environment = {entry["name"]: entry["value"] for entry in container["env"] if "value" in entry}
    return container["args"], {name: value.replace("$(POD_IP)", "192.0.2.7") for name, value in environment.items()}


@pytest.mark.parametrize("source", ["compose", "kubernetes"])
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


@pytest.mark.parametrize("source", ["compose", "kubernetes"])
def test_command_accepts_the_viewers_arguments(source: str) -> None:
    arguments = compose_service("viewer")["command"] if source == "compose" else pod_container("viewer")["args"]
    parsed = cli._parser().parse_args([shell_default(argument) for argument in arguments])
    assert parsed.port == 8080
    assert parsed.server


def test_dockerfile_copies_what_exists() -> None:
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    assert copied
    for source in " ".join(copied).split():
        assert (ROOT / source).exists(), f"{source} is not in the repository"


@pytest.mark.parametrize("file", ["compose.yaml", "compose.gpu.yaml"])
def test_compose_builds_targets_and_arguments_that_the_dockerfile_has(file: str) -> None:
    dockerfile = (DOCKER / "Dockerfile").read_text()
    targets = set(re.findall(r"^FROM \S+ AS (\w+)$", dockerfile, re.MULTILINE))
    arguments = set(re.findall(r"^ARG (\w+)", dockerfile, re.MULTILINE))
    for service in yaml.safe_load((DOCKER / file).read_text())["services"].values():
        build = service.get("build", {})
        assert set(build) <= {"context", "dockerfile", "target", "args"}
        assert {build.get("target", "server")} <= targets
        assert set(build.get("args", {})) <= arguments
