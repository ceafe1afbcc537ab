"""What a report of a misbehaving scene needs: its status, its state and itself, in one file.

A scene that a guard stopped stands at its last good state, so the file shows from where the step was tried.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tensormass.errors import InvalidArgumentError
from tensormass.files import replacing
from tensormass.output import to_plain

if TYPE_CHECKING:
    from tensormass.client import SceneHandle


def write_report(scene: SceneHandle, path: str | Path) -> Path:
    """Writes `status` (JSON, with the tools' poses) and for each body `<body>/displacement` [node_count, 3] m and
    `<body>/velocity` [node_count, 3] m/s, in the order of its mesh, as .npz.

    `scene` is the protobuf message as it was loaded, meshes included, in bytes:
    `tm.Scene(message=scene_pb2.Scene.FromString(report["scene"].tobytes()))`, with `scene_pb2` of `tensormass.v1`, can
    be loaded again. It is absent where the handle does not know it: another client, or another process, loaded it.

    Raises:
        InvalidArgumentError: the path does not end in .npz, or cannot be written.
        FailedPreconditionError: the device failed; there is no state to trust.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidArgumentError(f"{path}: a report is an .npz file")
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for body in scene.topology().bodies:
        fields = scene.fields(body.name, ["displacement", "velocity"])
        arrays[f"{body.name}/displacement"] = fields["displacement"]
        arrays[f"{body.name}/velocity"] = fields["velocity"]
    if scene.message is not None:
        arrays["scene"] = np.frombuffer(scene.message.SerializeToString(), np.uint8)
    status = np.array(json.dumps(to_plain(scene.status())))
    try:
        with replacing(path) as aside:
            np.savez_compressed(aside, status=status, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error
    return path
