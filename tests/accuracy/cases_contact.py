"""A rigid sphere against tissue: Hertz's formula for a small depth, and an independent solution for a deep press."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from . import contact_reference, references
from .case import Case, Group, Outcome, relative
from .engine import Engine
from .sphere_contact import FULL, HERTZ, SELECTIVE, Contact, press_block, press_half_ball

HERTZ_GROUP = Group(
    "hertz",
    "Sphere on a half-space (Hertz)",
    "A rigid sphere of 20 mm, pressed 0.02 mm into a half ball of linear tissue (E 5 kPa, ν 0.35) whose round side is "
    "fixed, 400 contact radii away. Contact radius a = √(radius · depth) = 0.63 mm. Cells are even within 1.25 a and "
    "grow outwards. The contact's stiffness is 100 E / a. Reference: Hertz 1882, F = 4/3 E* √radius depth^1.5, "
    "E* = E / (1 − ν²), depth measured at the sphere. Value: force on the sphere on the finest mesh. Error: relative. "
    "docs/decisions/contact.md says what the error is made of.",
)
DEEP_GROUP = Group(
    "deep_press",
    "Sphere pressed deep into a block",
    "A rigid sphere of 12 mm, pressed 6 mm into a block of 60 × 60 × 30 mm of stable neo-Hookean tissue (E 5 kPa, "
    "ν 0.45) with a fixed bottom, without friction. Reference: a quarter of the block in hexahedra of 27 nodes, with "
    "multipliers at the nodes of the top (contact_reference.py). Value: force on the sphere with 13 cells a side and "
    "the contact's default stiffness. Error: relative; it is one of discretization and penalty.",
)
STIFF = HERTZ.stiff(100)
DEFAULT = Contact()
CELLS = (9, 13)

Kind = tuple[str, int]
NAMES = {FULL: "full", SELECTIVE: "selective"}
#: By shape and quadrature: cells along half the width of the fine block, and the bound.
HERTZ_SERIES: dict[Kind, tuple[tuple[int, ...], float]] = {
    ("quadratic_tetrahedron", FULL): ((1, 2, 4), 0.03),
    ("hexahedron", FULL): ((2, 4, 8), 0.05),
}
#: By shape and quadrature: the bound with 13 cells a side; None where linear shapes lock.
DEEP_BOUNDS: dict[Kind, float | None] = {
    ("tetrahedron", FULL): None,
    ("tetrahedron", SELECTIVE): 0.02,
    ("hexahedron", FULL): None,
    ("hexahedron", SELECTIVE): 0.02,
}


def contact_cases() -> Iterator[Case]:
    for (shape, quadrature), (series, bound) in HERTZ_SERIES.items():

        def at(engine: Engine, cells: int, shape: str = shape, quadrature: int = quadrature) -> float:
            return press_half_ball(engine, shape, cells, STIFF, quadrature)

        yield _case(HERTZ_GROUP, shape, "hooke", NAMES[quadrature], "Hertz 1882", bound, at, series, _fine, _hertz)
    for (shape, quadrature), most in DEEP_BOUNDS.items():

        def deep(engine: Engine, cells: int, shape: str = shape, quadrature: int = quadrature) -> float:
            return press_block(engine, shape, cells, DEFAULT, quadrature)

        source = references.source("contact")
        name = NAMES[quadrature]
        yield _case(DEEP_GROUP, shape, "stable_neo_hookean", name, source, most, deep, CELLS, _coarse, _deep)


def _case(
    group: Group,
    shape: str,
    law: str,
    name: str,
    source: str,
    bound: float | None,
    force_n: Callable[[Engine, int], float],
    series: tuple[int, ...],
    label: Callable[[int], str],
    reference: Callable[[], float],
) -> Case:
    """force_n: engine and cells to the force; label: cells to the name of a mesh; both called once a mesh."""

    def run(engine: Engine) -> Outcome:
        exact = reference()
        details = []
        for cells in series:
            value = force_n(engine, cells)
            details.append((label(cells), value, relative(value, exact)))
        _, value, error = details[-1]
        return Outcome(value, exact, error, tuple(details))

    return Case(group, shape, law, name, "force [N]", source, {"double": bound}, run)


def _fine(cells: int) -> str:
    return f"{HERTZ.elements_per_contact_radius(cells):.1f} cells per contact radius"


def _coarse(cells: int) -> str:
    return f"{cells} cells a side"


def _hertz() -> float:
    return HERTZ.force_n


def _deep() -> float:
    return references.numbers("contact")[contact_reference.DEEP_PRESS]
