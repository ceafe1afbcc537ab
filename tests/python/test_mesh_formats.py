"""Mesh files of other programs: what is in them comes in, or is named. mesh_texts.py has the files."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import mesh_texts as texts
import numpy as np
import pytest

from tensormass._shared.errors import InvalidArgumentError, MeshFileWarning
from tensormass._src import mesh_files, mesh_reading, meshes
from tensormass._src.mesh_formats import limits

pytestmark = pytest.mark.filterwarnings("ignore::tensormass.MeshFileWarning")
TETRAHEDRA = [(10, nodes) for nodes in texts.TETRAHEDRA]


def read(folder: Path, name: str, content: str | bytes) -> meshes.VolumeMesh:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return mesh_files.read_mesh(path)


def surface(folder: Path, name: str, content: str | bytes) -> meshes.TriangleSurface:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return mesh_files.read_surface(path)


def sets_of(mesh: meshes.VolumeMesh) -> dict[str, list[int]]:
    return {name: nodes.tolist() for name, nodes in mesh.sets.items()}


# --- VTK --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["old.vtk", "new.vtk", "m.vtu"])
def test_voxels_are_hexahedra(tmp_path: Path, name: str) -> None:
    cells = [*TETRAHEDRA, (11, texts.VOXEL)]
    text = texts.vtu(cells) if name == "m.vtu" else texts.legacy_vtk(cells, "5.1" if name == "new.vtk" else "3.0")
    mesh = read(tmp_path, name, text)
    assert texts.volume(mesh) == pytest.approx(2)
    assert mesh.elements("hexahedron").tolist() == [list(texts.HEXAHEDRON)]


@pytest.mark.parametrize("wedges", [texts.WEDGES, texts.WEDGES_TURNED])
@pytest.mark.parametrize("name", ["m.vtk", "m.vtu", "m.inp"])
def test_wedges_of_either_orientation_have_a_positive_volume(
    tmp_path: Path, name: str, wedges: list[tuple[int, ...]]
) -> None:
    cells = [(13, nodes) for nodes in wedges]
    deck = f"*NODE\n{texts.abaqus_nodes()}*ELEMENT, TYPE=C3D6\n{texts.abaqus_elements(wedges)}"
    mesh = read(tmp_path, name, {"m.vtk": texts.legacy_vtk(cells), "m.vtu": texts.vtu(cells)}.get(name, deck))
    assert texts.volume(mesh) == pytest.approx(1)


KINDS = "bit char unsigned_char short unsigned_short int unsigned_int long unsigned_long vtkIdType vtktypeint64 float"


@pytest.mark.parametrize("kind", KINDS.split())
def test_legacy_vtk_has_arrays_of_any_numbers(tmp_path: Path, kind: str) -> None:
    data = f"CELL_DATA 6\nSCALARS label {kind} 1\nLOOKUP_TABLE default\n0 1 0 1 0 1\nFIELD FieldData 2\n"
    data += f"other 1 6 {kind}\n1 0 1 0 1 0\nMETADATA\nINFORMATION 0\n\npoisson_ratio 1 6 double\n.1 .2 .3 .1 .2 .3\n"
    mesh = read(tmp_path, "m.vtk", texts.legacy_vtk(TETRAHEDRA, "5.1", data))
    assert mesh.element_fields["poisson_ratio"].tolist() == [0.1, 0.2, 0.3, 0.1, 0.2, 0.3]


GRIDS = {
    "STRUCTURED_POINTS": "DIMENSIONS 2 2 3\nSPACING 1 1 1\nORIGIN 5 0 0\n",
    "RECTILINEAR_GRID": "DIMENSIONS 2 2 3\nX_COORDINATES 2 int\n0 1\nY_COORDINATES 2 float\n0 1\n"
    "Z_COORDINATES 3 double\n0 .5 2\n",
    "STRUCTURED_GRID": "DIMENSIONS 2 2 3\nPOINTS 12 float\n" + "".join(f"{x} {y} {z}\n" for x, y, z in texts.POINTS),
}


@pytest.mark.parametrize("kind", GRIDS)
def test_grids_of_vtk_are_hexahedra(tmp_path: Path, kind: str) -> None:
    data = "CELL_DATA 2\nSCALARS poisson_ratio float\nLOOKUP_TABLE default\n.1 .2\n"
    mesh = read(tmp_path, "m.vtk", f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET {kind}\n{GRIDS[kind]}{data}")
    assert len(mesh.elements("hexahedron")) == 2
    assert texts.volume(mesh) == pytest.approx(2)
    assert mesh.element_fields["poisson_ratio"] == pytest.approx([0.1, 0.2])
    assert bool(mesh.notes) == (kind == "STRUCTURED_POINTS")


def test_sets_are_data_of_points_or_cells(tmp_path: Path) -> None:
    data = "CELL_DATA 6\nFIELD f 1\nset:half%20one 1 6 long\n1 0 0 0 0 0\n"
    data += "POINT_DATA 12\nSCALARS set:base int\nLOOKUP_TABLE default\n1 1 0 0 0 0 0 0 0 0 0 0\n"
    mesh = read(tmp_path, "m.vtk", texts.legacy_vtk(TETRAHEDRA, more=data))
    assert sets_of(mesh) == {"base": [0, 1], "half_one": [0, 1, 3, 7]}


def test_the_kind_of_a_cell_that_is_not_read_is_named_with_its_line(tmp_path: Path) -> None:
    text = texts.legacy_vtk([*TETRAHEDRA, (99, (0, 1, 2, 3))])
    line = 1 + text.splitlines().index("99")
    with pytest.raises(InvalidArgumentError, match=rf"m\.vtk:{line}: cell 6 has VTK's type 99, which is not read"):
        read(tmp_path, "m.vtk", text)
    with pytest.raises(InvalidArgumentError, match="one of 1 elements of type wedge15; known are tetra"):
        read(tmp_path, "m.vtu", texts.vtu([(26, (*range(12), 0, 1, 2))]))


def test_compressed_arrays_are_read(tmp_path: Path) -> None:
    lz4 = pytest.importorskip("lz4.block")
    assert texts.volume(read(tmp_path, "m.vtu", texts.lzma_vtu())) == pytest.approx(1)
    packed = texts.vtu(TETRAHEDRA, "vtkLZ4DataCompressor", lambda data: lz4.compress(data, store_size=False))
    assert texts.volume(read(tmp_path, "m.vtu", packed)) == pytest.approx(1)
    with pytest.raises(InvalidArgumentError, match="block 0 is damaged"):
        read(tmp_path, "m.vtu", packed.replace("vtkLZ4", "vtkZLib"))
    with pytest.raises(InvalidArgumentError, match="compressor 'vtkNone' is not known; save with ZLib, LZ4 or LZMA"):
        read(tmp_path, "m.vtu", packed.replace("vtkLZ4DataCompressor", "vtkNone"))


@pytest.mark.parametrize(("version", "parts", "count"), [("3.0", texts.OLD_PARTS, 4), ("5.1", texts.NEW_PARTS, 3)])
def test_polydata_is_a_surface(tmp_path: Path, version: str, parts: str, count: int) -> None:
    found = surface(tmp_path, "m.vtk", texts.POLYDATA.format(version=version, parts=parts))
    assert len(found.triangles) == count
    with pytest.raises(InvalidArgumentError, match=r"no elements with a volume .*tensormass mesh --edge"):
        mesh_files.read_mesh(tmp_path / "m.vtk")


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
def test_what_vtk_writes_is_read(tmp_path: Path, mode: str) -> None:
    vtk = pytest.importorskip("vtk")
    pyvista = pytest.importorskip("pyvista")
    tetrahedra = np.array(texts.TETRAHEDRA)
    grid = pyvista.UnstructuredGrid({10: tetrahedra, 11: np.array([texts.VOXEL])}, np.array(texts.POINTS, float))
    grid.cell_data["label"] = np.arange(7)
    for compressor in ("None", "ZLib", "LZ4", "LZMA"):
        writer = vtk.vtkXMLUnstructuredGridWriter()
        writer.SetFileName(str(tmp_path / "m.vtu"))
        writer.SetInputData(grid)
        getattr(writer, f"SetDataModeTo{mode}")()
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        if mode == "Appended":
            writer.SetEncodeAppendedData(compressor in ("None", "LZ4"))
        writer.Write()
        assert texts.volume(mesh_files.read_mesh(tmp_path / "m.vtu")) == pytest.approx(2)
    ball = pyvista.Icosphere(radius=0.02, nsub=1)
    for name in ("organ.vtk", "organ.vtp"):
        ball.save(tmp_path / name, binary=mode != "Ascii")
        assert len(mesh_files.read_surface(tmp_path / name).triangles) == 80


# --- Abaqus and CalculiX ----------------------------------------------------------------------------------------------

INSTANCES = {
    "moved": (["*Instance, name=P-1, part=P\n10, 0, 0\n*End Instance\n"], 1, 11),
    "turned": (["*Instance, name=P-1, part=P\n0, 0, 0\n1, 0, 0, 1, 0, 1, 90\n*End Instance\n"], 1, 1),
    "moved, then turned": (["*Instance, name=P-1, part=P\n2, 0, 0\n0, 0, 0, 0, 0, 1, 180\n*End Instance\n"], 1, -2),
    "twice": ([f"*Instance, name=P-{n}, part=P\n{2 * n}, 0, 0\n*End Instance\n" for n in (1, 2)], 2, 5),
}


@pytest.mark.parametrize("case", INSTANCES)
def test_instances_are_where_abaqus_puts_them(tmp_path: Path, case: str) -> None:
    lines, volume, end = INSTANCES[case]
    mesh = read(tmp_path, "m.inp", texts.assembly(*lines))
    assert texts.volume(mesh) == pytest.approx(volume)
    assert mesh.nodes[:, 0].max() == pytest.approx(end)
    assert len(mesh.sets["Top"]) == 4 * len(lines)
    if case == "twice":
        assert mesh.sets["P-2_Top"].tolist() == [12, 13, 14, 15]


def test_sets_of_an_assembly_name_an_instance(tmp_path: Path) -> None:
    lines = INSTANCES["twice"][0]
    sets = "*Nset, nset=Held, instance=P-1\n1, 2\n*Nset, nset=Held, instance=P-2\n3\n*Nset, nset=Both\nHeld, P-2.Top\n"
    sets += "*Elset, elset=Far, instance=P-2, generate\n1, 5, 2\n"
    mesh = read(tmp_path, "m.inp", texts.assembly(*lines, sets))
    assert sets_of(mesh)["Held"] == [0, 1, 10]
    assert sets_of(mesh)["Both"] == [0, 1, 10, 12, 13, 14, 15]
    chosen = {node + 8 for row in (0, 2, 4) for node in texts.TETRAHEDRA[row]}
    assert sets_of(mesh)["Far"] == sorted(chosen)


def test_sets_are_repeated_generated_and_of_sets(tmp_path: Path) -> None:
    sets = "*NSET, NSET=a\n1, 2\n*NSET, NSET=A\n4,\n*NSET, NSET=odd, GENERATE\n1, 7, 2\n*NSET, NSET=all\na, odd, 8\n"
    sets += "*ELSET, ELSET=first\n1\n*NSET, NSET=of elements, ELSET=first\n*ELSET, ELSET=a\n2\n"
    assert sets_of(read(tmp_path, "m.inp", texts.abaqus(sets))) == {
        "a": [0, 1, 3],
        "odd": [0, 2, 4, 6],
        "all": [0, 1, 2, 3, 4, 6, 7],
        "of_elements": [0, 1, 3, 7],
        "E": list(range(8)),
        "a_elements": [0, 1, 5, 7],
    } | {"first": [0, 1, 3, 7]}


def test_included_files_are_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "nodes.inc").write_text("*NODE\n" + texts.abaqus_nodes(texts.POINTS[:8]))
    elements = f"*ELEMENT, TYPE=C3D4\n{texts.abaqus_elements()}"
    assert texts.volume(read(tmp_path, "m.inp", "*INCLUDE, INPUT=nodes.inc\n" + elements)) == pytest.approx(1)
    for name, message in (
        ("../nodes.inc", "lies outside of the folder"),
        ("/etc/passwd", "lies outside of the folder"),
        ("none.inc", "no such file; put it beside the file"),
        ("m.inp", "more than 10 files include each other"),
    ):
        with pytest.raises(InvalidArgumentError, match=rf"m\.inp:1: \*INCLUDE, INPUT='{name}': {message}"):
            read(tmp_path, "m.inp", f"*INCLUDE, INPUT={name}\n" + elements)


def test_included_files_may_hold_data_lines_alone(tmp_path: Path) -> None:
    (tmp_path / "nodes.dat").write_text("** by hand\n" + texts.abaqus_nodes(texts.POINTS[:4]))
    (tmp_path / "set.dat").write_text("1, 2\n")
    text = "\ufeff*HEADING\nBOM\n*NODE\n*INCLUDE, INPUT=nodes.dat\n" + texts.abaqus_nodes(texts.POINTS[4:8], 5)
    text += f"*ELEMENT, TYPE=C3D4\n{texts.abaqus_elements()}*NSET, NSET=a\n8,\n*INCLUDE, INPUT=set.dat\n3\n"
    mesh = read(tmp_path, "m.inp", text.replace("\n", "\r\n"))
    assert texts.volume(mesh) == pytest.approx(1)
    assert sets_of(mesh) == {"a": [0, 1, 2, 7]}
    with pytest.raises(InvalidArgumentError, match=r"m\.inp:2: expected a keyword such as \*NODE"):
        read(tmp_path, "m.inp", "\n1, 2, 3\n" + text)


def test_a_deck_has_nodes_in_several_places(tmp_path: Path) -> None:
    text = f"*NODE\n{texts.abaqus_nodes(texts.POINTS[:4])}** and\n*NODE, NSET=upper\n"
    text += texts.abaqus_nodes(texts.POINTS[4:8], 5) + f"*ELEMENT, TYPE=C3D4\n{texts.abaqus_elements()}"
    mesh = read(tmp_path, "m.inp", text + "*NODE, NSET=RP\n9001, 9., 9., 9.\n")
    assert texts.volume(mesh) == pytest.approx(1)
    assert sets_of(mesh) == {"upper": [4, 5, 6, 7]}
    assert "1 node belongs to no element and are left out" not in mesh.notes
    assert "1 node belongs to no element and is left out" in mesh.notes
    assert "the set 'RP' has 1 nodes, none of an element, and is skipped" in mesh.notes


@pytest.mark.parametrize("kind", ["C3D4", "C3D4H", "C3D4T", "DC3D4", "c3d4 "])
def test_names_of_solids_differ_in_letters_only(tmp_path: Path, kind: str) -> None:
    assert len(read(tmp_path, "m.inp", texts.abaqus(kind=kind)).elements("tetrahedron")) == 6


@pytest.mark.parametrize("kind", ["S3", "S3R", "STRI3", "CPS3", "M3D3", "SFM3D3", "R3D3", "DS3", "CAX3"])
def test_elements_without_a_volume_are_skipped_by_name(tmp_path: Path, kind: str) -> None:
    mesh = read(
        tmp_path,
        "m.inp",
        texts.abaqus(f"*ELEMENT, TYPE={kind}\n7, 1, 2, 4\n*ELEMENT, TYPE=S4, ELSET=side\n8, 1, 2, 6, 5\n"),
    )
    assert mesh.element_count == 6
    assert mesh.notes == (f"1 elements of type {kind} have no volume, belong to no set, and are skipped",)
    assert sets_of(mesh)["side"] == [0, 1, 4, 5]


def test_elements_of_a_network_have_nodes_that_do_not_exist(tmp_path: Path) -> None:
    more = "*ELEMENT, TYPE=DASHPOTA, ELSET=net\n7, 0, 2\n*ELEMENT, TYPE=D, ELSET=net\n8, 0, 3, 4\n9, 4, 5, 0\n"
    more += "*ELEMENT, TYPE=CAX8, ELSET=plane\n10, 1, 2, 3, 4,\n5, 6, 7, 8\n"
    mesh = read(tmp_path, "m.inp", texts.abaqus(more))
    assert sets_of(mesh)["net"] == [1, 2, 3, 4]
    assert sets_of(mesh)["plane"] == list(range(8))


REFUSED = {
    "*ELEMENT, TYPE=C3D99\n9, 1\n": r"m\.inp:17: \*ELEMENT: TYPE=C3D99 is not a known element; known are C3D4",
    "*ELEMENT, TYPE=C3D4\n9, 1, 2, 3\n": r"m\.inp:18: element 9: C3D4 needs 4 nodes",
    "*ELEMENT, TYPE=C3D4\n9, 1, 2, 3, 77\n": r"m\.inp:18: element 9 uses node 77, which is not defined",
    "*ELEMENT, TYPE=C3D4\n1, 5, 6, 7, 8\n": r"m\.inp:18: element 1 is defined a second time",
    "*NODE\n1, 5., 0., 0.\n": r"m\.inp:18: node 1 is defined a second time, at another place",
    "*NODE\n9, x, 0., 0.\n": r"m\.inp:18: \*NODE: expected a number, found 'x'",
    "*NODE, SYSTEM=C\n9, 1., 0., 0.\n": r"m\.inp:17: \*NODE, SYSTEM=C is not read; write the file with plain \*NODE",
    "*NGEN\n1, 2, 1\n": r"m\.inp:17: \*NGEN is not read",
    "*NSET, NSET=a\nb\n": r"m\.inp:18: the set 'a' names 'b', which is not a set; define it",
    "*NSET, NSET=a\nb\n*NSET, NSET=b\na\n": r"the set '[ab]' contains itself",
    "*INSTANCE, NAME=i, PART=q\n": r"m\.inp:17: \*INSTANCE: there is no part 'q' before it",
}


@pytest.mark.parametrize("more", REFUSED)
def test_a_deck_that_is_not_read_is_refused_by_line(tmp_path: Path, more: str) -> None:
    with pytest.raises(InvalidArgumentError, match=REFUSED[more]):
        read(tmp_path, "m.inp", texts.abaqus(more))


# --- Gmsh -------------------------------------------------------------------------------------------------------------


def test_an_element_of_two_groups_is_one_element(tmp_path: Path) -> None:
    for text in (texts.gmsh22(), texts.gmsh41()):
        mesh = read(tmp_path, "m.msh", text)
        assert texts.volume(mesh) == pytest.approx(2)
        assert sets_of(mesh) == {"all": list(range(12)), "tumour": list(range(4, 12)), "fixed": [0, 1, 2, 3]}


def test_groups_of_some_entities_are_sets(tmp_path: Path) -> None:
    mesh = read(tmp_path, "m.msh", texts.gmsh41(("1 3", "0", "0", "1 9")))
    assert sets_of(mesh) == {"fixed": [0, 1, 2, 3]}
    assert "physical groups without a name make no sets (1: volume 9 of 6 elements)" in mesh.notes
    assert "2 triangles have no volume, belong to no set, and are skipped" in mesh.notes
    assert texts.volume(mesh) == pytest.approx(2)


def test_old_formats_of_gmsh_are_read(tmp_path: Path) -> None:
    assert sets_of(read(tmp_path, "m.msh", texts.gmsh40())) == {"tumour": list(range(8))}
    mesh = read(tmp_path, "m.msh", texts.gmsh1())
    assert texts.volume(mesh) == pytest.approx(1)
    assert mesh.notes == ("4 nodes belong to no element and are left out",)


def test_binary_files_of_gmsh_are_those_of_text(tmp_path: Path) -> None:
    nodes = struct.pack("<QQQQ", 1, 12, 1, 12) + struct.pack("<iiiQ", 3, 1, 0, 12)
    nodes += np.arange(1, 13, dtype="<u8").tobytes() + np.array(texts.POINTS, "<f8").tobytes()
    elements = struct.pack("<QQQQ", 1, 6, 1, 6) + struct.pack("<iiiQ", 3, 1, 4, 6)
    elements += np.column_stack([np.arange(1, 7), np.array(texts.UPPER) + 1]).astype("<u8").tobytes()
    entities = struct.pack("<4Q", 0, 0, 0, 1) + struct.pack("<i6dQiQ", 1, *[0.0] * 6, 1, 2, 0)
    content = b"$MeshFormat\n4.1 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n" + texts.NAMES.encode()
    for name, data in ((b"Entities", entities), (b"Nodes", nodes), (b"Elements", elements)):
        content += b"$" + name + b"\n" + data + b"\n$End" + name + b"\n"
    mesh = read(tmp_path, "m.msh", content)
    assert texts.volume(mesh) == pytest.approx(1)
    assert sets_of(mesh) == {"tumour": list(range(8))}


# --- Medit, TetGen ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "head",
    [
        *(f"MeshVersionFormatted {version}\nDimension 3\n" for version in (1, 2, 3)),
        "MeshVersionFormatted\n2\n\nDimension\n3\n\n",
        "MeshVersionFormatted 1 Dimension 3 # one line\n",
    ],
)
def test_medit_is_read_in_every_layout(tmp_path: Path, head: str) -> None:
    more = "Corners\n2\n1 2\nRequiredVertices\n1\n1\nNormals\n1\n0 0 1\nStrange\n2\n1 2 3\nTriangles\n1\n1 2 4 5\n"
    mesh = read(tmp_path, "m.mesh", texts.medit(head, more))
    assert texts.volume(mesh) == pytest.approx(1)
    assert mesh.notes == (
        "the section Strange of 2 entries is skipped",
        "1 triangles have no volume, belong to no set, and are skipped",
    )


def test_medit_of_second_order_is_read_or_named(tmp_path: Path) -> None:
    assert read(tmp_path, "m.mesh", texts.medit(more="TetrahedraP2\n0\n")).element_count == 6
    with pytest.raises(InvalidArgumentError, match=r"m\.mesh:22: 1 HexahedraP3 are not read; save linear elements"):
        read(tmp_path, "m.mesh", texts.medit(more="HexahedraP3\n1\n1 2 3\n"))


def test_binary_medit_is_read(tmp_path: Path) -> None:
    content = struct.pack("<ii", 1, 2) + struct.pack("<iii", 3, 20, 3)
    vertices = b"".join(struct.pack("<3di", *point, 0) for point in texts.POINTS[:8])
    content += struct.pack("<iii", 4, 20 + 12 + len(vertices), 8) + vertices
    cells = b"".join(struct.pack("<5i", *(node + 1 for node in nodes), 1) for nodes in texts.TETRAHEDRA)
    content += struct.pack("<iii", 8, len(content) + 12 + len(cells), 6) + cells + struct.pack("<ii", 54, 0)
    assert texts.volume(read(tmp_path, "m.meshb", content)) == pytest.approx(1)


@pytest.mark.parametrize("name", ["t.ele", "t.node"])
def test_tetgen_has_attributes(tmp_path: Path, name: str) -> None:
    (tmp_path / "t.node").write_text(texts.tetgen_nodes())
    (tmp_path / "t.ele").write_text(texts.tetgen_elements())
    mesh = mesh_files.read_mesh(tmp_path / name)
    assert texts.volume(mesh) == pytest.approx(1)
    assert mesh.notes == ("attribute 1 of the elements (1 values) has no name and is skipped",)
    (tmp_path / "t.node").unlink()
    with pytest.raises(InvalidArgumentError, match=r"t\.node is not beside it"):
        read(tmp_path, "t.ele", texts.tetgen_elements())


# --- surfaces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "vertices", "triangles"),
    [
        ("m.off", texts.OFF, 4, 2),
        ("m.stl", texts.STL, 4, 2),
        ("m.ply", texts.PLY, 4, 3),
        ("m.obj", texts.OBJ, 4, 2),
    ],
)
def test_surfaces_of_text_are_read(tmp_path: Path, name: str, text: str, vertices: int, triangles: int) -> None:
    found = surface(tmp_path, name, text)
    assert (len(found.vertices), len(found.triangles)) == (vertices, triangles)
    with pytest.raises(InvalidArgumentError, match=rf"m\.{name[2:]}:\d+: |m\.{name[2:]}: .*cut off"):
        surface(tmp_path, name, text[: int(0.6 * len(text))] + "?")


def test_what_a_surface_does_not_use_is_named(tmp_path: Path) -> None:
    with pytest.warns(MeshFileWarning, match="1 entries of the element 'edge' are skipped"):
        surface(tmp_path, "m.ply", texts.PLY)
    with pytest.warns(MeshFileWarning, match="1 lines are skipped"):
        surface(tmp_path, "m.obj", texts.OBJ)


@pytest.mark.parametrize("name", ["m.ply", "m.stl", "m.obj", "m.off"])
def test_written_surfaces_are_read_back(tmp_path: Path, name: str) -> None:
    written = surface(tmp_path, "square.off", texts.OFF)
    mesh_files.write_surface(tmp_path / name, written)
    found = mesh_files.read_surface(tmp_path / name)
    np.testing.assert_array_equal(found.vertices[found.triangles], written.vertices[written.triangles])


def test_an_off_file_of_a_head_and_a_comment_ends(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"m\.off:2: OFF: vertices: expected a number of them, found ''"):
        surface(tmp_path, "m.off", "OFF\n# a comment")


def test_an_unknown_ending_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"m\.xdmf: files of this ending are not read; known are \.msh"):
        read(tmp_path, "m.xdmf", "<Xdmf/>")


# --- the process that reads -------------------------------------------------------------------------------------------


def test_a_reader_has_limits_of_memory_and_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.inp"
    path.write_text(texts.abaqus("*NSET, NSET=a, GENERATE\n" + "1, 8, 1\n" * 200_000))
    program = (
        "import sys; from tensormass._src.mesh_formats import limits, child; limits.MEMORY_FLOOR = 1 << 20; "
        "child.main('volume', sys.argv[1])"
    )
    ran = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, timeout=60)
    assert "needs more than 6 MiB of memory, the limit for its size" in ran.stdout
    monkeypatch.setattr(limits, "TIME_FLOOR_S", 0.01)
    monkeypatch.setattr(limits, "TIME_PER_BYTE_S", 0.0)
    with pytest.raises(InvalidArgumentError, match=r"m\.inp: was not read within 0 s, the limit for its size"):
        mesh_files.read_mesh(path)


def test_a_reader_that_dies_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.msh"
    path.write_text(texts.gmsh22())
    monkeypatch.setattr(mesh_reading, "_BOOT", "import sys; sys.exit('no numbers today')")
    with pytest.raises(InvalidArgumentError, match="its reader ended with status 1: no numbers today"):
        mesh_files.read_mesh(path)


def test_a_file_of_our_own_is_read_alike_without_a_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.msh"
    path.write_text(texts.gmsh22())
    apart = mesh_files.read_mesh(path)
    monkeypatch.setattr(mesh_reading, "_BOOT", "raise SystemExit(1)")
    here = mesh_files.read_mesh(path, trusted=True)
    np.testing.assert_array_equal(here.nodes, apart.nodes)
    assert here.notes == apart.notes
