"""Which mesh `tensormass run` takes of a built-in scene: the decision, its words, the wiring with a fake measure."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Recorder

import tensormass as tm
from tensormass._shared import defaults
from tensormass._shared.processes import ChildProcess
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_tools import fit_scene, fits, fitting, presets, priority, run
from tensormass_tools.cli import main
from tensormass_tools.fits import Rung
from tensormass_tools.fitting import Choice, Fit, Machine, Measured, choose
from tensormass_tools.trade.knobs import Knobs

LADDER = (Rung({}, 1.0, 0.04), Rung({"resolution": 0.7}, 0.4, 0.1), Rung({"resolution": 0.5}, 0.15, 0.24))
PERIOD_S = 1 / 60
TWO_CORES = Machine.of("cpu", 2, None)
EIGHT_CORES = Machine.of("cpu", 8, None)


def takes(times_ms: Mapping[Choice, float], asked: list[Choice]) -> Callable[[Choice], Measured | None]:
    """Returns a measure with these 99th percentiles, which notes what it is asked for."""

    def measure(choice: Choice) -> Measured | None:
        asked.append(choice)
        time_ms = times_ms.get(choice)
        return None if time_ms is None else Measured(time_ms / 1500, time_ms / 1000, PERIOD_S, 1000 - choice.rung)

    return measure


def fit(machine: Machine, times_ms: Mapping[Choice, float]) -> tuple[Fit | None, list[Choice]]:
    asked: list[Choice] = []
    return choose(LADDER, [PERIOD_S] * 3, machine, takes(times_ms, asked)), asked


def test_priority_lets_a_step_take_more_of_its_period() -> None:
    shares = [of.share() for of in (TWO_CORES, replace(TWO_CORES, realtime=True), replace(EIGHT_CORES, realtime=True))]
    assert shares == sorted(set(shares))
    assert [Machine.of("cpu", cores, None).may_have_priority() for cores in (1, 2, 4)] == [False, True, False]
    assert not Machine.of("cpu", 2, 2).may_have_priority(), "no core would be left"


def test_threads_leave_cores_for_the_others() -> None:
    assert [Machine.of("cpu", cores, None).threads for cores in (1, 2, 3, 16)] == [1, 1, 1, 8]
    assert [Machine.of("cpu", cores, None).crowded() for cores in (1, 2, 3, 4, 16)] == [True, True, False, False, False]
    assert Machine.of("cpu", 4, 3).crowded()
    assert not Machine.of("cuda", 2, None).crowded()
    assert [Machine.of("cpu", cores, None).more_threads() for cores in (1, 2, 3, 4, 8)] == [None, None, None, None, 6]
    assert Machine.of("cpu", 8, 2).more_threads() is None, "the user chose"
    assert Machine.of("cuda", 8, None).more_threads() is None


@pytest.mark.parametrize(
    ("machine", "time_ms"),
    [(EIGHT_CORES, 14.9), (Machine.of("cuda", 2, None), 14.9), (TWO_CORES, 8.2), (Machine.of("cpu", 3, None), 14.9)],
)
def test_nothing_changes_where_there_is_room(machine: Machine, time_ms: float) -> None:
    found, asked = fit(machine, {Choice(0): time_ms})
    assert found is not None
    assert asked == [Choice(0)]
    assert not found.changed
    assert found.leaves_room
    text = fitting.sentence("demo", LADDER, found)
    assert text == f"demo: 1,000 tetrahedra; a step takes {time_ms:.3g} ms of its 16.7 ms, which leaves room"


def test_a_scene_that_just_keeps_its_rate_leaves_no_room_on_two_cores() -> None:
    found, asked = fit(TWO_CORES, {Choice(0): 14.9, Choice(1): 6.1})
    assert found is not None
    assert asked == [Choice(0), Choice(1)]
    assert found.choice == Choice(1)
    assert found.leaves_room
    assert fitting.sentence("demo", LADDER, found) == (
        "demo: 999 tetrahedra instead of 1,000, because a step took 14.9 ms here and now takes 6.1 ms of 16.7 ms. "
        "The force of a held press is then 10 % off instead of 4 (docs/decisions/first-look.md). "
        "--no-fit keeps the scene"
    )


def test_the_measured_cost_decides_what_is_measured_next() -> None:
    # Four times too slow: the second mesh would be too slow as well.
    assert fit(TWO_CORES, {Choice(0): 33.0, Choice(2): 5.0})[1] == [Choice(0), Choice(2)]
    # The second mesh was expected to fit and does not, so the next one follows.
    found, asked = fit(TWO_CORES, {Choice(0): 20.0, Choice(1): 8.5, Choice(2): 3.0})
    assert asked == [Choice(0), Choice(1), Choice(2)]
    assert found is not None
    assert found.choice == Choice(2)


def test_the_coarsest_mesh_is_taken_and_its_lateness_said() -> None:
    found, asked = fit(TWO_CORES, {Choice(0): 200.0, Choice(2): 30.0})
    assert asked == [Choice(0), Choice(2)]
    assert found is not None
    assert found.choice == Choice(2)
    assert not found.leaves_room
    text = fitting.sentence("retract", LADDER, found)
    assert "now takes 30 ms of 16.7 ms. That is more than 50 %, so steps will be late beside a viewer. " in text
    assert "is then 24 % off instead of 4, as measured in 'demo' (docs/decisions/first-look.md)" in text


def test_more_threads_come_before_a_coarser_mesh() -> None:
    found, asked = fit(EIGHT_CORES, {Choice(0): 17.0, Choice(0, 6): 13.0})
    assert asked == [Choice(0), Choice(0, 6)]
    assert found is not None
    text = fitting.sentence("demo", LADDER, found)
    assert text == (
        "demo: 6 threads, because a step took 17 ms here and now takes 13 ms of 16.7 ms. --no-fit keeps the scene"
    )
    slower, _ = fit(EIGHT_CORES, {Choice(0): 17.0, Choice(0, 6): 19.0, Choice(1): 7.0})
    assert slower is not None
    assert slower.choice == Choice(1)


def test_a_scene_that_cannot_be_measured_is_kept() -> None:
    assert fit(TWO_CORES, {}) == (None, [Choice(0)])
    found, asked = fit(TWO_CORES, {Choice(0): 14.9})  # the coarser one stops
    assert asked == [Choice(0), Choice(1)]
    assert found is not None
    assert not found.changed
    assert fitting.sentence("demo", LADDER, found) == (
        "demo: 1,000 tetrahedra; a step takes 14.9 ms of its 16.7 ms. That is more than 50 %, so steps will be late "
        "beside a viewer"
    )


def test_a_slower_rate_counts_as_room() -> None:
    asked: list[Choice] = []
    ladder = (Rung({}, 1.0, 0.01), Rung({"resolution": 0.5}, 0.95, 0.05))
    machine = Machine.of("cuda", 8, None)
    found = choose(ladder, [1 / 960, PERIOD_S], machine, takes({Choice(0): 40.0, Choice(1): 15.0}, asked))
    assert found is not None
    assert found.choice == Choice(1)


def test_every_committed_mesh_is_one_of_its_scene(tmp_path: Path) -> None:
    for scene, backend in [(name, of) for name in tm.builtin_scenes() for of in ("cpu", "cuda")]:
        ladder = fits.ladder_of(scene, backend)
        if not ladder:
            continue
        knobs = Knobs(SceneFile.read(scene), tmp_path)
        assert ladder[0].setting == presets.FOR_BACKEND.get(backend, {}).get(scene, {})
        for rung in ladder:
            assert knobs.canonical(rung.setting) == rung.setting
        if backend == "cpu":
            assert knobs.apply(ladder[-1].setting).message().name == scene
    assert {len(fits.ladder_of(scene, "cpu")) for scene in (fits.MEASURED, *fits.LIKE)} == {3}
    for nothing in (("cantilever", "cpu"), ("beam", "cuda"), (None, "cpu"), ("demo", "")):
        assert fits.ladder_of(*nothing) == ()


@pytest.mark.parametrize(
    ("steps", "missed", "p99_ms", "said"),
    [
        (600, 6, 10.0, ""),
        (100, 50, 10.0, ""),
        (600, 60, 10.0, "scene 's' misses 10 % of its deadlines, although a step takes 10 of 16.7 ms"),
        (600, 300, 30.0, "a step takes 30 of 16.7 ms (99th percentile). It needs --rate 30 or about 50 % of its elem"),
    ],
)
def test_a_late_scene_of_a_user_gets_advice(steps: int, missed: int, p99_ms: float, said: str) -> None:
    status = stream_pb2.SceneStatus(
        scene="s", step=steps, missed_deadlines=missed, target_rate_hz=60, step_time_p99_s=p99_ms / 1000
    )
    advice = fitting.advice(status)
    assert said in advice
    assert bool(said) == bool(advice)


# --- the wiring -------------------------------------------------------------------------------------------------------


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[scene_pb2.Scene]:
    """Replaces the measure by one of two slow cores. Returns the scenes that it was asked for."""
    asked: list[scene_pb2.Scene] = []

    def measure(
        _server: object, scene: scene_pb2.Scene, _hand: object, _share: float, prepare: Callable[[], object]
    ) -> Measured:
        prepare()
        copy = scene_pb2.Scene()
        copy.CopyFrom(scene)
        asked.append(copy)
        size = len(scene.bodies[0].mesh.packed.node_positions)
        return Measured(2e-8 * size, 1.2e-7 * size, defaults.dt_s(scene), size)

    monkeypatch.setattr(fit_scene, "measure", measure)
    monkeypatch.setattr(fit_scene, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return asked


@pytest.fixture
def daemon(recorder: tuple[Recorder, tm.Server], monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """A fake daemon on a CPU, for `run`."""
    fake, server = recorder
    fake.replies |= {
        "GetVersion": control_pb2.GetVersionResponse(version="1", backend="cpu", device="two cores"),
        "LoadScene": control_pb2.LoadSceneResponse(),
        "GetTopology": control_pb2.GetTopologyResponse(),
        "GetStatus": control_pb2.GetStatusResponse(status=stream_pb2.SceneStatus(scene="demo")),
    }
    monkeypatch.setattr(run, "launch", lambda **_: server)
    return fake


RUN = ["run", "demo", "--no-viewer", "--no-haptic", "--seconds", "0.001"]


def loaded(daemon: Recorder) -> scene_pb2.Scene:
    (scene,) = [of.scene for of in daemon.asked if isinstance(of, control_pb2.LoadSceneRequest)]
    return scene


def test_run_says_first_what_it_fitted_and_loads_that(
    daemon: Recorder, measured: list[scene_pb2.Scene], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(RUN) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("demo: ")
    assert first.endswith("--no-fit keeps the scene")
    assert second.startswith("tensormassd ")
    assert len(measured) == 2
    assert measured[0].bodies[0] == tm.Scene.from_file("demo").message.bodies[0]
    assert loaded(daemon).bodies[0] == measured[1].bodies[0]
    assert (
        len(measured[1].bodies[0].mesh.packed.node_positions)
        < len(measured[0].bodies[0].mesh.packed.node_positions) / 2
    )


def test_run_tells_programs_what_it_fitted(
    daemon: Recorder, measured: list[scene_pb2.Scene], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, "--json"]) == 0
    where = json.loads(capsys.readouterr().out.splitlines()[0])
    assert where.keys() == {"control", "fit"}
    assert where["fit"].startswith("demo: ")


@pytest.fixture
def raised(
    daemon: Recorder,
    recorder: tuple[Recorder, tm.Server],
    measured: list[scene_pb2.Scene],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[list[int]]:
    """Gives the fake daemon a process, which may have priority. Returns how many scenes were measured at each raise."""
    _, server = recorder
    calls: list[int] = []

    def raise_threads(process: int) -> bool:
        assert server.process is not None
        assert process == server.process.process.pid
        calls.append(len(measured))
        return True

    monkeypatch.setattr(priority, "raise_threads", raise_threads)
    server.process = ChildProcess(["sleep", "60"], output=subprocess.DEVNULL)
    yield calls
    server.process.stop()


@pytest.mark.parametrize(("cores", "calls"), [(1, []), (2, [0, 0, 1]), (16, [])])
def test_the_daemon_gets_priority_where_the_page_shares_its_cores(
    cores: int,
    calls: list[int],
    raised: list[int],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert main(RUN) == 0
    assert raised == calls  # to know whether it may, for the measured scene, and for the scene that runs
    out = capsys.readouterr().out.splitlines()
    assert ("the daemon has real-time priority, because the viewer shares its cores" in out) == bool(calls)
    assert out[0].endswith("which leaves room") == (cores > 1)


def test_a_daemon_without_the_privilege_keeps_its_priority(
    raised: list[int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_process: int) -> bool:
        raised.append(-1)
        return False

    monkeypatch.setattr(priority, "raise_threads", refuse)
    assert main(RUN) == 0
    assert set(raised) == {-1}
    assert "real-time" not in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--no-fit"], ["--preset", "fast"], ["--rate", "30"]])
def test_run_keeps_what_the_user_chose(
    options: list[str], daemon: Recorder, measured: list[scene_pb2.Scene], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, *options]) == 0
    assert measured == []
    assert loaded(daemon).bodies[0] == tm.Scene.from_file("demo").message.bodies[0]
    assert capsys.readouterr().out.startswith("tensormassd ")


def test_run_never_fits_a_file_of_the_user(
    daemon: Recorder, measured: list[scene_pb2.Scene], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = (
        "name: demo\nbodies: [{name: b, mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 1}}, density_kg_per_m3: 1}]"
    )
    Path("demo").write_text(scene)  # somebody's own, of that name
    assert main(RUN) == 0
    assert measured == []
    assert loaded(daemon).bodies[0].name == "b"


def test_run_advises_a_late_scene_once(
    daemon: Recorder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    late = stream_pb2.SceneStatus(scene="demo", step=600, missed_deadlines=60, target_rate_hz=60, step_time_p99_s=0.03)
    daemon.replies["GetStatus"] = control_pb2.GetStatusResponse(status=late)
    monkeypatch.setattr(run, "_LOG_PERIOD_S", 0.01)
    assert main([*RUN[:-1], "0.2", "--preset", "balanced"]) == 0
    out = capsys.readouterr().out
    assert out.count("It needs --rate ") == 1
    assert out.count(" Hz  missed ") > 1


# --- priorities -------------------------------------------------------------------------------------------------------


def test_a_refused_priority_is_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not priority.raise_threads(os.getpid())


def test_a_daemon_that_has_ended_gets_no_priority() -> None:
    with subprocess.Popen(["true"]) as ended:
        ended.wait()
    assert not priority.raise_threads(ended.pid)


def test_all_threads_of_the_daemon_get_the_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[int, tuple[int, os.sched_param]] = {}
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: given.__setitem__(of[0], of[1:]))
    assert priority.raise_threads(os.getpid())
    assert set(given) >= {os.getpid()}
    for policy, parameters in given.values():
        assert policy & os.SCHED_FIFO
        assert parameters.sched_priority == priority.REALTIME
