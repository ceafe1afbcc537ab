"""Names of elements in input files of Abaqus and CalculiX."""

from __future__ import annotations

import re

from tensormass._src.mesh_formats.raw import FormatError

_SOLIDS = {
    4: "tetra",
    5: "pyramid",
    6: "wedge",
    8: "hexahedron",
    10: "tetra10",
    13: "pyramid13",
    15: "wedge15",
    20: "hexahedron20",
    27: "hexahedron27",
}
# Continua for stress, heat or both: C3D8RH, DC3D4, AC3D10. Letters at the end choose quadrature and formulation.
_SOLID = re.compile(r"(?:A|D|DC|Q)?C3D(\d+)[A-Z]*")
# Families without a volume: shells, membranes, plane and axisymmetric continua, rigid and surface elements.
_SURFACE = re.compile(
    r"(?:S[3468]|DS[3468]|STRI\d|SFM3D|M3D|R3D|CP[SE]|CPE?G|CAX|CGAX|R2D|RAX|SAX|MAX|MGAX|DC2D|DCAX|DSAX|AC2D|ACAX|ASI|"
    r"W2D|US\d|F3D|SFMAX|SFMGAX|MCL|LS\d|ACIN)[A-Z0-9]*"
)
_LINE = re.compile(
    r"(?:B[23]\d|T[23]D|PIPE|FRAME|ELBOW|CONN|SPRING|DASHPOT|GAP|JOINT|DC1D|AC1D|ITS|ITT|DCOUP|FLINK|PSI|DRAG|RB[23]D|D$|"
    r"T2D|TRUSS)[A-Z0-9]*"
)
_POINT = re.compile(r"(?:MASS|ROTARYI|HEATCAP|CAP|PD3D|PC3D)[A-Z0-9]*")
_BY_WIDTH = {
    2: {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"},
    1: {2: "line", 3: "line3"},
    0: {1: "vertex"},
}
_OTHERS = {2: "polygon", 1: "poly_line", 0: "poly_vertex"}


def solid(name: str) -> str | None:
    """Returns the kind of a solid element by its name, None for an element without a volume.

    Raises:
        FormatError: an unknown name; the message lists the known ones.
    """
    match = _SOLID.fullmatch(name)
    if match and int(match[1]) in _SOLIDS:
        return _SOLIDS[int(match[1])]
    if any(family.fullmatch(name) for family in (_SURFACE, _LINE, _POINT)):
        return None
    raise FormatError(
        f"TYPE={name} is not a known element; known are C3D4, C3D5, C3D6, C3D8, C3D10 and C3D20 with any letters after "
        "them (H, R, I, M ...), and elements without a volume are skipped: mesh it with those"
    )


def flat_node_count(name: str) -> int:
    """Returns the nodes of a shell, membrane or plane element by its name (S8R, CAX6M, STRI65); 0 if it has none."""
    match = re.fullmatch(r"(?:S(\d)R\d|.*?(\d)5?[A-Z]*)", name) if _SURFACE.fullmatch(name) else None
    return int(match[1] or match[2]) if match else 0


def flat(name: str, node_count: int) -> str:
    """Returns the kind of an element without a volume."""
    dimension = 2 if _SURFACE.fullmatch(name) else 1 if _LINE.fullmatch(name) else 0
    return _BY_WIDTH[dimension].get(node_count, _OTHERS[dimension])
