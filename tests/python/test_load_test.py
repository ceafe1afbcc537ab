"""What a load test reports when something goes wrong in it: it never ends without its report."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import full_disk

import tensormass as tm
from tensormass import load_report, load_test, load_viewer, processes
from tensormass.cli import main
from tensormass.v1 import stream_pb2

BLOCK = """
name: block
stepping: {dt_s: 0.01}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 3, cells_y: 3, cells_z: 2}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - {name: probe, spherical_probe: {radius_m: 0.01}, position_m: {x: 0.05, y: 0.05, z: 0.1}}
"""
# No step reaches that, so a guard stops the scene at once.
STOPPED = (
    BLOCK
    + "gravity_m_per_s2: {z: -9.81}\nsolver: {cg_max_iterations: 1, cg_tolerance: 1.0e-9, floor_tolerance: 1.0e-9}\n"
)

EMPTY: dict[str, Any] = {
    "scene_source": "s",
    "seconds": 1.0,
    "server": {"device": "", "backend": "cpu"},
    **{of: [] for of in ("scenes", "haptic", "viewers", "errors")},
}

Loaded = tuple[int, dict[str, Any]]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
        processes.find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server


@pytest.fixture
def load(server: tm.Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Loaded]:
    """Loads the module's daemon with a scene's text for a second."""

    def load(scene: str, *options: str) -> Loaded:
        (tmp_path / "scene.yaml").write_text(scene)
        report = tmp_path / "report.json"
        command = ["load-test", "--scene", str(tmp_path / "scene.yaml"), "--server", server.address, "--seconds", "1"]
        status = main([*command, "--json", str(report), *options])
        assert capsys.readouterr().out.splitlines()[-1].endswith(" errors")
        assert server.scenes() == []
        return status, json.loads(report.read_text())

    return load


def test_a_scene_that_is_stopped_is_named_in_the_report(load: Callable[..., Loaded]) -> None:
    status, report = load(STOPPED, "--haptic", "0")
    (scene,) = report["scenes"]
    assert (status, scene["state"]) == (1, "STATE_FAULTED")
    assert report["errors"] == [f"scene {scene['scene']} is faulted: {scene['fault']}"]
    assert scene["fault"].startswith("step 1 left its bounds")
    assert [viewer["scene"] for viewer in report["viewers"]] == [scene["scene"]]


@pytest.mark.parametrize("options", [(), ("--stop-viewer", "0.1")])
def test_a_viewer_that_ends_is_named_in_the_report(
    load: Callable[..., Loaded], monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...]
) -> None:
    wait_until_ready = load_test._LoadTest._wait_until_ready

    def then_end_the_first(test: load_test._LoadTest, viewers: list[load_test._Client]) -> None:
        wait_until_ready(test, viewers)
        viewers[0].process.process.kill()

    monkeypatch.setattr(load_test._LoadTest, "_wait_until_ready", then_end_the_first)
    monkeypatch.setattr(load_test, "_STATUS_WINDOW_STEPS", 10)
    status, report = load(BLOCK, "--haptic", "0", "--viewers", "2", *options)
    assert status == 1
    first, other = report["scenes"][0]["scene"], report["viewers"]
    assert report["errors"] == [f"viewer of {first} (zeromq): ended early with status -9: no word"]
    assert [viewer["transport"] for viewer in other] == ["zenoh"]
    assert other[0]["frame_age"]["count"] > 0
    assert report["stopped_viewer"] is None


def test_poses_of_a_client_that_failed_are_not_known(
    load: Callable[..., Loaded], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    haptic = processes.find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
    broken = tmp_path / "haptic"
    broken.write_text(f'#!/bin/sh\ncase "$*" in *zenoh*) echo it broke; exit 7;; esac\nexec "{haptic}" "$@"\n')
    broken.chmod(0o755)
    monkeypatch.setenv("TENSORMASS_HAPTIC", str(broken))
    status, report = load(BLOCK, "--haptic", "2", "--scenes", "2", "--viewers", "0")
    whole, without = report["scenes"]
    assert status == 1
    assert report["errors"][0] == f"haptic client of {without['scene']} (zenoh): status 7: it broke"
    assert whole["poses_sent"] == report["haptic"][0]["poses_sent"] > 0
    assert without["poses_sent"] is without["poses_overtaken_on_the_way"] is None


def test_what_is_not_known_is_a_dash_for_people() -> None:
    after = stream_pb2.SceneStatus(scene="s", step=10, poses_received=5)
    scene = load_report.scene_report(stream_pb2.SceneStatus(), after, poses_sent=None)
    assert scene["poses_received"] == 5
    heading, row = load_report.to_text({**EMPTY, "scenes": [scene]}).splitlines()[1:3]
    assert row[heading.index("poses sent") :].split() == ["–", "0", "0"]


def test_a_full_disk_leaves_the_report_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(load_test, "load_test", lambda _: EMPTY)
    file = tmp_path / "report.json"
    file.write_text("an older one\n")
    with full_disk(20):
        assert main(["load-test", "--json", str(file)]) == 1
    said = capsys.readouterr()
    assert said.err == f"tensormass: --json {file}: cannot be written: File too large\n"
    assert said.out.startswith("load test of s on cpu")
    assert file.read_text() == "an older one\n"


# --- the viewer -------------------------------------------------------------------------------------------------------


class Frames:
    """Gives out frames and raises what a test puts into it; then SIGTERM comes."""

    dropped_count = 0

    def __init__(self, items: list[Any]) -> None:
        self._items = iter(items)

    def __iter__(self) -> Frames:
        return self

    def __next__(self) -> Any:  # noqa: ANN401
        item = next(self._items, None)
        if item is None:
            os.kill(os.getpid(), signal.SIGTERM)
        if isinstance(item, Exception):
            raise item
        return item


FRAME = SimpleNamespace(server_time_ns=0, sequence=1, positions=np.zeros((3, 3)))
NOTHING_CAME = tm.DeadlineExceededError("nothing came in 5 s")


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., int]]:
    """Runs a viewer in this process on frames of a test's own, and a daemon that answers or does not."""

    def view(items: list[Any], daemon_is_gone: bool = False) -> int:
        def status() -> stream_pb2.SceneStatus:
            if daemon_is_gone:
                raise tm.UnavailableError("nobody answers")
            return stream_pb2.SceneStatus(state=stream_pb2.SceneStatus.STATE_FAULTED)

        topology = stream_pb2.Topology(bodies=[stream_pb2.BodySurface(vertex_count=3)])
        scene = SimpleNamespace(topology=lambda: topology, status=status, frames=lambda _: Frames(items))
        server = SimpleNamespace(scene=lambda _: scene)
        monkeypatch.setattr(load_viewer, "connect", lambda _: contextlib.nullcontext(server))
        command = ["--server", "a:1", "--scene", "s", "--transport", "zeromq"]
        return load_viewer.main([*command, "--ready", str(tmp_path / "ready"), "--report", str(tmp_path / "report")])

    handler = signal.getsignal(signal.SIGTERM)
    yield view
    signal.signal(signal.SIGTERM, handler)


def test_a_viewer_waits_as_long_as_the_test_takes(view: Callable[..., int], tmp_path: Path) -> None:
    assert view([FRAME, NOTHING_CAME, FRAME, NOTHING_CAME, NOTHING_CAME, FRAME]) == 0
    with np.load(tmp_path / "report") as report:
        assert len(report["ages_s"]) == 2  # all but the one by call
    assert (tmp_path / "ready").exists()


def test_a_viewer_does_not_wait_for_a_daemon_that_is_gone(
    view: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert view([FRAME, FRAME, NOTHING_CAME], daemon_is_gone=True) == 1
    assert capsys.readouterr().err == "s: nobody answers\n"
