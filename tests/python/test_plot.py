"""Pictures of recordings: which curves a recording has, what it cannot show, and the files."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from tensormass.v1 import recording_pb2, scene_pb2, stream_pb2
from tensormass_tools.cli import main
from tensormass_tools.recording.file import RecordingReader, RecordingWriter
from tensormass_tools.recording.series import RATE_WINDOW_S, rate_hz, read_series

# Frames, steps and statuses of a session of three seconds, whose clock reads what no double can hold to the nanosecond.
START_NS = 1_800_000_000_123_456_789
RATE_HZ = 100
SECONDS = 3


def feedback(tool: str, force_n: float, step_s: float) -> stream_pb2.ToolFeedback:
    force = scene_pb2.Vector3(x=0.6 * force_n, z=-0.8 * force_n)
    return stream_pb2.ToolFeedback(tool=tool, force_n=force, step_s=step_s)


def status(second: int, tools: list[stream_pb2.ToolFeedback]) -> stream_pb2.SceneStatus:
    return stream_pb2.SceneStatus(
        scene="block",
        state=stream_pb2.SceneStatus.STATE_RUNNING,
        step=1 + RATE_HZ * second,
        target_rate_hz=RATE_HZ,
        missed_deadlines=2 * second,
        cg_relative_residual=10.0 ** -(second + 2),
        step_time_p50_s=0.004,
        step_time_p99_s=0.009,
        tools=tools,
    )


def write(
    path: Path,
    *,
    frames: bool = True,
    statuses: bool = True,
    steps: bool = True,
    tool: str = "probe",
    recovered: Sequence[int] = (),
) -> None:
    """Writes a session in which the force on a tool grows by 1 N a second. It is reset after two seconds.

    Args:
        recovered: indices of the steps of recoveries.
    """
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="block"), START_NS)
        writer.add("/start", recording_pb2.RecordingStart(scene="block", server_time_ns=START_NS))
        for index in range(1, SECONDS * RATE_HZ + 1):
            time_s = index / RATE_HZ
            time_ns = START_NS + index * 10**9 // RATE_HZ
            if steps:
                if index == RATE_HZ:
                    writer.add("/edits", recording_pb2.RecordedEdit(index=index, restore=b"a snapshot"), time_ns)
                is_reset = index in (1, 2 * RATE_HZ)
                step = recording_pb2.RecordedStep(
                    index=index, step=index, reset=is_reset, recovered=index in recovered, server_time_ns=time_ns
                )
                writer.add("/inputs", step, time_ns)
            if frames and index % 2 == 0:
                tools = [feedback(tool, time_s, 1e-3)]
                writer.add("/frames", stream_pb2.Frame(step=index, server_time_ns=time_ns, tools=tools), time_ns)
            if statuses and index % RATE_HZ == 0:
                message = status(index // RATE_HZ, [feedback(tool, time_s, 0)])
                message.server_time_ns = time_ns
                writer.add("/status", message, time_ns)


def plot(path: Path, capsys: pytest.CaptureFixture[str], *, ending: str = "png") -> tuple[Path, dict[str, Any]]:
    output = path.with_suffix(f".{ending}")
    assert main(["plot", str(path), "-o", str(output), "--json"]) == 0
    return output, json.loads(capsys.readouterr().out)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "block.mcap"


def test_the_curves_are_those_of_the_messages(path: Path) -> None:
    write(path)
    series = read_series(RecordingReader(path))
    assert (series.frames, series.statuses, series.steps) == (150, 3, 300)
    force = series.forces_n["probe"]
    assert len(force.time_s) == 150
    np.testing.assert_allclose(force.values, force.time_s, atol=1e-9)
    assert list(series.step_times_s) == ["of each frame", "median", "99th percentile"]
    np.testing.assert_array_equal(series.residuals["conjugate gradients"].values, [1e-3, 1e-4, 1e-5])
    np.testing.assert_array_equal(series.missed_deadlines["missed"].values, [2, 4, 6])
    np.testing.assert_allclose(series.rates_hz["reached"].values, RATE_HZ, rtol=1e-6)
    assert series.resets_s == [2.0], "a recording may start with a reset, which is not shown"
    assert (series.restores_s, series.adjustments_s) == ([1.0], [])


def test_a_recovery_is_shown_where_it_begins(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(path, recovered=range(50, 53))
    series = read_series(RecordingReader(path))
    assert (series.recoveries_s, series.recovered_steps) == ([0.5], 3)
    output, said = plot(path, capsys, ending="svg")
    assert (said["recoveries"], said["recovered_steps"]) == (1, 3)
    assert said["notes"] == ["recoveries 1, 3 steps"]
    assert "recovers" in output.read_text()
    write(path)
    output, said = plot(path, capsys, ending="svg")
    assert (said["recoveries"], said["notes"]) == (0, [])
    assert "recovers" not in output.read_text()


def test_the_rate_counts_lost_steps_and_needs_no_order_of_the_clock() -> None:
    time_s = np.arange(200) / 100.0
    kept = np.flatnonzero((time_s < 0.6) | (time_s > 1.2))
    curve = rate_hz(time_s[kept], kept.astype(float))
    assert len(curve.time_s) == int(time_s[-1] / RATE_WINDOW_S)
    np.testing.assert_allclose(curve.values, 100)
    assert np.isfinite(rate_hz(np.array([0.0, 2.0, 1.0, 3.0]), np.arange(4.0)).values).all()
    np.testing.assert_allclose(rate_hz(np.array([0.0, 0.01]), np.array([1.0, 2.0])).values, [100])
    assert len(rate_hz(np.array([0.0]), np.array([1.0])).time_s) == 0
    assert len(rate_hz(np.array([0.0, 1e12]), np.array([1.0, 2.0])).time_s) <= 2, "a damaged time asks for no memory"


def test_a_recording_becomes_a_picture(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(path)
    output, said = plot(path, capsys)
    panels = ["force on tool [N]", "step time [ms]", "rate [Hz]", "residual", "missed deadlines"]
    assert list(said["panels"]) == panels
    assert said["panels"]["force on tool [N]"] == ["probe"]
    assert said["notes"] == []
    pixels = imread(output)
    assert min(pixels.shape[:2]) > 500
    # Matplotlib's first two colours; the force and the step times have them.
    for color in ([0x1F, 0x77, 0xB4], [0xFF, 0x7F, 0x0E]):
        assert (np.round(255 * pixels[..., :3]) == color).all(axis=2).sum() > 100


def test_an_svg_is_a_drawing(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(path)
    output, _ = plot(path, capsys, ending="svg")
    assert ElementTree.parse(output).getroot().tag == "{http://www.w3.org/2000/svg}svg"


@pytest.mark.parametrize(
    ("lacks", "panels", "says"),
    [
        ({"frames": False}, 5, "has no frames, so the forces are those of its statuses"),
        ({"frames": False, "statuses": False}, 1, "has no frames, so it shows no force"),
        ({"frames": False, "statuses": False}, 1, "has no status of a step, so it shows no residual"),
        ({"statuses": False}, 3, "has no status of a step"),
        ({"steps": False}, 5, ""),
    ],
)
def test_what_a_recording_cannot_show_is_said(
    lacks: dict[str, Any], panels: int, says: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(path, **lacks)
    _, said = plot(path, capsys)
    assert len(said["panels"]) == panels
    assert says in " ".join(said["notes"])


def test_names_are_not_formulas(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(path, tool="_$\\frac{$")
    _, said = plot(path, capsys)
    assert said["panels"]["force on tool [N]"] == ["_$\\frac{$"]


def test_numbers_that_are_not_finite_are_drawn_as_gaps(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="block"))
        writer.add("/start", recording_pb2.RecordingStart(scene="block"))
        for second, value in enumerate([float("nan"), float("inf"), -1.0, 1.0], start=1):
            message = status(second, [feedback("probe", value, 0)])
            message.server_time_ns = second * 10**9
            message.cg_relative_residual = value
            message.step_time_p50_s = value
            writer.add("/status", message)
    plot(path, capsys)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def scene_only(path: Path) -> None:
    write(path, frames=False, statuses=False, steps=False)


@pytest.mark.parametrize(
    ("change", "output", "says"),
    [
        (cut, "block.png", None),
        (scene_only, "block.png", "has nothing to draw"),
        (Path.unlink, "block.png", "No such file"),
        (lambda path: path.write_text("text"), "block.png", "is not an MCAP file"),
        (lambda path: None, "block.jpg", "must end in .png, .svg or .pdf"),
        (lambda path: None, "none/block.png", "no folder that can be written to"),
    ],
)
def test_files_that_cannot_be_drawn_are_refused(
    change: Callable[[Path], Any], output: str, says: str | None, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(path)
    change(path)
    exit_status = main(["plot", str(path), "-o", str(path.parent / output)])
    captured = capsys.readouterr()
    if says is None:
        assert exit_status == 0
        assert "the recording was cut off" in captured.out
    else:
        assert exit_status == 1
        assert says in captured.err
        assert not (path.parent / output).exists()
