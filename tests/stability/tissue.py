"""A tissue of any law with given Young's modulus and Poisson's ratio, and what the cases share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np

import tensormass as tm
from accuracy import laws
from accuracy.engine import BODY, Engine, State, state
from accuracy.laws import LAWS, Law
from accuracy.meshes import Floats, Mesh, box
from accuracy.problem import DENSITY_KG_PER_M3, Prescribed, Problem
from tensormass.v1 import scene_pb2

from .case import CURVATURE, FELT, INVERTED, NOT_CONVERGED, OUT_OF_RANGE, SOFTER, Check

CUBE_M = 0.1
YOUNG_PA = 5000.0
POISSON = 0.35
GRAVITY_M_PER_S2 = 9.81
REAL_TIME_DT_S = 1 / 60
# Laws by their answer to compression and inversion (promises.py).
RECOVERS = ("corotational", "stable_neo_hookean")
SOFTENS = ("st_venant_kirchhoff", "transversely_isotropic")

# Warnings of Newton's method. An equilibrium that was not found says nothing about the law.
NEWTON_SAYS = (NOT_CONVERGED, CURVATURE)

_OF_YOUNG_AND_POISSON = {
    "hooke": laws.hooke,
    "st_venant_kirchhoff": laws.st_venant_kirchhoff,
    "corotational": laws.corotational,
    "neo_hookean": laws.neo_hookean,
    "stable_neo_hookean": laws.stable_neo_hookean,
    "hencky": laws.hencky,
}


_Outcome = TypeVar("_Outcome")


def tissue(law: str, young_modulus_pa: float = YOUNG_PA, poisson_ratio: float = POISSON) -> Law:
    """A law that equals Hooke's law of these constants for small strain; fibres along x add 1.6 E."""
    if law in _OF_YOUNG_AND_POISSON:
        return _OF_YOUNG_AND_POISSON[law](young_modulus_pa, poisson_ratio)
    if law == "transversely_isotropic":
        return laws.transversely_isotropic(young_modulus_pa, poisson_ratio, 1.6 * young_modulus_pa, (1, 0, 0))
    shear_pa = young_modulus_pa / (2 * (1 + poisson_ratio))
    bulk_pa = young_modulus_pa / (3 * (1 - 2 * poisson_ratio))
    if law == "mooney_rivlin":
        return laws.mooney_rivlin(shear_pa / 3, shear_pa / 6, bulk_pa)
    if law == "ogden":
        return laws.ogden(shear_pa / 6, 12, bulk_pa)
    raise KeyError(f"{law} is not one of {', '.join(LAWS)}; add it here")


def law_says(law: str) -> tuple[str, ...]:
    """The warnings that a law gives when it is used beyond its promise."""
    if law == "hooke":
        return (OUT_OF_RANGE,)  # Hooke's law does not notice an inversion, and recovers from one
    return (SOFTER, INVERTED) if law in SOFTENS else (INVERTED,)


def cube(shape: str, cells: int = 2) -> Mesh:
    return box(shape, (5 if shape == "mixed" else cells, cells, cells), (CUBE_M,) * 3)


def clamped(mesh: Mesh) -> Prescribed:
    """Fixes the side at x = 0."""
    return Prescribed(mesh.where(lambda x, y, z: x < 1e-9), np.zeros(3))


def nodal_weight(mesh: Mesh, times: float = 1.0) -> Floats:
    """The weight of a cube of CUBE_M as equal nodal forces [N] along −z, so that its work is exactly f · u."""
    forces = np.zeros(mesh.nodes.shape)
    forces[:, 2] = -times * DENSITY_KG_PER_M3 * GRAVITY_M_PER_S2 * CUBE_M**3 / len(mesh.nodes)
    return forces


def real_time(engine: Engine, problem: Problem, dt_s: float = REAL_TIME_DT_S) -> scene_pb2.Scene:
    """The problem with a trainer's settings: implicit Euler linearized once, the daemon's default tolerances."""
    scene = engine.scene(problem, dt_s)
    precision = scene.solver.precision
    scene.solver.Clear()
    scene.solver.precision = precision
    return scene


def side_by_side(scenes: Mapping[str, scene_pb2.Scene]) -> scene_pb2.Scene:
    """Merges scenes of one body each. Bodies get the given names; all else comes from the first scene."""
    first, *_ = scenes.values()
    out = scene_pb2.Scene()
    out.CopyFrom(first)
    del out.bodies[:]
    for name, scene in scenes.items():
        (body,) = scene.bodies
        out.bodies.add().CopyFrom(body)
        out.bodies[-1].name = name
    return out


class Running:
    """A loaded scene. warnings: of all its statuses. last_warnings: of the last one."""

    def __init__(self, handle: tm.SceneHandle) -> None:
        self.handle = handle
        self.warnings: list[str] = []
        self.last_warnings: list[str] = []

    def step(self, count: int = 1) -> None:
        self.last_warnings = list(self.handle.step(count).warnings)
        self.warnings += [warning for warning in self.last_warnings if warning not in self.warnings]

    def state(self) -> State:
        return state(self.handle)

    def displacement_m(self, body: str) -> Floats:
        return self.handle.fields(body, ("displacement",))["displacement"]


@contextmanager
def running(engine: Engine, scene: scene_pb2.Scene) -> Iterator[Running]:
    with engine.loaded(scene) as handle:
        yield Running(handle)


class Shared(Generic[_Outcome]):
    """A run that several cases check (`Case.together`). It runs once for each daemon and precision.

    run: called with an engine; its result, or the exception that it raised, is kept for the other cases.
    """

    def __init__(self, run: Callable[[Engine], _Outcome]) -> None:
        self._run = run
        self._outcomes: dict[tuple[str, str], _Outcome | Exception] = {}

    def __call__(self, engine: Engine) -> _Outcome:
        key = engine.server.address, engine.precision
        if key not in self._outcomes:
            try:
                self._outcomes[key] = self._run(engine)
            except Exception as error:
                self._outcomes[key] = error
        outcome = self._outcomes[key]
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


_equilibria: dict[str, State] = {}


def equilibrium(engine: Engine, problem: Problem) -> State:
    """The equilibrium by Newton's method in double precision, cached by daemon and problem."""
    key = f"{engine.server.address} {problem.digest()}"
    if key not in _equilibria:
        _equilibria[key] = Engine(engine.server, "double").equilibrium(problem)
    return _equilibria[key]


def distance(ours: Floats, reference: Floats, label: str = "distance to the reference", bound: float = FELT) -> Check:
    """Checks the largest difference, divided by the largest displacement of the reference."""
    return Check(label, float(np.abs(ours - reference).max() / np.abs(reference).max()), bound)


def at_rest_again(found: State, mesh: Mesh, young_modulus_pa: float = YOUNG_PA) -> list[Check]:
    """Checks that every element has its rest volume and that no energy is left. The body may be anywhere."""
    volume = float(np.prod(np.ptp(mesh.nodes, axis=0)))
    return [
        Check("|det F − 1|", float(np.abs(found.det_f - 1).max()), FELT),
        Check("elastic energy / (E V)", found.elastic_energy_j / (young_modulus_pa * volume), FELT**2),
        Check("kinetic energy / (E V)", found.kinetic_energy_j / (young_modulus_pa * volume), FELT**2),
    ]


def packed(values: Sequence[Sequence[float]] | Floats) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()


def initial(
    scene: scene_pb2.Scene, displacement_m: Floats | None = None, velocity_m_per_s: Floats | None = None
) -> None:
    """Sets the initial state of the scene's body. displacement_m, velocity_m_per_s: [node_count, 3]."""
    (body,) = [body for body in scene.bodies if body.name == BODY]
    if displacement_m is not None:
        body.initial_displacement_m = packed(displacement_m)
    if velocity_m_per_s is not None:
        body.initial_velocity_m_per_s = packed(velocity_m_per_s)
