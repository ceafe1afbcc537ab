"""Files that are replaced when all of the new one is there, and else stay."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import meshio
import numpy as np
import pytest

from tensormass._shared.files import replacing
from tensormass._src import mesh_files


def test_a_file_is_there_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "new.txt"
    with replacing(path) as aside:
        assert aside.name == path.name  # writers take the format from it
        aside.write_text("half")
        assert not path.exists()
        aside.write_text("whole")
    assert path.read_text() == "whole"
    assert path.stat().st_mode & 0o777 == 0o666 & ~current_umask()
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "old.txt"
    path.write_text("old")

    def write_half(end: type[BaseException]) -> None:
        with replacing(path) as aside:
            aside.write_text("ne")
            raise end

    for end in (OSError, KeyboardInterrupt):
        with pytest.raises(end):
            write_half(end)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_replaced_file_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "old.txt"
    path.touch()
    path.chmod(0o640)
    with replacing(path) as aside:
        aside.write_text("new")
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o640)


def test_a_link_keeps_naming_the_same_file(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to("elsewhere/file.bin")  # which is not there yet
    for text in ("new", "newer"):
        with replacing(link) as aside:
            aside.write_text(text)
            assert aside.name == "link.txt"
        assert link.is_symlink()
        assert (elsewhere / "file.bin").read_text() == text
    assert len(list(elsewhere.iterdir())) == 1


def test_a_pipe_is_written_to_directly(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    heard: list[str] = []
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()), daemon=True)
    reader.start()
    with replacing(pipe) as aside:
        aside.write_text("words")
    reader.join(10)
    assert heard == ["words"]
    assert pipe.is_fifo()


@pytest.mark.parametrize("name", ["/dev/null", "/dev/stdout", "/proc/self/fd/1"])
def test_system_files_are_written_directly(name: str) -> None:
    with replacing(Path(name)) as aside:
        assert aside == Path(name)


def test_a_file_that_cannot_be_replaced_reports_its_own_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "none" / "file") as aside:
        aside.write_text("lost")
    with pytest.raises(IsADirectoryError), replacing(tmp_path) as aside:
        aside.write_text("lost")
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_file_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept.txt"
    path.touch()
    monkeypatch.setattr(os, "access", lambda of, mode: Path(of) != path or not mode & os.W_OK)
    with replacing(path) as aside:
        assert aside == path  # opening it says why not


def test_the_file_that_names_the_others_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    monkeypatch.setattr(os, "replace", lambda source, target: moved.append(Path(target).name))
    with replacing(tmp_path / "mesh.ele") as aside:
        for name in ("mesh.ele", "mesh.a", "mesh.node"):
            aside.with_name(name).touch()
    assert moved[-1] == "mesh.ele"
    assert sorted(moved) == ["mesh.a", "mesh.ele", "mesh.node"]


def test_a_mesh_of_two_files_is_written_as_both(tmp_path: Path) -> None:
    mesh = meshio.Mesh(np.eye(4, 3), [("tetra", [[0, 1, 2, 3]])])
    mesh_files.write_mesh(tmp_path / "mesh.ele", mesh_files.from_meshio(mesh))
    assert {path.name for path in tmp_path.iterdir()} == {"mesh.ele", "mesh.node"}
    assert mesh_files.read_mesh(tmp_path / "mesh.ele").element_count == 1


def current_umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
