"""Scenes, built from files, meshes or arrays."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy.typing as npt

from tensormass._shared.enums import enum_number
from tensormass._shared.errors import InvalidArgumentError, MeshFileWarning, naming
from tensormass._shared.files import read_bytes
from tensormass._shared.names import as_name, suggestion
from tensormass._shared.vectors import Vector, vector3
from tensormass._src import findings, mesh_files, mesh_units, meshes, node_conditions, notebook, textures
from tensormass._src.elastic_constants import young_poisson
from tensormass._src.laws import DEFAULT_LAW, LAWS, LIVER, law_message
from tensormass._src.links import Nodes, RestLength, make_attachment, make_contact
from tensormass._src.packing import add_what_the_mesh_carries, pack_mesh, pack_triangles
from tensormass._src.scene_file import SceneFile
from tensormass._src.solver_settings import Integrator, OnFault, Precision, set_fields
from tensormass._src.tools import make_tool
from tensormass.v1 import scene_pb2

if TYPE_CHECKING:
    import meshio


class Scene:
    """Holds a scene to load: `message`, the protobuf `tensormass.v1.Scene`, and the usual ways to make one.

    Whatever these methods do not offer is a field of `message`.
    """

    def __init__(self, name: str = "scene", message: scene_pb2.Scene | None = None) -> None:
        #: The protobuf message `tensormass.v1.Scene`.
        self.message = message if message is not None else scene_pb2.Scene(name=name)

    def __repr__(self) -> str:
        bodies = ", ".join(body.name for body in self.message.bodies)
        return f"Scene({self.message.name!r}, bodies: {bodies or 'none'})"

    def _repr_html_(self) -> str:
        return notebook.scene_html(self.message)

    @property
    def name(self) -> str:
        """Returns the name under which the daemon loads the scene."""
        return self.message.name

    @staticmethod
    def from_file(path: str | Path) -> Scene:
        """Reads a scene (.yaml, .yml) or a bare volume mesh, which becomes one body of soft tissue at rest.

        A mesh file has no unit of length. One that is larger than 5 m is taken as millimetres: a MeshFileWarning says
        so, and the body's `mesh.scale` is 0.001 then. In a scene file, `mesh.scale` decides.

        `path` may be the name of a built-in scene (`builtin_scenes`). A file of that name takes precedence.

        Raises:
            NotFoundError: the file, or a mesh that it names, does not exist.
            InvalidArgumentError: a mistake; the message names the file and the path of the field.
        """
        if SceneFile.is_mesh(path):
            mesh = mesh_files.read_mesh(Path(path))
            scene = Scene.from_mesh(mesh, name=as_name(Path(path).stem) or "scene")
            unit_m = mesh_units.guess_unit_m(mesh.nodes)
            if unit_m is not None:
                scene.message.bodies[0].mesh.scale = unit_m
                warnings.warn(f"{path}: {mesh_units.guess_in_words(mesh.nodes, unit_m)}", MeshFileWarning, stacklevel=2)
            return scene
        return Scene(message=SceneFile.read(path).message())

    @staticmethod
    def from_yaml(text: str, *, directory: str | Path = ".", where: str = "scene") -> Scene:
        """Parses the text of a scene file. Mesh files are relative to `directory`."""
        return Scene(message=SceneFile.parse(text, Path(directory), where).message())

    @staticmethod
    def from_arrays(nodes: npt.ArrayLike, tetrahedra: npt.ArrayLike, **options: Any) -> Scene:  # noqa: ANN401
        """Makes a scene of tetrahedra [n, 4] in VTK node order and nodes [node_count, 3] m. Options of `from_mesh`."""
        return Scene.from_mesh(meshes.VolumeMesh.from_tetrahedra(nodes, tetrahedra), **options)

    @staticmethod
    def from_meshio(mesh: meshio.Mesh, **options: Any) -> Scene:  # noqa: ANN401
        """Makes a scene of a `meshio.Mesh` in metres. Options of `from_mesh`."""
        return Scene.from_mesh(mesh_files.from_meshio(mesh), **options)

    @staticmethod
    def from_mesh(
        mesh: meshes.VolumeMesh,
        *,
        name: str = "scene",
        body: str = "body",
        gravity_m_per_s2: Vector | None = None,
        gravity_schedule: npt.ArrayLike | None = None,
        density_kg_per_m3: float = 1060.0,
        **options: Any,  # noqa: ANN401
    ) -> Scene:
        """Makes a scene of one body, by default of liver tissue. Add tools with `add_tool`.

        Args:
            gravity_schedule: pairs (time [s], factor) of gravity, as for `prescribe`.
            options: the further arguments of `add_body`.

        Raises:
            InvalidArgumentError: a mistake in an array; the message names array, row and remedy.
        """
        if gravity_schedule is not None and gravity_m_per_s2 is None:
            raise InvalidArgumentError("gravity_schedule: given without gravity_m_per_s2")
        scene = Scene(name)
        scene.add_body(body, mesh, density_kg_per_m3=density_kg_per_m3, **options)
        if gravity_m_per_s2 is not None:
            scene.message.gravity_m_per_s2.CopyFrom(vector3(gravity_m_per_s2, "gravity_m_per_s2"))
        if gravity_schedule is not None:
            schedule = node_conditions.schedule_message(gravity_schedule, "gravity_schedule")
            scene.message.gravity_schedule.CopyFrom(schedule)
        return scene

    def add_body(
        self,
        name: str,
        mesh: meshes.VolumeMesh,
        *,
        law: str = DEFAULT_LAW,
        constants: Mapping[str, float | Vector] | None = None,
        young_modulus_pa: float | None = None,
        poisson_ratio: float | None = None,
        lame_pa: tuple[float, float] | None = None,
        prony: Sequence[tuple[float, float]] = (),
        density_kg_per_m3: float,
        quadrature: str | None = None,
        mass: str | None = None,
        element_order: str | None = None,
        fixed: str | Sequence[str] = (),
        fixed_nodes: npt.ArrayLike | None = None,
        skin: meshes.TriangleSurface | None = None,
        texture: str | Path | bytes | None = None,
    ) -> scene_pb2.Body:
        """Adds a body and returns its message. Loads of regions and laws of regions are set there.

        `fix`, `prescribe`, `add_nodal_forces` and `set_initial_state` take arrays of single nodes.

        Args:
            mesh: elements in m; its named sets and element fields become those of the body.
            law: one of `LAWS`. The default stands an ordinary press. Scene files and messages name their law.
            constants: of the law, by name: `{"c10_pa": 2000, "c01_pa": 500, "bulk_modulus_pa": 1e6}`.
            young_modulus_pa: a constant of many laws; default 4 kPa if `constants` is not given.
            poisson_ratio: likewise; default 0.45 if `constants` is not given.
            lame_pa: Lamé's λ and μ [Pa], instead of these two.
            prony: (share, relaxation time [s]) of each term.
            quadrature: "full" (default), "reduced" or "selective".
            mass: "lumped" (default) or "consistent".
            element_order: "as_given" (default), or "quadratic" to make linear tetrahedra quadratic: the daemon adds
                a node in the middle of each edge, after the mesh's own nodes.
            fixed: names of sets whose nodes do not move.
            fixed_nodes: further nodes that do not move, indices [k] or mask [node_count].
            skin: a finer surface that moves with the body; clients see it instead of the boundary.
            texture: a picture on the skin, which needs texture coordinates: a PNG or JPEG, its file or its bytes.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it and the known values.
        """
        given = dict(constants or {})
        if constants is None and law in LAWS:
            fields = getattr(scene_pb2.Law(), law).DESCRIPTOR.fields_by_name
            given = {name: value for name, value in LIVER.items() if name in fields}
        if lame_pa is not None:
            if young_modulus_pa is not None or poisson_ratio is not None:
                raise InvalidArgumentError(f"{name}.lame_pa: given with young_modulus_pa or poisson_ratio; choose one")
            with naming(f"{name}.lame_pa"):
                young_modulus_pa, poisson_ratio = young_poisson(*lame_pa)
        if young_modulus_pa is not None:
            given["young_modulus_pa"] = young_modulus_pa
        if poisson_ratio is not None:
            given["poisson_ratio"] = poisson_ratio
        body = scene_pb2.Body(name=name, mesh=scene_pb2.Mesh(packed=pack_mesh(mesh)))
        body.law.CopyFrom(law_message(law, given, prony, where=f"{name}.law"))
        body.density_kg_per_m3 = density_kg_per_m3
        if quadrature is not None:
            body.quadrature = cast(
                scene_pb2.Quadrature,
                enum_number(scene_pb2.Quadrature.DESCRIPTOR, quadrature, f"{name}.quadrature"),
            )
        if mass is not None:
            body.mass = cast(scene_pb2.Mass, enum_number(scene_pb2.Mass.DESCRIPTOR, mass, f"{name}.mass"))
        if element_order is not None:
            body.element_order = cast(
                scene_pb2.ElementOrder,
                enum_number(scene_pb2.ElementOrder.DESCRIPTOR, element_order, f"{name}.element_order"),
            )
        add_what_the_mesh_carries(body, mesh, name)
        for set_name in [fixed] if isinstance(fixed, str) else fixed:
            if set_name not in mesh.sets:
                raise InvalidArgumentError(
                    f"{name}.fixed: the mesh has no set {set_name!r}; {suggestion(set_name, mesh.sets)}"
                )
            body.fixed.add().set = set_name
        if fixed_nodes is not None:
            indices = meshes.node_indices(fixed_nodes, len(mesh.nodes), f"{name}.fixed_nodes")
            body.fixed.add().nodes.indices.extend(indices.tolist())
        if skin is not None:
            body.skin.packed.CopyFrom(pack_triangles(skin))
        if texture is not None:
            if skin is None:
                raise InvalidArgumentError(f"{name}.texture: needs a skin to lie on; give one")
            body.texture.image = texture if isinstance(texture, bytes) else read_bytes(Path(texture))
            body.texture.coordinates = textures.coordinates(skin, f"{name}.texture")
        self.message.bodies.append(body)
        return self.message.bodies[-1]

    def body(self, name: str) -> scene_pb2.Body:
        """Returns the message of a body.

        Raises:
            InvalidArgumentError: no body of this name.
        """
        for body in self.message.bodies:
            if body.name == name:
                return body
        known = suggestion(name, [body.name for body in self.message.bodies])
        raise InvalidArgumentError(f"scene {self.name!r} has no body {name!r}; {known}")

    def fix(self, body: str, nodes: npt.ArrayLike | str, *, axes: str = "xyz") -> None:
        """Fixes nodes, in all directions or along some axes only.

        Args:
            nodes: indices [k], a mask [node_count], or the name of a set of the body.
            axes: the directions in which the nodes do not move: "z" makes a plane of symmetry.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it.
        """
        node_conditions.fix(self.body(body), nodes, axes)

    def prescribe(
        self,
        body: str,
        displacement_m: npt.ArrayLike,
        nodes: npt.ArrayLike | str | None = None,
        *,
        axes: str = "xyz",
        schedule: npt.ArrayLike | None = None,
    ) -> None:
        """Prescribes displacements of nodes from their rest positions.

        Nodes of equal displacement share an entry of the protocol; the daemon takes 65,536 entries.

        Args:
            displacement_m: [k, axes] m, a column for each of `axes`; or [axes] m, the same for all nodes.
            nodes: indices [k], a mask [node_count], the name of a set of the body (takes [axes] only), or None for all
                nodes.
            axes: the prescribed directions. The others stay free.
            schedule: pairs (time [s], factor), [points, 2]; the factor is linear in between and constant outside. None:
                1 from the first step.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it.
        """
        node_conditions.prescribe(self.body(body), displacement_m, nodes, axes, schedule)

    def add_nodal_forces(
        self,
        body: str,
        forces_n: npt.ArrayLike,
        nodes: npt.ArrayLike | None = None,
        *,
        schedule: npt.ArrayLike | None = None,
    ) -> None:
        """Adds forces on single nodes. They add to the loads that the body has.

        Nodes of equal force share an entry of the protocol; the daemon takes 65,536 entries.

        Args:
            forces_n: [k, 3] N, a row for each node.
            nodes: indices [k], a mask [node_count], or None for all nodes. Forces on the same node add up.
            schedule: as for `prescribe`.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it.
        """
        node_conditions.add_nodal_forces(self.body(body), forces_n, nodes, schedule)

    def set_initial_state(
        self,
        body: str,
        *,
        displacement_m: npt.ArrayLike | None = None,
        velocity_m_per_s: npt.ArrayLike | None = None,
    ) -> None:
        """Sets how a body starts, also after a reset. None leaves a part as it is.

        Args:
            displacement_m: [node_count, 3] m from the rest positions; zero at fixed nodes.
            velocity_m_per_s: [node_count, 3] m/s; zero at fixed nodes. A quasi-static scene has none.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it.
        """
        node_conditions.set_initial_state(self.body(body), displacement_m, velocity_m_per_s)

    def accept(self, code: str, *, reason: str, body: str = "", tool: str = "") -> None:
        """Accepts a finding of the scene: it stays in the report, marked, and nobody is warned of it.

        Args:
            code: of the finding, such as "locking"; docs/findings.md lists all.
            reason: why it is right for this scene.
            body: only findings that concern this body; empty: any.
            tool: only findings that concern this tool; empty: any.

        Raises:
            InvalidArgumentError: an unknown code.
        """
        number = findings.code_number(code)
        self.message.accepted_findings.add(code=number, reason=reason, body=body, tool=tool)

    def set_solver(
        self,
        *,
        integrator: Integrator | None = None,
        precision: Precision | None = None,
        cg_max_iterations: int | None = None,
        cg_tolerance: float | None = None,
        newton_max_iterations: int | None = None,
        newton_tolerance: float | None = None,
        allow_unconverged: bool | None = None,
        cpu_threads: int | None = None,
        coarse_level: bool | None = None,
        tangent_lag_steps: int | None = None,
        tangent_lag_strain: float | None = None,
    ) -> None:
        """Changes settings of the solver. None leaves a setting as it is; `Solver` in scene.proto has the defaults.

        Args:
            integrator: "implicit_euler", "bdf2", "implicit_midpoint" or "quasi_static".
            precision: "float" or "double".
            cg_max_iterations: limit of conjugate-gradient iterations of a linear solve.
            cg_tolerance: residual at which a linear solve ends, relative to its right-hand side.
            newton_max_iterations: limit of linear solves in a step; 1 linearizes once.
            newton_tolerance: residual at which Newton's method ends, relative to the forces at work.
            allow_unconverged: keep a quasi-static step that ends above it, instead of stopping the scene.
            cpu_threads: threads of the scene on the CPU backend.
            coarse_level: whether linear solves know the rigid motion of pieces of bodies, as stiff, slender ones need.
                Without a value a scene has it once a solve takes more than 80 iterations. A GPU that streams the matrix
                of a very large scene has none.
            tangent_lag_steps: steps from one evaluation of an element to the next. In between its force follows its
                last tangent. Not with Newton's method.
            tangent_lag_strain: change of a component of its deformation gradient that has an element evaluated at once.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it. The daemon checks the ranges.
        """
        settings = {name: value for name, value in locals().items() if name != "self"}
        set_fields(self.message.solver, "set_solver", settings)

    def set_stepping(self, *, dt_s: float | None = None, rate_hz: float | None = None) -> None:
        """Changes the time step. None leaves a setting as it is.

        Args:
            dt_s: simulated time of a step [s].
            rate_hz: steps in a second of real time; a scene in lockstep ignores it.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it. The daemon checks the ranges.
        """
        set_fields(self.message.stepping, "set_stepping", {"dt_s": dt_s, "rate_hz": rate_hz})

    def set_guard(
        self,
        *,
        max_move_m: float | None = None,
        max_distance_m: float | None = None,
        max_energy_ratio: float | None = None,
        on_fault: OnFault | None = None,
    ) -> None:
        """Changes the bounds of a step, and what follows a step that leaves them. None leaves a setting as it is.

        Args:
            max_move_m: largest motion of a node in a step [m]. Default: about the size of the scene.
            max_distance_m: largest distance of a node from its rest position, if every body has fixed nodes [m].
                Default: ten times that of `max_move_m`.
            max_energy_ratio: largest kinetic energy, relative to the energy that is available to the scene. Default: 4.
            on_fault: "go_on": tools back off or let go, or the tissue is held. "stop": the scene stops until it is
                reset. Default: "go_on" in a scene with a tool that takes poses, else "stop". A quasi-static scene
                always stops.

        Raises:
            InvalidArgumentError: a wrong argument; the message names it. The daemon checks the ranges.
        """
        settings = {name: value for name, value in locals().items() if name != "self"}
        set_fields(self.message.guard, "set_guard", settings)

    def add_spherical_probe(
        self, name: str, *, radius_m: float, position_m: Vector, max_speed_m_per_s: float | None = None
    ) -> scene_pb2.Tool:
        """Adds a probe and returns its message. The probe stays at `position_m` until its first pose."""
        return self.add_tool(
            name, "spherical_probe", position_m=position_m, max_speed_m_per_s=max_speed_m_per_s, radius_m=radius_m
        )

    def add_tool(
        self,
        name: str,
        kind: str,
        *,
        position_m: Vector,
        orientation: Vector | None = None,
        max_speed_m_per_s: float | None = None,
        friction_coefficient: float = 0.0,
        joint_values: Vector = (),
        fixed: bool = False,
        mass_kg: float | None = None,
        coupling_stiffness_n_per_m: float | None = None,
        coupling_damping_n_s_per_m: float | None = None,
        contact_method: str | None = None,
        max_force_n: float | None = None,
        max_torque_n_m: float | None = None,
        max_joint_load: float | None = None,
        cautery_power_w: float | None = None,
        cautery_efficiency: float | None = None,
        dissection_reach_m: float | None = None,
        dissection_length_m: float | None = None,
        **shape: float | Vector | meshes.TriangleSurface,
    ) -> scene_pb2.Tool:
        """Adds a tool of any kind and returns its message. It stays where it is until its first pose.

        Args:
            kind: a kind of the protocol's `Tool`, such as "spherical_probe", "grasper", "box", "plane" or "mesh".
            orientation: quaternion w, x, y, z; None is the identity.
            friction_coefficient: Coulomb's coefficient between the tool and tissue; 0 for a smooth tool.
            joint_values: one for each joint [rad or m]; empty: the least of each.
            fixed: whether it is an obstacle, for which poses are refused.
            mass_kg: makes the tool a rigid body that a spring and a damper pull towards its pose; the hand feels those.
            coupling_stiffness_n_per_m: of that spring; None: 1000.
            coupling_damping_n_s_per_m: of that damper; None: critical.
            contact_method: "penalty" (default) or "augmented_lagrangian", which leaves no penetration at rest.
            max_force_n: largest force on the hand [N]; above it the tool gives way and stays behind the hand. None: 30.
            max_torque_n_m: likewise, torque about `position_m` [N m]. None: 1.
            max_joint_load: likewise, load of a joint [N m or N]. None: 1.
            cautery_power_w: lets the tip burn tissue while the level of its pose is above zero; the scene needs
                `editing`. None: it burns nothing.
            cautery_efficiency: share of that power which reaches the element at the tip. None: 0.3.
            dissection_reach_m: lets the tip sever springs of attachments within this distance of its surface. Jaws
                sever while they are shut. None: it severs none.
            dissection_length_m: length of the core that severs, from the tip on. None: the round tip alone.
            shape: fields of that kind's message, such as `radius_m=0.005, length_m=0.2`, or
                `surface=TriangleSurface(vertices, triangles)` for a mesh.

        Raises:
            InvalidArgumentError: no such kind, or no such field.
        """
        self.message.tools.append(
            make_tool(
                name,
                kind,
                position_m=position_m,
                orientation=orientation,
                max_speed_m_per_s=max_speed_m_per_s,
                friction_coefficient=friction_coefficient,
                joint_values=joint_values,
                fixed=fixed,
                mass_kg=mass_kg,
                coupling_stiffness_n_per_m=coupling_stiffness_n_per_m,
                coupling_damping_n_s_per_m=coupling_damping_n_s_per_m,
                contact_method=contact_method,
                max_force_n=max_force_n,
                max_torque_n_m=max_torque_n_m,
                max_joint_load=max_joint_load,
                cautery_power_w=cautery_power_w,
                cautery_efficiency=cautery_efficiency,
                dissection_reach_m=dissection_reach_m,
                dissection_length_m=dissection_length_m,
                shape=shape,
            )
        )
        return self.message.tools[-1]

    def add_body_contact(
        self,
        body: str,
        other: str | None = None,
        *,
        friction_coefficient: float = 0.0,
        distance_m: float | None = None,
        penalty_stiffness_pa_per_m: float | None = None,
        reach_m: float | None = None,
    ) -> scene_pb2.BodyContact:
        """Lets two bodies touch each other, or with one name a body touch itself. `BodyContact` has the defaults.

        Args:
            friction_coefficient: Coulomb's coefficient; 0 for smooth surfaces.
            distance_m: distance at which the surfaces begin to push each other.
            penalty_stiffness_pa_per_m: contact pressure per metre of penetration.
            reach_m: largest penetration from which a node is pushed back.

        Raises:
            InvalidArgumentError: no such body.
        """
        settings = {
            "friction_coefficient": friction_coefficient,
            "distance_m": distance_m,
            "penalty_stiffness_pa_per_m": penalty_stiffness_pa_per_m,
            "reach_m": reach_m,
        }
        contact = make_contact(self.body(body), self.body(body if other is None else other), settings)
        self.message.body_contacts.append(contact)
        return self.message.body_contacts[-1]

    def attach(
        self,
        name: str,
        body: str,
        nodes: Nodes,
        other: str,
        other_nodes: Nodes,
        *,
        stiffness_n_per_m: float,
        breaking_force_n: float | None = None,
        rest_length_m: RestLength = None,
    ) -> scene_pb2.Attachment:
        """Holds nodes of a body to another body by springs that only pull, such as a ligament.

        Args:
            nodes: indices, a mask, or the name of a set of the body. Each is held by the nearest of `other_nodes`.
            stiffness_n_per_m: of all springs together.
            breaking_force_n: force at which the attachment tears if all springs are pulled alike; None: never.
            rest_length_m: length at rest of all springs, or of each; None: the distance of its nodes at rest.

        Raises:
            InvalidArgumentError: no such body, or no nodes.
        """
        settings = {"stiffness_n_per_m": stiffness_n_per_m, "breaking_force_n": breaking_force_n}
        ends = (self.body(body), nodes, self.body(other), other_nodes)
        attachment = make_attachment(name, *ends, settings, rest_length_m)
        self.message.attachments.append(attachment)
        return self.message.attachments[-1]

    def keep_to_budget(
        self, budget_s: float, *, floor_cg_iterations: int | None = None, floor_tolerance: float | None = None
    ) -> None:
        """Lets the daemon lower the solver's iterations, down to a floor, while steps take longer than `budget_s`.

        Args:
            floor_cg_iterations: lowest number of conjugate-gradient iterations.
            floor_tolerance: largest relative residual of a published step.
        """
        solver = self.message.solver
        solver.budget_s = budget_s
        if floor_cg_iterations is not None:
            solver.floor_cg_iterations = floor_cg_iterations
        if floor_tolerance is not None:
            solver.floor_tolerance = floor_tolerance
