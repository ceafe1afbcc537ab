"""Meshes: one element, slivers, layers with aspect ratio 1000, millions of elements."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from accuracy.cases_homogeneous import STEPS as PULLED_STEPS
from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES, Floats, Mesh, box
from accuracy.problem import Problem
from tensormass.v1 import scene_pb2

from .case import FELT, REFUSED, Case, Check, Found, Group
from .cases_material import pull
from .cases_steps import NEWTON_SOLVES, settle, settles, settling_steps
from .tissue import (
    CUBE_M,
    GRAVITY_M_PER_S2,
    NEWTON_SAYS,
    REAL_TIME_DT_S,
    clamped,
    cube,
    law_says,
    nodal_weight,
    real_time,
    running,
    tissue,
)

MESH = Group(
    "mesh",
    "Meshes",
    "slivers of 0.1°, aspect 1000: as length of a step; plate: as Poisson's ratio",
    "*One element*: fixed at one face. *0.1°*: the cube with a layer of cells in its middle so thin that dihedral "
    "angles of its tetrahedra are 0.1°. *Aspect 1000*: the layer is a thousandth as thick as the cells are wide. All "
    "three fall under their weight, 60 steps a second, with the bounds of “Length of a step”. *Plate*: 0.1 mm thick, "
    "100 mm wide, in cells of 50 mm, pulled to 1.1 of its length, with the bounds of “Poisson's ratio”. *Flat "
    "elements*: refused at load.",
)
MILLIONS = Group(
    "millions",
    "Millions of elements",
    "free fall to 1 %; even stretch and volumes to 0.1 %",
    "A cube of 0.1 m in 1,053,696 tetrahedra or 1,000,000 hexahedra. Free, it falls for 10 steps. Must hold: every "
    "node falls by the distance of implicit Euler, to 1 %. *Pulled*: without displacement across, its ends pulled to "
    "1.1 of its length in 8 steps of 1 s. Must hold: every node is at the place of an even stretch, and every element "
    "has 1.1 times its volume, to 0.1 %.",
)


PLATE_M = CUBE_M / 1000


def mesh_cases() -> Iterator[Case]:
    yield from _thin_cases()
    yield from _million_cases()


def _one_element(shape: str) -> Mesh:
    """The element of the cube with most nodes in the plane x = 0, which `clamped` fixes."""
    whole = box(shape, (1, 1, 1), (CUBE_M,) * 3)
    ((_, elements),) = whole.blocks
    on_face = [int((whole.nodes[element, 0] < 1e-9).sum()) for element in elements]
    element = elements[int(np.argmax(on_face))]
    return Mesh(whole.nodes[element], ((shape, np.arange(len(element))[None]),))


def _thin_layer(thickness_m: float, shape: str) -> Mesh:
    """Three layers along x, the middle one thin."""

    def place(nodes: Floats) -> Floats:
        out = nodes.copy()
        edges = [0, (CUBE_M - thickness_m) / 2, (CUBE_M + thickness_m) / 2, CUBE_M]
        out[:, 0] = np.interp(nodes[:, 0], np.linspace(0, CUBE_M, 4), edges)
        return out

    return box(shape, (3, 2, 2), (CUBE_M,) * 3, place)


def _thin_cases() -> Iterator[Case]:
    cell_m = CUBE_M / 2
    meshes: dict[str, Callable[[str], Mesh]] = {
        "one element": _one_element,
        "0.1°": lambda shape: _thin_layer(cell_m * np.tan(np.radians(0.1)), shape),
        "aspect 1000": lambda shape: _thin_layer(cell_m / 1000, shape),
    }

    def run(engine: Engine, name: str, law: str, shape: str) -> Found:
        mesh = meshes[name](shape)
        share = 1 / len(box(shape, (1, 1, 1)).blocks[0][1]) if name == "one element" else 1.0
        problem = Problem(mesh, tissue(law), [clamped(mesh)], forces_n=nodal_weight(mesh, share))
        return settle(engine, problem, REAL_TIME_DT_S)

    def flat(engine: Engine, law: str) -> Found:
        mesh = cube("tetrahedron")
        squeezed = Mesh(mesh.nodes * (1, 1, 1e-9), mesh.blocks)
        with running(engine, real_time(engine, Problem(squeezed, tissue(law), []))):
            raise AssertionError("it was admitted")

    def plate(engine: Engine, law: str, shape: str) -> Found:
        mesh = box(shape, (2, 2, 1), (CUBE_M, CUBE_M, PLATE_M))
        return pull(engine, mesh, tissue(law))

    for law in LAWS:
        for shape in SHAPES:
            yield Case(
                MESH,
                "plate",
                law,
                shape,
                partial(plate, law=law, shape=shape),
                names=NEWTON_SAYS,
                solves=PULLED_STEPS * NEWTON_SOLVES,
            )
    for name in meshes:
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    MESH,
                    name,
                    law,
                    shape,
                    partial(run, name=name, law=law, shape=shape),
                    expects=settles(law),
                    names=law_says(law),
                    quick=shape == "tetrahedron" and name == "0.1°",
                    solves=settling_steps(REAL_TIME_DT_S),
                )
    for law in LAWS:
        yield Case(MESH, "flat elements", law, "tetrahedron", partial(flat, law=law), expects=(REFUSED,))


def _million_cases() -> Iterator[Case]:
    steps, dt_s, gravity = 10, REAL_TIME_DT_S, GRAVITY_M_PER_S2
    pulled_steps, stretch, pulled_bound = 8, 1.1, 1e-3

    def cube_of(engine: Engine, law: str, shape: str, cells: int, dt_s: float) -> scene_pb2.Scene:
        scene = real_time(engine, Problem(box("hexahedron", (1, 1, 1)), tissue(law), []), dt_s)
        grid = scene.bodies[0].mesh.grid
        grid.size_m.x = grid.size_m.y = grid.size_m.z = CUBE_M
        grid.cells_x = grid.cells_y = grid.cells_z = cells
        grid.shape = SHAPES[shape].number
        return scene

    def fall(engine: Engine, law: str, shape: str, cells: int) -> Found:
        scene = cube_of(engine, law, shape, cells, dt_s)
        scene.gravity_m_per_s2.z = -gravity
        way = -gravity * dt_s**2 * steps * (steps + 1) / 2
        with engine.loaded(scene) as handle:
            handle.step(steps)
            moved = handle.fields("body", ("displacement",))["displacement"]
        error = float(np.abs(moved - (0, 0, way)).max() / abs(way))
        return Found([Check("distance to the fall", error, {"double": 1e-6, "float": FELT}[engine.precision])])

    def pulled(engine: Engine, law: str, shape: str, cells: int) -> Found:
        scene = cube_of(engine, law, shape, cells, 1.0)

        def hold(low_m: float, high_m: float, **displacement_m: float) -> None:
            region = scene.bodies[0].prescribed.add(y_m=0, z_m=0, **displacement_m).region.box
            region.min_m.x, region.min_m.y, region.min_m.z = low_m, -1, -1
            region.max_m.x, region.max_m.y, region.max_m.z = high_m, 1, 1

        hold(-1, 1)
        hold(-1, 1e-6, x_m=0)
        hold(CUBE_M - 1e-6, 1, x_m=(stretch - 1) * CUBE_M)
        with running(engine, scene) as scene_running:
            handle = scene_running.handle
            rest = handle.positions("body")
            scene_running.step(pulled_steps)
            found = handle.fields("body", ("displacement", "det_f"))
        off = found["displacement"] - (stretch - 1) * rest * (1, 0, 0)
        checks = [
            Check("distance to the even stretch", float(np.abs(off).max() / ((stretch - 1) * CUBE_M)), pulled_bound),
            Check("|det F − 1.1|", float(np.abs(found["det_f"] - stretch).max()), pulled_bound),
        ]
        return Found(checks, scene_running.last_warnings)

    one, all_laws = ("stable_neo_hookean",), tuple(LAWS)
    for shape, cells, name, run, laws in (
        ("tetrahedron", 56, "", fall, one),  # free fall does not depend on the law
        ("hexahedron", 100, "", fall, one),
        ("tetrahedron", 56, ", pulled", pulled, all_laws),
        ("hexahedron", 100, ", pulled", pulled, one),
    ):
        for law in laws:
            yield Case(
                MILLIONS,
                f"{cells}³ cells{name}",
                law,
                shape,
                partial(run, law=law, shape=shape, cells=cells),
                precisions=("float",),
                long=True,
                solves=steps,
            )
