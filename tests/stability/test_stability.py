"""The quick cases against a real daemon; `make stability` runs all. They are skipped without build/bin/tensormassd."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tensormass as tm
from accuracy.engine import Engine
from accuracy.laws import LAWS
from tensormass._shared import processes
from tensormass.v1 import scene_pb2
from tensormass_tools.trade.small_strain import small_strain

from . import cases_start, cases_steps, journal, report
from .case import (
    BROKEN,
    CAUGHT,
    CURVATURE,
    DEVICE_FAILED,
    HOLDS,
    INVERTED,
    NOT_CONVERGED,
    OUT_OF_RANGE,
    SHORT,
    SOFTER,
    Case,
    Check,
    Found,
    Group,
    Verdict,
    judge,
)
from .cases import all_cases
from .cases_input import SCENES, places, real_fields
from .journal import Entry, Journal
from .promises import PROMISES
from .run import bundles_of, run, tasks_of
from .tissue import Shared, tissue

QUICK = [(case, precision) for case in all_cases() if case.quick for precision in case.precisions]


@pytest.fixture(scope="module")
def daemon() -> Path:
    try:
        return Path(processes.find_program("tensormassd", "TENSORMASSD"))
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))


@pytest.fixture(scope="module")
def server(daemon: Path) -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as server:  # others run beside it
        yield server


@pytest.mark.parametrize(("case", "precision"), QUICK, ids=[f"{case.key}-{precision}" for case, precision in QUICK])
def test_case_keeps_its_promise(server: tm.Server, case: Case, precision: str) -> None:
    verdict = judge(case, Engine(server, precision))
    assert case.explains(verdict.outcome, precision), verdict


def test_input_cases_cover_every_number_of_a_scene() -> None:
    unused = Engine(None, "float")  # type: ignore[arg-type]
    visited = {place.kind for scene in SCENES for place in places(scene(unused))}
    assert real_fields(scene_pb2.DESCRIPTOR.message_types_by_name["Scene"]) - visited == set()


def test_every_law_has_a_promise_and_a_tissue() -> None:
    names = {field.name for field in scene_pb2.Law.DESCRIPTOR.oneofs_by_name["kind"].fields}
    assert set(PROMISES) == names == set(LAWS)
    for name in names:
        assert tissue(name).message.WhichOneof("kind") == name
    guards = (Path(__file__).parents[2] / "docs" / "decisions" / "guards.md").read_text()
    rows = re.findall(r"^\| ([a-z_, ]+) \|", guards.split("| law |")[1], re.MULTILINE)
    assert sorted(", ".join(rows).split(", ")) == sorted(names)


def test_every_isotropic_law_has_a_small_strain_equivalent() -> None:
    for name in LAWS:
        found = small_strain(tissue(name, 4000, 0.3).message)
        expected = None if LAWS[name].directed else pytest.approx((4000, 0.3))
        assert found == expected, f"{name}: add it to small_strain of tensormass_tools/trade/small_strain.py"


def test_promised_range_of_hooke_is_that_of_its_header() -> None:
    source = (Path(__file__).parents[2] / "server" / "physics" / "material" / "hooke.h").read_text()
    strain, rotation = (float(re.search(rf"kMax{of} = ([\d.]+)", source)[1]) for of in ("Strain", "Rotation"))  # type: ignore[index]
    assert f"strain {100 * strain:g} %, rotation {rotation:g} rad" in PROMISES["hooke"][0]


def test_every_exception_of_a_start_has_happened() -> None:
    rows = [row for backend in report.BACKENDS if (run := report.Run.read(backend)) for row in run.rows]
    happened = {(row.key, row.verdict.outcome) for row in rows}
    cases = [case for case in all_cases() if case.group.name == "start"]
    explained = {(case.key, outcome): why for case in cases for outcome, why in case.short.items()}
    assert explained.keys() <= happened
    # If a reason says that small steps by Newton's method come back, they do.
    mended = [key for (key, _), why in explained.items() if why == cases_start._IN_SMALL_STEPS]
    by_newton = {
        key.replace(name, name + cases_start._NEWTON)
        for key in mended
        for name in [key.split("/", 1)[1].rsplit("/", 2)[0]]
    }
    found = {row.key: row.verdict.outcome for row in rows if row.key in by_newton}
    assert found == dict.fromkeys(by_newton, HOLDS)
    # A law that must come back has no exception outside the table.
    (case,) = (case for case in cases if case.key == "start/stretched to 10×/corotational/wedge")
    assert not case.explains(CAUGHT, "float")
    assert not case.explains(SHORT, "float")


def test_files_are_those_of_the_results() -> None:
    runs = [run for backend in report.BACKENDS if (run := report.Run.read(backend))]
    for path, text in report.files(runs).items():
        assert path.read_text() == text, f"{path.name}: run `python -m stability.report` in tests/"
    for run in runs:
        assert report.unexplained_rows(run) == []


def test_the_page_is_short_and_has_the_worst_rows() -> None:
    runs = [run for backend in report.BACKENDS if (run := report.Run.read(backend))]
    page = report.page(runs)
    assert len(page.replace("|", " ").split()) <= 1100  # two screens; counts symbols, too
    broken = report.exceptions(all_cases(), runs)
    expects = {case.key: case.expects for case in all_cases()}
    rows = [row for run in runs for row in run.rows]
    assert sum(one.count.total() for one in broken) == sum(row.verdict.outcome not in expects[row.key] for row in rows)
    assert [one.outcome for one in broken] == sorted((one.outcome for one in broken), key=[SHORT, CAUGHT].index)
    for one in broken[: report.WORST]:
        assert f"| {one.name} |" in page
        assert one.reason in page


def test_the_page_shows_what_is_not_explained(tmp_path: Path) -> None:
    case = next(case for case in all_cases() if case.key == "step/1 s/corotational/hexahedron")
    head = dict.fromkeys(("backend", "device", "machine", "commit", "command", "date"), "x")
    run = report.Run(**head, seconds=1, rows=[report.Row(case.key, "float", Verdict(SHORT, 123.4, "off"))])
    page = report.page([run])
    assert "| step: 1 s | corotational | hexahedron | short | 123 | 1 | a |" in page
    assert "* a: NOT EXPLAINED." in page
    assert "No results of the cpu backend yet." in page
    assert report.table([run]).splitlines()[1] == "step,1 s,corotational,hexahedron,,,short,123"


def test_the_table_has_every_row_of_the_results() -> None:
    runs = [run for backend in report.BACKENDS if (run := report.Run.read(backend))]
    lines = list(csv.DictReader(io.StringIO(report.table(runs))))
    for run in runs:
        found = {
            ("/".join((line["section"], line["case"], line["law"], line["shape"])), precision): line[
                f"{run.backend} {precision}"
            ]
            for line in lines
            for precision in ("double", "float")
            if line[f"{run.backend} {precision}"]
        }
        assert found == {row.task: report._SHORT_NAMES[row.verdict.outcome] for row in run.rows}


def test_the_results_readme_says_what_is_left_out() -> None:
    lines = report._left_out(all_cases())
    assert all(line in report.explanation() for line in lines)
    assert "* Rest: hexahedron only" in lines
    assert "* Tools: tetrahedron, hexahedron only" in lines
    assert "* Free flight and spin: without quadratic tetrahedron, quadratic hexahedron" in lines
    assert "* Every input field: float only" in lines
    assert not any("Where it starts" in line for line in lines)
    assert any(line.startswith("* Meshes, flat elements: tetrahedron only") for line in lines)


def test_keys_are_unique() -> None:
    keys = [case.key for case in all_cases()]
    assert len(keys) == len(set(keys))


def test_nan_does_not_hold() -> None:
    group = Group("g", "G", "", "")

    def outcome(value: float, **reasons: str) -> tuple[str, bool]:
        case = Case(group, "n", "law", "shape", lambda engine: Found([Check("c", value, 1.0)]), short=reasons)
        verdict = judge(case, Engine(None, "float"))  # type: ignore[arg-type]
        return verdict.outcome, case.explains(verdict.outcome, "float")

    assert outcome(1.0) == (HOLDS, True)
    assert outcome(1.1) == (SHORT, False)
    assert outcome(float("nan")) == (SHORT, False)
    assert outcome(1.1, float="because") == (SHORT, True)
    assert outcome(1.1, double="because") == (SHORT, False)


def test_only_a_warning_that_names_the_cause_counts() -> None:
    group = Group("g", "G", "", "")

    def outcome(*warnings: str) -> str:
        run = lambda engine: Found([Check("c", 2.0, 1.0)], warnings)  # noqa: E731
        case = Case(group, "n", "law", "shape", run, names=(INVERTED,))
        return judge(case, Engine(None, "float")).outcome  # type: ignore[arg-type]

    assert outcome() == SHORT
    assert outcome("steps take 2 s of a budget of 1 s") == SHORT
    assert outcome("steps take 2 s of a budget of 1 s", f"{INVERTED} (min det F -1)") == CAUGHT


def test_expected_warnings_are_those_of_the_daemon() -> None:
    source = (Path(__file__).parents[2] / "server" / "world" / "findings.cpp").read_text()
    said = re.sub(r'"\s*\n\s*"', "", source)  # joins string literals of consecutive lines
    for named in (SOFTER, INVERTED, NOT_CONVERGED, CURVATURE, OUT_OF_RANGE):
        assert named in said


def test_a_reason_belongs_to_an_outcome() -> None:
    case = Case(Group("g", "G", "", ""), "n", "law", "shape", lambda engine: Found([]), short={CAUGHT: "so"})
    assert case.explains(CAUGHT, "float")
    assert not case.explains(SHORT, "float")
    assert not case.explains(BROKEN, "float")


def entry(key: str, outcome: str = HOLDS, share: float = 0.5) -> Entry:
    return Entry(report.Row(key, "float", Verdict(outcome, share, "said")), 1.5)


def test_a_journal_continues_after_a_stop(tmp_path: Path) -> None:
    path = tmp_path / "cpu.jsonl"
    head = dict.fromkeys(("backend", "device", "machine", "build", "cases"), "a")
    first = Journal(path, head)
    for one in (entry("a"), entry("b", SHORT, math.inf)):
        first.add(one)
    first.close()
    with path.open("a") as file:
        file.write('["c", "float", "hol')  # a process that was killed
    again = Journal(path, {**head, "commit": "of later"})
    assert list(again.entries.values()) == [entry("a"), entry("b", SHORT, math.inf)]
    assert "commit" not in again.head  # the rows belong to the first run
    again.add(entry("c"))
    again.close()
    assert len(journal.read(path)[1]) == 3
    longer = Journal(path, {**head, "long": True, "command": "c --long"})
    longer.close()
    assert longer.head["command"] == "c --long"
    assert len(longer.entries) == 3
    other = tmp_path / "other.jsonl"
    Journal(other, head).add(entry("b", HOLDS))
    _, rows = journal.merged([path, other])
    assert [rows[key, "float"].row.verdict.outcome for key in "abc"] == [HOLDS] * 3
    Journal(other, {**head, "build": "another"}).close()
    with pytest.raises(ValueError, match="build a and another"):
        journal.merged([path, other])
    assert Journal(path, {**head, "cases": "changed"}).entries == {}


def test_cases_run_in_parallel_until_the_limit(server: tm.Server) -> None:
    chosen = [case for case in all_cases() if case.key.startswith("input/pose")]
    wanted, entries = tasks_of(chosen), list[Entry]()
    run(wanted, backend="cpu", jobs=2, scenes=2, limit_s=600, take=entries.append, devices=("0", "1"))
    assert {(of.row.key, of.row.precision) for of in entries} == set(wanted)
    assert {of.row.verdict.outcome for of in entries} == {HOLDS}
    run(wanted, backend="cpu", jobs=1, scenes=1, limit_s=0, take=entries.append)
    assert len(entries) == len(wanted)


def test_broken_rows_run_again_alone(daemon: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The first two daemons end at once, so their rows break.
    stand_in = tmp_path / "tensormassd"
    stand_in.write_text(
        f'#!/bin/sh\ncd {tmp_path}\nmkdir a 2>/dev/null && exit 3\nmkdir b 2>/dev/null && exit 3\nexec {daemon} "$@"\n'
    )
    stand_in.chmod(0o755)
    monkeypatch.setenv("TENSORMASSD", str(stand_in))
    wanted, entries = tasks_of([case for case in all_cases() if case.key.startswith("input/pose")]), list[Entry]()
    run(wanted, backend="cpu", jobs=1, scenes=2, limit_s=600, take=entries.append)
    assert (tmp_path / "b").exists()
    assert sorted(of.row.task for of in entries) == sorted(wanted)
    assert {of.row.verdict.outcome for of in entries} == {HOLDS}


def test_a_device_failure_is_not_a_verdict_on_the_scene() -> None:
    def outcome(fault: Exception) -> str:
        def run(engine: Engine) -> Found:
            raise fault

        return judge(Case(Group("g", "G", "", ""), "n", "law", "shape", run), Engine(None, "float")).outcome  # type: ignore[arg-type]

    source = (Path(__file__).parents[2] / "server" / "world" / "loop.cpp").read_text()
    assert DEVICE_FAILED in source
    assert outcome(tm.FailedPreconditionError("scene 'a' is stopped: step 3 left its bounds")) == CAUGHT
    assert outcome(tm.FailedPreconditionError(f"scene 'a' is stopped: {DEVICE_FAILED} in step 3: it is hot")) == BROKEN
    assert outcome(tm.ResourceExhaustedError("CUDA: device memory")) == BROKEN


def test_rows_of_a_shared_run_stay_on_one_thread() -> None:
    cases = {case.key: case for case in all_cases()}
    bundles = bundles_of(tasks_of(list(cases.values())))
    assert sorted(task for bundle in bundles for task in bundle) == sorted(tasks_of(list(cases.values())))
    many = [bundle for bundle in bundles if len(bundle) > 1]
    assert {(cases[bundle[0][0]].together, bundle[0][1]) for bundle in many} == {
        *((f"rest, 10⁶ steps, {law}", precision) for law in LAWS for precision in ("double", "float")),
        ("hour, an hour", "float"),
    }
    for bundle in many:
        assert len({(cases[key].together, precision) for key, precision in bundle}) == 1
    assert all(not cases[key].together for bundle in bundles if len(bundle) == 1 for key, _ in bundle)


def test_a_shared_run_happens_once_even_if_it_raises(server: tm.Server) -> None:
    runs: list[str] = []

    def run_once(engine: Engine) -> str:
        runs.append(engine.precision)
        if engine.precision == "double":
            raise tm.FailedPreconditionError("it is stopped")
        return "found"

    shared = Shared(run_once)
    for _ in range(2):
        assert shared(Engine(server, "float")) == "found"
        with pytest.raises(tm.FailedPreconditionError, match="it is stopped"):
            shared(Engine(server, "double"))
    assert runs == ["float", "double"]


def test_broken_rows_of_a_journal_run_again() -> None:
    entries = {("a", "float"): entry("a"), ("b", "float"): entry("b", BROKEN)}
    assert journal.missing([("a", "float"), ("b", "float"), ("c", "float")], entries) == [
        ("b", "float"),
        ("c", "float"),
    ]


def test_jobs_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    (tmp_path / "alone.py").write_text(
        "import multiprocessing, sys, threading\n"
        "from stability import run\n"
        "def wait(told):\n"
        "    threading.Thread(target=run._end_with_parent, daemon=True).start()\n"
        "    told.send(multiprocessing.current_process().pid)\n"
        "    threading.Event().wait()\n"
        "if __name__ == '__main__':\n"
        "    here, there = multiprocessing.get_context('spawn').Pipe()\n"
        "    multiprocessing.get_context('spawn').Process(target=wait, args=(there,), daemon=True).start()\n"
        "    print(here.recv(), flush=True)\n"
        "    threading.Event().wait()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    parent = subprocess.Popen(
        [sys.executable, tmp_path / "alone.py"], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert parent.stdout is not None
    assert int(parent.stdout.readline()) > 0
    parent.kill()
    parent.communicate(timeout=30)  # returns when the job has ended and closed its end of the pipe


def test_results_are_read_back_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path)
    fault = "scene 'accuracy-7' is stopped: step 3 left its bounds: a node moved 2.5 m in it. 3 retries did not help"
    rows = [
        report.Row("group/1/60 s/hooke/wedge", "double", Verdict(HOLDS, 0.25)),
        report.Row("group/1/60 s/hooke/pyramid", "double", Verdict(SHORT, math.inf, "distance nan, bound 1")),
        report.Row("group/1/60 s/hooke/wedge", "float", Verdict(CAUGHT, math.nan, fault)),
        report.Row(
            "group/1/60 s/ogden/wedge", "float", Verdict(CAUGHT, 2, "a residual of 0.5; give it more (c 2, bound 1)")
        ),
    ]
    head = dict.fromkeys(("backend", "device", "machine", "commit", "command", "date"), "x")
    report.Run(**head, seconds=1, rows=rows).write()
    found = report.Run.read("x")
    assert found is not None
    by_key = {(row.key, row.precision): row.verdict for row in found.rows}
    assert by_key.keys() == {(row.key, row.precision) for row in rows}
    assert by_key[rows[0].key, "double"] == rows[0].verdict
    assert by_key[rows[1].key, "double"] == rows[1].verdict
    # The advice, which every fault repeats, is left out.
    assert by_key[rows[2].key, "float"].text == "step 3 left its bounds: a node moved 2.5 m in it"
    assert by_key[rows[3].key, "float"].text == "a residual of 0.5 (c 2, bound 1)"


def test_a_missing_reference_does_not_count_as_caught(server: tm.Server, monkeypatch: pytest.MonkeyPatch) -> None:
    (case,) = (case for case in all_cases() if case.key == "step/1 s/corotational/hexahedron")
    assert judge(case, Engine(server, "double")).outcome == HOLDS

    def none(*_: object) -> None:
        raise tm.FailedPreconditionError("it is stopped")

    monkeypatch.setattr(cases_steps, "equilibrium", none)
    assert judge(case, Engine(server, "double")).outcome == SHORT


def test_writing_results_again_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path)
    text = "scene 'x' is stopped: far off. Give it less (distance 0.3, bound 0.01)"
    row = report.Row("jump/a/law/shape", "float", Verdict(CAUGHT, 26.3, text))
    written = report.Run("cpu", "CPU", "m", "old", "command", "day", 1, [row]).write().read_text()
    assert "far off (distance 0.3, bound 0.01)" in written
    run = report.Run.read("cpu")
    assert run is not None
    assert run.write().read_text() == written


def test_a_run_keeps_the_rows_of_long_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path)
    long, short = entry("rest/long/law/shape").row, entry("motion/a/law/shape").row
    new = report.Run("cpu", "CPU", "m", "new", "command", "day", 1, [short])
    assert report.with_long_rows(new, {long.key}) == new, "there are no results yet"
    report.Run("cpu", "CPU", "m", "old", "command", "day", 1, [short, long]).write()
    kept = report.with_long_rows(new, {long.key})
    assert (kept.rows, kept.commit) == ([short, long], "new; long: old")
    kept.write()
    assert report.with_long_rows(new, {long.key}).commit == "new; long: old", "those rows have not run since"
    other = report.Run("cpu", "another CPU", "m", "new", "command", "day", 1, [short])
    assert report.with_long_rows(other, {long.key}) == other


def test_an_update_replaces_rows_and_notes_its_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path)
    head = {"backend": "cpu", "device": "CPU", "commit": "new"}
    with pytest.raises(ValueError, match="no results"):
        report.updated(head, "motion", [])
    rows = [entry("motion/a/law/shape").row, entry("step/a/law/shape").row]
    report.Run("cpu", "CPU", "m", "old", "command", "day", 1, rows).write()
    run = report.updated(head, "motion", [entry("motion/a/law/shape", SHORT).row])
    assert [(row.key, row.verdict.outcome) for row in run.rows] == [
        ("motion/a/law/shape", SHORT),
        ("step/a/law/shape", HOLDS),
    ]
    assert run.commit == "old; motion: new"
    run.write()
    assert report.updated({**head, "commit": "newer"}, "motion", []).commit == "old; motion: newer"
    with pytest.raises(ValueError, match="no results of GPU"):
        report.updated({**head, "device": "GPU"}, "motion", [])
