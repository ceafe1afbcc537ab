"""`tensormass organ`: a scene of a segmentation has its place and size, and is held where segments touch."""

from __future__ import annotations

import importlib.util
import json
import warnings
from pathlib import Path
from typing import Any

import label_files as files
import numpy as np
import pytest
import surfaces
import yaml

import tensormass as tm
from tensormass._shared import extras
from tensormass._src import mesh_files, mesh_geometry
from tensormass._src.meshes import TriangleSurface, VolumeMesh
from tensormass._src.scene import Scene
from tensormass_tools import organ_bodies, organ_scene, segment_surface, tissues
from tensormass_tools.cli import main

pytestmark = pytest.mark.skipif(
    any(importlib.util.find_spec(module) is None for module in extras.EXTRAS["organs"].values()),
    reason="the extra `organs` is not installed",
)
SPACING = (2e-3, 3e-3, 4e-3)
NAMES = {1: "Right kidney", 2: "table"}


def _organ(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    """Runs the command. Returns what it prints as JSON."""
    status = main(["organ", *map(str, args), "--json"])
    out = capsys.readouterr()
    assert status == 0, out.out + out.err
    answer: dict[str, Any] = json.loads(out.out)
    return answer


def _refused(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    assert main(["organ", *map(str, args)]) == 1
    return capsys.readouterr().err


def _mesh(path: Path) -> VolumeMesh:
    """Reads a mesh that was written: closed, and without inverted elements."""
    mesh = mesh_files.read_mesh(path)
    assert (mesh_geometry.signed_volumes(mesh) > 0).all()
    assert segment_surface.open_edges(mesh_geometry.boundary_surface(mesh).triangles) == 0
    return mesh


def _center(mesh: VolumeMesh) -> files.Floats:
    volumes = mesh_geometry.signed_volumes(mesh)
    return np.average(mesh.nodes[mesh.elements("tetrahedron")].mean(axis=1), axis=0, weights=volumes)


def _check_shape(mesh: VolumeMesh, voxels: np.ndarray[Any, Any], affine: files.Floats) -> None:
    """The mesh has volume, centre and extent of label 1."""
    volume = np.count_nonzero(voxels == 1) * abs(np.linalg.det(affine[:3, :3]))
    assert mesh_geometry.mesh_quality(mesh).volume == pytest.approx(volume, rel=0.02)
    np.testing.assert_allclose(_center(mesh), files.center_m(voxels, affine), atol=8e-4)
    # Each arm has its own length, so a turned or mirrored mesh has another extent along some axis of the image.
    index = np.argwhere(voxels == 1)
    along = (mesh.nodes - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
    np.testing.assert_allclose(along.min(axis=0), index.min(axis=0) - 0.5, atol=0.6)
    np.testing.assert_allclose(along.max(axis=0), index.max(axis=0) + 0.5, atol=0.6)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("written", ["lps.seg.nrrd", "ras.nrrd", "sform.nii.gz", "qform.nii"])
def test_a_segment_lies_where_its_voxels_lie(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], written: str, mirrored: bool
) -> None:
    voxels, affine = files.shape(SPACING), files.oblique(SPACING, mirrored=mirrored)
    path = tmp_path / written
    if "nrrd" in written:
        space = "right-anterior-superior" if "ras" in written else "left-posterior-superior"
        files.nrrd(path, voxels, affine, space=space, names=NAMES)
        chosen = ["--segment", "Right kidney"]
    else:
        files.nifti(path, voxels, affine, form=written.partition(".")[0])
        chosen = ["--segment", "1", "--tissue", "kidney"]
    answer = _organ(capsys, path, *chosen, "-o", tmp_path / "scene.yaml", "--edge", "7mm")
    body = answer["bodies"][0]
    mesh = _mesh(Path(answer["output"][1]))
    _check_shape(mesh, voxels, affine)
    assert body["volume_m3"] == pytest.approx(body["file_volume_m3"], rel=0.02)
    held = mesh.nodes[mesh.sets["held"]]
    along = (held - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
    # The plate lies below the third slice.
    assert len(held) > 5
    assert along[:, 2].max() < 2.5 + 1.5


def test_the_scene_names_sources_and_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = files.nrrd(tmp_path / "a.seg.nrrd", files.shape(SPACING), files.straight(SPACING), names=NAMES)
    answer = _organ(capsys, path, "--segment", "right kidney", "-o", tmp_path / "k.yaml", "--edge", "8mm")
    text = (tmp_path / "k.yaml").read_text()
    assert "doi:10.1002/jmri.22670" in text
    scene = Scene.from_file(tmp_path / "k.yaml").message
    assert scene.name == "k"
    assert scene.bodies[0].name == "Right_kidney"
    law = scene.bodies[0].law.stable_neo_hookean
    assert law.young_modulus_pa == pytest.approx(2 * 1.45 * 4900, rel=1e-5)
    assert law.young_modulus_pa == pytest.approx(answer["bodies"][0]["young_modulus_pa"], rel=1e-5)
    assert scene.tools[0].spherical_probe.radius_m >= answer["bodies"][0]["edge_m"] * 0.999


@pytest.mark.parametrize("law", organ_scene.LAWS)
def test_every_law_makes_a_scene(tmp_path: Path, law: str) -> None:
    cube = tm.grid([2, 2, 2], [0.02, 0.02, 0.02], shape="tetrahedron")
    held = cube.nodes[:, 2] < 0.001
    body = organ_bodies.Body("a", 'a "\n# b', tissues.by_hand(1e-7), cube, 8e-6, 0.01, held)
    organ_scene.write(tmp_path / "a.yaml", [body], law, organ_scene.Source("x\ny: z", ["has: a\nnote"]))
    message = Scene.from_file(tmp_path / "a.yaml").message
    assert message.bodies[0].law.WhichOneof("kind") == law
    assert getattr(message.bodies[0].law, law).young_modulus_pa == pytest.approx(1e-7)


def test_two_segments_touch_and_do_not_overlap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], server: tm.Server
) -> None:
    affine = files.oblique(SPACING)
    path = files.nrrd(tmp_path / "a.seg.nrrd", files.shape(SPACING), affine, names=NAMES)
    answer = _organ(
        capsys, path, "--segment", "Right kidney", "--segment", "table", "--tissue", "kidney", "--tissue", "liver",
        "-o", tmp_path / "two.yaml", "--edge", "7mm",
    )  # fmt: skip
    kidney, table = answer["bodies"]
    assert kidney["touches"]["table"] > 3
    assert table["touches"]["Right_kidney"] > 3
    assert [body["tissue"] for body in answer["bodies"]] == ["kidney", "liver"]
    for body in answer["bodies"]:
        assert body["volume_m3"] == pytest.approx(body["file_volume_m3"], rel=0.02)
    with server.load(tmp_path / "two.yaml", lockstep=True) as scene:
        assert scene.report is not None
        assert not [warning for warning in scene.report.warnings if "overlap" in warning]
        scene.step(5)
        moved = np.abs(scene.positions("Right_kidney") - _mesh(Path(answer["output"][1])).nodes).max()
        assert moved < 1e-4, "bodies at rest push each other"


@pytest.mark.parametrize("kind", ["nii", "nii.gz", "nrrd"])
def test_the_daemon_loads_a_label_without_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], server: tm.Server, kind: str
) -> None:
    path = tmp_path / f"1.{kind}"
    write = files.nrrd if kind == "nrrd" else files.nifti
    write(path, files.shape(SPACING), files.oblique(SPACING))
    output = tmp_path / "7.yaml"
    answer = _organ(capsys, path, "--segment", 1, "--young-modulus", 5000, "-o", output, "--edge", "9mm")
    with server.load(output, lockstep=True) as scene:
        before = scene.positions("label_1")
        scene.move_tool("probe", before.mean(axis=0))
        scene.step(20)
        after = scene.positions("label_1")
        assert np.isfinite(after).all()
        assert np.abs(after - before).max() > 1e-4, "the probe reaches the tissue"
        held = _mesh(Path(answer["output"][1])).sets["held"]
        np.testing.assert_allclose(after[held], before[held], atol=1e-7)


def test_overlaps_holes_and_parts_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    voxels = np.zeros((2, 24, 24, 24), np.uint8)
    voxels[0, 4:20, 4:20, 4:20] = 1
    voxels[0, 8:14, 8:14, 8:14] = 0  # a cavity
    voxels[0, 17, 17, 17] = 0  # a crumb of one
    voxels[0, 1, 1, 1] = 1  # a crumb
    voxels[1, 2:6, 2:22, 2:22] = 1
    more = (
        "Segment0_Name:=liver\nSegment0_LabelValue:=1\nSegment0_Layer:=0\n"
        "Segment1_Name:=spleen\nSegment1_LabelValue:=1\nSegment1_Layer:=1"
    )
    path = files.nrrd(tmp_path / "a.seg.nrrd", voxels, files.straight((3e-3, 3e-3, 3e-3)), more=more)
    said = " ".join(
        _organ(capsys, path, "--segment", "liver", "--edge", "12mm", "-o", tmp_path / "a.yaml")["bodies"][0]["notes"]
    )
    assert "512 voxels of it belong to 'spleen', too, and are taken; name both" in said
    assert "1 separate part of 1 voxel is dropped" in said
    assert "1 hole of 1 voxel is filled" in said
    assert "1 hole of 216 voxels is kept as cavities; --fill-holes fills them" in said
    mesh = _mesh(tmp_path / "a_liver.msh")
    assert mesh_geometry.mesh_quality(mesh).volume == pytest.approx((16**3 - 216) * 27e-9, rel=0.02)
    both = _organ(
        capsys,
        path,
        "--segment",
        "spleen",
        "--segment",
        "liver",
        "--fill-holes",
        "--edge",
        "12mm",
        "-o",
        tmp_path / "b.yaml",
    )["bodies"]
    assert any("belong to a segment that was named before" in note for note in both[1]["notes"])
    assert both[1]["volume_m3"] == pytest.approx((16**3 - 512) * 27e-9, rel=0.02)


def test_wrong_wishes_are_refused_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = {**NAMES, 3: "empty liver"}
    path = files.nrrd(tmp_path / "a.seg.nrrd", files.shape(SPACING), files.straight(SPACING), names=names)
    out = ["-o", tmp_path / "a.yaml"]
    assert "did you mean 'Right kidney'?" in _refused(capsys, path, "--segment", "Right kidny", *out)
    assert "segment 'empty liver' is empty" in _refused(capsys, path, "--segment", "empty liver", *out)
    assert "give --tissue (lung, liver" in _refused(capsys, path, "--segment", "table", *out)
    assert "given twice" in _refused(capsys, path, "--segment", 1, "--segment", "Right kidney", *out)
    assert "--support 'empty liver': does not touch" in _refused(
        capsys, path, "--segment", 1, "--support", "empty liver", "--edge", "9mm", *out
    )
    assert "--tissue livre: did you mean 'liver'?" in _refused(capsys, path, "--segment", 1, "--tissue", "livre", *out)
    assert "ends in .yaml" in _refused(capsys, path, "--segment", 1, "-o", tmp_path / "a.msh")
    assert "no such file" in _refused(capsys, tmp_path / "b.nrrd")
    assert "known are .nrrd" in _refused(capsys, Path(__file__))
    assert not (tmp_path / "a.yaml").exists()


def test_a_unit_replaces_that_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    voxels = files.shape(SPACING)
    path = files.nifti(tmp_path / "a.nii", voxels, files.straight(SPACING), unit=3)  # numbers for micrometres
    said = _organ(capsys, path, "--segment", 1, "--unit", "0.0001mm", "--tissue", "liver", "-o", tmp_path / "a.yaml")
    assert said["bodies"][0]["file_volume_m3"] == pytest.approx(np.count_nonzero(voxels == 1) * 24e-12)
    assert "is rare for an organ; --unit" in " ".join(said["bodies"][0]["notes"])
    assert "--unit replaces the file's unit" in said["notes"][0]


def test_segments_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    voxels, affine = files.shape(SPACING), files.straight(SPACING)
    path = files.nrrd(tmp_path / "a.seg.nrrd", voxels, affine, names=NAMES)
    rows = _organ(capsys, path)["segments"]
    assert [(row["segment"], row["tissue"]) for row in rows] == [("Right kidney", "kidney"), ("table", None)]
    assert rows[0]["volume_m3"] == pytest.approx(np.count_nonzero(voxels == 1) * 24e-9)
    assert main(["organ", str(path)]) == 0
    assert "Right kidney  (label 1)" in capsys.readouterr().out


@pytest.mark.parametrize("ending", [".stl", ".obj", ".ply"])
def test_a_closed_surface_becomes_a_body(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], server: tm.Server, ending: str
) -> None:
    vertices, triangles = surfaces.ball(3)
    # An ellipsoid of a third of a litre, in millimetres as 3D Slicer saves it, with its triangles turned inwards.
    surface = TriangleSurface.from_arrays(vertices * [60, 40, 30], triangles[:, ::-1])
    path = tmp_path / f"liver{ending}"
    mesh_files.write_surface(path, surface)
    answer = _organ(capsys, path, "-o", tmp_path / "a.yaml", "--edge", "14mm")
    body = answer["bodies"][0]
    volume = abs(segment_surface.enclosed_volume(surface.vertices, triangles)) * 1e-9
    assert (body["name"], body["tissue"]) == ("liver", "liver")
    assert body["volume_m3"] == pytest.approx(volume, rel=0.02)
    assert "is taken as millimetres; --unit names it" in " ".join(answer["notes"])
    assert "its back is held" in " ".join(body["notes"])
    mesh = _mesh(tmp_path / "a_liver.msh")
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [0.06, 0.04, 0.03], atol=2e-3)
    assert mesh.nodes[mesh.sets["held"]][:, 1].min() > 0.02
    with server.load(tmp_path / "a.yaml", lockstep=True) as scene:
        scene.step(2)


def test_surfaces_of_3d_slicer_in_ras_and_open_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vertices, triangles = surfaces.ball(2)
    path = tmp_path / "s.vtk"
    points = "\n".join(" ".join(map(repr, map(float, row))) for row in vertices * 0.03 + [0.1, 0.2, 0.3])
    cells = "\n".join(f"3 {a} {b} {c}" for a, b, c in triangles)
    text = (
        "# vtk DataFile Version 3.0\n3D Slicer output. SPACE=RAS\nASCII\nDATASET POLYDATA\n"
        f"POINTS {len(vertices)} double\n{points}\nPOLYGONS {len(triangles)} {4 * len(triangles)}\n{cells}\n"
    )
    path.write_text(text)
    wish = ["--segment", "left liver", "-o", tmp_path / "a.yaml", "--edge", "12mm", "--unit", "m"]
    _organ(capsys, path, *wish)
    np.testing.assert_allclose(_center(_mesh(tmp_path / "a_left_liver.msh")), [-0.1, -0.2, 0.3], atol=1e-3)
    path.write_text(
        text.replace(
            f"POLYGONS {len(triangles)} {4 * len(triangles)}", f"POLYGONS {len(triangles) - 1} {4 * len(triangles) - 4}"
        )
        .rstrip()
        .rpartition("\n")[0]
    )
    assert "the surface is not closed: 3 edges" in _refused(capsys, path, *wish)


def test_names_of_bodies_are_names_in_yaml_and_in_the_protocol() -> None:
    for title in ("5", "no", "Null", "", "---", "Leber ä/ö", "a b", "x" * 200, "1e5"):
        name = organ_bodies.body_name(title, [])
        assert yaml.safe_load(f"name: {name}") == {"name": name}
        assert 1 <= len(name) <= 64
    assert organ_bodies.body_name("a b", ["a_b"]) == "a_b_2"


def test_every_number_of_a_tissue_has_a_source_or_says_that_it_is_a_choice() -> None:
    table = yaml.safe_load(tissues.FILE.read_text())
    assert set(table["sources"]) == {
        entry["source"]
        for tissue in table["tissues"].values()
        for key, entry in tissue.items()
        if key != "words" and "source" in entry
    }
    for source in table["sources"].values():
        assert source["doi"].startswith("10.")
        assert source["read"]
    for name in tissues.known():
        tissue = tissues.by_name(name)
        assert 500 < tissue.young_modulus_pa.value < 50_000
        for number in (tissue.young_modulus_pa, tissue.poisson_ratio, tissue.density_kg_per_m3):
            assert "doi:" in number.why or "a choice" in number.why


@pytest.mark.parametrize(
    ("name", "term", "tissue"),
    [
        ("right lung", "", "lung"),
        ("Segment_3", "Liver", "liver"),
        ("liver vessels", "", None),
        ("liver and spleen", "", None),
        ("Kidneys", "", "kidney"),
        ("sliver", "", None),
        ("bone", "Rib", None),
    ],
)
def test_tissues_are_known_by_words(name: str, term: str, tissue: str | None) -> None:
    found = tissues.of_segment(name, term)
    assert (found.name if found else None) == tissue


@pytest.mark.skipif(importlib.util.find_spec("slicerio") is None, reason="slicerio is not installed")
def test_the_lung_of_slicerio(tmp_path: Path, capsys: pytest.CaptureFixture[str], server: tm.Server) -> None:
    spec = importlib.util.find_spec("slicerio")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    sample = Path(spec.submodule_search_locations[0]) / "data" / "Segmentation.seg.nrrd"
    answer = _organ(capsys, sample, "--segment", "right lung", "-o", tmp_path / "lung.yaml", "--edge", "20mm")
    body = answer["bodies"][0]
    assert body["tissue"] == "lung"
    assert body["volume_m3"] == pytest.approx(34450 * 3.04687595e-3**2 * 1e-2, rel=0.02)
    said = " ".join(body["notes"])
    assert "'ribs' holds it" in said
    assert "'tissue' touches" in said
    # LPS: the right lung lies at negative x, the ribs' side of it.
    assert _center(_mesh(tmp_path / "lung_right_lung.msh"))[0] < 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with server.load(tmp_path / "lung.yaml", lockstep=True) as scene:
            scene.step(2)
