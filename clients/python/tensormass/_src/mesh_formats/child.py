"""The process that reads one file: prints a line of JSON and then the bytes of the arrays that it lists.

python -m tensormass._src.mesh_formats.child volume|surface|labels FILE
"""

from __future__ import annotations

import json
import os
import resource
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.label_formats import content
from tensormass._src.label_formats import reading as label_reading
from tensormass._src.mesh_formats import finish, limits, reading
from tensormass._src.mesh_formats.raw import FormatError

_READ: dict[str, Callable[[Path], finish.Volume | finish.Surface | content.Labels]] = {
    "volume": reading.read_volume,
    "surface": reading.read_surface,
    "labels": label_reading.read,
}


def main(kind: str, file: str) -> None:
    """Reads the file within the limits of this process."""
    path = Path(file)
    warnings.simplefilter("ignore")
    try:
        size = path.stat().st_size
        limit_s = int(limits.time_limit_s(size))
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 1))
        limits.limit_memory(path)
        head, arrays = _packed(_READ[kind](path))
    except FormatError as error:
        head, arrays = {"error": str(error)}, []
    except MemoryError:
        head, arrays = {"error": f"{path}: {memory_message(path)}"}, []
    except OSError as error:
        head, arrays = {"error": f"{path}: cannot be read: {error.strerror}"}, []
    except Exception as error:
        # A mistake in a reader. The file is refused, and the program goes on.
        what = "label map" if kind == "labels" else "mesh"
        head, arrays = {"error": f"{path}: not readable as a {what}: {type(error).__name__}: {error}"}, []
    out = sys.stdout.buffer
    out.write(json.dumps(head).encode() + b"\n")
    for array in arrays:
        out.write(array.reshape(-1).view(np.uint8).data)
    out.flush()
    os._exit(0)


def memory_message(path: Path) -> str:
    """Returns why a file is refused that needs too much memory."""
    limit = max(limits.MEMORY_FLOOR, limits.MEMORY_FACTOR * path.stat().st_size)
    return (
        f"needs more than {limit >> 20} MiB of memory, the limit for its size; it is damaged, or save it as binary .vtu"
    )


def _packed(
    result: finish.Volume | finish.Surface | content.Labels,
) -> tuple[dict[str, Any], Sequence[npt.NDArray[Any]]]:
    """Returns what is printed: names, types and shapes, and the arrays."""
    names: list[tuple[str, ...]]
    arrays: list[npt.NDArray[Any]]
    more: dict[str, Any] = {}
    if isinstance(result, content.Labels):
        names = [("voxels",), ("affine",)]
        arrays = [np.ascontiguousarray(result.voxels, "<u2"), np.ascontiguousarray(result.affine, "<f8")]
        more["unit_m"] = result.unit_m
        more["segments"] = [asdict(segment) for segment in result.segments]
    elif isinstance(result, finish.Volume):
        names, arrays = [("points",)], [np.ascontiguousarray(result.points, "<f8")]
        for shape, nodes in result.blocks:
            names.append(("block", shape))
            arrays.append(np.ascontiguousarray(nodes, "<u4"))
        for name, nodes in result.sets.items():
            names.append(("set", name))
            arrays.append(np.ascontiguousarray(nodes, "<u4"))
        for name, values in result.fields.items():
            names.append(("field", name))
            arrays.append(np.ascontiguousarray(values, "<f8"))
    else:
        names = [("points",), ("triangles",)]
        arrays = [np.ascontiguousarray(result.points, "<f8"), np.ascontiguousarray(result.triangles, "<u4")]
        if result.texture is not None:
            names.append(("texture",))
            arrays.append(np.ascontiguousarray(result.texture, "<f4"))
    listed = [
        {"name": name, "dtype": array.dtype.str, "shape": array.shape}
        for name, array in zip(names, arrays, strict=True)
    ]
    return {"arrays": listed, "notes": result.notes, **more}, arrays
