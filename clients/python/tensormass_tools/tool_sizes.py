"""Which tools of a scene can be moved, and how large they are."""

from __future__ import annotations

from typing import Protocol, cast

import numpy as np

from tensormass import InvalidArgumentError
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
        kinds = (field.name for field in scene_pb2.Tool.DESCRIPTOR.oneofs_by_name["kind"].fields)
        raise InvalidArgumentError(f"tool {tool.name!r} has no kind; give one of {', '.join(kinds)}")
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
    if isinstance(shape, scene_pb2.Scalpel):
        return shape.thickness_m / 2
    return float(shape.radius_m)  # type: ignore[attr-defined]  # all other kinds are thin


def movable_tools(scene: scene_pb2.Scene) -> list[scene_pb2.Tool]:
    """Returns the tools that clients can move."""
    return [tool for tool in scene.tools if not tool.fixed]
