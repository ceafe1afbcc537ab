"""How long a large scene takes from its message's arrival to its first steps.

    python tests/bench/load_time.py [--backend cuda] [--commit HASH] [--json FILE]
    python tests/bench/load_time.py --elements 2000000 --element-fields young_modulus_pa,poisson_ratio \\
        --daemon before=OLD/bin/tensormassd --daemon after=build/bin/tensormassd --repeats 5

Each load has a daemon of its own, which is sent the packed mesh as a client sends it. The program prints a line of JSON
for each load. Times are the client's, on the machine of the daemon: from the call to the answer, and to the end of the
first step. Several --daemon, and scenes with and without element fields, take turns: if the machine is slower for a
while, it is slower for all of them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from functools import partial
from pathlib import Path

import numpy as np

import tensormass as tm

_CELLS, _SIZE_M = (236, 30, 24), (8.0, 1.0, 0.8)
_TETRAHEDRA_A_CELL = 6
# Element fields vary by so much about the law's own constants, so that no two elements are alike.
_VARIATION = 0.2
_BASE = {"young_modulus_pa": 4000.0, "poisson_ratio": 0.4}


def _remember(told: list[tuple[float, str]], begin_s: float, part: str, _fraction: float) -> None:
    told.append((time.perf_counter() - begin_s, part))


def _cells(elements: int | None) -> tuple[int, int, int]:
    """Counts of nearly cubic cells in the block, for about so many tetrahedra."""
    if elements is None:
        return _CELLS
    edge_m = (float(np.prod(_SIZE_M)) * _TETRAHEDRA_A_CELL / elements) ** (1 / 3)
    x, y, z = (max(1, round(size / edge_m)) for size in _SIZE_M)
    return x, y, z


def _scene(elements: int | None, fields: list[str]) -> tm.Scene:
    mesh = tm.grid(_cells(elements), _SIZE_M)
    random = np.random.default_rng(1)
    values = {name: random.uniform(1 - _VARIATION, 1 + _VARIATION, mesh.element_count) for name in fields}
    values = {name: _BASE[name] * factors for name, factors in values.items()}
    blocks = [(block.shape.name, block.nodes) for block in mesh.blocks]
    mesh = tm.VolumeMesh.from_arrays(mesh.nodes, blocks, element_fields=values)
    scene = tm.Scene.from_mesh(
        mesh,
        name="block",
        law="st_venant_kirchhoff",
        gravity_m_per_s2=(0.0, -9.81, 0.0),
        fixed_nodes=mesh.nodes[:, 0] == 0.0,
    )
    scene.message.stepping.dt_s = 1e-3
    scene.message.solver.cg_tolerance = 1e-3
    return scene


def _spent(told: list[tuple[float, str]], end_s: float) -> dict[str, float]:
    """[part]: seconds from the first message of a part to that of the next."""
    spent: dict[str, float] = {}
    for (begin, part), (end, _) in itertools.pairwise([*told, (end_s, "")]):
        spent[part] = spent.get(part, 0.0) + end - begin
    return {part: round(seconds, 3) for part, seconds in spent.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--commit", default="unknown", help="written into the result")
    parser.add_argument("--json", type=Path, help="append the lines to this file, too")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--elements", type=int, metavar="N", help="about so many (default: a million)")
    parser.add_argument("--element-fields", default="", metavar="A,B", help=f"of {', '.join(_BASE)}; default: none")
    parser.add_argument(
        "--daemon", action="append", default=[], metavar="NAME=PATH", help="a tensormassd; default: the built one"
    )
    arguments = parser.parse_args()
    fields = [name for name in arguments.element_fields.split(",") if name]
    daemons = [tuple(daemon.split("=", 1)) for daemon in arguments.daemon] or [("built", "")]
    scenes = {"without element fields": _scene(arguments.elements, [])}
    if fields:
        scenes["with element fields"] = _scene(arguments.elements, fields)
    # Without paths: they say nothing on another machine.
    command = f"python tests/bench/load_time.py --backend {arguments.backend}"
    command += f" --elements {arguments.elements}" if arguments.elements else ""
    command += f" --element-fields {arguments.element_fields}" if fields else ""
    turns = itertools.product(range(arguments.repeats), scenes.items(), daemons)
    for _, (case, scene), (name, path) in turns:
        if path:
            os.environ["TENSORMASSD"] = path
        told: list[tuple[float, str]] = []
        with tm.launch(backend=arguments.backend) as server:
            version = server.version()
            begin_s = time.perf_counter()
            handle = server.load(scene, lockstep=True, progress=partial(_remember, told, begin_s))
            answer_s = time.perf_counter() - begin_s
            handle.step()
            stepping_s = time.perf_counter() - begin_s
            element_count = sum(body.element_count for body in handle.report.bodies) if handle.report else 0
        line = json.dumps(
            {
                "case": f"load of a packed mesh {case}",
                "fields": fields if case.startswith("with ") else [],
                "daemon": name,
                "backend": version.backend,
                "device": version.device,
                "commit": arguments.commit,
                "command": command,
                "elements": element_count,
                "message_mb": round(scene.message.ByteSize() / 1e6, 1),
                "answer_s": round(answer_s, 3),
                "stepping_s": round(stepping_s, 3),
                "progress_messages": len(told),
                "part_s": _spent(told, answer_s),
            }
        )
        print(line, flush=True)
        if arguments.json is not None:
            with arguments.json.open("a", encoding="utf-8") as file:
                file.write(line + "\n")


if __name__ == "__main__":
    main()
