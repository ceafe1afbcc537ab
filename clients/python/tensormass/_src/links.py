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
#: Of all springs, or of each.
RestLength = float | Sequence[float] | npt.NDArray[np.floating] | None


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
    rest_length_m: RestLength = None,
) -> scene_pb2.Attachment:
    """See Scene.attach."""
    attachment = scene_pb2.Attachment(name=name, body=body.name, other=other.name)
    attachment.region.CopyFrom(_region(body.name, nodes, own_node_count(body), "attach.nodes"))
    attachment.other_region.CopyFrom(_region(other.name, other_nodes, own_node_count(other), "attach.other_nodes"))
    return _with_settings(attachment, settings, rest_length_m)


def new_attachment(
    name: str,
    ends: Sequence[tuple[str, Nodes]],
    stiffness_n_per_m: float,
    breaking_force_n: float | None,
    rest_length_m: RestLength,
) -> scene_pb2.Attachment:
    """See SceneHandle.attach. The daemon checks bodies and nodes, because another client may have loaded the scene.

    Args:
        ends: two bodies by name, each with its nodes.
    """
    (body, nodes), (other, other_nodes) = ends
    attachment = scene_pb2.Attachment(name=name, body=body, other=other)
    attachment.region.CopyFrom(_region(body, nodes, _most_nodes(nodes), "attach.nodes"))
    attachment.other_region.CopyFrom(_region(other, other_nodes, _most_nodes(other_nodes), "attach.other_nodes"))
    settings = {"stiffness_n_per_m": stiffness_n_per_m, "breaking_force_n": breaking_force_n}
    return _with_settings(attachment, settings, rest_length_m)


def _with_settings(
    attachment: scene_pb2.Attachment, settings: dict[str, float | None], rest_length_m: RestLength
) -> scene_pb2.Attachment:
    set_fields(attachment, "attach", settings)
    if rest_length_m is not None:
        lengths = np.atleast_1d(np.asarray(rest_length_m, dtype=np.float64))
        if lengths.ndim != 1 or lengths.size == 0:
            raise InvalidArgumentError(
                f"attach.rest_length_m: shape {list(lengths.shape)}; give one length, or one a spring"
            )
        attachment.rest_lengths_m.extend(lengths)
    return attachment


def _most_nodes(nodes: Nodes) -> int:
    """Nodes that a body of an unknown mesh may have: as many as a mask says, else as many as indices can name."""
    values = np.asarray(nodes)
    return len(values) if values.dtype == np.bool_ else int(np.iinfo(np.uint32).max)


def _region(body: str, nodes: Nodes, node_count: int, where: str) -> scene_pb2.Region:
    if isinstance(nodes, str):
        return scene_pb2.Region(set=nodes)
    indices = node_indices(nodes, node_count, where)
    if len(indices) == 0:
        raise InvalidArgumentError(f"{where}: no nodes of body '{body}'; give some, or the name of a set")
    return scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=indices.tolist()))
