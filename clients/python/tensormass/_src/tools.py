"""Tools of a scene, of any kind that the protocol knows."""

from __future__ import annotations

from typing import Protocol, cast

import numpy as np
from google.protobuf.descriptor import FieldDescriptor

from tensormass._src.enums import enum_number
from tensormass._src.errors import InvalidArgumentError
from tensormass._src.meshes import TriangleSurface
from tensormass._src.names import suggestion
from tensormass._src.packing import pack_triangles
from tensormass._src.vectors import Vector, finite_numbers, quaternion, vector3
from tensormass.v1 import scene_pb2


class ToolShape(Protocol):
    """What the messages of all kinds of tools have."""

    tip_offset_m: scene_pb2.Vector3


def shape_of(tool: scene_pb2.Tool) -> ToolShape:
    """Returns the message of a tool's kind.

    Raises:
        InvalidArgumentError: the tool has no kind.
    """
    kind = tool.WhichOneof("kind")
    if kind is None:
        raise InvalidArgumentError(f"tool {tool.name!r} has no kind; give one of {', '.join(_kinds())}")
    return cast("ToolShape", getattr(tool, kind))


def radius_m(tool: scene_pb2.Tool) -> float:
    """Returns the radius of a tool; of a solid half its smallest size [m].

    Raises:
        InvalidArgumentError: the tool has no kind, or no size.
    """
    shape = shape_of(tool)
    if isinstance(shape, scene_pb2.BoxSolid):
        return min(shape.size_x_m, shape.size_y_m, shape.size_z_m) / 2
    if isinstance(shape, scene_pb2.MeshSolid):
        positions = np.frombuffer(shape.surface.packed.vertex_positions, "<f8").reshape(-1, 3)
        if len(positions) == 0:
            raise InvalidArgumentError(f"tool {tool.name!r} has a surface without vertices")
        scale = shape.scale if shape.HasField("scale") else 1.0
        return float(scale * np.ptp(positions, axis=0).min() / 2)
    if isinstance(shape, scene_pb2.Plane):
        raise InvalidArgumentError(f"tool {tool.name!r} is a plane, which has no size")
    return float(shape.radius_m)  # type: ignore[attr-defined]  # all other kinds are thin


def movable_tools(scene: scene_pb2.Scene) -> list[scene_pb2.Tool]:
    """Returns the tools that clients can move."""
    return [tool for tool in scene.tools if not tool.fixed]


def make_tool(
    name: str,
    kind: str,
    *,
    position_m: Vector,
    orientation: Vector | None,
    max_speed_m_per_s: float | None,
    friction_coefficient: float,
    joint_values: Vector,
    fixed: bool,
    mass_kg: float | None,
    coupling_stiffness_n_per_m: float | None,
    coupling_damping_n_s_per_m: float | None,
    contact_method: str | None,
    max_force_n: float | None,
    max_torque_n_m: float | None,
    max_joint_load: float | None,
    shape: dict[str, float | Vector | TriangleSurface],
) -> scene_pb2.Tool:
    """Returns a tool of a kind. See Scene.add_tool."""
    if kind not in _kinds():
        raise InvalidArgumentError(f"{name}: there is no kind {kind!r}; {suggestion(kind, _kinds())}")
    tool = scene_pb2.Tool(
        name=name,
        position_m=vector3(position_m, f"{name}.position_m"),
        orientation=quaternion(orientation, f"{name}.orientation"),
        max_speed_m_per_s=max_speed_m_per_s,
        friction_coefficient=friction_coefficient,
        joint_values=finite_numbers(joint_values, f"{name}.joint_values"),
        fixed=fixed,
        mass_kg=mass_kg,
        coupling_stiffness_n_per_m=coupling_stiffness_n_per_m,
        coupling_damping_n_s_per_m=coupling_damping_n_s_per_m,
        max_force_n=max_force_n,
        max_torque_n_m=max_torque_n_m,
        max_joint_load=max_joint_load,
    )
    if contact_method is not None:
        where = f"{name}.contact_method"
        tool.contact_method = cast(
            "scene_pb2.ContactMethod", enum_number(scene_pb2.ContactMethod.DESCRIPTOR, contact_method, where)
        )
    message = getattr(tool, kind)
    message.SetInParent()
    for field, value in shape.items():
        described = message.DESCRIPTOR.fields_by_name.get(field)
        if described is None:
            fields = list(message.DESCRIPTOR.fields_by_name)
            raise InvalidArgumentError(f"{name}: {kind} has no {field!r}; {suggestion(field, fields)}")
        if isinstance(value, TriangleSurface):
            if field != "surface":
                raise InvalidArgumentError(f"{name}.{field}: expected a number, got a surface")
            message.surface.packed.CopyFrom(pack_triangles(value))
        elif described.type == FieldDescriptor.TYPE_MESSAGE:
            getattr(message, field).CopyFrom(vector3(cast("Vector", value), f"{name}.{field}"))
        else:
            try:
                setattr(message, field, value)
            except (TypeError, ValueError):
                raise InvalidArgumentError(f"{name}.{field}: expected a number, got {value!r}") from None
    return tool


def _kinds() -> list[str]:
    return [field.name for field in scene_pb2.Tool.DESCRIPTOR.oneofs_by_name["kind"].fields]
