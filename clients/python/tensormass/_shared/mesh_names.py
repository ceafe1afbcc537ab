"""Names of mesh files, which choose their format by the ending."""

from __future__ import annotations

from pathlib import Path

from tensormass._shared.errors import InvalidArgumentError

#: Formats of surfaces alone.
SURFACE_ENDINGS = (".obj", ".stl", ".ply", ".off", ".vtp")


def check_holds_volumes(path: str | Path) -> None:
    """Refuses a file format that has no volume elements.

    Raises:
        InvalidArgumentError: such a format, by the ending of the name.
    """
    if Path(path).suffix.lower() in SURFACE_ENDINGS:
        raise InvalidArgumentError(f"{path}: {Path(path).suffix} holds surfaces only; use .msh, .vtk or .vtu")
