"""The SDK against a control plane of its own making: errors, decoding, frames, and child processes."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import stat
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from conftest import Recorder
from fake_daemon import FakeDaemon, fake_daemon, frame_of, triangle_topology

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

DEADLINE_S = 60.0


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (grpc.StatusCode.INVALID_ARGUMENT, tm.InvalidArgumentError),
        (grpc.StatusCode.NOT_FOUND, tm.NotFoundError),
        (grpc.StatusCode.ALREADY_EXISTS, tm.AlreadyExistsError),
        (grpc.StatusCode.RESOURCE_EXHAUSTED, tm.ResourceExhaustedError),
        (grpc.StatusCode.FAILED_PRECONDITION, tm.FailedPreconditionError),
        (grpc.StatusCode.UNAVAILABLE, tm.UnavailableError),
        (grpc.StatusCode.DEADLINE_EXCEEDED, tm.DeadlineExceededError),
        (grpc.StatusCode.INTERNAL, tm.InternalError),
        (grpc.StatusCode.UNIMPLEMENTED, tm.InternalError),
    ],
)
def test_every_code_is_an_exception_with_the_daemons_message(
    recorder: tuple[Recorder, tm.Server], code: grpc.StatusCode, kind: type[tm.TensormassError]
) -> None:
    fake, server = recorder
    fake.failure = (code, "body 'liver': tetrahedron 7 is inverted; rewind it")
    with pytest.raises(kind, match="body 'liver': tetrahedron 7 is inverted; rewind it") as error:
        server.load(tm.Scene("s"))
    assert type(error.value) is kind


def test_endpoints_of_every_interface_are_those_of_the_host_that_answered(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies["GetVersion"] = control_pb2.GetVersionResponse(
        zeromq_publish_endpoint="tcp://0.0.0.0:1", zeromq_pose_endpoint="tcp://192.0.2.9:2", zenoh_locator="tcp/[::]:3"
    )
    version = server.version()
    assert version.zeromq_publish_endpoint == "tcp://127.0.0.1:1"
    assert version.zeromq_pose_endpoint == "tcp://192.0.2.9:2"
    assert version.zenoh_locator == "tcp/127.0.0.1:3"


def test_load_sends_the_scene_and_leaves_the_callers_alone(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies["LoadScene"] = control_pb2.LoadSceneResponse(report=control_pb2.SceneReport(scene="other"))
    message = scene_pb2.Scene(name="mine", tools=[scene_pb2.Tool(name="probe")])
    handle = server.load(message, lockstep=True, name="other")
    sent = fake.asked[-1].scene
    assert (sent.name, sent.stepping.lockstep, sent.tools[0].name) == ("other", True, "probe")
    assert (message.name, message.HasField("stepping")) == ("mine", False)
    assert handle.name == "other"
    assert handle.report is not None
    server.load(tm.Scene(message=message))
    assert fake.asked[-1].scene == message


def test_loads_may_take_minutes_and_steps_as_long_as_they_take(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies |= {
        "LoadScene": control_pb2.LoadSceneResponse(),
        "InspectScene": control_pb2.InspectSceneResponse(),
        "StepScene": control_pb2.StepSceneResponse(),
        "PauseScene": control_pb2.PauseSceneResponse(),
    }
    handle = server.load(tm.Scene("s"))
    assert 120 < fake.time_left_s < 1200
    server.inspect(tm.Scene("s"))
    assert 120 < fake.time_left_s < 1200
    handle.step(1000)
    assert fake.time_left_s > 86_400
    handle.pause()
    assert 10 < fake.time_left_s < 60


def test_a_load_ends_with_whoever_wanted_to_know_how_far_it_is(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    ended = threading.Event()

    def load(method: str, request: object, context: grpc.ServicerContext) -> Iterator[Any]:
        context.add_callback(ended.set)
        yield control_pb2.LoadSceneWithProgressResponse(part="half", fraction=0.5)
        ended.wait(DEADLINE_S)

    def give_up(part: str, fraction: float) -> None:
        raise KeyboardInterrupt

    fake.answer = load  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt) as raised:  # kept: it holds what the call left
        server.load(tm.Scene("s"), progress=give_up)
    assert ended.wait(DEADLINE_S / 2), raised


def test_a_scene_that_is_not_loaded_has_no_handle(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    statuses = [stream_pb2.SceneStatus(scene=name) for name in ("demo", "lever")]
    listed: list[list[stream_pb2.SceneStatus]] = [statuses, []]

    def answer(method: str, request: object, context: grpc.ServicerContext) -> Any:  # noqa: ANN401
        if method == "ListScenes":
            return control_pb2.ListScenesResponse(scenes=listed.pop(0))
        return context.abort(grpc.StatusCode.NOT_FOUND, "no scene 'liver'")

    fake.answer = answer  # type: ignore[method-assign]
    for loaded in ("demo, lever", "none"):
        with pytest.raises(tm.NotFoundError, match=f"^no scene 'liver'; there are: {loaded}$"):
            server.scene("liver")


def test_positions_are_writable_doubles_by_node(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    expected = np.arange(12, dtype="<f8").reshape(4, 3)
    fake.replies["GetStatus"] = control_pb2.GetStatusResponse()
    fake.replies["GetPositions"] = control_pb2.GetPositionsResponse(positions=expected.tobytes())
    positions = server.scene("s").positions("liver")
    assert fake.asked[-1] == control_pb2.GetPositionsRequest(scene="s", body="liver")
    np.testing.assert_array_equal(positions, expected)
    assert positions.dtype == np.float64
    positions += 1.0


def test_feedback_and_moves_carry_units_and_order(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies |= {"GetStatus": control_pb2.GetStatusResponse(), "MoveTool": control_pb2.MoveToolResponse()}
    fake.replies["GetFeedback"] = control_pb2.GetFeedbackResponse(
        feedback=stream_pb2.ToolFeedback(
            tool="probe",
            step=4,
            server_time_ns=1_800_000_000_123_456_789,
            pose_sequence=2,
            client_id=1 << 63,
            client_time_ns=77,
            position_m=scene_pb2.Vector3(x=1),
            orientation=scene_pb2.Quaternion(w=0.1, x=0.7, y=0.5, z=0.5),
            force_n=scene_pb2.Vector3(z=3),
            torque_n_m=scene_pb2.Vector3(y=5),
            local_model=stream_pb2.LocalModel(stiffness_n_per_m=range(9), valid_for_s=0.05),
        )
    )
    scene = server.scene("s")
    scene.move_tool("probe", (1, 2, 3))
    scene.move_tool("probe", np.array([1.0, 2.0, 4.0]), (0, 3, 0, 4))
    first, second = fake.asked[-2:]
    assert (first.scene, first.tool, first.pose.sequence, second.pose.sequence) == ("s", "probe", 1, 2)
    assert first.pose.client_id == second.pose.client_id
    assert second.pose.orientation == scene_pb2.Quaternion(x=0.6, z=0.8)
    feedback = scene.feedback("probe")
    np.testing.assert_array_equal(feedback.position_m, [1, 0, 0])
    np.testing.assert_array_equal(feedback.orientation, [0.1, 0.7, 0.5, 0.5])
    np.testing.assert_array_equal(feedback.force_n, [0, 0, 3])
    np.testing.assert_array_equal(feedback.torque_n_m, [0, 5, 0])
    np.testing.assert_array_equal(feedback.stiffness_n_per_m, np.arange(9).reshape(3, 3))
    assert (feedback.step, feedback.pose_sequence, feedback.valid_for_s) == (4, 2, 0.05)
    assert (feedback.server_time_ns, feedback.client_id) == (1_800_000_000_123_456_789, 1 << 63)
    assert feedback.client_time_ns == 77


def test_a_missing_daemon_is_reported_in_time() -> None:
    begin = time.monotonic()
    with pytest.raises(
        tm.UnavailableError, match=r"no daemon answers on 127\.0\.0\.1:1; start one with `tensormass run`,"
    ):
        tm.connect("127.0.0.1:1", timeout_s=0.2)
    assert time.monotonic() - begin < 5


def test_an_address_without_a_port_is_refused_at_once() -> None:
    with pytest.raises(tm.InvalidArgumentError, match=r"^address 'trainer': has no port; .* as in trainer:50051$"):
        tm.connect("trainer")


def test_counts_and_adjustments_of_a_wrong_kind_are_refused_here(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies["LoadScene"] = control_pb2.LoadSceneResponse()
    scene = server.load(tm.Scene("s"))
    asked = len(fake.asked)
    for count in (0, -1):
        with pytest.raises(tm.InvalidArgumentError, match=f"^count: expected 1 or more steps, got {count}$"):
            scene.step(count)
    with pytest.raises(
        tm.InvalidArgumentError, match=r"^stiffness_factor: expected a value for each body by name.*got 2$"
    ):
        scene.adjust(stiffness_factor=2)  # type: ignore[arg-type]
    assert len(fake.asked) == asked


# --- frames -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def loop() -> Iterator[Callable[[Coroutine[Any, Any, Any]], Any]]:
    """Runs coroutines on an event loop in a thread, so that the asynchronous fake serves the synchronous SDK."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield lambda work: asyncio.run_coroutine_threadsafe(work, loop).result(DEADLINE_S)
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.fixture
def daemon(loop: Callable[[Coroutine[Any, Any, Any]], Any]) -> Iterator[FakeDaemon]:
    context = fake_daemon()
    yield loop(context.__aenter__())
    loop(context.__aexit__(None, None, None))


def test_frames_start_with_the_present_and_go_on_over_the_bus(
    daemon: FakeDaemon, loop: Callable[[Coroutine[Any, Any, Any]], Any]
) -> None:
    topology = triangle_topology("s", vertex_count=4)
    daemon.topologies["s"] = topology
    daemon.frames["s"] = frame_of(topology, 1)
    with tm.connect(daemon.control) as server:
        scene = tm.SceneHandle(server, "s", None)
        with scene.frames(timeout_s=DEADLINE_S) as frames:
            loop(daemon.wait_subscribed("s", "frame"))
            first = next(frames)
            assert first.sequence == 1
            np.testing.assert_array_equal(first.vertices("fan"), np.full((4, 3), 1, np.float32))
            assert first.tools["probe"].force_n[2] == 1.0
            loop(daemon.publish("s", "frame", frame_of(topology, 5).SerializeToString()))
            assert next(frames).sequence == 5
        loop(daemon.wait_subscribed("s", "frame", count=0))
        vertices, triangles = scene.surface("fan")
        assert vertices.dtype == np.float64
        assert vertices.shape == (4, 3)
        np.testing.assert_array_equal(triangles, [[0, 1, 2], [0, 2, 3]])
        triangles[:] = 0  # the caller's own, as the vertices are
        vertices[:] = 0
        with pytest.raises(tm.NotFoundError, match="has no body 'spleen'; it has: fan"):
            scene.surface("spleen")


def test_a_tool_that_is_not_there_has_no_streams(daemon: FakeDaemon) -> None:
    daemon.topologies["s"] = triangle_topology("s")
    with tm.connect(daemon.control) as server:
        scene = tm.SceneHandle(server, "s", None)
        for name in ("prob", "", "*"):
            for opens in (scene.tool_stream, scene.feedbacks):
                with pytest.raises(tm.NotFoundError, match=f"scene 's' has no tool '{re.escape(name)}'; it has: probe"):
                    opens(name)
        scene.tool_stream("probe").close()
        scene.feedbacks("probe").close()


def test_no_stream_outlives_its_connection(daemon: FakeDaemon) -> None:
    daemon.topologies["s"] = triangle_topology("s")
    server = tm.connect(daemon.control)
    scene = tm.SceneHandle(server, "s", None)
    poses, feedbacks = scene.tool_stream("probe"), scene.feedbacks("probe")
    server.close()
    for call in (
        lambda: poses.send((0, 0, 0)),
        feedbacks.receive,
        scene.frames,
        scene.statuses,
        lambda: scene.tool_stream("probe"),
        lambda: scene.feedbacks("probe"),
    ):
        with pytest.raises(tm.UnavailableError, match=r"this connection to .* is closed; connect again"):
            call()


class Script:
    """A subscription that hands out what is written in it."""

    def __init__(self, frames: list[stream_pb2.Frame]) -> None:
        self.frames = frames

    def receive(self, timeout_s: float) -> stream_pb2.Frame:
        return self.frames.pop(0)


def test_repeated_frames_are_skipped_and_lost_ones_counted(daemon: FakeDaemon) -> None:
    old, new = triangle_topology("s", vertex_count=4), triangle_topology("s", version=2, vertex_count=6)
    daemon.topologies["s"] = old
    daemon.frames["s"] = frame_of(old, 1)
    script = Script([frame_of(old, 1), frame_of(old, 5), frame_of(new, 9), frame_of(old, 10), frame_of(new, 11)])
    with tm.connect(daemon.control) as server:
        frames = tm.FrameStream(tm.SceneHandle(server, "s", None), script, DEADLINE_S)  # type: ignore[arg-type]
        assert next(frames).sequence == 1
        assert next(frames).sequence == 5  # the same frame again is not news
        assert frames.dropped_count == 3
        daemon.topologies["s"] = new
        frame = next(frames)  # counting starts again with a topology
        assert (frame.sequence, frame.vertices("fan").shape, frames.dropped_count) == (9, (6, 3), 3)
        assert next(frames).sequence == 11  # what was under way from the old one is passed over
        assert frames.dropped_count == 4


def test_a_step_that_was_there_before_a_reset_is_news(daemon: FakeDaemon) -> None:
    topology = triangle_topology("s", vertex_count=4)
    daemon.topologies["s"] = topology
    daemon.frames["s"] = frame_of(topology, 3)
    begun, paused, again = (frame_of(topology, sequence) for sequence in (3, 5, 6))
    begun.sequence = 4  # published only after the call had brought it
    for frame in (paused, again):
        frame.step = begun.step
    with tm.connect(daemon.control) as server:
        script = Script([begun, paused, again])
        frames = tm.FrameStream(tm.SceneHandle(server, "s", None), script, DEADLINE_S)  # type: ignore[arg-type]
        assert [next(frames).sequence for _ in range(3)] == [3, 5, 6]
        assert frames.dropped_count == 0


def test_a_clock_that_was_set_back_hides_no_frame(daemon: FakeDaemon) -> None:
    topology = triangle_topology("s", vertex_count=4)
    daemon.topologies["s"] = topology
    daemon.frames["s"] = frame_of(topology, 3)
    before, stepped, reset = (frame_of(topology, sequence) for sequence in (2, 4, 5))
    stepped.server_time_ns = reset.server_time_ns = 1
    reset.step = 0
    with tm.connect(daemon.control) as server:
        script = Script([before, stepped, reset])
        frames = tm.FrameStream(tm.SceneHandle(server, "s", None), script, DEADLINE_S)  # type: ignore[arg-type]
        assert [next(frames).sequence for _ in range(3)] == [3, 4, 5]


def test_another_scene_of_the_same_name_has_another_topology(daemon: FakeDaemon) -> None:
    daemon.topologies["s"] = triangle_topology("s", vertex_count=4)
    daemon.frames["s"] = frame_of(daemon.topologies["s"], 1)
    with tm.connect(daemon.control) as server:
        scene = tm.SceneHandle(server, "s", None)
        assert scene.frame().positions.shape == (4, 3)
        daemon.topologies["s"] = triangle_topology("s", vertex_count=6)  # loaded when the clock had been set back
        daemon.frames["s"] = frame_of(daemon.topologies["s"], 1)
        assert scene.frame().vertices("fan").shape == (6, 3)


def test_a_frame_that_does_not_fit_its_topology_is_refused(daemon: FakeDaemon) -> None:
    daemon.topologies["s"] = triangle_topology("s", vertex_count=4)
    daemon.frames["s"] = frame_of(daemon.topologies["s"], 1)
    daemon.frames["s"].positions = daemon.frames["s"].positions[:-4]
    with (
        tm.connect(daemon.control) as server,
        pytest.raises(tm.InternalError, match="44 bytes of positions; its topology needs 48"),
    ):
        tm.SceneHandle(server, "s", None).frame()


# --- processes --------------------------------------------------------------------------------------------------------


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def script(folder: Path, name: str, body: str) -> Path:
    path = folder / name
    path.write_text(f"#!{sys.executable}\n{textwrap.dedent(body)}")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_child_ends_with_its_parent_however_that_ends(tmp_path: Path, how: signal.Signals) -> None:
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import subprocess, threading; from tensormass._shared.processes import ChildProcess\n"
            "def start():\n"  # runs in a thread that ends at once
            "    child = ChildProcess(['sleep', '600'], output=subprocess.DEVNULL)\n"
            "    print(child.process.pid, flush=True)\n"
            "    children.append(child)\n"
            "children = []\n"
            "thread = threading.Thread(target=start); thread.start(); thread.join()\n"
            "import time; time.sleep(600)",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    try:
        assert is_running(child)
        parent.send_signal(how)
        parent.wait(DEADLINE_S)
        wait_until(lambda: not is_running(child))
    finally:
        parent.stdout.close()
        parent.kill()
        if is_running(child):
            os.kill(child, signal.SIGKILL)


def test_ctrl_c_is_for_the_parent_alone() -> None:
    child = processes.ChildProcess(["sleep", "600"], output=subprocess.DEVNULL)
    try:
        assert os.getsid(child.process.pid) == child.process.pid
    finally:
        child.stop()


def test_stop_insists_on_a_child_that_does_not_listen(tmp_path: Path) -> None:
    deaf = script(
        tmp_path,
        "deaf",
        """
        import pathlib, signal, sys, time
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        pathlib.Path(sys.argv[1]).touch()
        time.sleep(600)
        """,
    )
    ready = tmp_path / "ready"
    child = processes.ChildProcess([deaf, ready], output=subprocess.DEVNULL)
    wait_until(ready.exists)
    assert child.stop(timeout_s=0.1) == -signal.SIGKILL
    assert not child.running


def test_a_stopped_child_is_ended_at_once() -> None:
    child = processes.ChildProcess(["sleep", "600"], output=subprocess.DEVNULL)
    os.kill(child.process.pid, signal.SIGSTOP)
    assert child.stop(timeout_s=DEADLINE_S) == -signal.SIGTERM


def test_launch_says_why_the_daemon_did_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failing = script(
        tmp_path,
        "tensormassd",
        """
        import sys
        for number in range(20):
            print("line", number, file=sys.stderr)
        print("no CUDA device answers", file=sys.stderr)
        sys.exit(3)
        """,
    )
    monkeypatch.setenv("TENSORMASSD", str(failing))
    log = r"its log ends:\nline 6\n(line \d+\n){13}no CUDA device answers$"
    with pytest.raises(tm.UnavailableError, match=rf"ended with status 3; {log}"):
        tm.launch(backend="cuda")


def test_launch_gives_up_on_a_daemon_that_is_never_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    silent = script(tmp_path, "tensormassd", "import time; time.sleep(600)")
    monkeypatch.setenv("TENSORMASSD", str(silent))
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    before = children.read_text()
    with pytest.raises(tm.UnavailableError, match=r"was not ready in 0\.5 s"):
        tm.launch(timeout_s=0.5)
    assert children.read_text() == before, "it ends, started or not"


def test_a_missing_program_is_reported_by_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent/tensormassd")
    with pytest.raises(tm.NotFoundError, match=r"\$TENSORMASSD names /nonexistent/tensormassd"):
        tm.launch()
    monkeypatch.delenv("TENSORMASSD")
    monkeypatch.setattr(processes, "BUILD_BIN", Path("/nonexistent"))
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(tm.NotFoundError, match="tensormassd is not built"):
        tm.launch()
