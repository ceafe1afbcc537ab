"""Written meshes come back alike from the programs that users have: VTK, CalculiX, meshio and meshlane."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tensormass._shared.errors import InvalidArgumentError, MeshFileWarning
from tensormass._src import grids, mesh_files, mesh_geometry, meshes
from tensormass._src.shapes import SHAPES

VOLUME = 2.0
#: What makes a deck of CalculiX out of a mesh: it prints the volume of all elements.
ANALYSIS = """*MATERIAL, NAME=M
*ELASTIC
1000., 0.3
*SOLID SECTION, ELSET=Eall, MATERIAL=M
*BOUNDARY
wall, 1, 3
*STEP
*STATIC
*CLOAD
2, 1, 0.001
*EL PRINT, ELSET=Eall, TOTALS=ONLY
EVOL
*END STEP
"""


def bar(shape: str) -> meshes.VolumeMesh:
    grid = grids.grid([2, 1, 1], [2.0, 1.0, 1.0], shape=shape)
    return replace(
        grid,
        sets={"wall": np.flatnonzero(grid.nodes[:, 0] == 0).astype(np.uint32)},
        element_fields={
            "young_modulus_pa": np.linspace(1e3, 2e3, grid.element_count),
            "fibre_directions": np.arange(3.0 * grid.element_count).reshape(-1, 3),
        },
    )


@pytest.mark.parametrize("ending", ["vtk", "vtu"])
@pytest.mark.parametrize("shape", SHAPES)
def test_vtk_reads_what_is_written(tmp_path: Path, shape: str, ending: str) -> None:
    pyvista = pytest.importorskip("pyvista")
    mesh, path = bar(shape), tmp_path / f"bar.{ending}"
    mesh_files.write_mesh(path, mesh)
    grid = pyvista.read(path)
    volumes = grid.compute_cell_sizes()["Volume"]
    assert volumes.sum() == pytest.approx(VOLUME)
    assert volumes.min() > 0
    np.testing.assert_array_equal(np.flatnonzero(grid.point_data["set:wall"]), mesh.sets["wall"])
    for name, values in mesh.element_fields.items():
        np.testing.assert_array_equal(grid.cell_data[name], values)


@pytest.mark.parametrize("ending", ["msh", "vtk", "vtu", "inp"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("library", ["meshio", "meshlane"])
def test_meshio_and_its_fork_read_what_is_written(tmp_path: Path, library: str, shape: str, ending: str) -> None:
    reader = pytest.importorskip(library)
    if (shape, ending) == ("pyramid", "inp"):
        pytest.skip(f"{library} does not know C3D5")
    mesh, path = bar(shape), tmp_path / f"bar.{ending}"
    if ending == "inp":
        mesh = replace(mesh, element_fields={})
    mesh_files.write_mesh(path, mesh)
    # Both mirror the wedges of VTK's formats, as VTK did once.
    back = mesh_files.from_meshio(reader.read(path))
    np.testing.assert_array_equal(back.nodes, mesh.nodes)
    np.testing.assert_array_equal(back.elements(shape), mesh.elements(shape))
    assert mesh_geometry.signed_volumes(back).min() > 0
    np.testing.assert_array_equal(back.sets["wall"], mesh.sets["wall"])
    np.testing.assert_equal(dict(back.element_fields), dict(mesh.element_fields))


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape != "pyramid"])
def test_calculix_reads_what_is_written(tmp_path: Path, shape: str) -> None:
    program = shutil.which("ccx")
    if program is None:
        pytest.skip("CalculiX (ccx) is not installed")
    with pytest.warns(MeshFileWarning, match=r"\.inp does not hold young_modulus_pa, fibre_directions"):
        mesh_files.write_mesh(tmp_path / "bar.inp", bar(shape))
    with (tmp_path / "bar.inp").open("a") as file:
        file.write(ANALYSIS)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [program, "-i", "bar"]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert "*ERROR" not in ran.stdout
    assert float((tmp_path / "bar.dat").read_text().split()[-1]) == pytest.approx(VOLUME)
    back = mesh_files.read_mesh(tmp_path / "bar.inp")
    np.testing.assert_array_equal(back.elements(shape), bar(shape).elements(shape))
    np.testing.assert_array_equal(back.sets["wall"], bar(shape).sets["wall"])


def test_a_format_without_such_elements_or_programs_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"bar\.ele: \.ele holds no elements of type hexahedron; use \.msh"):
        mesh_files.write_mesh(tmp_path / "bar.ele", bar("hexahedron"))
    with pytest.warns(MeshFileWarning, match=r"bar\.inp: CalculiX does not know pyramids \(C3D5\); Abaqus does"):
        mesh_files.write_mesh(tmp_path / "bar.inp", bar("pyramid"))
    mesh_files.write_mesh(tmp_path / "bar.mesh", replace(bar("wedge"), sets={}, element_fields={}))
    back = mesh_files.read_mesh(tmp_path / "bar.mesh")
    np.testing.assert_array_equal(back.elements("wedge"), bar("wedge").elements("wedge"))


@pytest.mark.parametrize("library", ["meshio", "meshlane"])
def test_a_mesh_of_either_library_becomes_a_volume(library: str) -> None:
    made = pytest.importorskip(library)
    grid = grids.grid([1, 1, 1], [1.0, 1.0, 1.0])
    mesh = made.Mesh(
        np.concatenate([grid.nodes, [[9.0, 9, 9]]]),
        [("line", [[0, 1]]), ("tetra", grid.elements("tetrahedron").astype(np.int64))],
        point_sets={"wall": [0, 2]},
        cell_sets={"first": [[], [0]], "edge": [[0], []]},
        cell_data={"poisson_ratio": [[0.0], [0.1, 0.2, 0.3, 0.1, 0.2, 0.3]]},
    )
    back = mesh_files.from_meshio(mesh)
    assert len(back.nodes) == 9, "the indices of nodes are the caller's"
    assert {name: nodes.tolist() for name, nodes in back.sets.items()} == {
        "wall": [0, 2],
        "first": sorted(grid.elements("tetrahedron")[0].tolist()),
        "edge": [0, 1],
    }
    assert back.element_fields["poisson_ratio"].tolist() == [0.1, 0.2, 0.3, 0.1, 0.2, 0.3]
