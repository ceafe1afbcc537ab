"""One soft beam in this server, in MuJoCo and in Newton, on the CPU, in one run: time of a step against its error.

    pip install mujoco newton
    python tests/bench/others.py [--cells 20,4,4] [--without newton] --commit HASH --json FILE

A beam of 0.2 × 0.04 × 0.04 m (six tetrahedra a cube, lumped mass, E 20 kPa, ν 0.4, ρ 1000 kg/m³) is fixed at one end
and falls under its weight for 20 steps of 5 ms. All engines get the same nodes, elements and masses.

Each law is that of the engine, so each engine has a reference with its own law: implicit Euler, solved to convergence
in each of the same steps. `error_percent` is |u − u_reference| / |u_reference| over all nodes after the last step.

    law                                engine        reference
    St-Venant-Kirchhoff                this, MuJoCo  this server in double precision, Newton's method to 1e-8
    neo-Hookean (Smith 2018, no log)   Newton        Newton with REFERENCE_ITERATIONS

The engines take turns, ROUNDS times, with one thread each. A time is that of the call that makes one step, without
reading the positions. Our call goes through gRPC to the daemon and back. Newton is made for a GPU: on a CPU most of its
time is spent starting kernels.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import itertools
import json
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import tensormass as tm

FloatArray = npt.NDArray[np.float64]

SIZE_M = (0.2, 0.04, 0.04)
YOUNG_PA, POISSON, DENSITY = 20e3, 0.4, 1000.0
DT_S, STEPS, ROUNDS = 0.005, 20, 3
GRAVITY = -9.81
REFERENCE_ITERATIONS = 1000
#: Restart of a run, and one step of it.
Engine = tuple[Callable[[], None], Callable[[], None], Callable[[], FloatArray]]


@dataclass
class Case:
    """An engine with one setting. `make` returns how a run starts, makes a step, and tells its positions."""

    engine: str
    setting: str
    law: str
    make: Callable[[], Engine]


def beam(cells: tuple[int, int, int]) -> tuple[FloatArray, npt.NDArray[np.int64], npt.NDArray[np.bool_], FloatArray]:
    """Returns nodes [n, 3] m, tetrahedra [k, 4], which nodes are fixed [n], lumped masses [n] kg."""
    mesh = tm.grid(cells, SIZE_M)
    nodes, tetrahedra = np.asarray(mesh.nodes), np.asarray(mesh.blocks[0].nodes, np.int64)
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    masses = np.zeros(len(nodes))
    np.add.at(masses, tetrahedra, (DENSITY * np.linalg.det(edges) / 24)[:, None])
    return nodes, tetrahedra, nodes[:, 0] < 1e-9, masses


def with_tensormass(server: tm.Server, cells: tuple[int, int, int], name: str, solver: dict[str, Any]) -> Engine:
    nodes, tetrahedra, fixed, _ = beam(cells)
    scene = tm.Scene.from_arrays(
        nodes,
        tetrahedra,
        name=name,
        law="st_venant_kirchhoff",
        young_modulus_pa=YOUNG_PA,
        poisson_ratio=POISSON,
        density_kg_per_m3=DENSITY,
        fixed_nodes=fixed,
        gravity_m_per_s2=(0, 0, GRAVITY),
    )
    scene.set_solver(**solver)
    scene.set_stepping(dt_s=DT_S)
    handle = server.load(scene, name=name, lockstep=True)

    def start() -> None:
        handle.reset()

    def step() -> None:
        handle.step()

    return start, step, lambda: handle.positions("body")


def with_mujoco(cells: tuple[int, int, int], solver: str, iterations: int, tolerance: float) -> Engine:
    mujoco = importlib.import_module("mujoco")

    nodes, tetrahedra, fixed, masses = beam(cells)
    bodies = []
    for index, (place, mass) in enumerate(zip(nodes.tolist(), masses.tolist(), strict=True)):
        joints = "" if fixed[index] else "".join(f'<joint type="slide" axis="{axis}"/>' for axis in _AXES)
        inertia = f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="1e-9 1e-9 1e-9"/>'
        bodies.append(f'<body name="n{index}" pos="{_words(place)}">{inertia}{joints}</body>')
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler boundmass="0"/>
        <option timestep="{DT_S}" integrator="discrete" solver="{solver}" iterations="{iterations}"
          tolerance="{tolerance}" gravity="0 0 {GRAVITY}"><flag contact="disable"/></option>
        <size memory="2G"/><worldbody>{"".join(bodies)}</worldbody>
        <deformable><flex name="beam" dim="3" body="{" ".join(f"n{index}" for index in range(len(nodes)))}"
          element="{_words(tetrahedra.ravel().tolist())}">
          <elasticity young="{YOUNG_PA}" poisson="{POISSON}" damping="0"/></flex></deformable></mujoco>"""
    )
    data = mujoco.MjData(model)

    def start() -> None:
        mujoco.mj_resetData(model, data)

    def step() -> None:
        mujoco.mj_step(model, data)

    def positions() -> FloatArray:
        mujoco.mj_kinematics(model, data)
        return np.array(data.xpos[1:], np.float64)

    return start, step, positions


_AXES = ("1 0 0", "0 1 0", "0 0 1")


def _words(numbers: list[Any]) -> str:
    return " ".join(map(repr, numbers))


def with_newton(cells: tuple[int, int, int], iterations: int) -> Engine:
    wp = importlib.import_module("warp")

    wp.config.quiet = True
    newton = importlib.import_module("newton")

    nodes, tetrahedra, fixed, _ = beam(cells)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, GRAVITY))
    lambda_pa, mu_pa = tm.lame(YOUNG_PA, POISSON)
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*node) for node in nodes.tolist()],
        indices=tetrahedra.ravel().tolist(),
        density=DENSITY,
        k_mu=mu_pa,
        k_lambda=lambda_pa,
        k_damp=0.0,
        add_surface_mesh_edges=False,
    )
    for index in np.flatnonzero(fixed).tolist():
        builder.particle_mass[index] = 0.0
    builder.color()
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverVBD(model=model, iterations=iterations)
    states = [model.state(), model.state()]
    control = model.control()

    def start() -> None:
        states[:] = [model.state(), model.state()]

    def step() -> None:
        states[0].clear_forces()
        solver.step(states[0], states[1], control, None, DT_S)
        states.reverse()

    return start, step, lambda: np.array(states[0].particle_q.numpy(), np.float64)


def cases(server: tm.Server, cells: tuple[int, int, int], newton: bool) -> Iterator[Case]:
    for count, tolerance in ((10, 1e-6), (50, 1e-6), (500, 1e-3), (500, 1e-6)):
        settings: dict[str, Any] = {"precision": "float", "cg_max_iterations": count, "cg_tolerance": tolerance}
        name = f"beam-{count}-{-math.log10(tolerance):.0f}"
        make = partial(with_tensormass, server, cells, name, settings)
        yield Case("Tensormass", f"one linear solve, at most {count} CG iterations to {tolerance:g}", "StVK", make)
    for solver, count, tolerance in (("CG", 100, 1e-8), ("Newton", 100, 1e-8)):
        discrete = partial(with_mujoco, cells, solver, count, tolerance)
        yield Case("MuJoCo", f"discrete, {solver}, at most {count} iterations to {tolerance:g}", "StVK", discrete)
    for count in (10, 50, 200) if newton else ():
        yield Case("Newton", f"VBD, {count} iterations", "neo-Hookean", partial(with_newton, cells, count))


def references(server: tm.Server, cells: tuple[int, int, int], newton: bool) -> dict[str, FloatArray]:
    """[law]: positions [n, 3] m after the last step, each step converged."""
    exact: dict[str, Any] = {"precision": "double", "cg_max_iterations": 5000, "cg_tolerance": 1e-10}
    exact |= {"newton_max_iterations": 50, "newton_tolerance": 1e-8}
    made = {"StVK": with_tensormass(server, cells, "reference", exact)}
    if newton:
        made["neo-Hookean"] = with_newton(cells, REFERENCE_ITERATIONS)
    return {law: run(engine)[1] for law, engine in made.items()}


def run(engine: Engine) -> tuple[list[float], FloatArray]:
    """Returns the time of each step [ms] and the last positions."""
    start, step, positions = engine
    start()
    times = []
    for _ in range(STEPS):
        before = time.perf_counter()
        step()
        times.append(1e3 * (time.perf_counter() - before))
    return times, positions()


def processor() -> str:
    found = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return f"{found[0].partition(':')[2].strip()}, {os.cpu_count()} threads"


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", default="20,4,4", help="cells along x, y, z (default: %(default)s)")
    parser.add_argument("--without", choices=("newton",), help="leave an engine out")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    parser.add_argument("--json", type=Path, required=True, help="file to append results to; Warp prints to stdout")
    args = parser.parse_args()
    x, y, z = map(int, args.cells.split(","))
    cells = (x, y, z)
    nodes, tetrahedra, _, _ = beam(cells)
    versions = {name: importlib.metadata.version(name) for name in ("mujoco", "newton", "warp-lang")}
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as server:
        newton = args.without != "newton"
        exact = references(server, cells, newton)
        all_cases = list(cases(server, cells, newton))
        engines = [case.make() for case in all_cases]
        times: list[list[float]] = [[] for _ in all_cases]
        last = [nodes for _ in all_cases]
        for engine in engines:
            run(engine)  # warm-up, and compilation
        for _, (index, engine) in itertools.product(range(ROUNDS), enumerate(engines)):
            measured, last[index] = run(engine)
            times[index] += measured
    for case, taken, end in zip(all_cases, times, last, strict=True):
        moved = exact[case.law] - nodes
        row = {
            "case": f"falling beam {len(tetrahedra)}: {case.engine}, {case.setting}",
            "backend": "cpu",
            "engine": case.engine,
            "setting": case.setting,
            "law": case.law,
            "device": processor(),
            "commit": args.commit,
            "versions": versions,
            "command": f"python tests/bench/others.py --cells {args.cells}{'' if newton else ' --without newton'}",
            "elements": len(tetrahedra),
            "nodes": len(nodes),
            "steps": len(taken),
            "step_ms_median": round(statistics.median(taken), 4),
            "step_ms_p99": round(float(np.quantile(taken, 0.99)), 4),
            "error_percent": round(100 * float(np.linalg.norm(end - exact[case.law]) / np.linalg.norm(moved)), 4),
            "reference_tip_mm": round(1e3 * float(np.linalg.norm(moved, axis=1).max()), 3),
        }
        with args.json.open("a") as file:
            file.write(json.dumps(row, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
