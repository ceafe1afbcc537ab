"""A recording that runs on: files of bounded size that replay alone, and memory that stays flat."""

from __future__ import annotations

import argparse
import json
import sys
import tracemalloc
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from tensormass.v1 import control_pb2, recording_pb2, scene_pb2
from tensormass_tools.cli import main
from tensormass_tools.recording import file as recording_file
from tensormass_tools.recording import files as recording_files
from tensormass_tools.recording import size_of
from tensormass_tools.recording.file import RecordingReader, RecordingWriter
from tensormass_tools.recording.files import Cut, RecordingFiles


def step(index: int, number: int, time_ns: int, *, reset: bool = False) -> recording_pb2.RecordedStep:
    return recording_pb2.RecordedStep(index=index, step=number, server_time_ns=time_ns, reset=reset)


def steps_of(path: Path) -> list[tuple[int, int]]:
    """Index and number of each step in a file."""
    entries = RecordingReader(path).entries()
    return [(entry.message.index, entry.message.step) for entry in entries if entry.channel == "/inputs"]


def begin(writer: RecordingWriter, start: recording_pb2.RecordingStart) -> None:
    writer.add("/scene", scene_pb2.Scene(name="block"))
    writer.add("/start", start)
    writer.flush()


def rotating(path: Path, cuts: list[Cut], max_bytes: int = 1, keep: int | None = None) -> RecordingFiles:
    """Files that are full after each flush, and take their snapshots out of `cuts`."""
    return RecordingFiles(path, recording_pb2.RecordingStart(), begin, lambda: cuts.pop(0), max_bytes, keep)


@pytest.fixture(autouse=True)
def full_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message is a chunk, and nobody waits for a second try."""
    monkeypatch.setattr(recording_file, "CHUNK_BYTES", 1)
    monkeypatch.setattr(recording_files, "RETRY_S", 0.0)


def fill(files: RecordingFiles) -> None:
    """Makes the newest file full."""
    files._full_bytes = 0


def test_file_is_cut_after_the_step_of_the_snapshot(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with rotating(path, [Cut(5, 400, b"five")]) as files:
        files.add_step(step(1, 1, 100))
        fill(files)
        for number in range(2, 5):
            files.add_step(step(number, number, 100 * number))
        files.add_step(step(5, 5, 500))
        files.add_check(recording_pb2.StateCheck(index=5, step=5, hash=55))  # comes after its step
        files.add_step(step(6, 6, 600))
        files.add_check(recording_pb2.StateCheck(index=4, step=4, hash=44))  # late
        files.add_check(recording_pb2.StateCheck(index=6, step=6, hash=66))
        files.add_lost(recording_pb2.LostSteps(first_index=7, count=2))
    assert files.paths == [path, tmp_path / "a-2.mcap"]
    assert steps_of(path) == [(1, 1), (2, 2), (3, 3), (4, 4), (5, 5)]
    assert steps_of(files.paths[1]) == [(1, 6)]
    second = RecordingReader(files.paths[1])
    assert (second.start.step, second.start.snapshot) == (5, b"five")
    assert not RecordingReader(path).cut_off
    kept = {}
    for each in files.paths:
        kept[each.name] = [
            (entry.message.index, entry.message.hash)
            for entry in RecordingReader(each).entries()
            if entry.channel == "/checks"
        ]
    assert kept == {"a.mcap": [(5, 55), (4, 44)], "a-2.mcap": [(1, 66)]}
    assert [e.message.first_index for e in second.entries() if e.channel == "/lost"] == [2]


@pytest.mark.parametrize(
    ("after", "cut"),
    [
        # The scene was reset and made five steps again before the snapshot was taken: the first step 5 is another one.
        ([step(5, 5, 500), step(6, 6, 600), step(7, 1, 700, reset=True)], Cut(5, 1150, b"other")),
        # The reset comes before the step.
        ([step(5, 1, 500, reset=True), step(6, 2, 600)], Cut(9, 1150, b"other")),
        # The step was lost.
        ([step(9, 9, 900)], Cut(5, 450, b"other")),
    ],
    ids=["same-number", "reset", "lost"],
)
def test_snapshot_that_fits_no_step_is_not_used(
    tmp_path: Path, after: list[recording_pb2.RecordedStep], cut: Cut
) -> None:
    later = Cut(after[-1].step + 1, 0, b"later")
    cuts = [cut, later, later]
    path = tmp_path / "a.mcap"
    with rotating(path, cuts, max_bytes=1 << 20) as files:
        fill(files)
        files.add_step(step(4, 4, 400))
        for each in after:
            files.add_step(each)
        assert files.paths == [path]
        last = after[-1]
        files.add_step(step(last.index + 1, last.step + 1, last.server_time_ns + 100))
        files.add_step(step(last.index + 2, last.step + 2, last.server_time_ns + 200))
    assert len(files.paths) == 2
    assert RecordingReader(files.paths[1]).start.snapshot == b"later"
    assert steps_of(files.paths[1]) == [(1, last.step + 2)]


def test_no_file_is_cut_beside_an_edit_but_a_reset(tmp_path: Path) -> None:
    """The snapshot may be of the state before the edit or after it, and of other values."""
    path = tmp_path / "a.mcap"
    values = control_pb2.SceneAdjustments(gravity_m_per_s2=scene_pb2.Vector3(z=-2))
    cuts = [Cut(4, 0, b"before or after"), Cut(6, 0, b"later", 77, values)]
    with rotating(path, cuts, max_bytes=1 << 20) as files:
        fill(files)
        files.add_step(step(4, 4, 400))
        files.add_step(step(5, 5, 500), [recording_pb2.RecordedEdit(index=5, step=4, adjust=values)])
        files.add_step(step(6, 6, 600))
        files.add_step(step(7, 1, 700, reset=True), [recording_pb2.RecordedEdit(index=7, reset={})])
    assert steps_of(path) == [(4, 4), (5, 5), (6, 6)]
    assert steps_of(files.paths[1]) == [(1, 1)]
    second = RecordingReader(files.paths[1])
    assert (second.start.scene_hash, second.start.adjustments) == (77, values)
    assert [e.message.index for e in RecordingReader(path).entries() if e.channel == "/edits"] == [5]
    assert [e.message.index for e in second.entries() if e.channel == "/edits"] == [1]


def test_memory_is_flat_and_only_the_newest_files_stay(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    at_the_end_of_a_file: list[int] = []
    cuts: list[Cut] = []
    tracemalloc.start()
    try:
        with rotating(path, cuts, max_bytes=200_000, keep=3) as files:
            number = 0
            while len(at_the_end_of_a_file) < 8:
                number += 1
                cuts[:] = [Cut(number, 0, b"")]
                names = len(at_the_end_of_a_file)
                newest = files.paths[-1]
                before = tracemalloc.get_traced_memory()[0]
                files.add_step(step(number, number, number))
                if files.paths[-1] != newest:
                    assert len(at_the_end_of_a_file) == names
                    at_the_end_of_a_file.append(before)
            assert [each.exists() for each in files.paths] == 3 * [True]
            assert [each.name for each in files.paths] == ["a-7.mcap", "a-8.mcap", "a-9.mcap"]
            assert not RecordingReader(files.paths[0]).cut_off
            assert sorted(each.name for each in tmp_path.iterdir()) == ["a-7.mcap", "a-8.mcap", "a-9.mcap"]
    finally:
        tracemalloc.stop()
    assert at_the_end_of_a_file[-1] < 1.05 * at_the_end_of_a_file[2]


def test_each_file_of_a_real_recording_replays_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from service_parts import BLOCK  # skips without a daemon

    monkeypatch.setattr(recording_file, "CHUNK_BYTES", 1000)
    scene, path = tmp_path / "block.yaml", tmp_path / "block.mcap"
    scene.write_text(BLOCK)
    # Steps go on while a file is closed and the next one begins, so that the files are larger than asked for, and few.
    record = ["record", str(scene), "-o", str(path), "--lockstep", "--steps", "9000", "--check-every", "30"]
    assert main([*record, "--max-size", "20K", "--frames", "--backend", "cpu", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["files"][:2] == [str(path), str(tmp_path / "block-2.mcap")]
    assert (said["steps"], said["lost_steps"]) == (9000, 0)
    assert said["checks"] > 0, "fewer than 300 if some came while a file began"
    steps = checks = 0
    for each in said["files"]:
        assert RecordingReader(Path(each)).start.step == steps
        status = main(["replay", each, "--json"])
        replayed = json.loads(capsys.readouterr().out)
        # A short file may have no check, and a replay that compares nothing does not end well.
        assert status == (0 if replayed["checks"] else 1)
        assert replayed["exact"]
        assert replayed["equal_hashes"] == replayed["checks"]
        steps += replayed["steps"]
        checks += replayed["checks"]
    assert (steps, checks) == (9000, said["checks"])


def test_sizes_are_read_and_wrong_ones_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [size_of(text) for text in ("1000", "64K", "1.5m", "2G", "2GB")] == [1000, 65536, 3 << 19, 2 << 30, 2 << 30]
    for wrong in ("", "G", "two", "nan", "1e999"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a size, such as 200M"):
            size_of(wrong)
    for option, says in (("--max-size=0", "--max-size 0: must be positive"), ("--keep=0", "--keep 0: at least")):
        assert main(["record", "beam", "-o", str(tmp_path / "a.mcap"), "--steps", "1", option]) == 1
        assert says in capsys.readouterr().err
