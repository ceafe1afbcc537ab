"""`tensormass-haptic` with libraries that stand for those of 3D Systems and Force Dimension. Needs a build."""

from __future__ import annotations

import itertools
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_haptic_program import BLOCK, BURNING, PROGRAM

import tensormass as tm

LIBRARIES = Path(PROGRAM).parent.parent / "tests"
NAMES = {"openhaptics": "OpenHaptics Fake Touch", "force-dimension": "Force Dimension omega.7 fake"}
FAKES = {"openhaptics": LIBRARIES / "libfake_hd.so", "force-dimension": LIBRARIES / "libfake_dhd.so"}
_NUMBER = itertools.count()

if not all(fake.exists() for fake in FAKES.values()):
    pytest.skip("no libfake_hd.so and libfake_dhd.so; build haptic_tests", allow_module_level=True)


@pytest.fixture
def scene(server: tm.Server) -> Iterator[tm.SceneHandle]:
    handle = server.load(tm.Scene.from_yaml(BLOCK), name=f"makers-{next(_NUMBER)}")
    yield handle
    handle.unload()


def run(server: tm.Server | None, scene: str, *options: object) -> subprocess.CompletedProcess[str]:
    address = "127.0.0.1:1" if server is None else server.address
    words = (PROGRAM, "--server", address, "--scene", scene, "--connect-timeout", 25, *options)
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("device", NAMES)
def test_a_device_of_a_makers_library_moves_the_tool(server: tm.Server, scene: tm.SceneHandle, device: str) -> None:
    options = ("--device", device, "--device-library", FAKES[device], "--seconds", 0.3, "--json", "-")
    done = run(server, scene.name, *options)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["device"] == NAMES[device]
    assert report["poses_invalid"] == 0
    assert report["feedback_received"] > 0
    assert ("max_torque_n_m" in report) == (device == "force-dimension")


@pytest.mark.parametrize("device", NAMES)
def test_a_button_is_read_of_a_tool_with_power_alone(server: tm.Server, scene: tm.SceneHandle, device: str) -> None:
    library = ("--device", device, "--device-library", FAKES[device])
    done = run(server, scene.name, *library, "--seconds", 0.1, "--cautery-button", 1)
    assert done.returncode == 2
    assert "--cautery-button: tool probe has no power; give it Tool.cautery, or leave this out" in done.stderr
    with server.load(tm.Scene.from_yaml(BURNING), name=f"makers-{next(_NUMBER)}") as burning:
        done = run(server, burning.name, *library, "--seconds", 0.3, "--json", "-")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["poses_with_power"] == 0, "nobody presses"
        done = run(server, burning.name, *library, "--seconds", 1, "--cautery-button", 7)
        wrong = "OpenHaptics: --cautery-button 7: choose a button from 1 to 4, or 0 for none"
        assert (done.returncode, wrong in done.stderr) == ((2, True) if device == "openhaptics" else (0, False))


@pytest.mark.parametrize("device", NAMES)
def test_a_missing_library_says_what_to_install(server: tm.Server, scene: tm.SceneHandle, device: str) -> None:
    done = run(server, scene.name, "--device", device, "--device-library", "/nowhere/lib.so")
    assert done.returncode == 1
    for words in ("cannot load /nowhere/lib.so", "install", "--device-library"):
        assert words in done.stderr


@pytest.mark.parametrize(
    ("options", "unused"),
    [
        (("--device", "haply", "--device-library", "x"), "--device-library"),
        (("--device", "openhaptics", "--grip-id", "1"), "--grip-id"),
        (("--device", "force-dimension", "--depth", "0.1"), "--depth"),
        (("--device", "simulated", "--workspace-scale", "2"), "--workspace-scale"),
        (("--device", "openhaptics", "--max-torque", "0.1"), "--max-torque"),
        (("--device", "haply", "--max-jaw-torque", "0.1"), "--max-jaw-torque"),
    ],
)
def test_options_of_another_device_are_refused(options: tuple[str, ...], unused: str) -> None:
    done = run(None, "none", *options)
    assert done.returncode == 2
    assert f"{unused} has no effect with --device {options[1]}" in done.stderr
