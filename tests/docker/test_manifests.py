"""What the manifests name exists: volumes, Secrets, ports, paths, variables, panels. No cluster is asked."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
DAEMON = ROOT / os.environ.get("BUILD", "build") / "bin/tensormassd"
KUBERNETES = (DOCKER / "kubernetes.yaml").read_text()
DOCUMENTS: dict[str, dict[str, Any]] = {each["kind"]: each for each in yaml.safe_load_all(KUBERNETES)}
POD: dict[str, Any] = DOCUMENTS["Deployment"]["spec"]["template"]
CONTAINERS: dict[str, dict[str, Any]] = {each["name"]: each for each in POD["spec"]["containers"]}
COMPOSE = ("compose.yaml", "compose.gpu.yaml", "compose.keys.yaml", "compose.metrics.yaml")


def value_of(arguments: list[str], option: str) -> str:
    return arguments[arguments.index(option) + 1]


def is_below(path: str, mounts: list[str]) -> bool:
    return any(PurePosixPath(path).is_relative_to(mount) for mount in mounts)


def test_volumes_of_the_pod_are_declared_and_used() -> None:
    declared = [volume["name"] for volume in POD["spec"]["volumes"]]
    mounted = [mount["name"] for one in CONTAINERS.values() for mount in one["volumeMounts"]]
    assert sorted(declared) == sorted(set(mounted)) == sorted(mounted)


def test_the_page_says_how_each_secret_is_made_with_the_files_that_are_read() -> None:
    made = {
        name: {PurePosixPath(file).name for file in re.findall(r"--from-file=(\S+)", files)}
        for name, files in re.findall(r"kubectl create secret generic (\S+)((?: --from-file=\S+)+)", KUBERNETES)
    }
    volumes = {each["name"]: each["secret"]["secretName"] for each in POD["spec"]["volumes"] if "secret" in each}
    assert set(made) == set(volumes.values())
    for name, container in CONTAINERS.items():
        folders = {mount["mountPath"]: volumes.get(mount["name"]) for mount in container["volumeMounts"]}
        keys = PurePosixPath(value_of(container["args"], "--keys"))
        if name == "server":  # it reads a folder, as a client does a file
            assert made[folders[str(keys)] or ""] == {"daemon.json", "clients.json"}
        else:
            assert made[folders[str(keys.parent)] or ""] == {keys.name}
        assert all(mount["readOnly"] for mount in container["volumeMounts"] if mount["name"] in volumes)


def test_files_that_the_containers_write_lie_in_volumes() -> None:
    for container in CONTAINERS.values():
        assert container["securityContext"]["readOnlyRootFilesystem"]
    server = CONTAINERS["server"]
    state = next(entry["value"] for entry in server["env"] if entry["name"] == "TENSORMASS_STATE")
    writable = [mount["mountPath"] for mount in server["volumeMounts"] if not mount.get("readOnly")]
    assert is_below(state, writable)


def test_ports_agree_from_the_daemon_to_the_service() -> None:
    ports = {port["name"]: port["containerPort"] for one in CONTAINERS.values() for port in one["ports"]}
    listens = {
        int(address) for entry in CONTAINERS["server"]["env"] for address in re.findall(r":(\d+)$", str(entry["value"]))
    }
    assert listens == {port["containerPort"] for port in CONTAINERS["server"]["ports"]}
    assert int(value_of(CONTAINERS["viewer"]["args"], "--port")) == ports["http"]
    assert value_of(CONTAINERS["viewer"]["args"], "--server") == f"localhost:{ports['control']}"
    served = {port["name"]: port["port"] for port in DOCUMENTS["Service"]["spec"]["ports"]}
    assert served == {name: port for name, port in ports.items() if name != "health"}
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert CONTAINERS["server"][probe]["grpc"]["port"] == ports["health"]


def test_labels_select_the_pod() -> None:
    labels = POD["metadata"]["labels"].items()
    for selector in (
        DOCUMENTS["Deployment"]["spec"]["selector"]["matchLabels"],
        DOCUMENTS["Service"]["spec"]["selector"],
        DOCUMENTS["NetworkPolicy"]["spec"]["podSelector"]["matchLabels"],
    ):
        assert selector.items() <= labels
    for rule in DOCUMENTS["NetworkPolicy"]["spec"]["ingress"]:
        assert rule["from"], "an empty list lets everybody in"


def test_variables_are_those_of_the_daemons_help() -> None:
    if not DAEMON.exists():
        pytest.skip(f"{DAEMON.name} is not built")
    help_text = subprocess.run([DAEMON, "--help"], capture_output=True, text=True, timeout=60).stdout
    known = set(re.findall(r"TENSORMASS_\w+", help_text))
    used = {entry["name"] for entry in CONTAINERS["server"]["env"]}
    options = {argument for argument in CONTAINERS["server"]["args"] if argument.startswith("--")}
    for file in COMPOSE:
        server = yaml.safe_load((DOCKER / file).read_text())["services"].get("server", {})
        used |= set(server.get("environment", {}))
        options |= {argument for argument in server.get("command", []) if argument.startswith("--")}
    assert used <= known
    assert all(re.search(rf"(?<!\S){option}(?!\S)", help_text) for option in options)


@pytest.mark.parametrize("service", ["server", "viewer"])
def test_compose_mounts_the_keys_that_it_names(service: str) -> None:
    one = yaml.safe_load((DOCKER / "compose.keys.yaml").read_text())["services"][service]
    volumes = [volume.removesuffix(":ro").rpartition(":") for volume in one["volumes"]]
    mounts = {place: source for source, _, place in volumes}
    keys = one["environment"]["TENSORMASS_KEYS"] if service == "server" else value_of(one["command"], "--keys")
    assert keys in mounts
    assert mounts[keys].startswith("${TENSORMASS_KEYS:?")


def test_panels_of_the_dashboard_are_told_apart_and_do_not_overlap() -> None:
    dashboard = json.loads((DOCKER / "grafana-dashboard.json").read_text())
    panels = dashboard["panels"]
    assert len({panel["id"] for panel in panels}) == len({panel["title"] for panel in panels}) == len(panels)
    cells = [
        (x, y)
        for place in (panel["gridPos"] for panel in panels)
        for x in range(place["x"], place["x"] + place["w"])
        for y in range(place["y"], place["y"] + place["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24, "Grafana has 24 columns"
    variables = {each["name"] for each in dashboard["templating"]["list"]}
    used = set(re.findall(r"\$\{?([a-z]\w*)", json.dumps(panels)))
    assert used <= variables
    for panel in panels:
        letters = [target["refId"] for target in panel["targets"]]
        assert len(set(letters)) == len(letters)
