"""Damaged files are read or refused, and never hang, crash or take all memory: see mesh_mutations.py."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import mesh_mutations
import pytest

from tensormass._src.label_formats import reading as label_reading
from tensormass._src.mesh_formats import obj, reading


@pytest.mark.parametrize("reader", sorted({*reading.READERS.values(), *label_reading.READERS.values()}))
def test_damaged_files_are_read_or_refused(reader: str) -> None:
    program = [sys.executable, str(Path(mesh_mutations.__file__)), reader]
    ran = subprocess.run(program, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert f"{reader}: {mesh_mutations.COUNT} files, " in ran.stdout
    was_read = int(ran.stdout.split(" files, ")[1].split()[0])
    assert 0 < was_read < mesh_mutations.COUNT, "mutations that change nothing, or only destroy, find little"


def test_mutations_follow_from_their_seed() -> None:
    content = mesh_mutations.samples()["gmsh"][0][1]
    first, second = (mesh_mutations.mutated(content, random.Random("1 gmsh 0")) for _ in range(2))
    assert first == second != content


def test_a_mistake_in_a_reader_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(obj, "_MAX_INDEX", 1 << 80)
    _, wrong = mesh_mutations.run("obj", 200, seed=1)
    assert any("OverflowError" in line for line in wrong)
