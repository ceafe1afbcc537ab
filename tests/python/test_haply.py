"""`tensormass-haptic --device haply` against a simulated Inverse service and a daemon. Skipped without a build."""

from __future__ import annotations

import itertools
import json
import signal
import socket
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from inverse_service import HANG_UP, SILENT, Dialect, InverseService, Message, Vector
from test_haptic_program import BLOCK, BURNING, PROGRAM

import tensormass as tm
from tensormass.v1 import stream_pb2

# The top is at 0.05 m: the probe touches it when its centre is at 0.06 m.
TOOL_START_M = 0.08
PRESS_M = 0.03
# 20 s of the simulation: more than a loaded machine needs for the press.
MAX_STEPS = 4000


@pytest.fixture
def scene(server: tm.Server) -> Iterator[tm.SceneHandle]:
    handle = server.load(tm.Scene.from_yaml(BLOCK), name=f"haply-{next(_NUMBER)}")
    yield handle
    handle.unload()


_NUMBER = itertools.count()


def command(
    scene: tm.SceneHandle, server: tm.Server, service: InverseService | str, *options: object, seconds: float = 60
) -> list[str]:
    url = service if isinstance(service, str) else service.url
    where = ("--server", server.address, "--scene", scene.name, "--device", "haply", "--device-url", url)
    return [str(word) for word in (PROGRAM, *where, "--seconds", seconds, *options)]


def run(words: Sequence[str | Path]) -> subprocess.CompletedProcess[str]:
    """Runs the program to its end."""
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)


def press(direction: Vector, depth_m: float) -> Callable[[int], Vector]:
    """A hand that rests for 200 commands and then moves by 0.02 mm with each, down to the depth."""

    def path(count: int) -> Vector:
        x, y, z = direction
        moved = min(max(count - 200, 0) * 2e-5, depth_m)
        return (x * moved, y * moved, z * moved)

    return path


# --- the probe follows, the hand feels --------------------------------------------------------------------------------


@dataclass
class Mount:
    """How the device stands, and how it presses down in the scene."""

    options: tuple[object, ...]
    down: Vector
    depth_m: float
    #: Of the tool in the scene, (w, x, y, z), with a grip whose orientation is GRIP.
    orientation: tuple[float, ...]


GRIP = (0.8, 0.0, 0.6, 0.0)
UPRIGHT = Mount((), (0.0, 0.0, -1.0), PRESS_M, GRIP)
# A quarter turn about x: forward in the device (y) is up in the scene. The hand moves half as far as the tool.
ON_ITS_SIDE = Mount(
    ("--workspace-rotation", "90,0,0", "--workspace-scale", 2, "--workspace-center", "0.05,0.05,0.08"),
    (0.0, -1.0, 0.0),
    PRESS_M / 2,
    tuple(0.5**0.5 * component for component in (0.8, 0.8, 0.6, 0.6)),
)


@pytest.mark.parametrize(
    ("dialect", "grips", "mount"),
    [("3.5", (), UPRIGHT), ("3.4", ("61548",), UPRIGHT), ("3.5", ("61548",), ON_ITS_SIDE)],
    ids=["3.5", "3.4-with-grip", "3.5-on-its-side"],
)
def test_the_probe_follows_the_hand_and_the_hand_feels_the_tissue(
    server: tm.Server, scene: tm.SceneHandle, dialect: Dialect, grips: tuple[str, ...], mount: Mount
) -> None:
    def against_the_press(force: Vector) -> float:
        return -sum(component * down for component, down in zip(force, mount.down, strict=True))

    with (
        InverseService(dialect, grips=grips, path=press(mount.down, mount.depth_m), orientation=GRIP) as service,
        scene.feedbacks("probe") as feedbacks,
        subprocess.Popen(
            command(scene, server, service, "--json", "-", *mount.options),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as hand,
    ):
        try:

            def pressed(feedback: stream_pb2.ToolFeedback) -> bool:
                return feedback.force_n.z > 0.05 and feedback.position_m.z < TOOL_START_M - PRESS_M + 1e-4

            assert any(pressed(feedback) for feedback in while_running(feedbacks, hand)), "the probe did not follow"
            assert service.wait_for(lambda: against_the_press(service.forces[-1]) > 0.05), service.forces[-1]
            # What the tissue does to the probe, it does to the hand, sideways too.
            force = service.forces[-1]
            assert against_the_press(force) == pytest.approx(sum(f * f for f in force) ** 0.5, rel=0.05)
            turned = scene.feedback("probe").orientation
            hand.send_signal(signal.SIGINT)
            out, words = hand.communicate(timeout=20)
        finally:
            hand.kill()
        assert service.wait_for(lambda: service.close_code is not None)
    assert hand.returncode == 0, words
    assert service.complaints == []
    assert service.close_code == 1000
    assert service.forces[0] == (0.0, 0.0, 0.0), "no force before the first pose"
    assert service.forces[-1] == (0.0, 0.0, 0.0), "the last message takes the force off"
    assert turned == pytest.approx(mount.orientation if grips else (1, 0, 0, 0), abs=1e-6)
    report = json.loads(out)
    assert report["device"] == 'Haply Inverse3 "049D"'
    assert report["poses_invalid"] == 0
    assert 0.05 < report["max_force_n"] <= 3.0 + 1e-9


def while_running(
    feedbacks: Iterable[stream_pb2.ToolFeedback], hand: subprocess.Popen[str]
) -> Iterator[stream_pb2.ToolFeedback]:
    for feedback in itertools.islice(feedbacks, MAX_STEPS):
        assert hand.poll() is None, hand.communicate()[1]
        yield feedback


def test_two_devices_are_told_apart_by_their_id(server: tm.Server, scene: tm.SceneHandle) -> None:
    def only_the_second_moves(number: int, message: Message) -> Message:
        message["inverse3"][0]["state"] = {"cursor_position": {"x": "broken"}}
        return message

    with InverseService(inverses=("049D", "04BA"), misbehave=only_the_second_moves) as service:
        done = run(command(scene, server, service, "--device-id", "04BA", "--json", "-", seconds=0.3))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["device"] == 'Haply Inverse3 "04BA"'
    assert service.complaints == []


# --- the button -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "burns"), [((), True), (("--cautery-button", 0), False)], ids=["1", "none"])
def test_the_grips_button_works_the_power(server: tm.Server, options: tuple[object, ...], burns: bool) -> None:
    with (
        server.load(tm.Scene.from_yaml(BURNING), name=f"haply-{next(_NUMBER)}") as scene,
        InverseService(grips=("61548",), presses=lambda count: 400 <= count < 800) as service,
    ):
        words = command(scene, server, service, "--json", "-", *options, seconds=1.0)
        done = run(words)
        assert done.returncode == 0, done.stderr
        assert (json.loads(done.stdout)["poses_with_power"] > 20) == burns
        with scene.feedbacks("probe") as feedbacks:
            assert next(iter(feedbacks)).level == 0
        assert not service.complaints


def test_a_button_needs_a_grip_that_has_it(server: tm.Server) -> None:
    with server.load(tm.Scene.from_yaml(BURNING), name=f"haply-{next(_NUMBER)}") as scene:
        with InverseService() as service:
            done = run(command(scene, server, service))
        assert done.returncode == 1
        assert "no Haply VerseGrip is connected" in done.stderr
        assert "--cautery-button 0" in done.stderr
        with InverseService(grips=("61548",)) as service:
            done = run(command(scene, server, service, "--cautery-button", 3))
        assert done.returncode == 1
        assert "its button 3 is missing; choose another one with --cautery-button" in done.stderr


# --- what goes wrong --------------------------------------------------------------------------------------------------


def on(number: int, change: Callable[[Message], Message | str]) -> Callable[[int, Message], Message | str]:
    """Misbehaves from the message of this number on: 0 is the snapshot, 50 is well within the run."""
    return lambda count, message: change(message) if count >= number else message


def position(value: object) -> Callable[[Message], Message]:
    def change(message: Message) -> Message:
        message["inverse3"][0]["state"]["cursor_position"] = value
        return message

    return change


def without(name: str) -> Callable[[Message], Message]:
    return lambda message: message | {name: []}


NAMED = 'Haply Inverse3 "049D"'
NOT_JSON = ("is not a JSON object", "--device-url")
FAULTS = {
    "silent at the start": (on(0, lambda _: SILENT), ("did not send the list of its devices within 3 s", "restart")),
    "silent after the snapshot": (on(1, lambda _: SILENT), ("did not answer the first force within 3 s", "restart")),
    "silent in the run": (on(50, lambda _: SILENT), (NAMED, "no state for 0.25 s", "restart")),
    "hangs up at the start": (on(0, lambda _: HANG_UP), ("has closed the connection", "restart")),
    "hangs up in the run": (on(50, lambda _: HANG_UP), (NAMED, "has closed the connection", "restart")),
    "garbage at the start": (on(0, lambda _: "<html>"), NOT_JSON),
    "garbage in the run": (on(50, lambda _: '{"inverse3": ['), (NAMED, *NOT_JSON)),
    "a huge message": (on(50, lambda _: " " * 300_000), ("larger than 262144 bytes", "--device-url")),
    "NaN": (on(50, position({"x": float("nan"), "y": 0, "z": 0})), (NAMED, "not finite", *NOT_JSON)),
    "a word for a number": (on(50, position({"x": "0", "y": 0, "z": 0})), (NAMED, "position.x is not a number")),
    "null for a number": (on(50, position({"x": 0, "y": None, "z": 0})), (NAMED, "position.y is not a number")),
    "a missing number": (on(50, position({"x": 0, "y": 0})), (NAMED, "position.z is missing", "restart")),
    "a list for an object": (on(50, position([0, 0, 0])), (NAMED, "position.x is missing", "restart")),
    "positions beyond any scene": (on(50, position({"x": 1e9, "y": 0, "z": 0})), (NAMED, "100 poses in a row are")),
    "no device": (on(0, without("inverse3")), ("no Haply Inverse3 is connected", "Haply Hub")),
    "the device goes": (on(50, without("inverse3")), (f"{NAMED} is gone", "check its cable")),
    "the grip goes": (on(50, without("verse_grip")), ('Haply VerseGrip "61548" is gone', "check its cable")),
    "the format of port 10000": (on(0, lambda _: '{"inverse3": {"049D": {}}}'), ("format 3.0 of port 10000",)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_service_that_fails_ends_the_run_with_words(server: tm.Server, scene: tm.SceneHandle, fault: str) -> None:
    misbehave, expected = FAULTS[fault]
    with InverseService(grips=("61548",), misbehave=misbehave) as service:
        done = run(command(scene, server, service))
    assert done.returncode == 1, done.stderr
    for words in expected:
        assert words in done.stderr
    assert service.complaints == []


@pytest.mark.parametrize("fault", [SILENT, '{"inverse3": ['])
def test_a_service_that_fails_in_contact_is_told_to_take_the_force_off(
    server: tm.Server, scene: tm.SceneHandle, fault: str
) -> None:
    last_good = 3000
    path = press(UPRIGHT.down, PRESS_M)
    with InverseService(path=path, misbehave=on(last_good + 1, lambda _: fault)) as service:
        done = run(command(scene, server, service))
        assert service.wait_for(lambda: service.close_code is not None)
    assert done.returncode == 1
    assert service.forces[last_good][2] > 0.05, "in contact"
    # Nothing more comes than the zero force.
    assert service.forces[last_good + 1 :] == [(0.0, 0.0, 0.0)]
    assert service.close_code == 1000


@pytest.mark.parametrize(
    ("status", "words"),
    [({"power_supply": False}, "plug in its power supply"), ({"calibrated": False}, "calibrate it in Haply Hub")],
)
def test_a_device_that_is_not_fit_is_refused(
    server: tm.Server, scene: tm.SceneHandle, status: Message, words: str
) -> None:
    with InverseService(status=status) as service:
        done = run(command(scene, server, service))
    assert done.returncode == 1
    assert words in done.stderr
    assert service.forces == []


def test_a_choice_of_devices_is_asked_for(server: tm.Server, scene: tm.SceneHandle) -> None:
    with InverseService(inverses=("049D", "04BA"), grips=("1", "2")) as service:
        which = run(command(scene, server, service))
        grip = run(command(scene, server, service, "--device-id", "04BA"))
        absent = run(command(scene, server, service, "--device-id", "FFFF"))
    assert [done.returncode for done in (which, grip, absent)] == [1, 1, 1]
    assert '"049D", "04BA"; choose one with --device-id' in which.stderr
    assert '"1", "2"; choose one with --grip-id' in grip.stderr
    assert 'Haply Inverse3 "FFFF" is not connected; the Inverse service has "049D", "04BA"' in absent.stderr


def test_nobody_at_the_url(server: tm.Server, scene: tm.SceneHandle) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{nobody.getsockname()[1]}"
        done = run(command(scene, server, url))
    assert done.returncode == 1
    assert f"no Haply Inverse service at {url}: Connection refused; start it (Haply Hub" in done.stderr


def test_a_server_without_websocket(server: tm.Server, scene: tm.SceneHandle) -> None:
    with InverseService() as service:
        done = run(command(scene, server, service.url + "/not-here"))
    assert done.returncode == 1
    assert "it does not speak WebSocket" in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--device-url", "http://127.0.0.1:10001"), "is not of the form ws://host:port"),
        (("--workspace-scale", "0"), "--workspace-scale"),
        (("--workspace-scale", "nan"), "--workspace-scale"),
        (("--workspace-center", "0,0,nan"), "--workspace-center"),
        (("--workspace-rotation", "0,0"), "--workspace-rotation"),
        (("--press-at", "0,0,0"), "--press-at has no effect with --device haply"),
        (("--device", "simulated", "--device-id", "1"), "--device-id has no effect with --device simulated"),
        (("--device", "omni"), "--device"),
    ],
)
def test_wrong_options_are_refused_before_anything_starts(options: tuple[str, ...], words: str) -> None:
    device = () if "--device" in options else ("--device", "haply")
    # A server that is not there would be waited for.
    done = run([PROGRAM, "--server", "127.0.0.1:1", "--connect-timeout", "25", *device, *options])
    assert done.returncode == 2, done.stderr
    assert words in done.stderr + done.stdout
