"""`tensormass trade` from its options to its reports, without a daemon."""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from trade_parts import BLOCK, COSTS, MACHINE, Formula, knobs_of, measurement

import tensormass as tm
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import scene_pb2
from tensormass_tools.cli import main
from tensormass_tools.trade import command, reference, report, session
from tensormass_tools.trade.arguments import parse_depths, parse_share, parse_time_s
from tensormass_tools.trade.measures import Errors
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine


def test_times_and_shares() -> None:
    assert parse_time_s("1ms") == pytest.approx(1e-3)
    assert parse_time_s("500us") == pytest.approx(5e-4)
    assert parse_share("2%") == pytest.approx(0.02)
    assert parse_share("0.02") == pytest.approx(0.02)
    for text in ("1", "-1ms", "ms", "nanms"):
        with pytest.raises(argparse.ArgumentTypeError, match="not a time"):
            parse_time_s(text)
    with pytest.raises(argparse.ArgumentTypeError, match="not a share"):
        parse_share("two")
    with pytest.raises(argparse.ArgumentTypeError, match="'2' is 200 %; write 2%"):
        parse_share("2")
    assert (parse_depths("0.5"), parse_depths("0.5,1")) == ((0.5,), (0.5, 1.0))
    for text in ("1,0.5", "1,1", "0.25,0.5,1"):
        with pytest.raises(argparse.ArgumentTypeError, match="one depth, or a shallow and a deep one"):
            parse_depths(text)


@pytest.mark.parametrize(
    "option", ["--seconds", "--press", "--reference-seconds", "--timing-seconds", "--budget", "--tolerance"]
)
@pytest.mark.parametrize("value", ["inf", "nan", "0", "-1", "1e308", "1e-400", "much"])
def test_options_that_are_not_positive_numbers_are_refused(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["trade", "none.yaml", f"{option}={value}" + ("s" if option == "--budget" else "")])
    assert ended.value.code == 2
    assert f"argument {option}: '{value}" in capsys.readouterr().err


def test_the_help_names_only_scenes_that_are_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["trade", "--help"])
    help_text = " ".join(capsys.readouterr().out.split())
    assert "scene a scene file (.yaml), or a built-in scene (beam, " in help_text
    assert "mesh file" not in help_text


class FakeServer:
    """Accepts every scene; all else only the recorder, which is `Formula`, would ask it."""

    def inspect(self, scene: scene_pb2.Scene) -> None:
        pass


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, broken_law: str = "") -> Formula:
    """In place of a daemon; the scene is in block.yaml."""
    (folder / "block.yaml").write_text(BLOCK)
    scene = knobs_of(BLOCK, folder).message
    formula = Formula(scene, Script.of(scene, None), broken_law)
    monkeypatch.setattr(command, "launch", lambda **_: contextlib.nullcontext(FakeServer()))
    monkeypatch.setattr(session, "Recorder", lambda *_: formula)
    monkeypatch.setattr(Machine, "of", lambda *_: MACHINE)
    return formula


def run_on(folder: Path, *options: str) -> int:
    """A short run; results in out/."""
    short = ["--knobs", "dt_s", "--combinations", "0", "--tolerance", "5%"]
    return main(["trade", str(folder / "block.yaml"), "--out", str(folder / "out"), *short, *options])


def test_a_run_is_resumed_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    out = tmp_path / "out"
    run = ["trade", str(tmp_path / "block.yaml"), "--out", str(out), "--knobs", "resolution,dt_s", "--json"]
    assert main([*run, "--tolerance", "3%"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert {tuple(of["setting"]) for of in first["measurements"]} >= {(), ("resolution",), ("resolution", "dt_s")}
    assert first["not_varied"]["law"] == "not asked for"
    assert first["budget_s"] == pytest.approx(1 / 60)
    own, *others = first["measurements"]
    assert own["moved"] == 0 < min(of["moved"] for of in others)
    assert first["fastest"]["errors"]["displacement"] <= 0.03
    assert first["fastest"]["cost_s"] < first["measurements"][0]["cost_s"] * 4
    runs = formula.runs
    (out / "results.jsonl").write_text("".join((out / "results.jsonl").read_text().splitlines(keepends=True)[:-2]))
    assert main([*run, "--tolerance", "3%"]) == 0
    assert json.loads(capsys.readouterr().out) == first
    # The two lines that were taken away, and the two files that are always run again.
    assert formula.runs == runs + 4
    assert first["confirmed"].keys() == {"fastest", "most_accurate"}
    assert first["confirmed"]["fastest"]["errors"] == first["fastest"]["errors"]
    monkeypatch.setattr(Machine, "of", lambda *_: replace(MACHINE, device="<another> & new"))
    assert main([*run, "--tolerance", "3%"]) == 0
    assert formula.runs == 2 * runs + 4  # nothing is taken from another machine
    capsys.readouterr()

    page = (out / "report.html").read_text()
    assert page.count("<circle") == len(first["measurements"])
    assert page.count('class="onfront"') + page.count('class="own"') == len({*first["front"], own["key"]})
    assert "&lt;another&gt; &amp; new" in page
    assert "<another>" not in page
    assert "http" not in page  # nothing is fetched
    ElementTree.fromstring(page[page.index("<svg") : page.index("</svg>") + 6])
    fastest = SceneFile.read(out / "fastest.yaml").message()
    assert fastest.tools == knobs_of(BLOCK, tmp_path).message.tools
    (tmp_path / "mine.yaml").write_text(BLOCK.replace("cells_x: 4", "cells_x: 2"))
    assert main([*run[:-1], "--tolerance", "0.0001%", "--confirm", str(tmp_path / "mine.yaml")]) == 1
    printed = capsys.readouterr().out
    assert "most_accurate.yaml, read and run again: confirmed: " in printed
    assert "mine.yaml, read and run again: displacement " in printed  # a file without a promised result
    mine = json.loads((out / "trade.json").read_text())["confirmed"]["mine"]
    assert mine["element_count"] == 2**3
    assert mine["errors"]["displacement"] > 2 * first["measurements"][0]["errors"]["displacement"]
    assert "none is that accurate" in printed
    assert not (out / "fastest.yaml").exists()


@pytest.mark.parametrize("room_for_both", [True, False])
def test_a_machine_that_is_slower_for_a_while_makes_no_setting_dearer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room_for_both: bool
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    formula.room_for_both = room_for_both
    # The own recording, two levels of the reference, one in quadratic tetrahedra, the unmodified scene, its dt doubled.
    formula.slowness = [1.0, 1.0, 1.0, 1.0, 1.0, 5.0]
    run_on(tmp_path, "--reference-seconds", "1")
    own, doubled, *others = json.loads((tmp_path / "out" / "trade.json").read_text())["measurements"]
    assert [of["cost_s"] for of in others] == pytest.approx([2e-3, 4e-3])
    assert doubled["costs"]["step_p50_s"] == pytest.approx(5e-3)  # what was measured stays
    assert doubled["cost_s"] == pytest.approx(0.5e-3 if room_for_both else 2.5e-3)
    assert own["cost_s"] == own["costs"]["step_p50_s"] == pytest.approx(1e-3)


def test_candidates_are_also_solved_better_to_detect_chance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    formula.lucky_tolerance = 0.1
    assert run_on(tmp_path, "--knobs", "resolution,dt_s,cg_tolerance", "--combinations", "12") == 0
    said = capsys.readouterr().err
    assert "solved better than what would be recommended, 1/1: resolution 2, dt_s 0.008333: " in said
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    luckiest = min(result["measurements"], key=lambda of: of["errors"]["displacement"])
    assert luckiest["setting"]["cg_tolerance"] == 0.1
    for name in ("fastest", "most_accurate"):
        assert "cg_tolerance" not in result[name]["setting"]
    assert luckiest["errors"]["displacement"] < result["most_accurate"]["errors"]["displacement"] < 0.003


def test_a_file_that_misses_its_limit_again_is_not_confirmed() -> None:
    promised = measurement({"a": 1}, 1.0, 0.02)

    def missed(cost_s: float, error: float, failure: str = "", /, **limits: float) -> str:
        return report.missed(promised, measurement({}, cost_s, error, failure), report.Limits(**limits))

    assert missed(1.4, 0.0201) == ""
    assert missed(1.6, 0.02) == "median 1.6e+03 ms, 1e+03 ms before"
    assert missed(0.5, 0.021) == "error 2.1 %, 2 % before"
    assert missed(0.0, 0.0, "stopped") == "stopped"
    # Much as before, and yet not what it was recommended for.
    assert missed(1.08, 0.02, cost_s=1.0) == "median 8 % above 1e+03 ms"
    assert missed(1.0, 0.02, slow_s=1.6) == "p99 25 % above 1.6e+03 ms"
    assert missed(1.0, 0.0201, error=0.02) == "error 0.5 % above 2 %"
    assert missed(1.0, 0.02, cost_s=1.0, error=0.02, slow_s=2.0) == ""
    assert report.beyond(measurement({}, 1.6, 0.02), report.Limits(cost_s=2.0)) == ""  # the promise is another matter
    assert report.beyond(measurement({}, 1.6, 0.02, "stopped"), report.Limits()) == "stopped"


def test_a_budget_that_slow_steps_exceed_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path, "--budget", "1.2ms") == 0
    printed = capsys.readouterr().out
    assert "most accurate within 1.2 ms, by the median: " in printed
    assert "ms a step of the scene (median; p99 2 ms)" in printed
    assert "its p99 is 2 ms, and a loop of a fixed rate misses such steps" in printed
    assert "most_accurate.yaml, read and run again: confirmed: displacement" in printed
    assert run_on(tmp_path, "--budget", "100ms") == 0
    assert "a loop of a fixed rate" not in capsys.readouterr().out


def second_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, slowness: list[float], wrongness: list[float] | None = None
) -> Formula:
    """Measurements at 0.5, 1, 2 and 4 ms, the more expensive ones more accurate; those of fastest.yaml first."""
    formula = stand_in(folder, monkeypatch)
    assert run_on(folder) == 0
    formula.slowness, formula.wrongness = slowness, wrongness or []
    formula.runs = 0
    return formula


def dt_of(file: Path) -> float:
    return SceneFile.read(file).message().stepping.dt_s


def test_a_setting_that_leaves_the_budget_makes_room_for_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # On a machine that is 2.2 times as slow 2 ms would not do either.
    formula = second_runs(tmp_path, monkeypatch, [1.0, 2.2])
    capsys.readouterr()
    assert run_on(tmp_path, "--budget", "4.1ms") == 0
    printed, said = capsys.readouterr()
    assert formula.runs == 3
    assert "most_accurate.yaml leaves its limit: median 115 % above 4.1 ms; next: as it is\n" in said
    assert "most accurate within 4.1 ms, by the median: as it is: " in printed
    dropped = "dropped from most_accurate.yaml, read and run again: dt_s 0.004167: median 115 % above 4.1 ms; "
    assert f"\n{dropped}median 8.8 ms, 4 ms before: displacement " in printed
    assert "\nmost_accurate.yaml, read and run again: confirmed: " in printed
    page = (tmp_path / "out" / "report.html").read_text()
    assert dropped in page
    assert "by the median</b>: as it is: " in page
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    assert result["most_accurate"]["setting"] == {}
    assert result["confirmed"]["most_accurate"]["cost_s"] == pytest.approx(1e-3)
    (tried,) = result["dropped"].pop("most_accurate")
    assert not result["dropped"]
    assert tried["key"] in [of["key"] for of in result["measurements"] if of["setting"] == tried["setting"] != {}]
    assert tried["again"]["cost_s"] == pytest.approx(8.8e-3)
    file = tmp_path / "out" / "most_accurate.yaml"
    assert dt_of(file) == 0  # the scene's own
    assert "# In place of one that left this limit when run again: dt_s 0.004167\n" in file.read_text()


def test_a_setting_that_leaves_the_tolerance_makes_room_for_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    second_runs(tmp_path, monkeypatch, [], [1.1])
    capsys.readouterr()
    assert run_on(tmp_path) == 0
    printed, said = capsys.readouterr()
    assert "fastest.yaml leaves its limit: error " in said
    assert "fastest within 5 %: as it is: " in printed
    assert "\ndropped from fastest.yaml, read and run again: dt_s 0.03333: error " in printed
    assert "\nfastest.yaml, read and run again: confirmed: " in printed
    assert dt_of(tmp_path / "out" / "fastest.yaml") == 0


def test_the_third_setting_is_kept_confirmed_or_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = second_runs(tmp_path, monkeypatch, [1.0, 1.1, 2.1, 4.2])
    capsys.readouterr()
    assert run_on(tmp_path, "--budget", "4.1ms") == 0
    printed, said = capsys.readouterr()
    assert formula.runs == 4
    assert "above 4.1 ms; no other takes its place\n" in said
    assert printed.count("dropped from most_accurate.yaml") == 2
    assert "most accurate within 4.1 ms, by the median: as it is: " in printed
    assert "\nmost_accurate.yaml, read and run again: NOT CONFIRMED: median 2.4 % above 4.1 ms; " in printed
    # None would be in the budget on a machine so slow: the first stands.
    formula.slowness = [1.0, 9.0]
    assert run_on(tmp_path, "--budget", "4.1ms") == 0
    printed = capsys.readouterr().out
    assert formula.runs == 6
    assert "dropped" not in printed
    assert "most accurate within 4.1 ms, by the median: dt_s 0.004167: " in printed
    assert "\nmost_accurate.yaml, read and run again: NOT CONFIRMED: " in printed


def test_a_setting_that_is_slower_but_keeps_its_limit_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    second_runs(tmp_path, monkeypatch, [1.6])
    capsys.readouterr()
    assert run_on(tmp_path) == 0
    printed, said = capsys.readouterr()
    assert "fastest.yaml, read and run again: NOT CONFIRMED: median 0.8 ms, 0.5 ms before" in printed
    assert "dropped" not in printed
    assert "leaves its limit" not in said


def test_the_written_file_is_named_even_if_the_daemon_ends_during_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    formula = second_runs(tmp_path, monkeypatch, [1.0, 1.1])
    formula.last_run = 3
    assert run_on(tmp_path, "--budget", "4.1ms") == 1
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    assert result["most_accurate"]["setting"] == {"dt_s": dt_of(tmp_path / "out" / "most_accurate.yaml")}
    assert result["most_accurate"]["cost_s"] == pytest.approx(2e-3)
    assert len(result["dropped"]["most_accurate"]) == 1
    assert result["confirmed"].keys() == {"fastest"}


def test_an_equilibrium_costs_one_step_whatever_its_dt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch)
    still = BLOCK[: BLOCK.index("tools:")] + "solver: {integrator: quasi_static}\n"
    (tmp_path / "block.yaml").write_text(still)
    (tmp_path / "mine.yaml").write_text(still + "stepping: {dt_s: 1.0}\n")
    run_on(tmp_path, "--knobs", "cg_tolerance", "--confirm", str(tmp_path / "mine.yaml"))
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    assert result["script"] == "one step from rest to equilibrium"
    assert result["confirmed"]["mine"]["cost_s"] == result["measurements"][0]["cost_s"] == pytest.approx(1e-3)


def test_a_reference_as_inaccurate_as_its_settings_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)
    run_on(tmp_path, "--reference-seconds", "0.001")
    found = json.loads((tmp_path / "out" / "trade.json").read_text())["reference"]
    for times, said in ((2, True), (4, False)):
        capsys.readouterr()
        tolerance = times * max(found["displacement_error"], found["force_error"])
        run_on(tmp_path, "--reference-seconds", "0.001", "--tolerance", f"{tolerance}")
        assert ("the reference itself may be off by" in capsys.readouterr().out) == said


def test_results_without_a_solution_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    warnings = ("settings have steps that ended above their newton_tolerance", "the reference has inverted elements")
    assert run_on(tmp_path) == 0
    printed = capsys.readouterr().out
    assert not any(warning in printed for warning in warnings)
    formula.unconverged_steps, formula.min_det_f = 3, 0.0
    assert run_on(tmp_path, "--press", "0.4") == 0  # another script: measured anew
    printed = capsys.readouterr().out
    assert all(warning in printed for warning in warnings)


def test_each_value_of_a_knob_is_compared_with_the_scenes_own(tmp_path: Path) -> None:
    knob = knobs_of(BLOCK, tmp_path).knobs["precision"]
    measured = [measurement({}, 2.0, 0.01), measurement({"precision": "double"}, 3.0, 0.02)]
    rows = [(row[1], row[2], row[3], kind) for row, kind in report.knob_rows([knob], measured)]
    assert rows == [("float", "× 1.00", "1 %", "front"), ("double", "× 1.50", "2 %", "")]


def test_a_row_has_its_units() -> None:
    errors = Errors(0.02, 0.03, 0.001, 0.05, math.radians(3), 0.04, 0.1, -0.02, 0.015)
    costs = replace(COSTS, latency_p50_s=0.0035, memory_bytes=12_300_000, step_energy_j=0.25)
    of = replace(measurement({"dt_s": 0.01}, 2e-3, 0.0), errors=errors, costs=costs, moved=0.004)
    row = dict(zip(report.HEADS, report.cells(of), strict=True))
    assert row == {
        "setting": "dt_s 0.01",
        "elements": "6",
        "error": "5 %",
        "displacement": "2 %",
        "worst node": "3 %",
        "force": "5 %",
        "force held": "1.5 %",
        "force moving": "–",
        "angle": "3°",
        "work": "4 %",
        "frequency": "10 %",
        "damping": "-0.020",
        "volume": "0.1 %",
        "cost": "2 ms",
        "step p50": "1 ms",
        "step p99": "2 ms",
        "latency": "3.5 ms",
        "memory": "12.3 MB",
        "energy": "250 mJ",
        "moved": "0.4 %",
    }


def test_two_depths_share_a_column() -> None:
    errors = Errors(0.02, 0.03, 0.001, 0.05, force_held=0.29, force_moving=0.4, force_held_shallow=0.54)
    row = dict(zip(report.HEADS, report.cells(replace(measurement({}, 2e-3, 0.0), errors=errors)), strict=True))
    assert (row["force held"], row["force moving"]) == ("54 % / 29 %", "40 %")


def test_a_setting_that_breaks_is_a_result_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch, broken_law="hencky")
    options = ["--knobs", "law", "--combinations", "0", "--reference-seconds", "1", "--tolerance", "5%"]
    main(["trade", str(tmp_path / "block.yaml"), "--out", str(tmp_path / "out"), *options])
    assert "law hencky could not be run: left the numbers" in capsys.readouterr().out


def test_the_unmodified_scene_is_run_before_its_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    formula.last_run = 1
    monkeypatch.delattr(reference, "find")
    assert run_on(tmp_path) == 1
    assert capsys.readouterr().err.endswith("\ntensormass: the daemon is gone\n")  # which no folder can help


def test_a_quick_run_takes_a_minute_for_its_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch)
    for options, limit_s in (([], 600), (["--quick"], 60), (["--quick", "--reference-seconds", "7"], 7)):
        run_on(tmp_path, "--tolerance", "0.0001%", *options)
        ended = json.loads((tmp_path / "out" / "trade.json").read_text())["reference"]["ended"]
        assert ended.endswith(f"(--reference-seconds {limit_s})")


def test_a_refused_scene_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)

    def refuse(_self: FakeServer, scene: scene_pb2.Scene) -> None:
        raise tm.InvalidArgumentError(f"scene.name: {scene.name} is refused")

    monkeypatch.setattr(FakeServer, "inspect", refuse)
    (tmp_path / "block.yaml").write_text(BLOCK.replace("name: block\ngravity", "name: ../../x\ngravity"))
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    monkeypatch.chdir(inner)
    assert main(["trade", str(tmp_path / "block.yaml")]) == 1
    assert "scene.name: ../../x is refused" in capsys.readouterr().err
    assert sorted(of.name for of in tmp_path.rglob("*")) == ["a", "b", "block.yaml"]
    assert formula.runs == 0


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("none.yaml", None, "none.yaml: no such file"),
        ("long.yaml", BLOCK + "stepping: {dt_s: 0.5}\n", "long.yaml: stepping.dt_s: 0.5 does not divide"),
        ("two.yaml", BLOCK.replace("- name: block", "- name: other"), "two.yaml: bodies are other, those of"),
        ("out/fastest.yaml", None, "fastest.yaml: the command writes this file itself"),
    ],
)
def test_files_to_confirm_are_read_first(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    text: str | None,
    said: str,
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    if text is not None:
        (tmp_path / name).write_text(text)
    assert run_on(tmp_path, "--confirm", str(tmp_path / name)) == 1
    error = capsys.readouterr().err
    assert "--confirm" in error
    assert said in error
    assert formula.runs == 0
    assert not (tmp_path / "out").exists()


def test_a_file_that_the_daemon_refuses_to_confirm_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)
    (tmp_path / "mine.yaml").write_text(BLOCK.replace("name: block\ngravity", "name: mine\ngravity"))

    def refuse_mine(_self: FakeServer, scene: scene_pb2.Scene) -> None:
        if scene.name == "mine":
            raise tm.InvalidArgumentError("scene.solver: no")

    monkeypatch.setattr(FakeServer, "inspect", refuse_mine)
    assert run_on(tmp_path, "--confirm", str(tmp_path / "mine.yaml")) == 1
    assert f"--confirm {tmp_path / 'mine.yaml'}: scene.solver: no" in capsys.readouterr().err


def test_files_of_the_same_name_are_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    files = [tmp_path / folder / "fastest.yaml" for folder in ("a", "b")]
    for cells, file in enumerate(files, 1):
        file.parent.mkdir()
        file.write_text(BLOCK.replace("cells_x: 4", f"cells_x: {cells}"))
    assert run_on(tmp_path, "--confirm", *map(str, files)) == 0
    confirmed = json.loads((tmp_path / "out" / "trade.json").read_text())["confirmed"]
    counts = {name: of["element_count"] for name, of in confirmed.items()}
    assert counts == {"fastest": 64, "most_accurate": 64, str(files[0]): 1, str(files[1]): 8}
    assert formula.together[-3:] == [1, 1, 2]  # what the user compares is timed in turns
    assert formula.limits_s[-4:] == [5.0, 20.0, 20.0, 20.0]
    printed = capsys.readouterr().out
    assert "\nfastest.yaml, read and run again: confirmed: " in printed
    assert f"\n{files[0]}, read and run again: displacement " in printed


def test_measurements_are_reported_even_if_the_daemon_ends_during_confirmation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path) == 0
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    (tmp_path / "out" / "trade.json").unlink()
    (tmp_path / "out" / "report.html").unlink()
    formula.last_run = formula.runs + 1  # all but the confirmation is there
    assert run_on(tmp_path) == 1
    kept = json.loads((tmp_path / "out" / "trade.json").read_text())
    assert kept == {**result, "confirmed": {}}
    assert "One knob at a time" in (tmp_path / "out" / "report.html").read_text()


def test_a_tool_that_touches_nothing_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path) == 0
    said = "touches nothing in the reference"
    assert said not in "".join(capsys.readouterr())
    formula.felt = False
    assert run_on(tmp_path, "--press", "0.4") == 0  # another script: measured anew
    printed, error = capsys.readouterr()
    assert f"warning: 'probe' {said}" in error
    assert f"  'probe' {said}" in printed
    assert said in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("shape", "over"),
    [
        ("hexahedron", "errors without that of the mesh, which the reference does not refine"),
        ("tetrahedron", "errors against the same mesh in quadratic tetrahedra, which the reference does not refine"),
    ],
)
def test_errors_that_leave_out_the_mesh_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shape: str, over: str
) -> None:
    stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path) == 0
    assert "without that of the mesh" not in "".join(capsys.readouterr())
    tm.write_mesh(tmp_path / "own.msh", tm.grid([4, 4, 3], [0.1, 0.1, 0.05], shape=shape))
    at = BLOCK.index("grid:")
    (tmp_path / "block.yaml").write_text(BLOCK[:at] + "file: own.msh}" + BLOCK[BLOCK.index("\n    law") :])
    assert run_on(tmp_path) == 0
    printed, error = capsys.readouterr()
    said = "the mesh is not refined (body 'block': its mesh comes from a file)"
    assert f"warning: {said}" in error
    assert f"  {said}" in printed
    assert "its own error (without that of the mesh), by Richardson" in printed
    assert f"{over}\n   setting" in printed
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.index(over) < page.index("<th>setting</th>")
    assert "the mesh is not refined" in page
    assert json.loads((tmp_path / "out" / "trade.json").read_text())["reference"]["refines_mesh"] is False


def test_a_full_disk_is_reported_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez_compressed", full)
        assert run_on(tmp_path) == 1
    assert f"--out {tmp_path / 'out'}: cannot be written to: No space left" in capsys.readouterr().err
    assert run_on(tmp_path) == 0
    before = (tmp_path / "out" / "trade.json").read_text()
    write_text = Path.write_text

    def full_at_the_end(path: Path, text: str, encoding: str) -> None:
        write_text(path, text[:10], encoding)
        if "trade.json" in path.name:
            full()
        write_text(path, text, encoding)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full_at_the_end)
        assert run_on(tmp_path) == 1
    assert (tmp_path / "out" / "trade.json").read_text() == before  # not half of another
