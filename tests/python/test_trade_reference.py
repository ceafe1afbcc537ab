"""The reference of `tensormass trade`: the scene refined until it no longer moves, without a daemon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import pytest
from trade_parts import BLOCK, MACHINE, Formula, knobs_of

import tensormass as tm
from tensormass.v1 import scene_pb2
from tensormass_tools.trade import reference
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Store


def test_the_reference_is_refined_until_its_own_error_is_a_third_of_the_tolerance(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK.replace("cells_x: 4", "cells_x: 40"), tmp_path)
    script = Script.of(knobs.message, None)
    formula, said = Formula(knobs.message, script), list[str]()

    def find(tolerance: float, limit_s: float) -> reference.Reference:
        return reference.find(
            knobs,
            script,
            formula,  # type: ignore[arg-type]
            Store(tmp_path),
            MACHINE,
            tolerance=tolerance,
            limit_s=limit_s,
            say=said.append,
        )

    found = find(0.02, 1e9)
    assert found.ended == "below a third of the tolerance"
    assert not found.raises_order
    assert found.order == 1.0  # the observed order is 2
    true_error = found.recording.displacement[0].max() - 1
    assert true_error < found.displacement_error < 3 * true_error
    assert found.displacement_error < 0.02 / 3
    # Quadratic tetrahedra with the same limit leave the error bar as it is.
    assert found.is_approached
    assert not found.raised
    assert [of.setting["resolution"] for of in found.other] == [of.setting["resolution"] for of in found.levels[-4:-1]]
    assert {of.setting["shape"] for of in found.other} == {"quadratic_tetrahedron"}
    assert len(said) == len(found.levels) + len(found.other) == formula.runs
    for name, value in {
        "integrator": "bdf2",
        "shape": "hexahedron",
        "quadrature": "selective",
        "precision": "double",
    }.items():
        assert found.levels[-1].setting[name] == value
    before = formula.runs
    assert find(0.02, 1e9) == replace(found, recording=ANY)  # taken from the folder
    assert formula.runs == before
    finer = find(0.002, 1e9)
    assert len(finer.levels) > len(found.levels)
    in_quadratic_ones = {of.setting["resolution"] for of in (*found.other, *finer.other)}
    assert formula.runs == len(finer.levels) + len(in_quadratic_ones)
    limited = find(1e-9, 30.0)
    assert "--reference-seconds 30" in limited.ended
    assert limited.error > 1e-9


@pytest.mark.parametrize("factor", [1.0, 1.09])
def test_a_distance_that_the_other_discretization_does_not_explain_raises_the_error_bar(
    tmp_path: Path, factor: float
) -> None:
    class Shifted(Formula):
        """Quadratic tetrahedra converge to `factor` times the limit of hexahedra."""

        def record(self, scene: scene_pb2.Scene) -> Recording:
            found = super().record(scene)
            if scene.bodies[0].mesh.grid.shape != scene_pb2.SHAPE_QUADRATIC_TETRAHEDRON:
                return found
            return replace(found, displacement=[factor * of for of in found.displacement], force=factor * found.force)

    knobs = knobs_of(BLOCK.replace("cells_x: 4", "cells_x: 40"), tmp_path)
    script = Script.of(knobs.message, None)
    shifted, store = Shifted(knobs.message, script), Store(tmp_path)
    found = reference.find(knobs, script, shifted, store, MACHINE, tolerance=0.02, limit_s=1e9, say=lambda _: None)  # type: ignore[arg-type]
    assert found.raised == (factor > 1)
    assert ("; raised, because the error of the quadratic tetrahedra" in "".join(found.text())) == found.raised
    assert found.force_error is not None
    for error in (found.displacement_error, found.force_error):
        assert (error > 0.05) == found.raised
    assert found.to_plain()["raised"] == found.raised


def test_inverted_elements_end_the_other_discretization(tmp_path: Path) -> None:
    class Inverting(Formula):
        def record(self, scene: scene_pb2.Scene) -> Recording:
            is_other = scene.bodies[0].mesh.grid.shape == scene_pb2.SHAPE_QUADRATIC_TETRAHEDRON
            return replace(super().record(scene), min_det_f=-0.5 if is_other else 0.9)

    knobs = knobs_of(BLOCK, tmp_path)
    script, said = Script.of(knobs.message, None), list[str]()
    inverting, store = Inverting(knobs.message, script), Store(tmp_path)
    found = reference.find(knobs, script, inverting, store, MACHINE, tolerance=0.1, limit_s=1e9, say=said.append)  # type: ignore[arg-type]
    assert found.other == []
    assert said[-1] == "reference, in quadratic tetrahedra: inverted elements, det F down to -0.5"


def _of_tetrahedra(folder: Path, quadrature: str) -> Knobs:
    tm.write_mesh(folder / "own.msh", tm.grid([4, 4, 3], [0.1, 0.1, 0.05]))
    text = BLOCK[: BLOCK.index("grid:")] + "file: own.msh}" + BLOCK[BLOCK.index("\n    law") :]
    return knobs_of(text.replace("quadrature: selective", f"quadrature: {quadrature}"), folder)


def _make_refinable(knobs: Knobs) -> None:
    """Lets a mesh be refined as if it were that of a built-in organ."""
    knobs.refinable.add("resolution")
    knobs._setters["resolution"] = lambda fields, value: None


def test_tetrahedra_without_locking_are_their_own_reference(tmp_path: Path) -> None:
    knobs = _of_tetrahedra(tmp_path, "selective")
    _make_refinable(knobs)
    script, store = Script.of(knobs.message, None), Store(tmp_path)
    formula = Formula(knobs.message, script)
    found = reference.find(knobs, script, formula, store, MACHINE, tolerance=0.02, limit_s=1e9, say=lambda _: None)  # type: ignore[arg-type]
    assert "element_order" not in found.levels[-1].setting
    assert not found.raises_order
    assert found.other_name == "quadratic tetrahedra"
    assert [of.setting["resolution"] for of in found.other] == [of.setting["resolution"] for of in found.levels[-4:-1]]
    for of in found.other:
        assert (of.setting["element_order"], of.setting["quadrature"]) == ("quadratic", "full")


def test_the_reference_of_a_tetrahedral_mesh_is_quadratic(tmp_path: Path) -> None:
    knobs = _of_tetrahedra(tmp_path, "full")
    script, store = Script.of(knobs.message, None), Store(tmp_path)
    formula = Formula(knobs.message, script)
    found = reference.find(knobs, script, formula, store, MACHINE, tolerance=0.02, limit_s=1e9, say=lambda _: None)  # type: ignore[arg-type]
    assert found.levels[-1].setting["element_order"] == "quadratic"
    assert found.raises_order
    assert found.other == []  # the mesh is not refined, so linear tetrahedra have another limit


@pytest.mark.parametrize(("wrongness", "is_approached"), [((10, 5, 2), True), ((10, 10, 20), False)])
def test_refined_linear_tetrahedra_approach_a_quadratic_reference(
    tmp_path: Path, wrongness: tuple[float, ...], is_approached: bool
) -> None:
    class Tetrahedra(Formula):
        left = iter(wrongness)

        def record(self, scene: scene_pb2.Scene) -> Recording:
            is_linear = scene.bodies[0].element_order != scene_pb2.ELEMENT_ORDER_QUADRATIC
            self.wrongness = [next(self.left)] if is_linear else []
            return super().record(scene)

    knobs = _of_tetrahedra(tmp_path, "full")
    _make_refinable(knobs)
    script, said = Script.of(knobs.message, None), list[str]()

    def find(limit_s: float) -> reference.Reference:
        formula, store = Tetrahedra(knobs.message, script), Store(tmp_path / f"{limit_s}")
        formula.left = iter(wrongness)
        return reference.find(knobs, script, formula, store, MACHINE, tolerance=1e-9, limit_s=limit_s, say=said.append)  # type: ignore[arg-type]

    found = find(1e9)
    assert [of.setting["element_order"] for of in found.other] == ["as_given"] * 3
    assert [of.setting["resolution"] for of in found.other] == [of.setting["resolution"] for of in found.levels[-3:]]
    assert found.is_approached == is_approached
    assert found.text()[-1].startswith("in linear tetrahedra: 64 elements")
    assert f"reference, {found.text()[-1]}" == said[-1]
    # Almost all that is left is the error of a mesh that stands still, 1 % in quadratic tetrahedra.
    distances = [of.displacement for of in found.other]
    assert distances == pytest.approx([0.01 * (off - 1) / 1.01 for off in wrongness], rel=0.1)
    assert len(find(10.0).other) == 1  # no time for more


def test_a_level_that_fails_ends_the_refinement_only_where_there_are_two(tmp_path: Path) -> None:
    class Failing(Formula):
        at = 1

        def record(self, scene: scene_pb2.Scene) -> Recording:
            if self.runs + 1 == self.at:
                raise tm.ResourceExhaustedError("too many elements")
            return super().record(scene)

    knobs = knobs_of(BLOCK, tmp_path)
    script = Script.of(knobs.message, None)

    def find(at: int) -> reference.Reference:
        failing = Failing(knobs.message, script)
        failing.at = at
        store = Store(tmp_path / str(at))
        return reference.find(knobs, script, failing, store, MACHINE, tolerance=1e-9, limit_s=1e9, say=lambda _: None)  # type: ignore[arg-type]

    for at in (1, 2):
        with pytest.raises(tm.ResourceExhaustedError):
            find(at)
    found = find(3)
    assert found.ended == "the next level failed: too many elements"
    assert len(found.levels) == 2
    # The larger error of displacement and force.
    assert replace(found, displacement_error=0.1, force_error=0.2).error == 0.2
    assert replace(found, displacement_error=0.1, force_error=0.05).error == 0.1
    assert replace(found, displacement_error=0.1, force_error=None).error == 0.1


def test_a_level_of_one_step_takes_longer_by_its_mesh_alone(tmp_path: Path) -> None:
    still = BLOCK[: BLOCK.index("tools:")] + "solver: {integrator: quasi_static}\n"
    for text, growth in ((still, 1.5**3), (BLOCK, 1.5**4)):
        knobs = knobs_of(text.replace("cells_x: 4", "cells_x: 40"), tmp_path)
        script = Script.of(knobs.message, None)
        assert script.one_step == (text is still)
        formula, store = Formula(knobs.message, script), Store(tmp_path / f"{growth}")
        found = reference.find(knobs, script, formula, store, MACHINE, tolerance=1e-9, limit_s=1000, say=lambda _: None)  # type: ignore[arg-type]
        assert f"another level would take about {found.levels[-1].wall_s * growth:.0f} s" in found.ended
