"""Scenes: the protobuf `Scene`, read from YAML one to one by field name, or built from arrays.

Files are resolved here, because the daemon reads none: mesh and skin files become packed arrays in the message. Their
positions are sent as the file has them; `Mesh.scale` and `Mesh.translation_m` travel along and the daemon applies them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import meshio
import numpy as np
import numpy.typing as npt
import yaml
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor

from tensormass import demo, mesh_files, meshes
from tensormass.errors import InvalidArgumentError, NotFoundError, naming
from tensormass.names import as_name, suggestion
from tensormass.shapes import BY_NUMBER
from tensormass.v1 import scene_pb2

Vector = Sequence[float] | npt.NDArray[np.floating]

LAWS = tuple(field.name for field in scene_pb2.Law.DESCRIPTOR.oneofs_by_name["kind"].fields)
_LIVER = {"young_modulus_pa": 4000.0, "poisson_ratio": 0.45}
_YAML_ENDINGS = (".yaml", ".yml")


class Scene:
    """A scene to be loaded: `message`, the protobuf `tensormass.v1.Scene`, with the usual ways to make one.

    Anything that the methods below do not offer is a field of `message`.
    """

    def __init__(self, name: str = "scene", message: scene_pb2.Scene | None = None) -> None:
        self.message = message if message is not None else scene_pb2.Scene(name=name)

    def __repr__(self) -> str:
        bodies = ", ".join(body.name for body in self.message.bodies)
        return f"Scene({self.message.name!r}, bodies: {bodies or 'none'})"

    @property
    def name(self) -> str:
        return self.message.name

    @staticmethod
    def from_file(path: str | Path) -> Scene:
        """Reads a scene (.yaml, .yml) or a bare volume mesh, which becomes one body of soft tissue at rest.

        The name of a built-in scene (`builtin_scenes`) stands for its file, unless a file of that name exists.

        Raises:
            NotFoundError: no such file, or a mesh that the scene names is not there.
            InvalidArgumentError: what is wrong, with the file and the path of the field.
        """
        if is_mesh_file(path):
            return Scene.from_mesh(mesh_files.read_mesh(Path(path)), name=as_name(Path(path).stem) or "scene")
        return SceneFile.read(path).scene()

    @staticmethod
    def from_yaml(text: str, *, directory: str | Path = ".", where: str = "scene") -> Scene:
        """Parses a scene file's text; mesh files are looked up relative to `directory`."""
        return SceneFile.parse(text, Path(directory), where).scene()

    @staticmethod
    def from_arrays(nodes: npt.ArrayLike, tetrahedra: npt.ArrayLike, **options: Any) -> Scene:  # noqa: ANN401
        """As `from_mesh`, of tetrahedra [n, 4] in VTK node order and their nodes [node_count, 3] m."""
        return Scene.from_mesh(meshes.VolumeMesh.from_tetrahedra(nodes, tetrahedra), **options)

    @staticmethod
    def from_meshio(mesh: meshio.Mesh, **options: Any) -> Scene:  # noqa: ANN401
        """As `from_mesh`, from a `meshio.Mesh` in metres."""
        return Scene.from_mesh(mesh_files.from_meshio(mesh), **options)

    @staticmethod
    def from_mesh(
        mesh: meshes.VolumeMesh,
        *,
        name: str = "scene",
        body: str = "body",
        gravity_m_per_s2: Vector | None = None,
        density_kg_per_m3: float = 1060.0,
        **options: Any,  # noqa: ANN401
    ) -> Scene:
        """A scene of one body, by default of liver tissue (add tools with `add_spherical_probe`).

        Args:
            options: those of `add_body`.

        Raises:
            InvalidArgumentError: naming the array, the row and the remedy.
        """
        scene = Scene(name)
        scene.add_body(body, mesh, density_kg_per_m3=density_kg_per_m3, **options)
        if gravity_m_per_s2 is not None:
            scene.message.gravity_m_per_s2.CopyFrom(vector3(gravity_m_per_s2, "gravity_m_per_s2"))
        return scene

    def add_body(
        self,
        name: str,
        mesh: meshes.VolumeMesh,
        *,
        law: str = "st_venant_kirchhoff",
        constants: Mapping[str, float | Vector] | None = None,
        young_modulus_pa: float | None = None,
        poisson_ratio: float | None = None,
        prony: Sequence[tuple[float, float]] = (),
        density_kg_per_m3: float,
        quadrature: str | None = None,
        mass: str | None = None,
        fixed: str | Sequence[str] = (),
        fixed_nodes: npt.ArrayLike | None = None,
        skin: meshes.TriangleSurface | None = None,
    ) -> scene_pb2.Body:
        """Adds a body and returns its message, for what the arguments do not cover: loads, prescribed displacements,
        laws of regions.

        Args:
            mesh: elements in m, with the named sets and element fields that it carries.
            law: one of `LAWS`.
            constants: the law's by name, as `{"c10_pa": 2000, "c01_pa": 500, "bulk_modulus_pa": 1e6}`.
            young_modulus_pa: a constant that many laws have; without `constants` 4 kPa.
            poisson_ratio: as `young_modulus_pa`; without `constants` 0.45.
            prony: (share, relaxation time [s]) of each term.
            quadrature: "full" (default), "reduced" or "selective".
            mass: "lumped" (default) or "consistent".
            fixed: names of sets whose nodes do not move.
            fixed_nodes: indices [k] or mask [node_count] of further nodes that do not move.
            skin: a finer surface that the body carries along; what clients see.

        Raises:
            InvalidArgumentError: naming the argument, what is wrong and what is known.
        """
        given = dict(constants or {})
        if constants is None and law in LAWS:
            fields = getattr(scene_pb2.Law(), law).DESCRIPTOR.fields_by_name
            given = {name: value for name, value in _LIVER.items() if name in fields}
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
                _enum_number(scene_pb2.Quadrature.DESCRIPTOR, quadrature, f"{name}.quadrature"),
            )
        if mass is not None:
            body.mass = cast(scene_pb2.Mass, _enum_number(scene_pb2.Mass.DESCRIPTOR, mass, f"{name}.mass"))
        _add_what_the_mesh_carries(body, mesh, name)
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
        self.message.bodies.append(body)
        return self.message.bodies[-1]

    def add_spherical_probe(
        self, name: str, *, radius_m: float, position_m: Vector, max_speed_m_per_s: float | None = None
    ) -> scene_pb2.Tool:
        """Adds a probe that stands at `position_m` until its first pose, and returns its message."""
        tool = scene_pb2.Tool(
            name=name,
            spherical_probe=scene_pb2.SphericalProbe(radius_m=radius_m),
            position_m=vector3(position_m, f"{name}.position_m"),
            max_speed_m_per_s=max_speed_m_per_s,
        )
        self.message.tools.append(tool)
        return self.message.tools[-1]

    def keep_to_budget(
        self, budget_s: float, *, floor_cg_iterations: int | None = None, floor_tolerance: float | None = None
    ) -> None:
        """Lets the daemon lower the solver's iterations while steps take longer than `budget_s`, down to a floor.

        Args:
            floor_cg_iterations: never fewer.
            floor_tolerance: no step is published whose relative residual is above.
        """
        solver = self.message.solver
        solver.budget_s = budget_s
        if floor_cg_iterations is not None:
            solver.floor_cg_iterations = floor_cg_iterations
        if floor_tolerance is not None:
            solver.floor_tolerance = floor_tolerance


@dataclass(frozen=True)
class SceneFile:
    """A scene as its file has it: fields by name, before meshes are read."""

    fields: dict[str, Any]
    #: Mesh files are relative to it.
    directory: Path
    #: For messages.
    where: str
    #: The name of the built-in scene that this is; None: somebody's own.
    builtin: str | None = None

    @staticmethod
    def read(path: str | Path) -> SceneFile:
        """Reads a scene file or a built-in scene. Raises as `Scene.from_file`."""
        directory: Path | None = None
        builtin: str | None = None
        if not Path(path).exists() and (found := demo.builtin_scene(str(path))) is not None:
            builtin = str(path)
            path, directory = found
        path = Path(path)
        try:
            text = path.read_text("utf-8")
        except FileNotFoundError:
            raise NotFoundError(
                f"{path}: no such file, nor a built-in scene ({', '.join(demo.builtin_scenes())})"
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidArgumentError(f"{path}: cannot be read: {error}") from error
        return replace(SceneFile.parse(text, directory or path.parent, str(path)), builtin=builtin)

    @staticmethod
    def parse(text: str, directory: Path, where: str) -> SceneFile:
        """As `read`, of a text."""
        try:
            # A SafeLoader: nothing in the text is run.
            content = yaml.load(text, Loader=_StrictLoader)
        except yaml.YAMLError as error:
            raise InvalidArgumentError(f"{where}: not valid YAML: {error}") from error
        except RecursionError:
            raise InvalidArgumentError(f"{where}: not valid YAML: nested too deep") from None
        if not isinstance(content, dict):
            raise InvalidArgumentError(f"{where}: a scene is a mapping of fields, starting with `name: ...`")
        return SceneFile(content, directory, where)

    def scene(self) -> Scene:
        """Checks the fields and reads the meshes."""
        message = scene_pb2.Scene()
        fields = _checked_fields(self.fields, cast(Descriptor, message.DESCRIPTOR), self.where, "")
        try:
            json_format.ParseDict(fields, message, max_recursion_depth=20)
        except json_format.ParseError as error:
            raise InvalidArgumentError(f"{self.where}: {error}") from error
        _resolve_files(message, self.directory, self.where)
        return Scene(message=message)


def is_mesh_file(path: str | Path) -> bool:
    """Whether a name says of itself that it is a bare mesh and no scene."""
    suffix = Path(path).suffix.lower()
    return suffix != "" and suffix not in _YAML_ENDINGS


def vector3(values: Vector, where: str) -> scene_pb2.Vector3:
    """A message from three finite numbers."""
    array = _numbers(values)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InvalidArgumentError(f"{where}: expected three finite numbers, got {values!r}")
    return scene_pb2.Vector3(x=float(array[0]), y=float(array[1]), z=float(array[2]))


def quaternion(values: Vector | None, where: str) -> scene_pb2.Quaternion | None:
    """A message from (w, x, y, z), normalized; None stays None (the identity)."""
    if values is None:
        return None
    array = _numbers(values)
    if array.shape != (4,) or not np.isfinite(array).all() or not np.linalg.norm(array) > 1e-6:
        raise InvalidArgumentError(f"{where}: expected four finite numbers w, x, y, z, not all zero, got {values!r}")
    w, x, y, z = array / np.linalg.norm(array)
    return scene_pb2.Quaternion(w=w, x=x, y=y, z=z)


def _numbers(values: Vector) -> npt.NDArray[np.float64]:
    """Empty for what is no sequence of numbers."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def law_message(
    name: str,
    constants: Mapping[str, float | Vector],
    prony: Sequence[tuple[float, float]] = (),
    where: str = "law",
) -> scene_pb2.Law:
    """A law by its name, with its constants by theirs and Prony terms (share, relaxation time [s]).

    Raises:
        InvalidArgumentError: an unknown law, an unknown or missing constant, a value that is not a number.
    """
    if name not in LAWS:
        raise InvalidArgumentError(f"{where}: unknown law {name!r}; {suggestion(name, LAWS)}")
    law = scene_pb2.Law(prony=[scene_pb2.PronyTerm(share=share, relaxation_time_s=time) for share, time in prony])
    message = getattr(law, name)
    message.SetInParent()
    fields = message.DESCRIPTOR.fields_by_name
    for constant, value in constants.items():
        if constant not in fields:
            # A bulk modulus is spelt nearly as Young's, and is another number.
            known = f"it is given by {', '.join(fields)}" if constant in _LIVER else suggestion(constant, fields)
            raise InvalidArgumentError(f"{where}: {name} has no constant {constant!r}; {known}")
        if fields[constant].message_type is not None:
            getattr(message, constant).CopyFrom(vector3(cast(Vector, value), f"{where}.{name}.{constant}"))
            continue
        try:
            setattr(message, constant, value)
        except TypeError as error:
            raise InvalidArgumentError(f"{where}.{name}.{constant}: expected a number, got {value!r}") from error
        if not math.isfinite(getattr(message, constant)):
            raise InvalidArgumentError(f"{where}.{name}.{constant}: expected a finite number, got {value!r}")
    # A direction may come with each element instead.
    missing = [field for field, of in fields.items() if of.message_type is None and field not in constants]
    if missing:
        raise InvalidArgumentError(f"{where}: {name} needs {', '.join(missing)}")
    return law


def pack_mesh(mesh: meshes.VolumeMesh) -> scene_pb2.PackedMesh:
    """Little-endian float64 and uint32 arrays, as the protocol has them."""
    return scene_pb2.PackedMesh(
        node_positions=mesh.nodes.astype("<f8", copy=False).tobytes(),
        elements=[
            scene_pb2.PackedElements(shape=shape.number, nodes=elements.astype("<u4", copy=False).tobytes())
            for shape, elements in mesh.blocks
        ],
    )


def unpack_mesh(packed: scene_pb2.PackedMesh, where: str = "mesh") -> meshes.VolumeMesh:
    """The mesh of a message.

    Raises:
        InvalidArgumentError: arrays that are cut off or do not fit together.
    """
    blocks = []
    for index, block in enumerate(packed.elements):
        shape = BY_NUMBER.get(block.shape or scene_pb2.SHAPE_TETRAHEDRON)
        if shape is None or len(block.nodes) % (4 * shape.node_count) != 0:
            raise InvalidArgumentError(f"{where}.elements[{index}]: an unknown shape, or not whole elements")
        blocks.append((shape.name, np.frombuffer(block.nodes, "<u4").reshape(-1, shape.node_count)))
    if len(packed.node_positions) % 24 != 0:
        raise InvalidArgumentError(f"{where}.node_positions: not a whole number of nodes")
    return meshes.VolumeMesh.from_arrays(
        np.frombuffer(packed.node_positions, "<f8").reshape(-1, 3), blocks, where=where
    )


def volume_mesh(body: scene_pb2.Body) -> meshes.VolumeMesh:
    """The mesh that a body's message holds or, of a grid, stands for; before scale and translation."""
    if body.mesh.WhichOneof("source") != "grid":
        return unpack_mesh(body.mesh.packed, f"body {body.name!r}")
    of = body.mesh.grid
    shape = BY_NUMBER[of.shape or scene_pb2.SHAPE_TETRAHEDRON].name
    size, origin = ([v.x, v.y, v.z] for v in (of.size_m, of.origin_m))
    return meshes.grid([of.cells_x, of.cells_y, of.cells_z], size, shape=shape, origin_m=origin)


def pack_triangles(surface: meshes.TriangleSurface) -> scene_pb2.PackedTriangles:
    """As `pack_mesh`."""
    return scene_pb2.PackedTriangles(
        vertex_positions=surface.vertices.astype("<f8", copy=False).tobytes(),
        triangles=surface.triangles.astype("<u4", copy=False).tobytes(),
    )


def _add_what_the_mesh_carries(body: scene_pb2.Body, mesh: meshes.VolumeMesh, where: str) -> None:
    """Named sets and element fields. The mesh's sets come first: the scene's own may be made of them."""
    own = list(body.sets)
    for named in own:
        if named.name in mesh.sets:
            raise InvalidArgumentError(f"{where}: the mesh has a set {named.name!r} already; name this one otherwise")
    del body.sets[:]
    for name, nodes in mesh.sets.items():
        body.sets.add(name=name).regions.add().nodes.indices.extend(nodes.tolist())
    body.sets.extend(own)
    for name, values in mesh.element_fields.items():
        setattr(body.element_fields, name, values.astype("<f8", copy=False).tobytes())


def _checked_fields(content: object, descriptor: Descriptor, where: str, path: str) -> dict[str, Any]:
    """The fields with the full names of enums. Refuses what the parser would pass over or explain poorly: unknown,
    empty and wrongly nested fields."""
    at = f"{where}: {path or 'scene'}"
    if not isinstance(content, dict):
        raise InvalidArgumentError(f"{at}: expected a mapping of {descriptor.name}'s fields, found {content!r}")
    fields = descriptor.fields_by_name
    checked: dict[str, Any] = {}
    for key, value in content.items():
        field = fields.get(key) if isinstance(key, str) else None
        if field is None:
            raise InvalidArgumentError(f"{at}: {descriptor.name} has no field {key!r}; {suggestion(str(key), fields)}")
        inner = f"{path}.{key}" if path else key
        if value is None:
            raise InvalidArgumentError(f"{where}: {inner}: has no value; give one or leave the field out")
        if not field.is_repeated:
            values = {inner: value}
        elif isinstance(value, list):
            values = {f"{inner}[{index}]": item for index, item in enumerate(value)}
        else:
            raise InvalidArgumentError(f"{where}: {inner}: expected a list, found {value!r}")
        items: list[Any] = []
        for place, item in values.items():
            if field.message_type is not None:
                items.append(_checked_fields(item, field.message_type, where, place))
                continue
            _check_value(field, item, f"{where}: {place}")
            items.append(
                _enum_number(field.enum_type, item, f"{where}: {place}") if field.enum_type is not None else item
            )
        checked[key] = items if field.is_repeated else items[0]
    return checked


def _check_value(field: FieldDescriptor, value: object, where: str) -> None:
    """Refuses what is no number or text that the field can hold, as far as the parser does not."""
    if isinstance(value, dict | list | None):
        raise InvalidArgumentError(f"{where}: expected one value, found {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidArgumentError(f"{where}: expected a finite number, found {value!r}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        beyond = f"above {sys.float_info.max:.2g}" if value > 0 else f"below {-sys.float_info.max:.2g}"
        raise InvalidArgumentError(f"{where}: expected a finite number, found one {beyond}")
    # `yes` and `on` too, which the parser takes for 1; what an enum knows is said with it.
    if isinstance(value, bool) and field.type not in (FieldDescriptor.TYPE_BOOL, FieldDescriptor.TYPE_ENUM):
        is_text = field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
        expected, remedy = ("text", "; write it in quotes") if is_text else ("a number", "")
        raise InvalidArgumentError(f"{where}: expected {expected}, found {str(value).lower()}{remedy}")


def _enum_number(enum: EnumDescriptor, value: object, where: str) -> int:
    """A value by its full name or without the enum's name: SHAPE_HEXAHEDRON, hexahedron."""
    known = {short_name(enum, of.number): of.number for of in enum.values if of.number != 0}
    short = str(value).removeprefix(_enum_prefix(enum)).lower()
    if short not in known:
        said = short if isinstance(value, bool) else repr(value)
        raise InvalidArgumentError(f"{where}: unknown value {said}; {suggestion(short, known)}")
    return known[short]


def short_name(enum: EnumDescriptor, number: int) -> str:
    """A value of an enum as scene files have it: SHAPE_HEXAHEDRON -> hexahedron."""
    return str(enum.values_by_number[number].name).removeprefix(_enum_prefix(enum)).lower()


def _enum_prefix(enum: EnumDescriptor) -> str:
    return "".join(f"_{c}" if c.isupper() else c.upper() for c in enum.name).removeprefix("_") + "_"


def _resolve_files(scene: scene_pb2.Scene, directory: Path, where: str) -> None:
    for index, body in enumerate(scene.bodies):
        at = f"{where}: bodies[{index}]"
        with naming(f"{at}.mesh.file"):
            if body.mesh.WhichOneof("source") == "file":
                mesh = mesh_files.read_mesh(directory / body.mesh.file)
                body.mesh.packed.CopyFrom(pack_mesh(mesh))
                _add_what_the_mesh_carries(body, mesh, f"{at}.sets")
        with naming(f"{at}.skin.file"):
            if body.skin.WhichOneof("source") == "file":
                body.skin.packed.CopyFrom(pack_triangles(mesh_files.read_surface(directory / body.skin.file)))


class _StrictLoader(yaml.SafeLoader):
    """PyYAML keeps the last of two equal keys; a scene file that says two things is refused instead. And what Python
    raises on a value that only looks like one, as `2001-99-99`, is said with its place."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:  # noqa: ANN401
        try:
            return super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, ValueError) as error:
            if not isinstance(node, yaml.ScalarNode):
                raise
            text = node.value if len(node.value) <= 40 else f"{node.value[:40]}..."
            what = f"{text!r} cannot be read as {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        # What only its tag makes a mapping, as `!!map x`, is refused below.
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a field's name is a plain word", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} stands twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)
