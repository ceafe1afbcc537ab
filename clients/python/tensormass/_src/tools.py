"""Tools of a scene, of any kind that the protocol knows."""

from __future__ import annotations

from typing import Any, cast

from google.protobuf.descriptor import FieldDescriptor

from tensormass._shared.enums import enum_number
from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._shared.vectors import Vector, finite_numbers, quaternion, vector3
from tensormass._src.meshes import TriangleSurface
from tensormass._src.packing import pack_triangles
from tensormass.v1 import edit_pb2, scene_pb2


def make_tool(
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
            "edit_pb2.ContactMethod", enum_number(edit_pb2.ContactMethod.DESCRIPTOR, contact_method, where)
        )
    if cautery_power_w is not None:
        tool.cautery.CopyFrom(edit_pb2.Cautery(power_w=cautery_power_w, efficiency=cautery_efficiency))
    elif cautery_efficiency is not None:
        raise InvalidArgumentError(f"{name}: cautery_efficiency needs cautery_power_w")
    if dissection_reach_m is not None:
        tool.dissection.CopyFrom(edit_pb2.Dissection(reach_m=dissection_reach_m, length_m=dissection_length_m))
    elif dissection_length_m is not None:
        raise InvalidArgumentError(f"{name}: dissection_length_m needs dissection_reach_m")
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


def tool_of(name: str, kind: str, position_m: Vector, fields: dict[str, Any]) -> scene_pb2.Tool:
    """Returns a tool. fields: what make_tool takes besides; the others are those of the kind's message."""
    own = (make_tool.__kwdefaults__ or {}).keys()
    given = {field: value for field, value in fields.items() if field in own}
    shape = {field: value for field, value in fields.items() if field not in own}
    return make_tool(name, kind, position_m=position_m, shape=shape, **given)


def _kinds() -> list[str]:
    return [field.name for field in scene_pb2.Tool.DESCRIPTOR.oneofs_by_name["kind"].fields]
