"""Reports of misbehaving scenes: status, state and the scene itself in one file.

A scene that a guard stopped is at its last good state, so the report shows the start of the step that failed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.files import replacing
from tensormass._shared.plain import to_plain
from tensormass._src.fields import FieldName, Fields
from tensormass.v1 import scene_pb2, stream_pb2

#: The fields that a report holds of each body.
REPORT_FIELDS: tuple[FieldName, ...] = ("displacement", "velocity")


def report_path(path: str | Path) -> Path:
    """The path of a report.

    Raises:
        InvalidArgumentError: it does not end in .npz.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidArgumentError(f"{path}: a report is an .npz file")
    return path


def write_report(
    path: Path,
    status: stream_pb2.SceneStatus,
    bodies: Mapping[str, Fields],
    message: scene_pb2.Scene | None,
) -> Path:
    """Writes a report as .npz and returns its path.

    It holds `status` (JSON, with the tools' poses) and for each body `<body>/displacement` [node_count, 3] m and
    `<body>/velocity` [node_count, 3] m/s, in the order of its mesh.

    `scene` is the protobuf message as it was loaded, meshes included, in bytes:
    `tm.Scene(message=scene_pb2.Scene.FromString(report["scene"].tobytes()))`, with `scene_pb2` of `tensormass.v1`, can
    be loaded again. It is absent if another client or process loaded the scene.

    Raises:
        InvalidArgumentError: the file cannot be written.
    """
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for name, fields in bodies.items():
        for field in REPORT_FIELDS:
            arrays[f"{name}/{field}"] = fields[field]
    if message is not None:
        arrays["scene"] = np.frombuffer(message.SerializeToString(), np.uint8)
    plain = np.array(json.dumps(to_plain(status)))
    try:
        with replacing(path) as aside:
            np.savez_compressed(aside, status=plain, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error
    return path
