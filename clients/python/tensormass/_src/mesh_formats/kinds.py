"""Kinds of cells in mesh files: their nodes, their names in each format, and what becomes of them.

The names of kinds are those of meshio, so that objects of meshio and meshlane need no table of their own.
"""

from __future__ import annotations

from typing import NamedTuple

#: Parameters of single elements that a mesh can carry: number of components, by name.
ELEMENT_FIELDS = {"young_modulus_pa": 1, "poisson_ratio": 1, "fibre_directions": 3}
#: Other names of `ELEMENT_FIELDS` in files.
FIELD_ALIASES = {"fibre_direction": "fibre_directions"}
#: Data of nodes or cells with this prefix are sets: the form in which sets are written.
SET_PREFIX = "set:"


class Kind(NamedTuple):
    """One kind of cells."""

    name: str
    #: Nodes of a cell; 0 if cells differ.
    node_count: int
    dimension: int
    #: Name of the shape that is simulated; empty if none is.
    shape: str = ""


_ALL = (
    Kind("vertex", 1, 0),
    Kind("poly_vertex", 0, 0),
    Kind("line", 2, 1),
    Kind("line3", 3, 1),
    Kind("line4", 4, 1),
    Kind("poly_line", 0, 1),
    Kind("triangle", 3, 2),
    Kind("triangle6", 6, 2),
    Kind("triangle7", 7, 2),
    Kind("triangle10", 10, 2),
    Kind("triangle_strip", 0, 2),
    Kind("quad", 4, 2),
    Kind("pixel", 4, 2),
    Kind("quad8", 8, 2),
    Kind("quad9", 9, 2),
    Kind("polygon", 0, 2),
    Kind("tetra", 4, 3, "tetrahedron"),
    Kind("pyramid", 5, 3, "pyramid"),
    Kind("wedge", 6, 3, "wedge"),
    Kind("voxel", 8, 3, "hexahedron"),
    Kind("hexahedron", 8, 3, "hexahedron"),
    Kind("tetra10", 10, 3, "quadratic_tetrahedron"),
    Kind("hexahedron20", 20, 3, "quadratic_hexahedron"),
    # The rest is named when it is refused.
    Kind("pyramid13", 13, 3),
    Kind("pyramid14", 14, 3),
    Kind("wedge12", 12, 3),
    Kind("wedge15", 15, 3),
    Kind("wedge18", 18, 3),
    Kind("hexahedron24", 24, 3),
    Kind("hexahedron27", 27, 3),
    Kind("tetra14", 14, 3),
    Kind("tetra20", 20, 3),
    Kind("polyhedron", 0, 3),
)
KINDS = {kind.name: kind for kind in _ALL}
#: The kinds that become elements.
VOLUMES = [kind.name for kind in _ALL if kind.shape]
#: Words for messages.
PLAIN = {
    "tetra": "tetrahedra",
    "pyramid": "pyramids",
    "wedge": "wedges",
    "voxel": "voxels",
    "hexahedron": "hexahedra",
    "tetra10": "quadratic tetrahedra",
    "hexahedron20": "quadratic hexahedra",
    "vertex": "points",
    "poly_vertex": "groups of points",
    "line": "lines",
    "line3": "quadratic lines",
    "line4": "cubic lines",
    "poly_line": "polylines",
    "triangle": "triangles",
    "triangle6": "quadratic triangles",
    "triangle_strip": "triangle strips",
    "quad": "quadrilaterals",
    "quad8": "quadratic quadrilaterals",
    "quad9": "quadratic quadrilaterals",
    "polygon": "polygons",
    "pixel": "pixels",
    "pyramid13": "quadratic pyramids",
    "pyramid14": "quadratic pyramids",
    "wedge15": "quadratic wedges",
    "wedge18": "quadratic wedges",
    "hexahedron27": "quadratic hexahedra of 27 nodes",
    "tetra20": "cubic tetrahedra",
}

#: Cell types of VTK.
VTK = {
    1: "vertex",
    2: "poly_vertex",
    3: "line",
    4: "poly_line",
    5: "triangle",
    6: "triangle_strip",
    7: "polygon",
    8: "pixel",
    9: "quad",
    10: "tetra",
    11: "voxel",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    21: "line3",
    22: "triangle6",
    23: "quad8",
    24: "tetra10",
    25: "hexahedron20",
    26: "wedge15",
    27: "pyramid13",
    28: "quad9",
    29: "hexahedron27",
    31: "wedge12",
    32: "wedge18",
    33: "hexahedron24",
    34: "triangle7",
    35: "line4",
    42: "polyhedron",
}
VTK_NUMBERS = {name: number for number, name in VTK.items()}

#: Element types of Gmsh.
GMSH = {
    1: "line",
    2: "triangle",
    3: "quad",
    4: "tetra",
    5: "hexahedron",
    6: "wedge",
    7: "pyramid",
    8: "line3",
    9: "triangle6",
    10: "quad9",
    11: "tetra10",
    12: "hexahedron27",
    13: "wedge18",
    14: "pyramid14",
    15: "vertex",
    16: "quad8",
    17: "hexahedron20",
    18: "wedge15",
    19: "pyramid13",
    21: "triangle10",
    26: "line4",
    29: "tetra20",
}
GMSH_NUMBERS = {name: number for number, name in GMSH.items()}
#: [kind] node order: the n-th node of a cell in VTK order is the `GMSH_ORDER[kind][n]`-th one in Gmsh.
GMSH_ORDER = {
    "tetra10": (0, 1, 2, 3, 4, 5, 6, 7, 9, 8),
    "hexahedron20": (0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15),
}


def plain(kind: str) -> str:
    """Returns a kind's name in the plural, for messages."""
    return PLAIN.get(kind, f"cells of kind {kind}")
