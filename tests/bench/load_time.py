"""How long a scene of a million tetrahedra takes from its message's arrival to its first steps.

    python tests/bench/load_time.py [--backend cuda] [--commit HASH] [--json FILE]

A daemon of its own is sent the mesh, packed, as a client sends it; prints a line of JSON. Times are the client's, on
the machine of the daemon: from the call to the answer, and to the end of the first step.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path

import tensormass as tm
from tensormass._src import grids

_CELLS, _SIZE_M = (236, 30, 24), (8.0, 1.0, 0.8)


def _remember(told: list[tuple[str, float]], part: str, fraction: float) -> None:
    told.append((part, fraction))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--commit", default="unknown", help="written into the result")
    parser.add_argument("--json", type=Path, help="append the line to this file, too")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    mesh = grids.grid(list(_CELLS), list(_SIZE_M))
    scene = tm.Scene.from_mesh(
        mesh, name="million", gravity_m_per_s2=(0.0, -9.81, 0.0), fixed_nodes=mesh.nodes[:, 0] == 0.0
    )
    scene.message.stepping.dt_s = 1e-3
    scene.message.solver.cg_tolerance = 1e-3
    for _ in range(arguments.repeats):
        told: list[tuple[str, float]] = []
        with tm.launch(backend=arguments.backend) as server:
            version = server.version()
            begin_s = time.perf_counter()
            handle = server.load(scene, lockstep=True, progress=partial(_remember, told))
            answer_s = time.perf_counter()
            handle.step()
            first_step_s = time.perf_counter()
        line = json.dumps(
            {
                "case": "load of a packed mesh",
                "backend": version.backend,
                "device": version.device,
                "commit": arguments.commit,
                "command": f"python tests/bench/load_time.py --backend {arguments.backend}",
                "elements": mesh.element_count,
                "message_mb": round(scene.message.ByteSize() / 1e6, 1),
                "answer_s": round(answer_s - begin_s, 3),
                "stepping_s": round(first_step_s - begin_s, 3),
                "progress_messages": len(told),
                "progress_parts": sorted({part for part, _ in told}),
            }
        )
        print(line, flush=True)
        if arguments.json is not None:
            with arguments.json.open("a", encoding="utf-8") as file:
                file.write(line + "\n")


if __name__ == "__main__":
    main()
