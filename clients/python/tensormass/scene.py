"""Scenes: the protobuf `Scene`, read from YAML one to one by field name, or built from arrays.

Files are resolved here, because the daemon reads none: mesh and skin files become packed arrays in the message. Their
positions are sent as the file has them; `Mesh.scale` and `Mesh.translation_m` travel along and the daemon applies them.
"""

from __future__ import annotations

import difflib
from collections.abc import Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import meshio
import numpy as np
import numpy.typing as npt
import yaml
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor

from tensormass import demo, meshes
from tensormass.errors import InvalidArgumentError, NotFoundError
from tensormass.v1 import scene_pb2

Vector = Sequence[float] | npt.NDArray[np.floating]

LAWS = tuple(field.name for field in scene_pb2.Law.DESCRIPTOR.oneofs_by_name["kind"].fields)
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
        """Reads a scene (.yaml, .yml) or a bare tetrahedral mesh, which becomes one body of soft tissue at rest.

        The name of a built-in scene (`builtin_scenes`) stands for its file, unless a file of that name exists.

        Raises:
            NotFoundError: no such file, or a mesh that the scene names is not there.
            InvalidArgumentError: what is wrong, with the file and the path of the field.
        """
        directory: Path | None = None
        if not Path(path).exists() and (builtin := demo.builtin_scene(str(path))) is not None:
            path, directory = builtin
        path = Path(path)
        if path.suffix and path.suffix.lower() not in _YAML_ENDINGS:
            name = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in path.stem)[:64]
            return Scene._from_mesh(meshes.read_mesh(path), name=name or "scene")
        try:
            text = path.read_text("utf-8")
        except FileNotFoundError:
            raise NotFoundError(
                f"{path}: no such file, nor a built-in scene ({', '.join(demo.builtin_scenes())})"
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidArgumentError(f"{path}: cannot be read: {error}") from error
        return Scene.from_yaml(text, directory=directory or path.parent, where=str(path))

    @staticmethod
    def from_yaml(text: str, *, directory: str | Path = ".", where: str = "scene") -> Scene:
        """Parses a scene file's text; mesh files are looked up relative to `directory`."""
        try:
            # A SafeLoader: nothing in the text is run.
            content = yaml.load(text, Loader=_StrictLoader)
        except yaml.YAMLError as error:
            raise InvalidArgumentError(f"{where}: not valid YAML: {error}") from error
        if not isinstance(content, dict):
            raise InvalidArgumentError(f"{where}: a scene is a mapping of fields, starting with `name: ...`")
        message = scene_pb2.Scene()
        _check_fields(content, cast(Descriptor, message.DESCRIPTOR), where, "")
        try:
            json_format.ParseDict(content, message, max_recursion_depth=20)
        except json_format.ParseError as error:
            raise InvalidArgumentError(f"{where}: {error}") from error
        _resolve_files(message, Path(directory), where)
        return Scene(message=message)

    @staticmethod
    def from_arrays(
        nodes: npt.ArrayLike,
        tetrahedra: npt.ArrayLike,
        *,
        name: str = "scene",
        body: str = "body",
        law: str = "st_venant_kirchhoff",
        young_modulus_pa: float = 4000.0,
        poisson_ratio: float = 0.45,
        density_kg_per_m3: float = 1060.0,
        fixed_nodes: npt.ArrayLike | None = None,
        gravity_m_per_s2: Vector | None = None,
        skin: meshes.TriangleSurface | None = None,
    ) -> Scene:
        """A scene of one body; the defaults are those of liver tissue (add tools with `add_spherical_probe`).

        Args:
            nodes: [node_count, 3] m.
            tetrahedra: [tetrahedron_count, 4], indices into the nodes, positively wound, VTK node order.
            law: one of `LAWS`.
            fixed_nodes: indices [k] or mask [node_count] of the nodes that do not move.
            skin: a finer surface that the body carries along; what clients see.

        Raises:
            InvalidArgumentError: naming the array, the row and the remedy.
        """
        scene = Scene(name)
        scene.add_body(
            body,
            meshes.TetrahedralMesh.from_arrays(nodes, tetrahedra, body),
            law=law,
            young_modulus_pa=young_modulus_pa,
            poisson_ratio=poisson_ratio,
            density_kg_per_m3=density_kg_per_m3,
            fixed_nodes=fixed_nodes,
            skin=skin,
        )
        if gravity_m_per_s2 is not None:
            scene.message.gravity_m_per_s2.CopyFrom(vector3(gravity_m_per_s2, "gravity_m_per_s2"))
        return scene

    @staticmethod
    def from_meshio(mesh: meshio.Mesh, **options: Any) -> Scene:  # noqa: ANN401  (the options of from_arrays)
        """As `from_arrays`, from the tetrahedra of a `meshio.Mesh`, in metres."""
        return Scene._from_mesh(meshes.from_meshio(mesh), **options)

    @staticmethod
    def _from_mesh(mesh: meshes.TetrahedralMesh, **options: Any) -> Scene:  # noqa: ANN401
        return Scene.from_arrays(mesh.nodes, mesh.tetrahedra, **options)

    def add_body(
        self,
        name: str,
        mesh: meshes.TetrahedralMesh,
        *,
        law: str = "st_venant_kirchhoff",
        young_modulus_pa: float,
        poisson_ratio: float,
        density_kg_per_m3: float,
        fixed_nodes: npt.ArrayLike | None = None,
        skin: meshes.TriangleSurface | None = None,
    ) -> scene_pb2.Body:
        """Adds a body and returns its message, for what the arguments (see `from_arrays`) do not cover."""
        if law not in LAWS:
            raise InvalidArgumentError(f"{name}: unknown law {law!r}; known: {', '.join(LAWS)}")
        body = scene_pb2.Body(name=name, mesh=scene_pb2.Mesh(packed=pack_tetrahedra(mesh)))
        elastic = scene_pb2.IsotropicElastic(young_modulus_pa=young_modulus_pa, poisson_ratio=poisson_ratio)
        getattr(body.law, law).CopyFrom(elastic)
        body.density_kg_per_m3 = density_kg_per_m3
        if fixed_nodes is not None:
            indices = _node_indices(fixed_nodes, len(mesh.nodes), f"{name}.fixed_nodes")
            body.fixed.add().nodes.indices.extend(indices)
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


def vector3(values: Vector, where: str) -> scene_pb2.Vector3:
    """A message from three finite numbers."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InvalidArgumentError(f"{where}: expected three finite numbers, got {values!r}")
    return scene_pb2.Vector3(x=float(array[0]), y=float(array[1]), z=float(array[2]))


def quaternion(values: Vector | None, where: str) -> scene_pb2.Quaternion | None:
    """A message from (w, x, y, z), normalized; None stays None (the identity)."""
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (4,) or not np.isfinite(array).all() or not np.linalg.norm(array) > 1e-6:
        raise InvalidArgumentError(f"{where}: expected four finite numbers w, x, y, z, not all zero, got {values!r}")
    w, x, y, z = array / np.linalg.norm(array)
    return scene_pb2.Quaternion(w=w, x=x, y=y, z=z)


def pack_tetrahedra(mesh: meshes.TetrahedralMesh) -> scene_pb2.PackedTetrahedra:
    """Little-endian float64 and uint32 arrays, as the protocol has them."""
    return scene_pb2.PackedTetrahedra(
        node_positions=mesh.nodes.astype("<f8", copy=False).tobytes(),
        tetrahedra=mesh.tetrahedra.astype("<u4", copy=False).tobytes(),
    )


def pack_triangles(surface: meshes.TriangleSurface) -> scene_pb2.PackedTriangles:
    """As `pack_tetrahedra`."""
    return scene_pb2.PackedTriangles(
        vertex_positions=surface.vertices.astype("<f8", copy=False).tobytes(),
        triangles=surface.triangles.astype("<u4", copy=False).tobytes(),
    )


def _check_fields(content: object, descriptor: Descriptor, where: str, path: str) -> None:
    """Refuses what the parser would pass over or explain poorly: unknown, empty and wrongly nested fields."""
    at = f"{where}: {path or 'scene'}"
    if not isinstance(content, dict):
        raise InvalidArgumentError(f"{at}: expected a mapping of {descriptor.name}'s fields, found {content!r}")
    fields = descriptor.fields_by_name
    for key, value in content.items():
        field = fields.get(key) if isinstance(key, str) else None
        if field is None:
            close = difflib.get_close_matches(str(key), fields, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(fields)}"
            raise InvalidArgumentError(f"{at}: {descriptor.name} has no field {key!r}; {hint}")
        inner = f"{path}.{key}" if path else key
        if value is None:
            raise InvalidArgumentError(f"{where}: {inner}: has no value; give one or leave the field out")
        if not field.is_repeated:
            values = {inner: value}
        elif isinstance(value, list):
            values = {f"{inner}[{index}]": item for index, item in enumerate(value)}
        else:
            raise InvalidArgumentError(f"{where}: {inner}: expected a list, found {value!r}")
        for place, item in values.items():
            if field.message_type is not None:
                _check_fields(item, field.message_type, where, place)
            elif isinstance(item, dict | list | None):
                raise InvalidArgumentError(f"{where}: {place}: expected one value, found {item!r}")


def _resolve_files(scene: scene_pb2.Scene, directory: Path, where: str) -> None:
    for index, body in enumerate(scene.bodies):
        at = f"{where}: bodies[{index}]"
        with _naming(f"{at}.mesh.file"):
            if body.mesh.WhichOneof("source") == "file":
                body.mesh.packed.CopyFrom(pack_tetrahedra(meshes.read_mesh(directory / body.mesh.file)))
        with _naming(f"{at}.skin.file"):
            if body.skin.WhichOneof("source") == "file":
                body.skin.packed.CopyFrom(pack_triangles(meshes.read_surface(directory / body.skin.file)))


class _naming:  # noqa: N801  (reads as a statement)
    """Puts the place in front of the message of an error of the SDK."""

    def __init__(self, where: str) -> None:
        self._where = where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, NotFoundError | InvalidArgumentError):
            raise type(error)(f"{self._where}: {error}") from error


def _node_indices(values: npt.ArrayLike, node_count: int, where: str) -> Iterable[int]:
    array = np.asarray(values)
    if array.dtype == np.bool_:
        if array.shape != (node_count,):
            raise InvalidArgumentError(f"{where}: a mask needs shape [{node_count}], got {list(array.shape)}")
        array = np.flatnonzero(array)
    if array.ndim != 1 or not (array.size == 0 or np.issubdtype(array.dtype, np.integer)):
        raise InvalidArgumentError(f"{where}: expected node indices or a mask, got {array.dtype} {list(array.shape)}")
    bad = array[(array < 0) | (array >= node_count)]
    if bad.size:
        raise InvalidArgumentError(f"{where}: index {bad[0]}, but nodes run from 0 to {node_count - 1}")
    return (int(index) for index in array)


class _StrictLoader(yaml.SafeLoader):
    """PyYAML keeps the last of two equal keys; a scene file that says two things is refused instead."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a field's name is a plain word", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} stands twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)
