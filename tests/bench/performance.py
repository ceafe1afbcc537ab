"""Writes the tables of pages (TABLES) from the results, and every row as CSV.

    python tests/bench/performance.py

A table stands between `<!-- name: begin -->` and `<!-- name: end -->`, and only that part of a page is replaced. The
rows of all *.jsonl files go to results/steps.csv. test_performance.py fails if a page or the CSV differs from the
results.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import leading
import yaml

from tensormass_tools import fits

RESULTS = Path(__file__).parent / "results"
REPOSITORY = Path(__file__).parents[2]
Row = dict[str, Any]

# Floors of scenes that stay on the chip [ms]; docs/decisions/solver-speed.md counts them. Larger scenes have the floor
# of their row: the bytes of a step at the rate of a copy in the same run.
COUNTED_FLOORS_MS = {
    "beam 307200 StVK": 0.13,
    "beam 307200 Hooke": 0.11,
    "beam 43200 StVK": 0.05,
    "51200 hexahedra, corotational": 0.16,
    "51200 hexahedra, StVK": 0.15,
}
# Commits whose runs left most iterations of a fused solve out of `floor_ms`. The floor of the run before stands.
WRONG_FLOORS = {"77eda44", "308c9db"}
# Targets that no row of the results has.
ITERATION_FLOOR_US, ITERATION_TARGET_US = 2.0, 2.8
BYTES_TARGET = 250
SCENES_TARGET, KEPT_TARGET = 192, 0.999
KEPT_SHOWN = 0.998  # the table shows the most scenes that keep this share of their deadlines in every run
FIRST_LOOK = "two-cores-first-look.jsonl"
LOAD_TARGETS_S = {"cuda": 5, "cpu": 10}
CSV_COLUMNS = (
    "case",
    "backend",
    "device",
    "commit",
    "elements",
    "scenes",
    "step_ms_median",
    "step_ms_p99",
    "cg_iteration_us",
    "floor_ms",
    "bytes_per_element",
    "target_ms",
    "target_met",
    "steps",
    "missed_deadlines",
    "stepping_s",
    "command",
)


def rows(name: str) -> list[Row]:
    return [json.loads(line) for line in (RESULTS / name).read_text().splitlines() if line]


def newest(name: str) -> dict[str, Row]:
    """The last row of each case in a file to which runs are appended, with the last floor that is right."""
    found: dict[str, Row] = {}
    for row in rows(name):
        case = row["case"]
        if row["commit"] in WRONG_FLOORS and case in found:
            row["floor_ms"] = found[case]["floor_ms"]
        found[case] = row
    return found


def _thousands(case: str) -> str:
    return re.sub(r"\d{5,}", lambda number: f"{int(number[0]):,}", case).replace("StVK", "tetrahedra, StVK", 1)


def _case_words(case: str) -> str:
    words = _thousands(case).replace("beam ", "").replace(" Hooke", " tetrahedra, Hooke")
    return words.replace("hexahedra, tetrahedra, StVK", "hexahedra, StVK")


def _verdict(met: bool) -> str:
    return "**met**" if met else "missed"


def _target_row(row: Row) -> str:
    case, target = row["case"], row["target_ms"]
    floor = COUNTED_FLOORS_MS.get(case)
    if floor is None and row["cg_iterations"] >= 30:  # a solve to a tolerance has no fixed number of bytes
        floor = row["floor_ms"]
    iteration = f"{row['cg_iteration_us']:.3g} µs" if row["cg_iteration_us"] else ""
    step = f"{row['step_ms_median']:.3g} ({row['step_ms_p99']:.3g}) ms"
    if row["step_ms_median"] > 10:
        step = f"{row['step_ms_median']:.2f} ({row['step_ms_p99']:.2f}) ms"
    kind = "p99 " if case.startswith("beam 1019520") else ""
    ends = " | |" if row["target_met"] is None else f" {kind}{target:.4g} ms | {_verdict(row['target_met'])} |"
    return f"| {_case_words(case)} | {step} | {iteration} | {f'{floor:.3g} ms' if floor else ''} |{ends}"


def kept_shares(row: Row) -> float:
    """Share of the deadlines that concurrent scenes kept."""
    return 1 - row["missed_deadlines"] / row["steps"]


def concurrent() -> dict[int, list[float]]:
    """By number of concurrent scenes, the kept shares of the runs that count deadlines missed while loading apart."""
    found: dict[int, list[float]] = {}
    for row in rows("nvidia-h200-stations.jsonl"):
        if "missed_while_loading" in row and len(row.get("scenes_of_device", [1])) == 1:
            found.setdefault(row["scenes"], []).append(kept_shares(row))
    return found


def _percent(shares: list[float]) -> str:
    low, high = (f"{100 * share:.{3 if share > 0.9999 else 2}f}" for share in (min(shares), max(shares)))
    return f"{low} to {high} %" if low != high else f"{low} %"


def _most_concurrent() -> tuple[int, list[float]]:
    """The most concurrent scenes that kept KEPT_SHOWN of their deadlines in every run, and the shares they kept."""
    shares = concurrent()
    most = max(count for count, kept in shares.items() if min(kept) >= KEPT_SHOWN)
    return most, shares[most]


def _load_s(name: str) -> tuple[float, float]:
    """Fastest and slowest load of the last commit in a file [s]."""
    found = rows(name)
    times = [row["stepping_s"] for row in found if row["commit"] == found[-1]["commit"]]
    return min(times), max(times)


def targets() -> Iterator[str]:
    """The H200's targets: result, floor and target of each case."""
    gpu, largest = newest("nvidia-h200-targets.jsonl"), newest("nvidia-h200-largest.jsonl")
    yield "| case | step: median (p99) | CG iteration | floor | target | |"
    yield "|---|---|---|---|---|---|"
    yield from map(_target_row, gpu.values())
    yield _target_row(max(largest.values(), key=lambda row: row["elements"]))
    beam = gpu["beam 307200 StVK"]
    iteration, size = beam["cg_iteration_us"], beam["bytes_per_element"]
    yield (
        f"| CG iteration of 307,200 tetrahedra | | {iteration:.3g} µs | {ITERATION_FLOOR_US:g} µs "
        f"| {ITERATION_TARGET_US:g} µs | {_verdict(iteration <= ITERATION_TARGET_US)} |"
    )
    yield (
        f"| device memory of a tetrahedron, 307,200 StVK | {size:.1f} bytes | | | {BYTES_TARGET} bytes "
        f"| {_verdict(size <= BYTES_TARGET)} |"
    )
    most, shares = _most_concurrent()
    met = any(count >= SCENES_TARGET and min(kept) >= KEPT_TARGET for count, kept in concurrent().items())
    yield (
        f"| concurrent scenes of 20,520 tetrahedra at 1 kHz | {most} keep {_percent(shares)} of their deadlines "
        f"| | | {SCENES_TARGET} at {100 * KEPT_TARGET:g} % | {_verdict(met)} |"
    )
    for backend, name, where in (
        ("cuda", "nvidia-h200-load.jsonl", "H200"),
        ("cpu", "two-cores-load.jsonl", "two cores"),
    ):
        low, high = _load_s(name)
        target = LOAD_TARGETS_S[backend]
        yield (
            f"| load of 1,019,520 tetrahedra to the first step, {where} | {low:.1f} to {high:.1f} s | | | {target} s "
            f"| {_verdict(high <= target)} |"
        )


def organs() -> Iterator[str]:
    """Meshes of organs beside the beam."""
    names = {
        "beam 307200 StVK float": "beam, for comparison",
        "liver285": "the demo's liver, cut finer: a lattice inside",
        "liver-wild": "a scanned liver without a lattice",
        "liver_wild20": "the same, coarse",
    }
    found = newest("nvidia-h200.jsonl") | newest("nvidia-h200-organs.jsonl")
    yield "| mesh | tetrahedra | step: median (p99) | CG iteration | bytes a tetrahedron |"
    yield "|---|---|---|---|---|"
    for case, name in names.items():
        row = found[case]
        yield (
            f"| {name} | {row['elements']:,} | {row['step_ms_median']:.3f} ({row['step_ms_p99']:.3f}) ms "
            f"| {row['cg_iteration_us']:.2f} µs | {row['bytes_per_element']:.1f} |"
        )


def processors() -> Iterator[str]:
    """The same beam on CPUs."""
    yield "| 307,200 tetrahedra, StVK, 50 iterations | step: median (p99) | floor |"
    yield "|---|---|---|"
    for name, case in (
        ("two-cores-beams.jsonl", "beam 307200 StVK float"),
        ("xeon-16-threads-sizes.jsonl", "size 307200 StVK"),
    ):
        row = newest(name)[case]
        step = f"{row['step_ms_median']:.1f} ({row['step_ms_p99']:.1f}) ms"
        yield f"| {row['device']} | {step} | {row['floor_ms']:.1f} ms |"


def instruments() -> Iterator[str]:
    """Scenes with a scripted hand, with their tools and without."""
    yield "| scene, device | tetrahedra | period | step: median (p99) | without |"
    yield "|---|---|---|---|---|"
    found = {(row["case"], row["device"]): row for row in rows("instruments.jsonl")}
    for (case, device), row in sorted(found.items()):
        times = (f"{row[f'{of}_ms_median']:.3g} ({row[f'{of}_ms_p99']:.3g}) ms" for of in ("step", "alone"))
        yield (
            f"| {case.removeprefix('instrument: ')}, {device} | {row['elements']:,} | {row['dt_ms']:.3g} ms "
            f"| {' | '.join(times)} |"
        )
    if earlier := {row["commit"] for row in found.values() if "step_ms_p999" not in row}:
        yield ""
        yield (
            f"At {', '.join(f'`{commit}`' for commit in sorted(earlier))} steps with the tool were made one a call, "
            "and those without it many a call. The former hold a check of the elements and a frame each, 13 to 19 % "
            "of a step."
        )


def contacts() -> Iterator[str]:
    """One scene with every kind of contact, and without one kind after the other."""
    devices = sorted({row["device"] for row in rows("contacts.jsonl")}, reverse=True)
    yield "| `demo-abdomen` |" + "".join(f" {device}: median step (p99) |" for device in devices)
    yield f"|---|{'---|' * len(devices)}"
    cells: dict[str, dict[str, str]] = {}
    for row in rows("contacts.jsonl"):
        times = f"{row['step_ms_median']:.3g} ({row['step_ms_p99']:.3g}) ms"
        case = row["case"].removeprefix("contact: ").replace("ties", "links")  # ties: their name in older rows
        cells.setdefault(case, {})[row["device"]] = times
    for case, of_device in cells.items():
        yield f"| {case} | {' | '.join(of_device.get(device, '') for device in devices)} |"


def bodies() -> Iterator[str]:
    """Time, error and iterations of boxes that fall, by mesh: the newest rows of each device."""
    by_setting = {(row["device"], case, row["setting"]): row for row in rows("bodies.jsonl") for case in (row["case"],)}
    yield "| body, tetrahedra, device | default | two linearizations | iterations to 1 %: without coarse level | with |"
    yield "|---|---|---|---|---|"
    for device, case in dict.fromkeys((device, case) for device, case, _ in by_setting):
        of = {setting: row for (its, same, setting), row in by_setting.items() if (its, same) == (device, case)}
        measured = [
            f"{of[name]['step_ms_median']:.3g} ms, {of[name]['error_percent']:.2g} %" for name in ("default", "newton")
        ]
        counts = [
            str(of[name]["iterations_to_1_percent"] or f"more than {of[name]['cg_iterations_last'] // 2}")
            for name in ("plain", "coarse")
        ]
        yield f"| {_thousands(case.removeprefix('body: '))}, {device} | {' | '.join([*measured, *counts])} |"


def lag() -> Iterator[str]:
    """What lagged tangents save and change, by their length: the newest rows of each device."""
    shown = (1, 8, 16)
    newest = {(row["scene"], row["device"], row["lag"]): row for row in rows("lag.jsonl") if row["lag"] in shown}
    yield "| scene, device | lag | step: median (p99) | CG iterations | force changed | displacement changed |"
    yield "|---|---|---|---|---|---|"
    for (scene, device, steps), row in newest.items():
        times = f"{row['step_ms_median']:.3g} ({row['step_ms_p99']:.3g}) ms"
        changed = [f"{row[f'{what}_percent']:.2g} %" if steps > 1 else "" for what in ("force", "displacement")]
        yield f"| `{scene}`, {device} | {steps} | {times} | {row['cg_iterations']:g} | {' | '.join(changed)} |"


def changes() -> Iterator[str]:
    """What a change of a scene costs it while it steps in real time, and how long the change takes."""
    yield "| in real time | deadlines missed | from the call to the answer: median (p99) |"
    yield "|---|---|---|"
    found = {row["device"]: row for row in rows("editing.jsonl") if row["case"] == "editing: retract in real time"}
    for device, row in found.items():
        for kind, words in (
            ("plain", "`retract`, no change"),
            ("stiffness", "`retract`, ten changes of stiffness a second"),
            ("ablation", "`retract`, ten ablations a second"),
        ):
            missed = f"{row[f'{kind}_missed_deadlines']:,} of {row[f'{kind}_steps']:,}"
            took = (
                f"{row[f'{kind}_call_ms_median']:.3g} ({row[f'{kind}_call_ms_p99']:.3g}) ms" if kind != "plain" else ""
            )
            yield f"| {row['elements']:,} tetrahedra, {device}: {words} | {missed} | {took} |"
    for row in {
        row["device"]: row for row in rows("editing.jsonl") if row["case"] == "editing: cut in real time"
    }.values():
        for kind, words in (("air", "`cut`, its scalpel in the air"), ("tissue", "`cut`, its scalpel in tissue")):
            missed = f"{row[f'{kind}_missed_deadlines']:,} of {row[f'{kind}_steps']:,}"
            yield f"| {row['elements']:,} tetrahedra, {row['device']}: {words} | {missed} | |"


def streams() -> Iterator[str]:
    """What a frame costs the gateway and a viewer in Python, by codec."""
    found = newest("streams.jsonl")
    yield "| scene, codec | bytes a frame | at 60 Hz | encode | decode in Python | largest error (stated) | keyframes |"
    yield "|---|---|---|---|---|---|---|"
    for case, row in found.items():
        if case.startswith("stream: "):
            yield (
                f"| {_thousands(case.removeprefix('stream: '))} | {row['bytes_per_frame']:,} "
                f"| {row['bytes_per_s'] / 1e6:.1f} MB/s | {row['encode_ms_median']:.2f} ms "
                f"| {row['decode_ms_median']:.2f} ms | {row['error_um']:.2g} ({row['stated_error_um']:.2g}) µm "
                f"| {row['keyframes']} of {row['frames']} |"
            )


def details() -> Iterator[str]:
    """What less detail saves, and how far the whole surface is from the simplified one."""
    found = newest("streams.jsonl")
    if not any(case.startswith("detail: ") for case in found):
        yield "Not measured yet: `python tests/bench/streams.py` on a machine with nothing else to do."
        return
    yield "| scene, detail | triangles | vertices | bytes a frame | encode | surface error | simplified in |"
    yield "|---|---|---|---|---|---|---|"
    for case, row in found.items():
        if case.startswith("detail: "):
            yield (
                f"| {_thousands(case.removeprefix('detail: '))} | {row['triangles']:,} | {row['vertices']:,} "
                f"| {row['bytes_per_frame']:,} | {row['encode_ms_median']:.2f} ms "
                f"| {row['surface_error_um']:.0f} µm | {row['simplify_ms'] / 1e3:.1f} s |"
            )


def browser() -> Iterator[str]:
    """What a frame costs the viewer in a browser that draws in software, by codec."""
    found = newest("streams.jsonl")
    if not any(case.startswith("browser: ") for case in found):
        yield "Not measured yet: `python tests/bench/streams.py --browser` on a machine with nothing else to do."
        return
    yield "| vertices, codec | decode: least | median | prepare: least | median | upload | WebGL calls | whole frame |"
    yield "|---|---|---|---|---|---|---|---|"
    parts: tuple[str, ...] = ("decode_ms_least", "decode_ms_median", "prepare_ms_least", "prepare_ms_median")
    parts += ("upload_ms_median", "render_ms_median", "frame_ms_median")
    for case, row in found.items():
        if case.startswith("browser: "):
            times = (f"{row[part]:.1f} ms" for part in parts)
            yield f"| {_thousands(case.removeprefix('browser: '))} | {' | '.join(times)} |"


def browser_rate() -> Iterator[str]:
    """How often a browser with a GPU draws a large surface, by codec and detail."""
    yield "| vertices, codec | pictures a second | between two: median (p99) | decode | prepare | WebGL calls |"
    yield "|---|---|---|---|---|---|"
    for case, row in newest("browser-rate.jsonl").items():
        parts = (f"{row[f'{part}_ms_median']:.1f} ms" for part in ("decode", "prepare", "render"))
        yield (
            f"| {_thousands(case.removeprefix('browser rate: '))} | {row['drawn_hz']} "
            f"| {row['frame_ms_median']:.1f} ({row['frame_ms_p99']:.1f}) ms | {' | '.join(parts)} |"
        )


def first_look() -> Iterator[str]:
    """Deadlines missed by `tensormass run` on two cores, with and without a page."""
    if not (RESULTS / FIRST_LOOK).exists():
        yield "Not measured yet: `python tests/bench/first_look.py` on two cores with nothing else to do."
        return
    found = newest(FIRST_LOOK)
    yield "| `tensormass run demo` | deadlines missed | target | step: p50 / p99 | pictures a second |"
    yield "|---|---|---|---|---|"
    for case, row in found.items():
        missed = f"{row['missed_deadlines']:,} of {row['steps']:,}: {_missed_percent(row)}"
        target = f"{100 * row['target_missed']:g} %, {_verdict(row['target_met'])}" if "target_met" in row else ""
        yield (
            f"| {case.removeprefix('first look: ')} | {missed} | {target} "
            f"| {row['step_ms_median']:.1f} / {row['step_ms_p99']:.1f} ms | {row.get('drawn_hz', '')} |"
        )
    row = next(iter(found.values()))
    yield ""
    yield f"{row['device']}, commit `{row['commit']}`: `{row['command']}`."


def _missed_percent(row: Row) -> str:
    return f"{100 * row['missed_deadlines'] / row['steps']:.2f} %"


def meshes() -> Iterator[str]:
    """Meshes among which `tensormass run` chooses."""
    yield "| on | edits of the scene file | 99th percentile of a step, relative | error of the force |"
    yield "|---|---|---|---|"
    for backend, rungs in yaml.safe_load(fits.FILE.read_text("utf-8")).items():
        for rung in rungs:
            setting = ", ".join(f"`{name}` {value:.4g}" for name, value in rung["setting"].items()) or "none"
            yield f"| {backend} | {setting} | {rung['cost']:.3g} | {100 * rung['error']:.2g} % |"


def stream_sources() -> Iterator[str]:
    """Device, commit and command of each file's last row."""
    yield "| file | device | commit | command |"
    yield "|---|---|---|---|"
    for name in ("streams", "browser-rate"):
        row = rows(f"{name}.jsonl")[-1]
        link = f"[`{name}.jsonl`](../../tests/bench/results/{name}.jsonl)"
        yield f"| {link} | {row['device']} | `{row['commit']}` | `{row['command']}` |"


def engines() -> Iterator[str]:
    """One beam in several engines: step time and error of each setting, by the size of the mesh."""
    found = newest("two-cores-others.jsonl").values()
    sizes = sorted({row["elements"] for row in found})
    yield "| engine, setting |" + "".join(f" {size:,} tetrahedra: median step | error |" for size in sizes)
    yield f"|---|{'---|---|' * len(sizes)}"
    cells: dict[tuple[str, str], dict[int, str]] = {}
    for row in found:
        measured = f"{row['step_ms_median']:.3g} ms | {row['error_percent']:.2g} %"
        setting = re.sub(r"one linear solve, |at most | iterations to .*(?<=1e-08)", "", row["setting"])
        cells.setdefault((row["engine"], setting), {})[row["elements"]] = measured
    package = {"MuJoCo": "mujoco", "Newton": "newton"}
    versions = next(iter(found))["versions"]
    for (engine, setting), of_size in sorted(cells.items(), key=lambda cell: (cell[0][0] != "Tensormass", cell[0][0])):
        name = f"{engine} {versions[package[engine]]}" if engine in package else engine
        yield f"| {name}: {setting} | {' | '.join(of_size.get(size, ' | ') for size in sizes)} |"


def beside_sofa() -> Iterator[str]:
    """Step times of beams in SOFA and here on one GPU, by law and size."""
    found = rows("nvidia-h200-sofa.jsonl")
    sizes = sorted({row["elements"] for row in found})
    yield "| engine, law |" + "".join(f" {size:,} tetrahedra |" for size in sizes)
    yield f"|---|{'---|' * len(sizes)}"
    for engine, law in dict.fromkeys((row["engine"], row["setting"]) for row in found):
        times = {
            row["elements"]: row["step_ms_median"] for row in found if (row["engine"], row["setting"]) == (engine, law)
        }
        yield f"| {engine}: {law} |" + "".join(f" {times[size]:g} ms |" for size in sizes)


def sources() -> Iterator[str]:
    """Device, commit and command of the last row in each file that the page uses."""
    yield "| file | device | commit | command |"
    yield "|---|---|---|---|"
    for name in (
        "nvidia-h200-targets.jsonl",
        "nvidia-h200-largest.jsonl",
        "nvidia-h200-stations.jsonl",
        "nvidia-h200-organs.jsonl",
        "nvidia-h200-load.jsonl",
        "two-cores-load.jsonl",
        "two-cores-beams.jsonl",
        "xeon-16-threads-sizes.jsonl",
    ):
        row = rows(name)[-1]
        command = re.sub(r" --commit \w+", "", row["command"])
        yield f"| [`{name}`](../tests/bench/results/{name}) | {row['device']} | `{row['commit']}` | `{command}` |"


def summary() -> Iterator[str]:
    """The rows of README.md: whole runs first, then the kernel's benchmark. Each figure names its field."""

    def beam(name: str, row: Row, digits: int) -> str:
        of = leading.Figures(leading.README, RESULTS / name, row, "case")
        median, p99 = (of.of(field, f"{row[field]:.{digits}f} ms") for field in ("step_ms_median", "step_ms_p99"))
        what = f"beam of {of.count('elements')} tetrahedra, {of.count('cg_iterations')} CG iterations"
        return f"| {what} | H200 | step {median} (p99 {p99}) |"

    yield "| what | where | result |"
    yield "|---|---|---|"
    yield from leading.readme_rows(RESULTS)
    if not leading.most_scenes(RESULTS):
        yield _stations()
    yield beam("nvidia-h200-targets.jsonl", newest("nvidia-h200-targets.jsonl")["beam 307200 StVK"], 3)
    largest = max(newest("nvidia-h200-largest.jsonl").values(), key=lambda row: row["elements"])
    yield beam("nvidia-h200-largest.jsonl", largest, 1)
    if not any(row["backend"] == "cpu" for row in leading.long_runs(RESULTS, 1)):
        yield _two_cores()


def _stations() -> str:
    """Concurrent scenes under a probe, until such scenes under haptic clients were measured."""
    stations = "nvidia-h200-stations.jsonl"
    most, _ = _most_concurrent()
    runs = [row for row in rows(stations) if row["scenes"] == most and "missed_while_loading" in row]
    of = leading.Figures(leading.README, RESULTS / stations, min(runs, key=kept_shares), "scenes", "commit")
    missed = 1 - kept_shares(min(runs, key=kept_shares))
    return (
        f"| scenes of {of.count('elements')} tetrahedra at once, 1000 steps a second each | H200 "
        f"| {of.count('scenes')} miss at most {of.of('missed_deadlines / steps', f'{100 * missed:.2f} %')} of their "
        "deadlines |"
    )


def _two_cores() -> str:
    """A load test of 20 s, until a longer run was measured."""
    load = json.loads((RESULTS / "two-cores-load-test.json").read_text())
    of = leading.Figures(leading.README, RESULTS / "two-cores-load-test.json", load)
    force = [of.of(f"pose_to_force.{at}", f"{1e3 * load['pose_to_force'][at]:.0f} ms") for at in ("p50_s", "p99_s")]
    return (
        "| 2 demo scenes at 60 Hz, 2 haptic clients, 4 viewers | two cores "
        f"| pose to force {force[0]} (p99 {force[1]}) |"
    )


def table() -> str:
    """results/steps.csv: every row of the *.jsonl files, without what is a list."""
    text = io.StringIO()
    out = csv.DictWriter(text, ("file", *CSV_COLUMNS), extrasaction="ignore", lineterminator="\n")
    out.writeheader()
    for path in sorted(RESULTS.glob("*.jsonl")):
        for row in rows(path.name):
            out.writerow({"file": path.name, **{name: of for name, of in row.items() if not isinstance(of, list)}})
    return text.getvalue()


TABLES = {
    REPOSITORY / "docs" / "performance.md": {
        "roam": leading.roam_table,
        "runs": lambda: leading.runs_table(RESULTS),
        "targets": targets,
        "sources": sources,
    },
    REPOSITORY / "docs" / "decisions" / "step-times.md": {
        "organs": organs,
        "processors": processors,
        "instruments": instruments,
        "bodies": bodies,
        "changes": changes,
    },
    REPOSITORY / "docs" / "comparison.md": {"engines": engines, "sofa": beside_sofa},
    REPOSITORY / "docs" / "decisions" / "contact-cost.md": {"contacts": contacts},
    REPOSITORY / "docs" / "decisions" / "lagged-tangents.md": {"lag": lag},
    REPOSITORY / "docs" / "decisions" / "stream-codecs.md": {
        "streams": streams,
        "browser": browser,
        "browser-rate": browser_rate,
        "sources": stream_sources,
    },
    REPOSITORY / "docs" / "decisions" / "first-look.md": {"first-look": first_look, "meshes": meshes},
    REPOSITORY / "docs" / "decisions" / "stream-detail.md": {"details": details},
    REPOSITORY / "README.md": {"summary": summary},
}


def filled(text: str, parts: Mapping[str, str]) -> str:
    """Replaces what stands between the marks of each part.

    Raises:
        ValueError: the text lacks the marks of a part.
    """
    for name, part in parts.items():
        begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise ValueError(f"'{begin.strip()}' and '{end}' must stand once each")
        head, rest = text.split(begin)
        text = f"{head}{begin}\n{part}\n\n{end}{rest.split(end)[1]}"
    return text


def files() -> dict[Path, str]:
    """Everything that is made of the results, by where it lies."""
    pages = {
        path: filled(path.read_text(), {name: "\n".join(made()) for name, made in parts.items()})
        for path, parts in TABLES.items()
    }
    return {**pages, RESULTS / "steps.csv": table()}


def main() -> None:
    for path, text in files().items():
        path.write_text(text)
        print(f"wrote {path.relative_to(REPOSITORY)}")


if __name__ == "__main__":
    main()
