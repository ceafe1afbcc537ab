"""Mesh files as text, written line by line: two unit cubes on top of each other, and what formats add to them."""

from __future__ import annotations

import base64
import lzma
import struct
from collections.abc import Callable, Sequence

import numpy as np

from tensormass._src import mesh_geometry, meshes

POINTS = [(x, y, z) for z in (0, 1, 2) for y in (0, 1) for x in (0, 1)]
#: The lower cube as tetrahedra, and the upper one as a voxel, x fastest, and as a hexahedron.
TETRAHEDRA = [(0, 1, 3, 7), (0, 1, 7, 5), (0, 5, 7, 4), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7)]
VOXEL = tuple(range(4, 12))
HEXAHEDRON = (4, 5, 7, 6, 8, 9, 11, 10)
#: The lower cube as two wedges, whose first triangle is clockwise seen from the other one, or counter-clockwise.
WEDGES = [(0, 1, 3, 4, 5, 7), (0, 3, 2, 4, 7, 6)]
WEDGES_TURNED = [(0, 3, 1, 4, 7, 5), (0, 2, 3, 4, 6, 7)]
Cells = Sequence[tuple[int, tuple[int, ...]]]


def volume(mesh: meshes.VolumeMesh) -> float:
    """Returns the sum of the volumes, which are all positive."""
    volumes = mesh_geometry.signed_volumes(mesh)
    assert (volumes > 0).all(), "an element is inverted"
    return float(volumes.sum())


def _lines(rows: Sequence[Sequence[float]], first: int | None = None) -> str:
    numbered = rows if first is None else [(n, *row) for n, row in enumerate(rows, first)]
    return "".join(" ".join(map(str, row)) + "\n" for row in numbered)


def legacy_vtk(cells: Cells, version: str = "3.0", more: str = "") -> str:
    """A legacy VTK file of cells (VTK's type, nodes)."""
    head = f"# vtk DataFile Version {version}\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(POINTS)} double\n"
    types = f"CELL_TYPES {len(cells)}\n" + "".join(f"{kind}\n" for kind, _ in cells)
    if version == "5.1":
        offsets = [0, *np.cumsum([len(nodes) for _, nodes in cells]).tolist()]
        parts = f"CELLS {len(offsets)} {offsets[-1]}\nOFFSETS vtktypeint64\n{' '.join(map(str, offsets))}\n"
        parts += "CONNECTIVITY vtktypeint64\n" + _lines([nodes for _, nodes in cells])
    else:
        size = sum(1 + len(nodes) for _, nodes in cells)
        parts = f"CELLS {len(cells)} {size}\n" + _lines([(len(nodes), *nodes) for _, nodes in cells])
    return head + _lines(POINTS) + parts + types + more


def vtu(cells: Cells, compressor: str = "", compress: Callable[[bytes], bytes] = bytes) -> str:
    """An unstructured grid in XML: text, or compressed with one block an array."""

    def array(name: str, kind: str, values: Sequence[float], width: int = 1) -> str:
        start = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" format='
        if not compressor:
            return f'{start}"ascii">{" ".join(map(str, values))}</DataArray>'
        data = np.array(values, {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}[kind]).tobytes()
        packed = compress(data)
        header = struct.pack("<4I", 1, len(data), 0, len(packed))
        return f'{start}"binary">{(base64.b64encode(header) + base64.b64encode(packed)).decode()}</DataArray>'

    return (
        f'<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" compressor="{compressor}">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(POINTS)}" NumberOfCells="{len(cells)}"><Points>'
        + array("Points", "Float64", [x for point in POINTS for x in point], 3)
        + "</Points><Cells>"
        + array("connectivity", "Int64", [node for _, nodes in cells for node in nodes])
        + array("offsets", "Int64", np.cumsum([len(nodes) for _, nodes in cells]).tolist())
        + array("types", "UInt8", [kind for kind, _ in cells])
        + "</Cells></Piece></UnstructuredGrid></VTKFile>"
    )


def lzma_vtu() -> str:
    return vtu([(10, nodes) for nodes in TETRAHEDRA], "vtkLZMADataCompressor", lzma.compress)


POLYDATA = """# vtk DataFile Version {version}
x
ASCII
DATASET POLYDATA
POINTS 5 float
0 0 0 1 0 0 1 1 0 0 1 0 2 0 0
{parts}"""
OLD_PARTS = "LINES 1 3\n2 0 1\nPOLYGONS 1 5\n4 0 1 2 3\nTRIANGLE_STRIPS 1 5\n4 0 1 3 2\n"
NEW_PARTS = "POLYGONS 3 7\nOFFSETS vtktypeint64\n0 3 7\nCONNECTIVITY vtktypeint64\n1 4 2 0 1 2 3\n"


# --- Abaqus -----------------------------------------------------------------------------------------------------------


def abaqus_nodes(points: Sequence[Sequence[float]] = POINTS, first: int = 1) -> str:
    return "".join(f"{n}, {x}, {y}, {z}\n" for n, (x, y, z) in enumerate(points, first))


def abaqus_elements(rows: Sequence[Sequence[int]] = TETRAHEDRA, first: int = 1) -> str:
    return "".join(f"{n}, " + ", ".join(str(node + 1) for node in row) + "\n" for n, row in enumerate(rows, first))


def abaqus(more: str = "", kind: str = "C3D4") -> str:
    """The lower cube, and what comes after it."""
    return f"*NODE\n{abaqus_nodes(POINTS[:8])}*ELEMENT, TYPE={kind}, ELSET=E\n{abaqus_elements()}{more}"


PART = (
    f"*Part, name=P\n*Node\n{abaqus_nodes(POINTS[:8])}*Element, type=C3D4\n{abaqus_elements()}"
    "*Nset, nset=Top\n5, 6, 7, 8\n*End Part\n"
)


def assembly(*lines: str) -> str:
    return f"*Heading\n{PART}*Assembly, name=A\n{''.join(lines)}*End Assembly\n"


# --- Gmsh -------------------------------------------------------------------------------------------------------------

UPPER = [tuple(node + 4 for node in nodes) for nodes in TETRAHEDRA]
NAMES = '$PhysicalNames\n3\n2 3 "fixed"\n3 1 "all"\n3 2 "tumour"\n$EndPhysicalNames\n'


def gmsh22() -> str:
    """The upper cube is in two groups, so that Gmsh writes its elements twice."""
    rows: list[tuple[int, int, int, tuple[int, ...]]] = [(2, 3, 1, (0, 1, 3)), (2, 3, 1, (0, 3, 2))]
    rows += [(4, 1, 1, nodes) for nodes in TETRAHEDRA] + [(4, 1, 2, nodes) for nodes in UPPER]
    rows += [(4, 2, 2, nodes) for nodes in UPPER]
    text = f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{NAMES}$Nodes\n{len(POINTS)}\n{_lines(POINTS, 1)}$EndNodes\n"
    text += f"$Elements\n{len(rows)}\n"
    for number, (kind, group, entity, nodes) in enumerate(rows, 1):
        text += f"{number} {kind} 2 {group} {entity} " + " ".join(str(node + 1) for node in nodes) + "\n"
    return text + "$EndElements\n"


def gmsh41(groups: Sequence[str] = ("1 3", "0", "1 1", "2 1 2")) -> str:
    """Two surfaces and two volumes, with the groups of each: `count tags`."""
    box = "0 0 0 1 1 2"
    text = f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{NAMES}$Entities\n0 0 2 2\n"
    for tag, own in zip((1, 2, 1, 2), groups, strict=True):
        text += f"{tag} {box} {own} 0\n"
    text += f"$EndEntities\n$Nodes\n1 {len(POINTS)} 1 {len(POINTS)}\n3 1 0 {len(POINTS)}\n"
    text += "".join(f"{n + 1}\n" for n in range(len(POINTS))) + _lines(POINTS) + "$EndNodes\n$Elements\n4 16 1 16\n"
    tag = 0
    surfaces = ([(0, 1, 3), (0, 3, 2)], [(8, 9, 11), (8, 11, 10)])
    for dimension, entity, kind, rows in (
        (2, 1, 2, surfaces[0]),
        (2, 2, 2, surfaces[1]),
        (3, 1, 4, TETRAHEDRA),
        (3, 2, 4, UPPER),
    ):
        text += f"{dimension} {entity} {kind} {len(rows)}\n"
        for row in rows:
            tag += 1
            text += f"{tag} " + " ".join(str(node + 1) for node in row) + "\n"
    return text + "$EndElements\n"


def gmsh40() -> str:
    elements = "".join(f"{n} " + " ".join(str(node + 1) for node in row) + "\n" for n, row in enumerate(TETRAHEDRA, 1))
    return (
        f"$MeshFormat\n4 0 8\n$EndMeshFormat\n{NAMES}$Entities\n0 0 0 1\n7 0 0 0 1 1 1 1 2 0 \n$EndEntities\n"
        f"$Nodes\n1 8\n7 3 0 8\n{_lines(POINTS[:8], 1)}$EndNodes\n$Elements\n1 6\n7 3 4 6\n{elements}$EndElements\n"
    )


def gmsh1() -> str:
    return (
        f"$NOD\n12\n{_lines(POINTS, 1)}$ENDNOD\n$ELM\n1\n1 5 1 1 8 "
        + " ".join(str(node + 1) for node in HEXAHEDRON)
        + "\n$ENDELM\n"
    )


# --- Medit, TetGen, surfaces ------------------------------------------------------------------------------------------


def medit(head: str = "MeshVersionFormatted 2\nDimension 3\n", more: str = "") -> str:
    rows = [(*(node + 1 for node in nodes), 1) for nodes in TETRAHEDRA]
    vertices = [(*point, 0) for point in POINTS[:8]]
    return f"{head}Vertices\n8\n{_lines(vertices)}Tetrahedra\n6\n{_lines(rows)}{more}End\n"


def tetgen_nodes() -> str:
    return f"# made by hand\n8 3 1 1\n{_lines([(*point, 0.5, 1) for point in POINTS[:8]], 0)}"


def tetgen_elements() -> str:
    return f"6 4 1\n{_lines([(*nodes, 1.5) for nodes in TETRAHEDRA], 0)}# the end\n"


OFF = "OFF # a square\n# and a comment\n4 2 0\n0 0 0\n1 0 0 # the second\n1 1 0\n\n0 1 0\n3 0 1 2\n3 0 2 3 255 0 0\n"
STL = (
    "solid a\n"
    + "".join(
        f"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex {x} 1 0\nendloop\nendfacet\n"
        for x in (0, 1)
    )
    + "endsolid a\n"
)
PLY = """ply
format ascii 1.0
comment by hand
element vertex 4
property float x
property float y
property float z
property uchar red
element face 2
property list uchar int vertex_indices
property uchar flag
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0 9
1 0 0 9
1 1 0 9
0 1 0 9
4 0 1 2 3 7
3 0 1 2 7
0 1
"""
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 \\\n3//1\nf -4 -2 -1\nl 1 2\n"
