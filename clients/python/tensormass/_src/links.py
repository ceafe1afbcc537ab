"""Contact between bodies, and attachments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.meshes import node_indices
from tensormass._src.packing import own_node_count
from tensormass._src.solver_settings import set_fields
from tensormass.v1 import scene_pb2

Nodes = str | Sequence[int] | npt.NDArray[np.integer] | npt.NDArray[np.bool_]


def make_contact(
    body: scene_pb2.Body, other: scene_pb2.Body, settings: dict[str, float | None]
) -> scene_pb2.BodyContact:
    """See Scene.add_body_contact."""
    contact = scene_pb2.BodyContact(body=body.name, other=other.name)
    set_fields(contact, "add_body_contact", settings)
    return contact


def make_attachment(
    name: str,
    body: scene_pb2.Body,
    nodes: Nodes,
    other: scene_pb2.Body,
    other_nodes: Nodes,
    settings: dict[str, float | None],
) -> scene_pb2.Attachment:
    """See Scene.attach."""
    attachment = scene_pb2.Attachment(name=name, body=body.name, other=other.name)
    attachment.region.CopyFrom(_region(body, nodes, "attach.nodes"))
    attachment.other_region.CopyFrom(_region(other, other_nodes, "attach.other_nodes"))
    set_fields(attachment, "attach", settings)
    return attachment


def _region(body: scene_pb2.Body, nodes: Nodes, where: str) -> scene_pb2.Region:
    if isinstance(nodes, str):
        return scene_pb2.Region(set=nodes)
    indices = node_indices(nodes, own_node_count(body), where)
    if len(indices) == 0:
        raise InvalidArgumentError(f"{where}: no nodes of body '{body.name}'; give some, or the name of a set")
    return scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=indices.tolist()))
