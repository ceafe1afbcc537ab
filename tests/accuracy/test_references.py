"""The references agree with each other, and stored answers belong to the problems as they are now."""

from __future__ import annotations

import numpy as np
import pytest

from . import calculix, numpy_fem, references, skfem_fem
from .cases_equilibrium import CELLS, PROBLEMS, SIZE_M, compare, pairs, problem
from .laws import IDENTITY, LAWS
from .meshes import MESHES, SHAPES, boundary_faces, box, shaken, sphere_octant


@pytest.mark.parametrize("law", LAWS)
def test_the_three_forms_of_a_law_agree(law: str) -> None:
    entry = LAWS[law]
    stretches, gamma = np.array([1.3, 0.8, 1.1]), 0.4
    np.testing.assert_allclose(entry.stress(np.diag(stretches)), np.diag(entry.pull(stretches)), atol=1e-9)
    sheared = entry.stress(IDENTITY + gamma * np.outer(IDENTITY[0], IDENTITY[1]))
    np.testing.assert_allclose(sheared[[0, 0, 1, 1, 2], [0, 1, 0, 1, 2]], entry.shear(gamma), atol=1e-9)
    np.testing.assert_allclose(entry.stress(IDENTITY), 0, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_the_volumetric_stress_is_a_pressure_at_rest(law: str) -> None:
    """The remaining stress does not resist a change of volume."""
    entry, step = LAWS[law], 1e-6
    grown = (1 + step) * IDENTITY
    pressure = entry.volumetric(grown) / step
    np.testing.assert_allclose(pressure, pressure[0, 0] * IDENTITY, atol=1e-4 * pressure[0, 0])
    if not entry.directed:
        np.testing.assert_allclose(entry.stress(grown) / step, pressure, atol=1e-4 * pressure[0, 0])
    sheared = entry.volumetric(IDENTITY + step * np.outer(IDENTITY[0], IDENTITY[1])) / step
    np.testing.assert_allclose(sheared, 0, atol=1e-4 * pressure[0, 0])


@pytest.mark.parametrize("law", LAWS)
def test_a_law_has_an_energy(law: str) -> None:
    f = IDENTITY + 0.2 * np.random.default_rng(0).standard_normal((3, 3))
    moduli = numpy_fem.tangent(LAWS[law].stress, f).reshape(9, 9)
    np.testing.assert_allclose(moduli, moduli.T, atol=1e-6 * np.abs(moduli).max())


@pytest.mark.parametrize("shape", MESHES)
def test_meshes_fill_their_box_and_conform(shape: str) -> None:
    cells = (5, 3, 2)
    mesh = box(shape, cells, place=shaken(1, 0.2, cells))
    volume = numpy_fem.consistent_forces(mesh, lambda x: np.ones((*x.shape[:-1], 1))).sum()
    assert volume == pytest.approx(1, abs=1e-13)
    for face in boundary_faces(mesh):  # an inner face without a twin would be a boundary face
        assert any((np.ptp(mesh.nodes[face], axis=0) < 1e-12).tolist())


@pytest.mark.parametrize("shape", SHAPES)
def test_the_octant_is_one_body(shape: str) -> None:
    mesh = sphere_octant(shape, 3, 2, 1.0, 2.0)
    volume = numpy_fem.consistent_forces(mesh, lambda x: np.ones((*x.shape[:-1], 1))).sum()
    assert volume == pytest.approx(7 * np.pi / 6, rel=0.05)
    radius = np.linalg.norm(mesh.nodes, axis=1)
    for face in boundary_faces(mesh):
        on_plane = (np.abs(mesh.nodes[face]) < 1e-9).all(axis=0).any()
        assert on_plane or np.ptp(radius[face]) < 1e-9


@pytest.mark.parametrize("shape", skfem_fem.SHAPES)
def test_own_solver_and_scikit_fem_agree(shape: str) -> None:
    stated = problem("cantilever", shape, "ogden")
    assert compare(numpy_fem.solve(stated), skfem_fem.solve(stated)).error < 1e-10


@pytest.mark.parametrize("shape", calculix.ELEMENTS)
def test_own_solver_and_calculix_agree(shape: str) -> None:
    if not calculix.available():
        pytest.skip("CalculiX (ccx) is not installed; its stored answers are still compared")
    stated = problem("cantilever", shape, "st_venant_kirchhoff")
    assert compare(numpy_fem.solve(stated), calculix.solve(stated)).error < 1e-6


def test_wedges_of_one_cell_form_a_pair() -> None:
    cells = (3, 2, 2)
    mesh = box("wedge", cells, place=shaken(2, 0.1, cells))
    ((_, elements),) = mesh.blocks
    for first, second in elements[numpy_fem.wedge_pairs(mesh, elements)]:
        both = mesh.nodes[np.union1d(first, second)]
        assert len(both) == 8
        assert (np.ptp(np.round(both * cells), axis=0) == 1).all(), "the corners of a cell"


def test_every_stored_answer_belongs_to_its_problem() -> None:
    for solver, name, shape, law in pairs():
        stated = problem(name, shape, law)
        assert references.read(solver, name, shape, law, stated).shape == stated.mesh.nodes.shape


def test_a_changed_problem_is_noticed() -> None:
    other = PROBLEMS["cantilever"](box("hexahedron", CELLS, (*SIZE_M[:2], 0.041)), LAWS["hooke"])
    with pytest.raises(references.StaleReferenceError, match="remake"):
        references.read("scikit-fem", "cantilever", "hexahedron", "hooke", other)
