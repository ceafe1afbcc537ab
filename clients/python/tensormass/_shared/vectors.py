"""Vectors and quaternions as the protocol's messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass.v1 import scene_pb2

Vector = Sequence[float] | npt.NDArray[np.floating]


def vector3(values: Vector, where: str) -> scene_pb2.Vector3:
    """Makes a message of three finite numbers."""
    array = _numbers(values)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InvalidArgumentError(f"{where}: expected three finite numbers, got {values!r}")
    return scene_pb2.Vector3(x=float(array[0]), y=float(array[1]), z=float(array[2]))


def quaternion(values: Vector | None, where: str) -> scene_pb2.Quaternion | None:
    """Makes a message of (w, x, y, z), normalized; None, the identity, stays None."""
    if values is None:
        return None
    array = _numbers(values)
    if array.shape != (4,) or not np.isfinite(array).all() or not np.linalg.norm(array) > 1e-6:
        raise InvalidArgumentError(f"{where}: expected four finite numbers w, x, y, z, not all zero, got {values!r}")
    w, x, y, z = array / np.linalg.norm(array)
    return scene_pb2.Quaternion(w=w, x=x, y=y, z=z)


def finite_numbers(values: Vector, where: str) -> list[float]:
    """Returns any number of finite numbers."""
    array = _numbers(values)
    if array.ndim != 1 or array.size != len(values) or not np.isfinite(array).all():
        raise InvalidArgumentError(f"{where}: expected finite numbers, got {values!r}")
    return [float(value) for value in array]


def _numbers(values: Vector) -> npt.NDArray[np.float64]:
    """Converts a sequence of numbers; returns an empty array if it is not one."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
