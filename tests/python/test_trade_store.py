"""Measurements on disk: what is kept, what is forgotten, and what a key holds."""

from __future__ import annotations

import json
import platform
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import full_disk
from trade_parts import BLOCK, COSTS, MACHINE, knobs_of, measurement, recording

import tensormass as tm
from tensormass_tools.trade.measures import Errors, compare
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Store, _host, key_of


def test_results_survive_and_half_a_line_is_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path)
    kept = [measurement({}, 1.0, 0.1), replace(measurement({"law": "hooke"}, 0.0, 0.0, failure="no"), warnings=["w"])]
    for of in kept:
        store.put(of)
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "half')
    again = Store(tmp_path)
    assert [again.get(of.key) for of in kept] == kept
    again.put(measurement({"law": "hencky"}, 1.0, 0.1))  # goes on a line of its own
    assert Store(tmp_path).get(repr({"law": "hencky"})) is not None
    (tmp_path / "results.jsonl").write_text("{}\n")
    with pytest.raises(tm.InvalidArgumentError, match=r"results.jsonl:1: not a measurement"):
        Store(tmp_path)


def test_older_results_are_read(tmp_path: Path) -> None:
    Store(tmp_path).put(measurement({}, 1.0, 0.1))
    (line,) = (tmp_path / "results.jsonl").read_text().splitlines()
    plain = json.loads(line)
    del plain["machine"]["host"]
    (tmp_path / "results.jsonl").write_text(json.dumps(plain) + "\n")
    assert Store(tmp_path).get(repr({})) == measurement({}, 1.0, 0.1)


def test_a_host_is_told_from_others_without_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, other, none = (tmp_path / name for name in ("own", "other", "none"))
    own.write_text("0123456789abcdef0123456789abcdef\n")
    other.write_text("1123456789abcdef0123456789abcdef\n")
    hosts = [_host(of) for of in (own, other, none)]
    assert len({*hosts}) == 3
    assert all(re.fullmatch("[0-9a-f]{8}", of) for of in hosts)
    assert hosts[0] == _host(own)
    own.write_bytes(b"\xff\xfe")
    assert _host(own) == hosts[2]  # as if there were none
    own.write_text("0123456789abcdef0123456789abcdef\n")
    monkeypatch.setattr(platform, "node", lambda: "another")
    assert _host(none) != hosts[2]
    assert _host(own) == hosts[0]


def test_recordings_survive_and_half_of_one_is_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.keep("a", recording(1.5))
    again = store.recording("a")
    assert again is not None
    assert compare(again, recording(1.5), [np.ones(3)]) == Errors(0, 0, 0, 0, 0, 0, 0, 0)
    assert again.costs == COSTS
    file = tmp_path / "recordings" / "a.npz"
    file.write_bytes(file.read_bytes()[:100])
    assert store.recording("a") is None


def test_a_full_disk_leaves_what_was_measured(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.keep("a", recording(1.5))
    store.put(measurement({}, 1.0, 0.1))
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "half')
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with full_disk(100):
        with pytest.raises(OSError, match="File too large"):
            store.keep("a", recording(2.5))
        with pytest.raises(OSError, match="File too large"):
            Store(tmp_path)  # forgets the half line
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_key_holds_scene_script_and_machine(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None)
    key = key_of(scene, script, MACHINE, "r")
    assert key == key_of(scene, script, MACHINE, "r")
    assert key != key_of(scene, script, replace(MACHINE, device="another"), "r")
    assert key != key_of(scene, script, replace(MACHINE, build="def"), "r")
    assert key != key_of(scene, script, replace(MACHINE, host="0123abcd"), "r")
    assert key != key_of(scene, replace(script, duration_s=9.0), MACHINE, "r")
    scene.solver.cg_tolerance = 0.5
    assert key != key_of(scene, script, MACHINE, "r")
