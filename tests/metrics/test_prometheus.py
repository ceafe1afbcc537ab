"""A real Prometheus scrapes a daemon with a scene, and a gateway with a token."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from metrics_parts import DOCKER, baseline, families, program

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import control_pb2
from tensormass_gateway.gateway import serve
from tensormass_gateway.options import GatewayOptions

TOKEN = "a-scrapers-token"
BLOCK = """
name: block
stepping: {rate_hz: 100, dt_s: 0.01}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 2, cells_y: 2, cells_z: 1}}
    law: {corotational: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
"""
#: Bounds a broken build only.
DEADLINE_S = 120.0


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    options = ("--metrics", "127.0.0.1:0", "--log-format", "json")
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False, options=options) as server:
        yield server


def endpoint(server: tm.Server) -> str:
    """HOST:PORT of /metrics, as the log has it."""
    assert server.log_file is not None
    lines = [json.loads(line) for line in server.log_file.read_text().splitlines()]
    return str(next(line["metrics"] for line in lines if line.get("metrics")))


def get(url: str) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=DEADLINE_S) as reply:
        return str(reply.read().decode())


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


@pytest.fixture
def gateway(server: tm.Server, tmp_path: Path) -> Iterator[str]:
    """HOST:PORT of a gateway on a loop of its own."""
    (tmp_path / "dist/assets").mkdir(parents=True)
    (tmp_path / "dist/index.html").write_text("")
    options = GatewayOptions(control=server.address, viewer=tmp_path / "dist", metrics_token=TOKEN)
    started, stop = threading.Event(), asyncio.Event()
    found: list[Any] = []

    async def run() -> None:
        async with serve(options) as running:
            found.extend([asyncio.get_running_loop(), f"127.0.0.1:{running.port}"])
            started.set()
            await stop.wait()

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    assert started.wait(DEADLINE_S)
    yield found[1]
    found[0].call_soon_threadsafe(stop.set)
    thread.join()


def test_the_daemon_tells_the_same_over_http_and_grpc(server: tm.Server) -> None:
    over_http = get(f"http://{endpoint(server)}/metrics")
    over_grpc = server.call("GetMetrics", control_pb2.GetMetricsRequest()).text
    assert list(families(over_http)) == list(families(over_grpc))
    expected = [name for name in families(baseline()) if not name.startswith("tensormass_gateway_")]
    assert list(families(over_http)) == expected


class Prometheus:
    """A Prometheus that scrapes `targets`: job -> settings of the job."""

    def __init__(self, folder: Path, jobs: dict[str, dict[str, Any]]) -> None:
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": [str(DOCKER / "prometheus-alerts.yaml")],
            "scrape_configs": [{"job_name": name, **job} for name, job in jobs.items()],
        }
        (folder / "prometheus.yaml").write_text(yaml.safe_dump(config))
        self._log = folder / "prometheus.log"
        command = [
            program("prometheus"),
            f"--config.file={folder / 'prometheus.yaml'}",
            f"--storage.tsdb.path={folder / 'data'}",
            "--web.listen-address=127.0.0.1:0",
        ]
        with self._log.open("w") as output:
            self._process = subprocess.Popen(command, stdout=output, stderr=output)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait()

    @property
    def address(self) -> str | None:
        """HOST:PORT of its interface; None before it listens."""
        assert self._process.poll() is None, self._log.read_text()
        listens = re.search(r"component=web .*address=(127\.0\.0\.1:[1-9]\d*)$", self._log.read_text(), re.MULTILINE)
        return listens and listens[1]

    def is_ready(self) -> bool:
        try:
            return "Ready" in get(f"http://{self.address}/-/ready")
        except OSError:
            return False

    def has(self, query: str) -> bool:
        """Tells whether a series of the query is above 10."""
        return any(value > 10 for _, value in self.ask(query))

    def ask(self, query: str) -> list[tuple[dict[str, str], float]]:
        """Returns the labels and the value of each series of a query."""
        answer = json.loads(get(f"http://{self.address}/api/v1/query?{urllib.parse.urlencode({'query': query})}"))
        assert answer["status"] == "success"
        return [(each["metric"], float(each["value"][1])) for each in answer["data"]["result"]]


def test_a_prometheus_scrapes_daemon_and_gateway(server: tm.Server, gateway: str, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(f"{TOKEN}\n")
    jobs: dict[str, dict[str, Any]] = {
        "tensormass": {"static_configs": [{"targets": [endpoint(server)]}]},
        "gateway": {
            "authorization": {"credentials_file": str(token)},
            "static_configs": [{"targets": [gateway]}],
        },
    }
    prometheus = Prometheus(tmp_path, jobs)
    try:
        wait_for(lambda: prometheus.address is not None, "Prometheus does not listen")
        with server.load(tm.Scene.from_yaml(BLOCK)):
            # The interface listens before it answers queries.
            wait_for(lambda: prometheus.is_ready(), "Prometheus is not ready")
            for job in jobs:
                steps = f'tensormass_step_duration_seconds_count{{scene="block", job="{job}"}}'
                wait_for(partial(prometheus.has, steps), f"no steps in {job}")
            quantile = "histogram_quantile(0.5, tensormass_step_duration_seconds_bucket)"
            assert all(0 < value <= 1 for _, value in prometheus.ask(quantile))
        wait_for(lambda: prometheus.ask("tensormass_gateway_daemon_up") != [], "no metrics of the gateway")
        assert all(bytes_ > 1e6 for _, bytes_ in prometheus.ask("tensormass_memory_bytes"))
        assert prometheus.ask('ALERTS{alertstate="firing"}') == []
        targets = json.loads(get(f"http://{prometheus.address}/api/v1/targets"))["data"]["activeTargets"]
        assert {(each["labels"]["job"], each["health"], each["lastError"]) for each in targets} == {
            ("tensormass", "up", ""),
            ("gateway", "up", ""),
        }
    finally:
        prometheus.stop()
