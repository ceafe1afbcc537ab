"""The files of `tensormass solve`: fields as VTU, a series of them as PVD."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass import (
    NODE_FIELDS,
    ElementBlock,
    FieldName,
    Fields,
    InvalidArgumentError,
    SceneHandle,
    VolumeMesh,
    write_fields,
)
from tensormass._shared.files import replacing


class Writer:
    """Writes the state of a scene: points at rest, all bodies in one file, numbered by the cell data `body`."""

    def __init__(self, out: Path, handle: SceneHandle, volumes: list[VolumeMesh], names: list[FieldName]) -> None:
        self._out = out
        self._handle = handle
        self._names = names
        self.bodies = [body.name for body in handle.topology().bodies]
        points = np.concatenate([handle.positions(body) for body in self.bodies])
        blocks: list[ElementBlock] = []
        first = 0
        for volume in volumes:
            blocks += [ElementBlock(shape, elements + np.uint32(first)) for shape, elements in volume.blocks]
            first += len(volume.nodes)
        self._mesh = VolumeMesh(points, tuple(blocks))
        self._body_of = np.repeat(np.arange(len(volumes), dtype=np.int32), [v.element_count for v in volumes])
        self._series: list[tuple[float, Path]] = []

    def write(self, path: Path | None = None) -> list[Fields]:
        """Writes the present state to `path` (None: `--out`) and returns the fields of each body."""
        measured = [self._handle.fields(body, list(dict.fromkeys([*self._names, *SUMMED]))) for body in self.bodies]
        nodes: dict[str, npt.NDArray[np.generic]] = {}
        cells: dict[str, npt.NDArray[np.generic]] = {"body": self._body_of}
        for name in self._names:
            values = np.concatenate([fields[name] for fields in measured])
            if name == "cauchy_stress":
                values = values[:, [0, 1, 2, 5, 3, 4]]  # VTK's symmetric tensor: xx yy zz xy yz xz
            (nodes if name in NODE_FIELDS else cells)[name] = values
        write_fields(path or self._out, self._mesh, nodes, cells)
        return measured

    def write_one_of_series(self, step: int, time_s: float) -> None:
        """Writes the present state as one file of the series, and the list of all its files."""
        path = self._out.with_name(f"{self._out.stem}_{step:06d}.vtu")
        self.write(path)
        self._series.append((time_s, path))
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
        collection = ElementTree.SubElement(root, "Collection")
        for at_s, file in self._series:
            ElementTree.SubElement(collection, "DataSet", timestep=repr(at_s), part="0", file=file.name)
        ElementTree.indent(root)
        listing = self._out.with_suffix(".pvd")
        try:
            with replacing(listing) as aside:
                ElementTree.ElementTree(root).write(aside, encoding="utf-8", xml_declaration=True)
        except OSError as error:
            raise InvalidArgumentError(f"{listing}: cannot be written: {error.strerror}") from error

    @property
    def so_far(self) -> str:
        """Says, for people, what was written before the last step."""
        if not self._series:
            return "Nothing is written"
        states = "1 state" if len(self._series) == 1 else f"{len(self._series)} states"
        return f"{self._out.with_suffix('.pvd')} lists {states} before it, --out is not written"

    @property
    def files(self) -> list[str]:
        """Returns the written files; for a series, its list."""
        return [str(self._out), *([str(self._out.with_suffix(".pvd"))] if self._series else [])]


SUMMED: tuple[FieldName, ...] = ("displacement", "reaction_force")
