"""The map of the haptic client's stability: runs it, writes results/, and makes picture and tables of docs/haptics.md.

python tests/haptic/stability_map.py [--draw-only]

Needs `make build` and matplotlib (`pip install "tensormass[plot]"`). closed_loop.h says what a case is.
results/stability-map.csv has a row for each case: the motion in each chain (r, s, g) and numbers of the full client.
results/stability-map.json has the command, the commit and totals for each chain.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import json
import subprocess
import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parent / "results"
PAGE = ROOT / "docs" / "haptics.md"
PICTURE = ROOT / "docs" / "images" / "haptic-stability.png"
PROGRAM = ROOT / "build" / "bin" / "tensormass-haptic-stability-map"

MOTIONS = ("rests", "shakes", "grows")
COLORS = ("#cfe3f2", "#f2b134", "#a50f15")
CHAINS = {
    "transmitted": "force from the network",
    "transmitted with controller": "the same, with passivity controller",
    "no controller": "local model, no passivity controller",
    "no secant": "local model and controller, no secant stiffness",
    "full": "the client",
}
CASE = ("tissue", "stiffness_n_per_m", "server_rate_hz", "delay_ms", "jitter_ms", "loss", "hand")
HELD = ("soft", "stiff")
_CELL_WIDTH, _CELL_HEIGHT = 0.92, 0.88
Row = Mapping[str, Any]


def cases(lines: Iterable[str]) -> list[dict[str, Any]]:
    """Joins the program's lines, one for each chain, into a row for each case."""
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for line in lines:
        found = json.loads(line)
        row = rows.setdefault(tuple(found[name] for name in CASE), {name: found[name] for name in CASE})
        row[found["chain"]] = found["motion"][0]
        if found["chain"] == "full":
            first, _, last = found["kinetic_energy_j"]
            row |= {
                "first_uj": _short(1e6 * first),
                "last_uj": _short(1e6 * last),
                "amplitude_mm": _short(1e3 * found["amplitude_m"]),
                "generated_mj": _short(1e3 * found["generated_energy_j"]),
                "min_observer_mj": _short(1e3 * found["min_observer_energy_j"]),
                "max_force_n": found["max_force_n"],
            }
    return list(rows.values())


def totals(lines: Iterable[str]) -> list[dict[str, Any]]:
    """Counts the motions of each chain and loss, with the 90th percentile and the maximum of the energies."""
    found: dict[tuple[str, float], list[Row]] = {}
    for line in lines:
        row = json.loads(line)
        found.setdefault((row["chain"], row["loss"]), []).append(row)
    out = []
    for (chain, loss), rows in found.items():
        count = Counter(row["motion"] for row in rows)
        last = sorted(row["kinetic_energy_j"][2] for row in rows)
        generated = sorted(row["generated_energy_j"] for row in rows)
        out.append(
            {"chain": chain, "loss": loss, "cases": len(rows)}
            | {motion: count[motion] for motion in MOTIONS}
            | {"last_kinetic_energy_j": [last[9 * len(last) // 10], last[-1]]}
            | {"generated_energy_j": [generated[9 * len(generated) // 10], generated[-1]]}
        )
    return out


def run(program: Path) -> None:
    """Runs the map and writes its results."""
    began = time.monotonic()
    lines = subprocess.run([program], check=True, capture_output=True, text=True).stdout.splitlines()
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    head = {
        "command": "python tests/haptic/stability_map.py",
        "commit": commit,
        "date": time.strftime("%Y-%m-%d"),
        "seconds": round(time.monotonic() - began),
        "kinetic_and_generated_energy": "[90th percentile, maximum] over the cases",
    }
    RESULTS.mkdir(exist_ok=True)
    rows = ",\n".join(f"    {json.dumps(row)}" for row in totals(lines))
    start = json.dumps(head, indent=2).rstrip("}\n")
    (RESULTS / "stability-map.json").write_text(f'{start},\n  "chains": [\n{rows}\n  ]\n}}\n')
    table = cases(lines)
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    (RESULTS / "stability-map.csv").write_text(text.getvalue())


def read() -> list[dict[str, Any]]:
    """Returns the committed rows, with numbers as numbers."""
    with (RESULTS / "stability-map.csv").open() as file:
        return [{name: _number(value) for name, value in row.items()} for row in csv.DictReader(file)]


def chain_table() -> str:
    """Motions and energies of each chain, as a table of Markdown."""
    chains = json.loads((RESULTS / "stability-map.json").read_text())["chains"]
    out = [
        "| in use | rests | shakes | grows | largest kinetic energy left | rests/shakes/grows without loss |",
        "|---|---|---|---|---|---|",
    ]
    for chain, words in CHAINS.items():
        rows = [row for row in chains if row["chain"] == chain]
        (lossless,) = (row for row in rows if row["loss"] == 0)
        counts = " | ".join(f"{sum(row[motion] for row in rows)}" for motion in MOTIONS)
        largest = max(row["last_kinetic_energy_j"][1] for row in rows)
        without = "/".join(f"{lossless[motion]}" for motion in MOTIONS)
        out.append(f"| {words} | {counts} | {1e3 * largest:.3g} mJ | {without} |")
    return "\n".join(out)


def delay_table(rows: Sequence[Row]) -> str:
    """Results of the full client with a held device and no loss at each delay, as a table of Markdown."""
    held = [row for row in rows if row["loss"] == 0 and row["hand"] in HELD]
    out = [
        "| delay one way | at rest, 60 Hz | at rest, 1 kHz | largest amplitude | energy of contact, 60 Hz | 1 kHz |",
        "|---|---|---|---|---|---|",
    ]
    for delay in sorted({row["delay_ms"] for row in held}):
        at = [row for row in held if row["delay_ms"] == delay]
        parts = [[row for row in at if row["server_rate_hz"] == rate] for rate in (60, 1000)]
        rest = [f"{sum(row['full'] == 'r' for row in part)} of {len(part)}" for part in parts]
        kick = [f"{max(row['generated_mj'] for row in part):.1f} mJ" for part in parts]
        amplitude = max(row["amplitude_mm"] for row in at)
        out.append(f"| {delay:g} ms | {rest[0]} | {rest[1]} | {amplitude:.2f} mm | {kick[0]} | {kick[1]} |")
    return "\n".join(out)


def page() -> str:
    """docs/haptics.md with its tables made again."""
    text = PAGE.read_text()
    for name, table in {"chains": chain_table(), "delays": delay_table(read())}.items():
        head, _, rest = text.partition(f"<!-- {name}: begin -->\n")
        _, end, tail = rest.partition(f"<!-- {name}: end -->")
        if not end:
            raise ValueError(f"{PAGE.name} lacks the marks of {name}")
        text = f"{head}<!-- {name}: begin -->\n\n{table}\n\n{end}{tail}"
    return text


def draw(rows: Sequence[Row]) -> None:
    """Draws stiffness against delay for each chain and rate. A cell's areas are the shares of its cases."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    stiffnesses = sorted({row["stiffness_n_per_m"] for row in rows})
    delays = sorted({row["delay_ms"] for row in rows})
    lines = list(itertools.product((60, 1000), (False, True)))
    figure, axes = plt.subplots(len(lines), len(CHAINS), figsize=(13, 9.4), sharex=True, sharey=True)
    for number, (rate, loses) in enumerate(lines):
        of_line = [row for row in rows if row["server_rate_hz"] == rate and (row["loss"] > 0) == loses]
        for axis, (chain, words) in zip(axes[number], CHAINS.items(), strict=True):
            for (at, delay), (up, stiffness) in itertools.product(enumerate(delays), enumerate(stiffnesses)):
                cell = [r for r in of_line if (r["delay_ms"], r["stiffness_n_per_m"]) == (delay, stiffness)]
                left = at - _CELL_WIDTH / 2
                for motion, color in zip(MOTIONS, COLORS, strict=True):
                    width = _CELL_WIDTH * sum(row[chain] == motion[0] for row in cell) / len(cell)
                    axis.barh(up, width, _CELL_HEIGHT, left, color=color, linewidth=0)
                    left += width
            if number == 0:
                axis.set_title("\n".join(textwrap.wrap(words, 26)), fontsize=10)
            axis.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays], fontsize=8)
            axis.set_yticks(range(len(stiffnesses)), [f"{stiffness:g}" for stiffness in stiffnesses], fontsize=8)
            axis.tick_params(length=0)
            axis.set_frame_on(False)
        loss = "10 or 50 % loss" if loses else "no loss"
        axes[number][0].set_ylabel(f"{rate} Hz, {loss}\nstiffness [N/m]", fontsize=9)
    figure.supxlabel("delay one way [ms]", fontsize=9)
    handles = [Patch(color=color, label=motion) for motion, color in zip(MOTIONS, COLORS, strict=True)]
    figure.legend(handles=handles, ncols=3, frameon=False, loc="lower right", fontsize=9)
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=100, metadata={"Software": ""})


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--program", type=Path, default=PROGRAM, help=f"default: build/bin/{PROGRAM.name}")
    parser.add_argument("--draw-only", action="store_true", help="keep the results, draw them again")
    options = parser.parse_args()
    if not options.draw_only:
        run(options.program)
    draw(read())
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
