"""The table of files and readers: it runs, and it finds a reader that sees more than we do."""

from __future__ import annotations

import sys
from pathlib import Path

import mesh_table
import mesh_texts as texts
import pytest


def test_the_table_says_what_came_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.msh").write_text(texts.gmsh41())
    (tmp_path / "s.off").write_text(texts.OFF)
    (tmp_path / "cut.inp").write_text("*NODE\n1, 0, 0\n*ELEMENT, TYPE=C3D4\n1, 1\n")
    (tmp_path / "notes.txt").write_text("not a mesh\n")
    monkeypatch.setattr(mesh_table, "readers", lambda: [mesh_table._ours])
    monkeypatch.setattr(sys, "argv", ["mesh_table", str(tmp_path), "--json", str(tmp_path / "table.json")])
    assert mesh_table.main() == 0
    out = capsys.readouterr().out
    assert "| m.msh | tensormass | 12 | 0 | 3 | 2 |" in out
    assert "| s.off | tensormass | 0 | 2 | 0 | 0 | a surface |" in out
    assert "| cut.inp | tensormass | 0 | 0 | 0 | 0 | cut.inp:4: element 1: C3D4 needs 4 nodes" in out
    assert "tensormass: 3 files, 2 read, 1 refused" in out
    more = mesh_table.Read("vtk", elements=12, volume=2.5)
    monkeypatch.setattr(mesh_table, "readers", lambda: [mesh_table._ours, lambda _: more])
    assert mesh_table.main() == 1
    assert "2 files in which another reader found more volume: m.msh, s.off" in capsys.readouterr().out
