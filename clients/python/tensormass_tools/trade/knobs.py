"""The choices that a scene leaves open. A setting is an edit of the scene file, so the written file is the measured
scene."""

from __future__ import annotations

import copy
import math
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import yaml
from google.protobuf.descriptor import Descriptor

from tensormass import ORGANS, SHAPES, InvalidArgumentError, Organ, SceneFile, write_mesh
from tensormass._shared import defaults
from tensormass._shared.enums import short_name
from tensormass._shared.files import replacing
from tensormass._shared.names import suggestion
from tensormass.v1 import edit_pb2, scene_pb2
from tensormass_tools.trade.scene_edits import (
    Value,
    each_body,
    set_contact_method,
    set_dt,
    set_integrator,
    solver_setter,
    with_numbers,
)
from tensormass_tools.trade.small_strain import ISOTROPIC_LAWS, small_strain

#: Values by the names of knobs. Knobs that are missing keep the value of the scene.
Setting = Mapping[str, Value]
#: Parts of the engine that exist once, so that there is nothing to choose or measure.
ONE_CHOICE = {
    "preconditioner": "block-Jacobi",
    "stream codec": "32-bit floats",
}
#: Quadratures that are the same for linear tetrahedra.
_ONE_POINT = ("full", "reduced")
_RESOLUTIONS = (0.5, 0.7, 1.0, 1.4, 2.0)
_DT_FACTORS = (2.0, 1.0, 0.5, 0.25)
_CG_SHARES = (0.1, 0.25, 1.0)
_CG_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
_NEWTON_ITERATIONS = (1, 2, 5)
_NEWTON_TOLERANCES = (1e-2, 1e-3, 1e-4)
_LAGS = (16, 8, 1)
#: Knobs that change how accurately a step is solved, but not the problem.
SOLVE_KNOBS = (
    "newton_max_iterations",
    "newton_tolerance",
    "cg_max_iterations",
    "cg_tolerance",
    "precision",
    "tangent_lag_steps",
)


@dataclass(frozen=True)
class Knob:
    """One choice. `values` include the scene's own; ordered ones go from cheap to expensive."""

    name: str
    what: str
    own: Value
    values: tuple[Value, ...]
    #: True if the values have an order.
    ordered: bool = False

    def others(self, nearest: bool = False) -> list[Value]:
        """Returns the values except the scene's own; `nearest`: of an ordered knob only its two neighbours."""
        at = self.values.index(self.own)
        near = self.values[max(0, at - 1) : at + 2] if nearest and self.ordered else self.values
        return [value for value in near if value != self.own]


class Knobs:
    """Finds the choices of one scene and applies settings to its file.

    Args:
        file: a scene that the daemon accepts. A built-in organ is meshed again for each resolution.
        mesh_folder: for those meshes.
    """

    def __init__(self, file: SceneFile, mesh_folder: Path) -> None:
        self.message = file.message()
        self.file = replace(file, fields=with_numbers(file.fields, cast(Descriptor, self.message.DESCRIPTOR)))
        self.mesh_folder = mesh_folder
        self._made: set[Path] = set()
        #: True if all bodies are in selective quadrature.
        self.is_selective = all(body.quadrature == scene_pb2.QUADRATURE_SELECTIVE for body in self.message.bodies)
        self.quasi_static = self.message.solver.integrator == scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
        #: Knobs by name.
        self.knobs: dict[str, Knob] = {}
        #: Reason why there is nothing to choose, by the name of the knob.
        self.without: dict[str, str] = {name: f"one choice, not measured: {what}" for name, what in ONE_CHOICE.items()}
        self._setters: dict[str, Callable[[dict[str, Any], Value], None]] = {
            "resolution": self._set_resolution,
            "grading": self._set_grading,
            "shape": self._set_shape,
            "law": self._set_law,
            "element_order": self._set_element_order,
            "quadrature": lambda fields, value: each_body(fields, lambda body: body.update(quadrature=value)),
            "mass": lambda fields, value: each_body(fields, lambda body: body.update(mass=value)),
            "dt_s": set_dt,
            **{name: solver_setter(name) for name in SOLVE_KNOBS},
            "integrator": set_integrator,
            "contact_method": set_contact_method,
        }
        self._find_mesh_knobs()
        self._find_law_knob()
        self._find_time_knobs()
        self._find_solver_knobs()
        self._find_contact_knob()
        #: Knobs of the mesh that a reference may refine, even if `choose` drops them.
        self.refinable = {"resolution", "grading", "shape", "element_order"} & set(self.knobs)

    # --- settings -----------------------------------------------------------------------------------------------------

    def canonical(self, setting: Setting) -> dict[str, Value]:
        """Drops values that equal the scene's own or have no effect, and sorts by the order of the knobs."""
        kept = {name: setting[name] for name in self.knobs if name in setting and setting[name] != self.knobs[name].own}
        if self._has_one_point(kept) and kept.get("quadrature") in _ONE_POINT:
            if self.knobs["quadrature"].own in _ONE_POINT:
                kept.pop("quadrature")
            else:
                kept["quadrature"] = _ONE_POINT[0]
        if self.value(kept, "integrator") == "quasi_static" and not self.quasi_static:
            kept.pop("mass", None)
        # Newton's method, also that of equilibrium, evaluates every element.
        newton = self.value(kept, "newton_max_iterations") not in (None, 1)
        if newton or self.value(kept, "integrator") == "quasi_static":
            kept.pop("tangent_lag_steps", None)
            if "tangent_lag_steps" in self.knobs and self.knobs["tangent_lag_steps"].own != 1:
                kept["tangent_lag_steps"] = 1
        return {name: kept[name] for name in self.knobs if name in kept}

    def _has_one_point(self, setting: Setting) -> bool:
        """Tells whether all elements are linear tetrahedra in a setting."""
        if "shape" in setting:
            return setting["shape"] == "tetrahedron"
        is_linear = setting.get("element_order", self._own_order) == "as_given"
        return self._own_shape == "tetrahedron" and is_linear

    def value(self, setting: Setting, name: str) -> Value | None:
        """Returns the value of a knob in a setting; None if there is no such knob."""
        if name in setting:
            return setting[name]
        return self.knobs[name].own if name in self.knobs else None

    def effort(self, setting: Setting) -> tuple[float, ...]:
        """Returns how accurately a setting is solved, for each of `SOLVE_KNOBS`; more is better. The daemon's defaults,
        which depend on the integrator, replace values that neither scene nor setting has."""
        solver = scene_pb2.Solver()
        solver.CopyFrom(self.message.solver)
        for name, value in setting.items():
            if name in _SOLVER_FIELDS:
                kind = solver.DESCRIPTOR.fields_by_name[name].enum_type
                number = kind.values_by_name[f"{name.upper()}_{str(value).upper()}"].number if kind else value
                setattr(solver, name, number)
        return (
            defaults.newton_max_iterations(solver),
            -defaults.newton_tolerance(solver),
            defaults.cg_max_iterations(solver),
            -defaults.cg_tolerance(solver),
            solver.precision == scene_pb2.Solver.PRECISION_DOUBLE,
            -defaults.tangent_lag_steps(solver),
        )

    def solved_better(self, setting: Setting) -> dict[str, Value]:
        """Returns the setting without the values by which it is solved worse than the scene."""
        of_scene = self.effort({name: value for name, value in setting.items() if name not in SOLVE_KNOBS})
        worse = [
            name for name, own, ours in zip(SOLVE_KNOBS, of_scene, self.effort(setting), strict=True) if own > ours
        ]
        return self.canonical({name: value for name, value in setting.items() if name not in worse})

    def apply(self, setting: Setting) -> SceneFile:
        """Returns the scene file with these values. All other fields are unchanged."""
        fields = copy.deepcopy(self.file.fields)
        for name, value in setting.items():
            self._setters[name](fields, value)
        return replace(self.file, fields=fields)

    def choose(self, names: Iterable[str]) -> None:
        """Keeps only these knobs.

        Raises:
            InvalidArgumentError: the scene has no such knob; the message says why.
        """
        names = list(names)
        for name in names:
            if name not in self.knobs:
                raise InvalidArgumentError(
                    f"knob {name!r}: " + (self.without.get(name) or f"unknown; {suggestion(name, self.knobs)}")
                )
        self.without.update({name: "not asked for" for name in self.knobs if name not in names})
        self.knobs = {name: knob for name, knob in self.knobs.items() if name in names}

    def write(self, setting: Setting, path: Path, comment: str) -> None:
        """Writes the scene of a setting as a file that needs nothing else; meshes of built-in organs go into its
        folder."""
        file = self.apply(setting)

        def place(of: dict[str, Any]) -> None:
            source = (file.directory / of["file"]).resolve()
            if file.builtin is None:
                of["file"] = os.path.relpath(source, path.resolve().parent)
            else:
                of["file"] = f"{path.stem}_{source.name}"
                shutil.copyfile(source, path.with_name(of["file"]))

        for body in file.fields["bodies"]:
            for of in (body["mesh"], body.get("skin", {})):
                if "file" in of:
                    place(of)
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        with replacing(path) as aside:
            aside.write_text(lines + yaml.safe_dump(file.fields, sort_keys=False, allow_unicode=True), "utf-8")

    # --- what there is to choose --------------------------------------------------------------------------------------

    def _add(self, name: str, what: str, own: Value, values: Sequence[Value], ordered: bool = False) -> None:
        if own not in values:
            values = [own, *values]
        self.knobs[name] = Knob(name, what, own, tuple(dict.fromkeys(values)), ordered)

    def _find_mesh_knobs(self) -> None:
        bodies = self.message.bodies
        grids, reasons = [], []
        for index, body in enumerate(bodies):
            own = self.file.fields["bodies"][index]["mesh"]
            grids.append("grid" in own)
            if "grid" not in own and self._organ(own) is None:
                reasons.append(f"body {body.name!r}: its mesh comes from a file")
            elif _names_single_nodes(body, carried=() if "grid" in own else (Organ.HELD,)):
                reasons.append(f"body {body.name!r}: node numbers or element fields belong to its mesh as it is")
        if reasons:
            self.without["resolution"] = "; ".join(reasons)
        else:
            self._add("resolution", "elements along an edge, against the scene's own", 1.0, _RESOLUTIONS, True)
        organs = [self._organ(self.file.fields["bodies"][index]["mesh"]) for index in range(len(bodies))]
        if reasons or any(organ is None or ORGANS[organ[0]].focus is None for organ in organs):
            self.without["grading"] = "; ".join(reasons) or "only the built-in liver has a place where tools act"
        else:
            self._add("grading", "cells of one size, or smaller where tools act", "graded", ("uniform", "graded"))
        shapes = {_shape_of_grid(body) for body in bodies if body.mesh.WhichOneof("source") == "grid"}
        orders = {body.element_order or scene_pb2.ELEMENT_ORDER_AS_GIVEN for body in bodies}
        self._own_shape = "tetrahedron" if all(map(_is_tetrahedral, bodies)) else "any"
        self._own_order = "as_given" if orders == {scene_pb2.ELEMENT_ORDER_AS_GIVEN} else "quadratic"
        if reasons or not all(grids):
            self.without["shape"] = "; ".join(reasons) or "only grids are cut into any shape"
        elif len(shapes) > 1:
            self.without["shape"] = "the grids differ"
        else:
            self._add("shape", "shape of the elements", shapes.pop(), tuple(SHAPES))
        if "shape" in self.knobs:
            self.without["element_order"] = "one of the shapes is quadratic"
        elif self._own_shape != "tetrahedron":
            self.without["element_order"] = "only linear tetrahedra can be made quadratic"
        elif len(orders) > 1:
            self.without["element_order"] = "the bodies differ"
        else:
            self._add("element_order", "order of the tetrahedra", self._own_order, _ORDERS)
        quadratures = {body.quadrature or scene_pb2.QUADRATURE_FULL for body in bodies}
        if len(quadratures) > 1:
            self.without["quadrature"] = "the bodies differ"
        else:
            own = short_name(scene_pb2.Quadrature.DESCRIPTOR, quadratures.pop())
            self._add("quadrature", "points an element's energy is summed over", own, ("reduced", "selective", "full"))

    def _find_law_knob(self) -> None:
        laws = {body.law.WhichOneof("kind") or "" for body in self.message.bodies}
        if any(body.law_regions for body in self.message.bodies):
            self.without["law"] = "regions have laws of their own"
        elif any(small_strain(body.law) is None for body in self.message.bodies):
            self.without["law"] = f"{', '.join(sorted(laws))} has no isotropic law that equals it for small strains"
        else:
            self._add("law", "law, of equal stiffness for small strains", "+".join(sorted(laws)), ISOTROPIC_LAWS)

    def _find_time_knobs(self) -> None:
        dt_s = defaults.dt_s(self.message)
        if self.quasi_static:
            self.without["integrator"] = self.without["mass"] = "the scene asks for equilibrium"
            if defaults.scheduled_s(self.message) == 0 and not self.message.tools:
                self.without["dt_s"] = "equilibrium under constant loads knows no time"
                return
        self._add("dt_s", "simulated time of a step [s]", dt_s, [dt_s * factor for factor in _DT_FACTORS], True)
        if self.quasi_static:
            return
        own = self.message.solver.integrator or scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER
        integrators = ["implicit_euler", "bdf2"]
        if all(body.fixed or body.prescribed for body in self.message.bodies):
            integrators.append("quasi_static")
        self._add("integrator", "time scheme", short_name(scene_pb2.Solver.Integrator.DESCRIPTOR, own), integrators)
        masses = {body.mass or scene_pb2.MASS_LUMPED for body in self.message.bodies}
        if len(masses) > 1:
            self.without["mass"] = "the bodies differ"
        else:
            self._add(
                "mass",
                "mass at the nodes or over the elements",
                short_name(scene_pb2.Mass.DESCRIPTOR, masses.pop()),
                _MASSES,
            )

    def _find_solver_knobs(self) -> None:
        solver = self.message.solver
        newton = defaults.newton_max_iterations(solver)
        counts = sorted({*_NEWTON_ITERATIONS, newton})
        self._add("newton_max_iterations", "linearized solves a step, at most", newton, counts, True)
        if newton > 1:
            tolerance = defaults.newton_tolerance(solver)
            tolerances = sorted({*_NEWTON_TOLERANCES, tolerance}, reverse=True)
            self._add("newton_tolerance", "residual of the forces that ends a step", tolerance, tolerances, True)
        else:
            self.without["newton_tolerance"] = "one linearized solve a step"
        most = defaults.cg_max_iterations(solver)
        counts = sorted({max(1, round(share * most)) for share in _CG_SHARES})
        self._add("cg_max_iterations", "conjugate-gradient iterations a solve, at most", most, counts, True)
        tolerance = defaults.cg_tolerance(solver)
        tolerances = sorted({*_CG_TOLERANCES, tolerance}, reverse=True)
        self._add("cg_tolerance", "residual that ends a solve", tolerance, tolerances, True)
        if self.quasi_static or newton > 1:
            self.without["tangent_lag_steps"] = "Newton's method evaluates every element"
        else:
            lag = defaults.tangent_lag_steps(solver)
            lags = sorted({*_LAGS, lag}, reverse=True)
            self._add("tangent_lag_steps", "steps from one evaluation of an element to the next", lag, lags, True)
        precision = "double" if solver.precision == scene_pb2.Solver.PRECISION_DOUBLE else "float"
        self._add("precision", "of the numbers", precision, ("float", "double"))

    def _find_contact_knob(self) -> None:
        methods = {tool.contact_method or edit_pb2.CONTACT_METHOD_PENALTY for tool in self.message.tools}
        if len(methods) != 1:
            self.without["contact_method"] = "the tools differ" if methods else "the scene has no tools"
        else:
            own = short_name(edit_pb2.ContactMethod.DESCRIPTOR, methods.pop())
            self._add("contact_method", "how contacts of tools carry their load", own, _CONTACT_METHODS)

    # --- edits of the file --------------------------------------------------------------------------------------------

    def _set_resolution(self, fields: dict[str, Any], value: Value) -> None:
        factor = float(value)

        def set_of(body: dict[str, Any]) -> None:
            mesh = body["mesh"]
            if "grid" in mesh:
                for axis in ("cells_x", "cells_y", "cells_z"):
                    mesh["grid"][axis] = max(1, math.floor(mesh["grid"][axis] * factor + 0.5))
                return
            organ = self._organ(mesh)
            assert organ is not None
            mesh["file"] = self._mesh_again(organ[0], factor, organ[2])

        each_body(fields, set_of)

    def _set_grading(self, fields: dict[str, Any], value: Value) -> None:
        def set_of(body: dict[str, Any]) -> None:
            organ = self._organ(body["mesh"])
            assert organ is not None
            body["mesh"]["file"] = self._mesh_again(organ[0], organ[1], value == "graded")

        each_body(fields, set_of)

    def _mesh_again(self, name: str, factor: float, graded: bool) -> str:
        """Meshes an organ with `factor` times the cells along an edge. Returns the file, which `_organ` knows again."""
        path = (self.mesh_folder / f"{name}-{'graded' if graded else 'uniform'}-{factor:g}.msh").resolve()
        if path not in self._made:
            self.mesh_folder.mkdir(parents=True, exist_ok=True)
            organ = replace(ORGANS[name], cell_m=ORGANS[name].cell_m / factor)
            write_mesh(path, organ.volume(graded=graded))
            self._made.add(path)
        return str(path)

    def _organ(self, mesh: Mapping[str, Any]) -> tuple[str, float, bool] | None:
        """Returns the built-in organ of a mesh, its resolution, and whether it is graded; None for other meshes, which
        cannot be meshed again."""
        name, *made = Path(mesh.get("file", "")).stem.split("-")
        if self.file.builtin is None or name not in ORGANS:
            return None
        return (name, float(made[1]), made[0] == "graded") if made else (name, 1.0, ORGANS[name].focus is not None)

    def _set_shape(self, fields: dict[str, Any], value: Value) -> None:
        def set_of(body: dict[str, Any]) -> None:
            body["mesh"]["grid"]["shape"] = value
            body.pop("element_order", None)  # the shape says it

        each_body(fields, set_of)

    def _set_element_order(self, fields: dict[str, Any], value: Value) -> None:
        each_body(fields, lambda body: body.update(element_order=value))

    def _set_law(self, fields: dict[str, Any], value: Value) -> None:
        for body, message in zip(fields["bodies"], self.message.bodies, strict=True):
            constants = small_strain(message.law)
            assert constants is not None
            body["law"] = {
                str(value): dict(zip(("young_modulus_pa", "poisson_ratio"), constants, strict=True)),
                **{key: of for key, of in body["law"].items() if key == "prony"},
            }


_MASSES = ("lumped", "consistent")
_ORDERS = ("as_given", "quadratic")
_CONTACT_METHODS = ("penalty", "augmented_lagrangian")
_SOLVER_FIELDS = ("integrator", *SOLVE_KNOBS)


def _names_single_nodes(body: scene_pb2.Body, carried: Sequence[str]) -> bool:
    """Tells whether a body refers to nodes or elements by number. The sets `carried` are made with its mesh."""
    sets = [named for named in body.sets if named.name not in carried]
    regions = [*body.fixed, *(load.region for load in body.loads), *(of.region for of in body.law_regions)]
    regions += [of.region for of in body.prescribed] + [region for named in sets for region in named.regions]
    fields = body.element_fields
    of_elements = fields.young_modulus_pa or fields.poisson_ratio or fields.fibre_directions
    return bool(of_elements) or any(region.WhichOneof("kind") == "nodes" for region in regions)


def _shape_of_grid(body: scene_pb2.Body) -> str:
    if body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC:
        return "quadratic_tetrahedron"
    number = body.mesh.grid.shape or scene_pb2.SHAPE_TETRAHEDRON
    return short_name(scene_pb2.Shape.DESCRIPTOR, number)


def _is_tetrahedral(body: scene_pb2.Body) -> bool:
    """Tells whether the body's mesh, before its element order, has only linear tetrahedra."""
    if body.mesh.WhichOneof("source") == "grid":
        return (body.mesh.grid.shape or scene_pb2.SHAPE_TETRAHEDRON) == scene_pb2.SHAPE_TETRAHEDRON
    shapes = {block.shape or scene_pb2.SHAPE_TETRAHEDRON for block in body.mesh.packed.elements}
    return shapes == {scene_pb2.SHAPE_TETRAHEDRON}
