"""The index of a recording's frames: times, frames on demand, and files that are cut off, damaged or empty."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_parts import A_CHUNK, STEPS, TOPOLOGY, recorded_frame, write_recording

import tensormass as tm
from tensormass.v1 import control_pb2, recording_pb2, scene_pb2, stream_pb2
from tensormass_gateway.player import Mark
from tensormass_tools.cli import main
from tensormass_tools.recording import chunks
from tensormass_tools.recording import index as recording_index
from tensormass_tools.recording.edits import TEXTS
from tensormass_tools.recording.file import RecordingWriter
from tensormass_tools.recording.index import RecordingIndex


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "liver.mcap")


def chunk_ends(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]


def test_times_count_simulated_time_over_pauses_and_resets(path: Path) -> None:
    index = RecordingIndex(path)
    # The fourth frame is of a pause, the fifth of a reset.
    assert list(index.times_s) == pytest.approx([0, 0.1, 0.2, 0.2, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    (mark,) = index.marks
    assert mark.kind == "reset"
    assert mark.time_s == pytest.approx(0.2)
    assert (index.name, index.note, index.topology) == ("liver.mcap", "", TOPOLOGY)


def test_a_reset_whose_frame_was_lost_still_takes_its_time(tmp_path: Path) -> None:
    index = RecordingIndex(write_recording(tmp_path / "a.mcap", [100, 30, 40]))
    assert list(index.times_s) == pytest.approx([0, 0.3, 0.4])


@pytest.mark.parametrize("late", [False, True])
def test_edits_are_marked_and_a_snapshot_takes_no_time(tmp_path: Path, late: bool) -> None:
    edits = {
        2: recording_pb2.RecordedEdit(index=2, step=10, adjust=control_pb2.SceneAdjustments()),
        4: recording_pb2.RecordedEdit(index=4, step=20, restore=b"a snapshot"),
        6: recording_pb2.RecordedEdit(index=6, reset=recording_pb2.ResetEdit()),
    }
    path = write_recording(tmp_path / "a.mcap", [10, 20, 30, 21, 31, 5, 15], edits=edits, late_edits=late)
    index = RecordingIndex(path)
    assert list(index.times_s) == pytest.approx([0, 0.1, 0.2, 0.21, 0.31, 0.36, 0.46])
    assert [mark.kind for mark in index.marks] == ["adjust", "restore", "reset"]


def test_a_reset_at_the_start_of_a_recording_has_no_mark(tmp_path: Path) -> None:
    edits = {1: recording_pb2.RecordedEdit(index=1, reset=recording_pb2.ResetEdit())}
    assert RecordingIndex(write_recording(tmp_path / "a.mcap", [1, 2], edits=edits)).marks == []


def test_each_edit_of_the_protocol_has_words() -> None:
    fields = recording_pb2.RecordedEdit.DESCRIPTOR.oneofs_by_name["edit"].fields
    assert set(TEXTS) == {field.name for field in fields}


def test_frames_come_as_they_were_recorded_in_any_order(path: Path) -> None:
    index = RecordingIndex(path)
    for at in (9, 0, 5, 4, 4, 1):
        assert index.frame(at) == recorded_frame(STEPS[at], at + 1)


def test_the_status_of_a_frame_is_the_last_one_before_it(path: Path, tmp_path: Path) -> None:
    index = RecordingIndex(path)
    found = [index.status(at) for at in range(len(STEPS))]
    assert [status.cg_iterations for status in found if status is not None] == [10, 10, 30, 30, 0, 0, 20, 20, 40, 40]
    without = RecordingIndex(write_recording(tmp_path / "without.mcap", statuses=False))
    assert without.status(0) is None


def test_contacts_guards_and_stops_are_marked(tmp_path: Path) -> None:
    steps = range(0, 2000, 10)
    # Two contacts; the second one is interrupted for 0.2 s.
    touching = [*range(21, 41), *range(101, 121), *range(123, 130)]
    index = RecordingIndex(write_recording(tmp_path / "a.mcap", steps, touching=touching, rejected=[151]))
    assert [(mark.kind, round(mark.time_s, 3), mark.text) for mark in index.marks] == [
        ("contact", 2.0, "probe touches."),
        ("contact", 10.0, "probe touches."),
        ("stop", 14.9, "A guard stopped the scene."),
    ]


def test_a_recovery_has_one_mark_where_it_begins(tmp_path: Path) -> None:
    recovered = [3, 4, 5, 8]
    index = RecordingIndex(write_recording(tmp_path / "a.mcap", range(0, 100, 10), recovered=recovered))
    assert [(mark.kind, round(mark.time_s, 3)) for mark in index.marks] == [("recovery", 0.1), ("recovery", 0.6)]
    assert index.marks[0].text == "The scene recovers: tools back off, or the tissue is held."


def test_a_status_marks_what_guards_did_besides_recoveries() -> None:
    marks: list[Mark] = []
    timeline = recording_index._Timeline(array("d"), marks)
    for events, recovering_steps, text in ((1, 0, "before"), (4, 3, "recovers"), (5, 3, "repeated")):
        status = stream_pb2.SceneStatus(guard_events=events, recovering_steps=recovering_steps, guard_text=text)
        timeline.take_status(status)
    assert [(mark.kind, mark.text) for mark in marks] == [("guard", "repeated")]


def test_marks_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_index, "MAX_MARKS", 3)
    index = RecordingIndex(write_recording(tmp_path / "a.mcap", [10, 0] * 10))
    assert len(index.marks) == 3


def test_little_of_a_recording_is_held(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index = RecordingIndex(path)
    assert index.held_bytes == 0, "the index has places, not content"
    index.frame(0)
    one = index.held_bytes
    assert one > 0
    # Two chunks fit: they differ by a few bytes.
    monkeypatch.setattr(recording_index, "MAX_HELD_BYTES", int(2.5 * one))
    for at in (*range(len(STEPS)), *reversed(range(len(STEPS)))):
        index.frame(at)
        index.status(at)
        assert index.held_bytes <= 2.5 * one
    monkeypatch.setattr(recording_index, "MAX_HELD_BYTES", 0)
    assert index.frame(7) == recorded_frame(STEPS[7], 8), "one chunk is always held"


def test_a_file_that_was_cut_off_is_shown_up_to_its_last_whole_chunk(path: Path, tmp_path: Path) -> None:
    whole, cut = path.read_bytes(), tmp_path / "cut.mcap"
    ends = chunk_ends(path)
    assert len(ends) == 1 + len(STEPS) // A_CHUNK
    for size in [end + by for end in ends[1:] for by in (-1, 0, 9)]:
        cut.write_bytes(whole[:size])
        frames = A_CHUNK * (sum(at <= size for at in ends) - 1)
        if frames == 0:
            with pytest.raises(tm.InvalidArgumentError, match=r"cut\.mcap: has no frames"):
                RecordingIndex(cut)
            continue
        index = RecordingIndex(cut)
        assert len(index.times_s) == frames, size
        assert index.note.startswith("The file was cut off. It is shown up to its last whole chunk, at ")
        assert index.frame(frames - 1) == recorded_frame(STEPS[frames - 1], frames)


def test_a_damaged_chunk_ends_what_is_shown(path: Path, tmp_path: Path) -> None:
    whole, damaged = path.read_bytes(), tmp_path / "damaged.mcap"
    ends = chunk_ends(path)
    for at in range(ends[1] + 1, ends[-1], 23):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        index = RecordingIndex(damaged)
        # A byte between two chunks may be of their index, which nobody needs.
        assert A_CHUNK <= len(index.times_s) <= len(STEPS)
        for each in range(len(index.times_s)):
            assert index.frame(each) == recorded_frame(STEPS[each], each + 1)
        assert index.note != "" or len(index.times_s) == len(STEPS)
    damaged.write_bytes(whole[: ends[2] - 40] + bytes(20) + whole[ends[2] - 20 :])
    assert RecordingIndex(damaged).note.startswith("The file is damaged. It is shown up to")


@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100)])
def test_another_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(tm.InvalidArgumentError, match=r"other\.mcap: (is not an MCAP file|has no scene)"):
        RecordingIndex(path)


def test_a_recording_without_frames_says_how_to_record_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_recording(tmp_path / "inputs.mcap", [])
    assert main(["view", str(path)]) == 1
    assert (
        "inputs.mcap: has no frames to show; record them: tensormass record SCENE --frames" in capsys.readouterr().err
    )
    with pytest.raises(tm.InvalidArgumentError, match="has no frames"):
        RecordingIndex(write_recording(tmp_path / "no-topology.mcap", topology=None))


def test_frames_that_do_not_fit_are_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="liver"))
        writer.add("/start", tm.v1.recording_pb2.RecordingStart(scene="liver"))
        writer.add("/topology", TOPOLOGY)
        other = recorded_frame(10, 1)
        other.topology_version += 1
        writer.add("/frames", other)
        writer.add("/frames", recorded_frame(20, 2))
        writer.flush()
        short = recorded_frame(30, 3)
        short.positions = short.positions[:-12]
        writer.add("/frames", short)
    index = RecordingIndex(path)
    assert [index.frame(at).sequence for at in range(len(index.times_s))] == [2]
    assert index.note.startswith("The file is damaged.")


def test_a_time_that_is_not_a_number_ends_what_is_shown(tmp_path: Path) -> None:
    index = RecordingIndex(write_recording(tmp_path / "a.mcap", [10, 20]))
    assert len(index.times_s) == 2
    timeline = recording_index._Timeline(index.times_s, [])
    with pytest.raises(ValueError, match="no finite time"):
        timeline.take_frame(stream_pb2.Frame(step=30, simulated_time_s=np.nan))


def test_an_invalid_name_of_the_scene_is_refused(tmp_path: Path) -> None:
    topology = stream_pb2.Topology()
    topology.CopyFrom(TOPOLOGY)
    topology.scene = "a/b\0"
    with pytest.raises(tm.InvalidArgumentError, match="its scene has no valid name"):
        RecordingIndex(write_recording(tmp_path / "a.mcap", topology=topology))


def test_limits_are_named(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    holds = summary.chunk_indexes[0].uncompressed_size
    for limit, value, says in (
        ("MAX_FRAMES", len(STEPS) - 1, "more than 9 frames"),
        ("MAX_CHUNK_BYTES", 100, "a chunk has [0-9]+ bytes, the limit is 100"),
        ("MAX_CHUNK_BYTES", holds - 1, f"a chunk of [0-9]+ bytes holds {holds}, the limit is {holds - 1}"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(recording_index if limit == "MAX_FRAMES" else chunks, limit, value)
            with pytest.raises(tm.ResourceExhaustedError, match=says):
                RecordingIndex(path)


def test_a_file_that_changes_under_the_index_is_noticed(path: Path) -> None:
    index = RecordingIndex(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: chunk_ends(path)[2]])
    with pytest.raises(tm.InvalidArgumentError, match="has changed since it was opened"):
        index.frame(8)
    path.unlink()
    with pytest.raises(tm.InvalidArgumentError, match=r"liver\.mcap: No such file"):
        index.frame(8)
    path.write_bytes(whole)
    assert index.frame(8) == recorded_frame(STEPS[8], 9)


@pytest.mark.parametrize("option", [["--desktop"], ["--server", "127.0.0.1:1"], ["--allow-poses"]])
def test_options_of_running_scenes_are_refused(
    path: Path, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(path), *option]) == 1
    assert f"{option[0]}: is for running scenes" in capsys.readouterr().err


def test_frames_are_shown_with_the_tools_of_their_time(tmp_path: Path) -> None:
    later = stream_pb2.Topology()
    later.CopyFrom(TOPOLOGY)
    later.version += 5
    del later.tools[:]
    later.tools.add(name="hook", radius_m=0.01)
    path = tmp_path / "tools.mcap"
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="liver"), 1000)
        writer.add("/start", recording_pb2.RecordingStart(scene="liver"))
        for sequence, topology in enumerate((TOPOLOGY, later, TOPOLOGY, None), start=1):
            if topology is not None:
                writer.add("/topology", topology)
            frame = recorded_frame(sequence, sequence)
            frame.topology_version = topology.version if topology is not None else 77
            writer.add("/frames", frame)
    index = RecordingIndex(path)
    assert len(index.times_s) == 3, "one is of a topology that is not recorded"
    shown = [index.topology_of(index.frame(i)) for i in range(3)]
    assert [[tool.name for tool in topology.tools] for topology in shown] == [["probe"], ["hook"], ["probe"]]
    assert [topology.version for topology in shown] == [1000, 1005, 1000]
    assert all(topology.bodies == TOPOLOGY.bodies for topology in shown)
