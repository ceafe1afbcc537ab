"""Messages of edits: what a scene that steps is told to change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass.v1 import adjustment_pb2, scene_pb2


def edit_of(
    ablate: Mapping[str, Iterable[int]], kept: float, sever: Mapping[str, Iterable[int] | None]
) -> adjustment_pb2.SceneEdit:
    """Returns the edit of `SceneHandle.edit`."""
    edit = adjustment_pb2.SceneEdit()
    for body, elements in ablate.items():
        edit.ablations.add(body=body, elements=elements, kept=[kept])
    for attachment, springs in sever.items():
        edit.severings.add(attachment=attachment, springs=[] if springs is None else springs)
    return edit


def cut_of(body: str, blade: npt.ArrayLike) -> adjustment_pb2.SceneEdit:
    """Returns the edit of `SceneHandle.cut`. Raises InvalidArgumentError for an array of another shape."""
    path = np.asarray(blade, dtype=np.float64)
    if path.ndim != 3 or path.shape[2] != 3:
        raise InvalidArgumentError(f"blade: an array of shape {path.shape}; give [position, point, 3]")
    edit = adjustment_pb2.SceneEdit()
    cut = edit.cuts.add(body=body)
    for position in path:
        cut.blade.add(points_m=position.ravel())
    return edit


def tools_of(added: Iterable[scene_pb2.Tool], removed: Iterable[str]) -> adjustment_pb2.SceneEdit:
    """Returns the edit of `SceneHandle.add_tool` and `remove_tool`."""
    return adjustment_pb2.SceneEdit(add_tools=added, remove_tools=removed)


def attachments_of(added: Iterable[scene_pb2.Attachment], removed: Iterable[str]) -> adjustment_pb2.SceneEdit:
    """Returns the edit of `SceneHandle.attach` and `detach`."""
    return adjustment_pb2.SceneEdit(add_attachments=added, remove_attachments=removed)
