"""Reports of load tests in which something goes wrong: every test ends with its report."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import full_disk

import tensormass as tm
from tensormass._shared import processes
from tensormass._src.meshes import FloatArray
from tensormass.v1 import control_pb2, stream_pb2
from tensormass_tools import load_report, load_test, load_viewer
from tensormass_tools.cli import main

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
    + "guard: {on_fault: stop}\n"
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


def test_a_scene_that_is_stopped_is_named_in_the_report(
    load: Callable[..., Loaded], monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_until_ready = load_test._LoadTest._wait_until_ready

    def see_them_ready(test: load_test._LoadTest, viewers: list[load_test._Client]) -> None:
        wait_until_ready(test, viewers)
        # A viewer that is still starting would be ended without a report.
        assert all(viewer.ready_file.exists() for viewer in viewers)

    monkeypatch.setattr(load_test._LoadTest, "_wait_until_ready", see_them_ready)
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
    status, report = load(BLOCK, "--haptic", "0", "--viewers", "2", *options)
    assert status == 1
    first, other = report["scenes"][0]["scene"], report["viewers"]
    assert report["errors"] == [f"viewer of {first} (zeromq): ended early with status -9: no word"]
    assert [viewer["transport"] for viewer in other] == ["zenoh"]
    assert other[0]["frame_age"]["count"] > 0
    assert report["stopped_viewer"] is None


def test_edits_change_each_scene_in_every_second_part(load: Callable[..., Loaded]) -> None:
    status, report = load(BLOCK, "--scenes", "2", "--haptic", "0", "--edits", "40", "--seconds", "2")
    edits = report["edits"]
    assert (status, report["errors"], edits["refused"]) == (0, [], 0)
    assert [part["name"] for part in edits["parts"]] == ["without", "with", "without", "with"]
    assert all(part["steps"] > 0 for part in edits["parts"])
    assert edits["calls"]["count"] > 2
    assert edits["calls"]["max_s"] > 0


def test_edits_and_a_stopped_viewer_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["load-test", "--edits", "5", "--stop-viewer", "1", "--json", str(tmp_path / "report.json")]) == 1
    assert "give one of them" in capsys.readouterr().err


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


def test_messages_that_the_daemon_could_not_read_are_errors(
    load: Callable[..., Loaded], monkeypatch: pytest.MonkeyPatch
) -> None:
    version, more = tm.Server.version, itertools.count(5, 2)

    def counting(server: tm.Server) -> control_pb2.GetVersionResponse:
        answer = version(server)
        answer.malformed_messages = next(more)
        return answer

    monkeypatch.setattr(tm.Server, "version", counting)
    status, report = load(BLOCK, "--haptic", "0", "--viewers", "0", "--seconds", "0.01")
    assert (status, report["errors"]) == (1, ["2 messages reached the daemon malformed"])


def test_hands_press_as_long_as_a_viewer_is_stopped_and_watched(
    load: Callable[..., Loaded], monkeypatch: pytest.MonkeyPatch
) -> None:
    start_haptic, lasting_s = load_test._LoadTest._start_haptic, list[float]()

    def start(test: load_test._LoadTest, *args: Any) -> load_test._Client:  # noqa: ANN401
        lasting_s.append(args[-1])
        return start_haptic(test, *args)

    monkeypatch.setattr(load_test._LoadTest, "_start_haptic", start)
    _, report = load(BLOCK, "--stop-viewer", "0.1", "--seconds", "0.01")
    assert lasting_s == [pytest.approx(0.3)]
    assert report["stopped_viewer"]["seconds"] == 0.1
    assert [phase["name"] for phase in report["stopped_viewer"]["phases"]] == ["before", "while stopped", "after"]


def test_unknown_numbers_are_printed_as_dashes() -> None:
    after = stream_pb2.SceneStatus(scene="s", step=10, missed_deadlines=2, poses_received=5)
    scene = load_report.scene_report(stream_pb2.SceneStatus(), after, poses_sent=None)
    assert scene["poses_received"] == 5
    heading, row = load_report.to_text({**EMPTY, "scenes": [scene]}).splitlines()[1:3]
    assert row[heading.index("missed") :].split() == ["2/10", "–", "0", "0", "0"]


def test_a_report_has_the_findings_that_a_scene_does_not_accept() -> None:
    after = stream_pb2.SceneStatus(scene="s")
    after.findings.add(code="FINDING_CODE_LOCKING", message="it locks", remedy="mend it")
    after.findings.add(code="FINDING_CODE_OVERLAP", message="they overlap", remedy="no", accepted="a test")
    scene = load_report.scene_report(stream_pb2.SceneStatus(), after, poses_sent=0)
    assert scene["findings"] == ["locking: it locks; mend it"]


def test_recoveries_are_counted_from_the_start_of_the_test() -> None:
    before = stream_pb2.SceneStatus(scene="s", recoveries=2, recovering_steps=5, held_steps=1)
    after = stream_pb2.SceneStatus(scene="s", recoveries=5, recovering_steps=12, held_steps=3)
    scene = load_report.scene_report(before, after, poses_sent=0)
    assert (scene["recoveries"], scene["recovering_steps"], scene["held_steps"]) == (3, 7, 2)
    heading, row = load_report.to_text({**EMPTY, "scenes": [scene]}).splitlines()[1:3]
    assert row[heading.index("recoveries") :] == "3 (7 steps)"


NO_TIME = dict.fromkeys(("p50_s", "p99_s", "p999_s", "max_s"), 0.0)
HAPTIC: dict[str, Any] = {
    "scene": "s",
    "tool": "probe",
    "transport": "zenoh",
    "poses_sent": 1000,
    "last_sequence_sent": 1000,
    "last_sequence_echoed": 1000,
    "feedback_malformed": 0,
    "feedback_dropped": 4,
    "stale_ticks": 5,
    "max_force_n": 0.5,
    "pose_to_force": NO_TIME,
}


def test_people_see_how_many_poses_were_lost() -> None:
    none = {**NO_TIME, "count": 0}
    report = {**EMPTY, "haptic": [{**HAPTIC, "last_sequence_echoed": 993}]}
    times = dict.fromkeys(("pose_to_force", "answered_pose_age", *load_report.PARTS_OF_THE_AGE), none)
    heading, row = load_report.to_text({**report, **times}).splitlines()[7:9]
    assert row[heading.index("sent") :].split() == ["1000", "7", "4", "5", "0.50"]


class Process:
    """A client's process, which remembers what it was told."""

    def __init__(self) -> None:
        self.running = True
        self.process = self
        self.signals: list[signal.Signals] = []

    def send_signal(self, which: signal.Signals) -> None:
        self.signals.append(which)

    def stop(self) -> int:
        self.running = False
        return 0


def client_of(folder: Path, name: str) -> load_test._Client:
    files = (folder / f"{name}.{kind}" for kind in ("log", "report", "ready"))
    client = load_test._Client(Process(), "s", "zenoh", *files)  # type: ignore[arg-type]
    client.log_file.write_text("")
    return client


def test_a_viewer_ends_the_test_only_with_its_daemon(tmp_path: Path) -> None:
    viewer = client_of(tmp_path, "viewer")
    viewer.process.stop()

    def watch(version: Callable[[], object]) -> None:
        viewer.ended_early = False
        server: Any = SimpleNamespace(version=version)
        test = load_test._LoadTest(SimpleNamespace(), server, tmp_path, contextlib.ExitStack())  # type: ignore[arg-type]
        test._watch([viewer], lambda: viewer.ended_early)

    watch(lambda: None)

    def gone() -> None:
        raise tm.UnavailableError("nobody answers")

    with pytest.raises(tm.UnavailableError, match="nobody answers"):
        watch(gone)


def a_test(folder: Path, **options: object) -> load_test._LoadTest:
    return load_test._LoadTest(SimpleNamespace(**options), None, folder, contextlib.ExitStack())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("said", "error"),
    [
        ({}, None),
        ({"last_sequence_echoed": 998}, "the last 2 poses were never answered"),
        ({"feedback_malformed": 3}, "3 malformed messages"),
    ],
)
def test_lost_poses_of_a_haptic_client_are_an_error(tmp_path: Path, said: dict[str, int], error: str | None) -> None:
    client, test = client_of(tmp_path, "haptic"), a_test(tmp_path)
    client.process.stop()
    client.report_file.write_text(json.dumps({**HAPTIC, **said}))
    assert test._end_haptic(client) == {**HAPTIC, **said}
    assert test._errors == ([] if error is None else [f"haptic client of s/probe (zenoh): {error}"])


def test_a_client_that_ends_early_has_failed_though_it_says_otherwise(tmp_path: Path) -> None:
    client = client_of(tmp_path, "viewer")
    client.status = 0
    assert client.failure() is None
    client.ended_early = True
    assert client.failure() == "ended early with status 0: no word"


def test_ages_of_a_viewer_that_was_stopped_are_its_own(tmp_path: Path) -> None:
    viewers = [client_of(tmp_path, name) for name in ("first", "second")]
    for viewer, ages_s in zip(viewers, ([9.0], [1.0, 2.0]), strict=True):
        with viewer.report_file.open("wb") as file:
            np.savez(file, ages_s=np.array(ages_s), dropped=3)
    for stopped, ages in ((True, [1, 2]), (False, [9, 1, 2])):
        reports, all_ages = a_test(tmp_path)._end_viewers(viewers, stopped)
        assert all_ages.tolist() == ages
        assert [report["was_stopped"] for report in reports] == [stopped, False]
        assert [report["frame_age"]["max_s"] for report in reports] == [9.0, 2.0]


def test_a_viewer_that_was_stopped_goes_on(tmp_path: Path) -> None:
    viewer, missed = client_of(tmp_path, "viewer"), iter(range(0, 60, 10))
    scene: Any = SimpleNamespace(status=lambda: stream_pb2.SceneStatus(missed_deadlines=next(missed)))
    report = a_test(tmp_path)._with_a_stopped_viewer(viewer, scene, 0.0)
    assert report is not None
    assert viewer.process.signals == [signal.SIGSTOP, signal.SIGCONT]  # type: ignore[attr-defined]
    phases = [(phase["name"], phase["missed_deadlines"]) for phase in report["phases"]]
    assert phases == [("before", 10), ("while stopped", 10), ("after", 10)]


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
    """Gives out frames and raises what a test puts into it; then SIGTERM comes. Two are lost before each."""

    def __init__(self, items: list[Any]) -> None:
        self._items = iter(items)
        self.dropped_count = 0

    def __iter__(self) -> Frames:
        return self

    def __next__(self) -> Any:  # noqa: ANN401
        item = next(self._items, None)
        if item is None:
            os.kill(os.getpid(), signal.SIGTERM)
        if isinstance(item, Exception):
            raise item
        self.dropped_count += 2
        return item


FRAME = SimpleNamespace(server_time_ns=0, sequence=1, positions=np.zeros((3, 3)))
NOTHING_CAME = tm.DeadlineExceededError("nothing came in 5 s")
RUNNING, FAULTED = stream_pb2.SceneStatus.STATE_RUNNING, stream_pb2.SceneStatus.STATE_FAULTED


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., int]]:
    """Runs a viewer in this process on frames of a test's own, and a daemon that answers or does not."""

    def view(items: list[Any], states: Iterator[stream_pb2.SceneStatus.State] = itertools.repeat(RUNNING)) -> int:  # noqa: B008
        def status() -> stream_pb2.SceneStatus:
            state = next(states, None)
            if state is None:
                raise tm.UnavailableError("nobody answers")
            return stream_pb2.SceneStatus(state=state)

        topology = stream_pb2.Topology(bodies=[stream_pb2.BodySurface(vertex_count=3)])
        scene = SimpleNamespace(topology=lambda: topology, status=status, frames=lambda _: Frames(items))
        server = SimpleNamespace(scene=lambda _: scene)
        monkeypatch.setattr(load_viewer, "connect", lambda _, keys=None: contextlib.nullcontext(server))
        command = ["--server", "a:1", "--scene", "s", "--transport", "zeromq"]
        return load_viewer.main([*command, "--ready", str(tmp_path / "ready"), "--report", str(tmp_path / "report")])

    handler = signal.getsignal(signal.SIGTERM)
    yield view
    signal.signal(signal.SIGTERM, handler)


def test_a_viewer_waits_as_long_as_the_test_takes(view: Callable[..., int], tmp_path: Path) -> None:
    assert view([FRAME, NOTHING_CAME, FRAME, NOTHING_CAME, NOTHING_CAME, FRAME]) == 0
    with np.load(tmp_path / "report") as report:
        assert len(report["ages_s"]) == 2  # all but the one by call
        assert report["dropped"] == 2  # between the two
    assert (tmp_path / "ready").exists()


@pytest.mark.parametrize(
    ("items", "states", "ready"),
    [
        ([FRAME], [RUNNING], False),
        ([FRAME], [FAULTED], True),
        ([FRAME, NOTHING_CAME], [RUNNING, RUNNING], False),
        ([FRAME, NOTHING_CAME], [RUNNING, FAULTED], True),
        ([FRAME, FRAME], [RUNNING], True),
    ],
)
def test_a_viewer_of_a_scene_that_is_stopped_is_ready_too(
    view: Callable[..., int], tmp_path: Path, items: list[Any], states: list[int], ready: bool
) -> None:
    assert view(items, iter(states)) == 0
    assert (tmp_path / "ready").exists() == ready


def test_ages_are_in_seconds(view: Callable[..., int], tmp_path: Path) -> None:
    before_s = time.time()
    assert view([FRAME, SimpleNamespace(**{**vars(FRAME), "server_time_ns": int((before_s - 3) * 1e9)})]) == 0
    with np.load(tmp_path / "report") as report:
        assert 3 <= report["ages_s"][0] + 1e-6 <= 3 + time.time() - before_s + 1e-3


@pytest.mark.parametrize("positions", [np.zeros((2, 3)), np.full((3, 3), np.nan)])
def test_a_frame_that_is_not_whole_is_a_failure(
    view: Callable[..., int], capsys: pytest.CaptureFixture[str], positions: FloatArray
) -> None:
    assert view([FRAME, SimpleNamespace(**{**vars(FRAME), "positions": positions})]) == 1
    assert capsys.readouterr().err == "frame 1 is not 3 finite positions\n"


def test_a_viewer_does_not_wait_for_a_daemon_that_is_gone(
    view: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert view([FRAME, FRAME, NOTHING_CAME], iter([RUNNING])) == 1
    assert capsys.readouterr().err == "s: nobody answers\n"
