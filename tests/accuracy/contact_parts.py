"""What the error of a sphere's force is made of: results/contact-parts.json, docs/decisions/contact.md.

python -m accuracy.contact_parts [--only GROUP]     one group leaves the rows of the others as they are

*kinds*: the deep press in every kind of element, with the default penalty and ten times it. *refined*: the same by
mesh, with contact that hardly gives way. *sampling*: one mesh of hexahedra with ever stiffer contact, against the
same mesh and quadrature with multipliers at its nodes. What is left is how the server samples contact. *hertz*:
Hertz's sphere, by mesh. *stiffness*: the same on one mesh, by penalty.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tensormass._shared.enums import short_name
from tensormass._src.launching import launch
from tensormass.v1 import scene_pb2

from . import contact_reference, record, references
from .engine import Engine
from .laws import stable_neo_hookean
from .sphere_contact import DEEP, FULL, HERTZ, SELECTIVE, press_block, press_half_ball
from .tables import markdown

FILE = record.HERE / "results" / "contact-parts.json"
PAGE = Path(__file__).parents[2] / "docs" / "decisions" / "contact.md"
#: Cells a side of the mesh that both solvers take; even, because the other has a quarter of it.
COMMON_CELLS = 14
#: Times the default.
PENALTIES = (1.0, 10.0, 100.0)
KINDS = (
    ("tetrahedron", FULL),
    ("tetrahedron", SELECTIVE),
    ("hexahedron", FULL),
    ("hexahedron", SELECTIVE),
    ("quadratic_tetrahedron", FULL),
)
#: Cells a side of the block.
CELLS = (9, 13)
#: Cells a side of the block as it is refined, in selective hexahedra, which do not lock.
REFINED_CELLS = (13, 19, 27, 35)
#: By shape: cells along half the width of the fine block in the half ball.
HERTZ_SERIES = {"quadratic_tetrahedron": (1, 2, 4), "hexahedron": (2, 4, 8)}
STIFF = HERTZ.penalty_pa_per_m(100)
#: In E / a.
HERTZ_PENALTIES = (10.0, 30.0, 100.0, 300.0)
HERTZ_CELLS = 4

#: By group: heads of the first two columns, and the unit of the penalty.
HEADS = {
    "sampling": ("contact", "cells a side", "× default"),
    "kinds": ("elements", "cells a side", "× default"),
    "refined": ("elements", "cells a side", "× default"),
    "hertz": ("elements", "cells per contact radius", "E / a"),
    "stiffness": ("elements", "cells per contact radius", "E / a"),
}

Row = dict[str, float | str]


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, prog="accuracy.contact_parts", description=__doc__)
    parser.add_argument("--only", choices=tuple(GROUPS), help="the group that is measured")
    only = parser.parse_args().only
    began = time.monotonic()
    rows = [row for row in _measured() if row["group"] != only] if only else []
    with launch(backend="cpu", zenoh=False) as server:
        engine = Engine(server, "double")
        for name in [only] if only else GROUPS:
            for row in GROUPS[name](engine):
                head = record.Head.of_run(server.version(), "accuracy.contact_parts", began).head()
                rows.append({"group": name, **row, "commit": head["commit"]})
                print(rows[-1], file=sys.stderr, flush=True)
                record.write(FILE, head, rows)  # a time limit may end the run
    return 0


def _measured() -> list[Row]:
    """Rows of earlier runs, each with its commit."""
    if not FILE.exists():
        return []
    content = json.loads(FILE.read_text())
    return [{"commit": content["commit"], **row} for row in content["rows"]]


def tables() -> dict[str, list[str]]:
    """Tables of docs/decisions/contact.md, by name; of the groups that were measured."""
    content = json.loads(FILE.read_text())
    out = {}
    for name, (first, by, unit) in HEADS.items():
        rows = [row for row in content["rows"] if row["group"] == name]
        if not rows:
            continue
        penalties = list(dict.fromkeys(row["penalty"] for row in rows if row["penalty"]))
        lines: dict[tuple[str, str], dict[float, str]] = {}
        for row in rows:
            line = lines.setdefault((row["name"], _size(name, row)), dict.fromkeys(penalties, "–"))
            for penalty in [row["penalty"]] if row["penalty"] else penalties[-1:]:
                line[penalty] = f"{100 * row['error']:+.1f} %"
        heads = [first, by, *(f"{penalty:g} {unit}" for penalty in penalties)]
        table = markdown(heads, [[*names, *line.values()] for names, line in lines.items()])
        out[f"contact_{name}"] = table
    if out:
        commits = ", ".join(f"`{commit}`" for commit in dict.fromkeys(row["commit"] for row in _measured()))
        run = f"{content['device']}, {commits}, {content['date']}: `python -m accuracy.contact_parts`."
        out[list(out)[-1]] += ["", run]
    return out


def _size(group: str, row: Mapping[str, Any]) -> str:
    if group in ("hertz", "stiffness"):
        return f"{HERTZ.elements_per_contact_radius(row['cells']):.2g}"
    return str(row["cells"])


def _kinds(engine: Engine) -> Iterator[Row]:
    exact = references.numbers("contact")[contact_reference.DEEP_PRESS]
    for shape, quadrature in KINDS:
        for cells in CELLS:
            for times in PENALTIES[:2]:
                force_n = press_block(engine, shape, cells, DEEP.penalty_pa_per_m(times), quadrature)
                yield _row(_kind(shape, quadrature), cells, times, force_n, exact)


def _refined(engine: Engine) -> Iterator[Row]:
    exact = references.numbers("contact")[contact_reference.DEEP_PRESS]
    for cells in REFINED_CELLS:
        for times in PENALTIES[1:]:
            force_n = press_block(engine, "hexahedron", cells, DEEP.penalty_pa_per_m(times), SELECTIVE)
            yield _row(_kind("hexahedron", SELECTIVE), cells, times, force_n, exact)


def _sampling(engine: Engine) -> Iterator[Row]:
    half, side = COMMON_CELLS // 2, DEEP.side_m
    across, down = np.linspace(0, side / 2, half + 1), np.linspace(0, DEEP.thickness_m, half + 1)
    law = stable_neo_hookean(DEEP.young_modulus_pa, DEEP.poisson_ratio)
    tissue = contact_reference.block_quarter(law, across, down, quadratic=False)
    augmentation = 20 * DEEP.young_modulus_pa / DEEP.radius_m
    at_nodes = 4 * float(contact_reference.press(tissue, DEEP.radius_m, [DEEP.depth_m], augmentation)[0])
    exact = references.numbers("contact")[contact_reference.DEEP_PRESS]
    yield _row("multipliers at nodes", COMMON_CELLS, 0, at_nodes, exact)
    for times in PENALTIES:
        force_n = press_block(engine, "hexahedron", COMMON_CELLS, DEEP.penalty_pa_per_m(times), FULL)
        yield _row("penalty at the deepest point", COMMON_CELLS, times, force_n, exact)


def _hertz(engine: Engine) -> Iterator[Row]:
    for shape, series in HERTZ_SERIES.items():
        for cells in series:
            force_n = press_half_ball(engine, shape, cells, STIFF)
            yield _row(_kind(shape, FULL), cells, 100, force_n, HERTZ.force_n)


def _stiffness(engine: Engine) -> Iterator[Row]:
    for times in HERTZ_PENALTIES:
        force_n = press_half_ball(engine, "hexahedron", HERTZ_CELLS, HERTZ.penalty_pa_per_m(times))
        yield _row("hexahedron, full", HERTZ_CELLS, times, force_n, HERTZ.force_n)


GROUPS: dict[str, Callable[[Engine], Iterator[Row]]] = {
    "sampling": _sampling,
    "kinds": _kinds,
    "refined": _refined,
    "hertz": _hertz,
    "stiffness": _stiffness,
}


def _kind(shape: str, quadrature: int) -> str:
    return f"{shape.replace('_', ' ')}, {short_name(scene_pb2.Quadrature.DESCRIPTOR, quadrature)}"


def _row(name: str, cells: int, penalty: float, force_n: float, exact_n: float) -> Row:
    return {"name": name, "cells": cells, "penalty": penalty, "force_n": force_n, "error": force_n / exact_n - 1}


if __name__ == "__main__":
    sys.exit(main())
