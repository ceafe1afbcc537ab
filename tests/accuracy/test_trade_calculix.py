"""The parts of the comparison with CalculiX that run without CalculiX."""

from __future__ import annotations

import numpy as np

from tensormass_tools.trade.script import Script

from .meshes import box
from .trade_calculix import Beam, Setting, deck, quadratic, serendipity


def test_quadratic_hexahedra_interpolate_quadratic_fields_exactly() -> None:
    mesh = box("hexahedron", (3, 2, 1), (3.0, 1.0, 0.5))
    ((_, hexahedra),) = mesh.blocks
    nodes, elements = quadratic(mesh.nodes, hexahedra)
    assert elements.shape == (6, 20)
    assert len(np.unique(nodes, axis=0)) == len(nodes)  # no edge has two midpoints
    points = np.random.default_rng(1).uniform(0, 1, (50, 3)) * (3.0, 1.0, 0.5)
    at, weights = serendipity(nodes, elements, points)
    np.testing.assert_allclose(weights.sum(axis=1), 1)

    def field(x: np.ndarray) -> np.ndarray:
        return 1 + x[..., 0] - 2 * x[..., 1] + x[..., 0] * x[..., 2] + 3 * x[..., 1] ** 2

    taken = np.einsum("pk,pk->p", weights, field(nodes)[elements[at]])
    np.testing.assert_allclose(taken, field(points), rtol=1e-12)


def test_the_input_file_has_the_values_of_the_scene() -> None:
    beam = Beam()
    setting = Setting("C3D20R", 0.1)
    nodes, elements = beam.mesh(setting)
    assert len(elements) == 6 * 1 * 1
    text = deck(beam, setting, nodes, elements, Script.of(beam.message, 0.8))
    lines = text.splitlines()
    assert lines[lines.index("*ELASTIC") + 1] == "1e+06, 0.4"
    assert lines[lines.index("*DENSITY") + 1] == "1000"
    assert "BODY, GRAV, 9.81, 0., 0., -1." in lines
    assert "*NODE PRINT, NSET=ALL, FREQUENCY=2" in lines
    start = lines.index("*ELEMENT, TYPE=C3D20R, ELSET=BODY")
    numbers = [int(number) for number in "".join(lines[start + 1 : start + 3]).split(",")]
    assert numbers == [1, *(elements[0] + 1)]
    fixed = [
        int(line.rstrip(",")) - 1 for line in lines[lines.index("*NSET, NSET=WALL") + 1 : lines.index("*BOUNDARY")]
    ]
    assert set(fixed) == set(np.flatnonzero(nodes[:, 0] == 0))


def test_a_recording_has_no_error_against_itself() -> None:
    beam = Beam()
    setting = Setting("C3D8I", 0.15)
    nodes, elements = beam.mesh(setting)
    u = np.stack([nodes * 0.1, nodes * 0.2])  # linear, so interpolated exactly
    exact = np.stack([beam.points * 0.1, beam.points * 0.2])
    np.testing.assert_allclose(beam.taken(setting, nodes, elements, u), exact, atol=1e-12)

    class Reference:
        displacement = (exact,)

    assert beam.error(exact, Reference()) == (0, 0)  # type: ignore[arg-type]
    error, worst = beam.error(1.1 * exact, Reference())  # type: ignore[arg-type]
    np.testing.assert_allclose((error, worst), 0.1)
