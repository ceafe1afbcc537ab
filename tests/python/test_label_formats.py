"""Label maps are read with their place in the patient, or refused with a reason. Needs no extra."""

from __future__ import annotations

import bz2
import gzip
import importlib.util
from pathlib import Path
from typing import Any, Literal

import label_files as files
import numpy as np
import pytest

import tensormass as tm
from tensormass._src import mesh_reading
from tensormass._src.label_formats import content, reading
from tensormass._src.mesh_formats.raw import FormatError

SPACING = (2e-3, 3e-3, 5e-3)


def _read(path: Path) -> content.Labels:
    return reading.read(path)  # in this process, which is faster


def _refused(path: Path) -> str:
    with pytest.raises(FormatError) as refusal:
        _read(path)
    assert str(path) in str(refusal.value)
    return str(refusal.value)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("space", ["left-posterior-superior", "right-anterior-superior", "left-anterior-superior"])
def test_nrrd_of_any_space_lies_at_the_same_place(tmp_path: Path, space: str, mirrored: bool) -> None:
    voxels, affine = files.shape(SPACING), files.oblique(SPACING, mirrored=mirrored)
    labels = _read(files.nrrd(tmp_path / "a.nrrd", voxels, affine, space=space))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-9)
    np.testing.assert_array_equal(labels.voxels[0], voxels)
    assert labels.notes == []


@pytest.mark.parametrize("unit", ["", "mm", "m", "um"])
def test_nrrd_of_any_unit(tmp_path: Path, unit: str) -> None:
    voxels, affine = files.shape(SPACING), files.oblique(SPACING)
    labels = _read(files.nrrd(tmp_path / "a.nrrd", voxels, affine, unit=unit))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-9)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["u1", "i2", "u2", "i4", "f4", "f8"])
@pytest.mark.parametrize("encoding", ["raw", "gzip", "ascii"])
def test_nrrd_of_any_type(tmp_path: Path, kind: str, encoding: str, order: Literal["<", ">"]) -> None:
    voxels = files.shape(SPACING)
    path = files.nrrd(tmp_path / "a.nrrd", voxels.astype(kind), files.straight(SPACING), encoding=encoding, order=order)
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)


def test_nrrd_packed_by_bzip2_and_in_several_members(tmp_path: Path) -> None:
    voxels = files.shape(SPACING)
    path = files.nrrd(tmp_path / "a.nrrd", voxels, files.straight(SPACING), encoding="bzip2")
    head, _, data = path.read_bytes().partition(b"\n\n")
    path.write_bytes(head + b"\n\n" + bz2.compress(data))
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)
    half = len(data) // 2
    path.write_bytes(
        head.replace(b"bzip2", b"gzip") + b"\n\n" + gzip.compress(data[:half]) + gzip.compress(data[half:])
    )
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)


def test_detached_data_lie_beside_their_header(tmp_path: Path) -> None:
    voxels = files.shape(SPACING)
    path = files.nrrd(tmp_path / "a.nhdr", voxels, files.straight(SPACING), encoding="raw")
    head, _, data = path.read_bytes().partition(b"\n\n")
    (tmp_path / "a.raw").write_bytes(b"12345678" + data)
    path.write_bytes(head + b"\nbyte skip: -1\ndata file: a.raw\n\n")
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)
    for elsewhere in ("../a.raw", "/etc/passwd", "a%d.raw", "LIST"):
        path.write_bytes(head + f"\ndata file: {elsewhere}\n\n".encode())
        assert "save it as one .nrrd" in _refused(path)
    path.write_bytes(head + b"\ndata file: b.raw\n\n")
    assert "no such file beside it" in _refused(path)


def test_segments_of_3d_slicer_in_layers(tmp_path: Path) -> None:
    voxels = np.stack([files.shape(SPACING), np.zeros_like(files.shape(SPACING))])
    voxels[1, 3:5, 3:5, 3:5] = 1
    tags = "TerminologyEntry:a~SCT^1^b~SCT^10200004^Liver~^^~c~^^~^^|"
    more = (
        f"Segment0_Name:=the liver\nSegment0_LabelValue:=1\nSegment0_Layer:=0\nSegment0_Tags:={tags}\n"
        "Segment0_Color:=0.5 0.25 1\nSegment1_Name:=a ball\nSegment1_LabelValue:=1\nSegment1_Layer:=1"
    )
    labels = _read(files.nrrd(tmp_path / "a.seg.nrrd", voxels, files.straight(SPACING), more=more))
    assert labels.segments == [
        content.Segment("the liver", 1, 0, "Liver", (0.5, 0.25, 1.0)),
        content.Segment("a ball", 1, 1),
    ]
    np.testing.assert_array_equal(labels.voxels, voxels)
    of_child = mesh_reading.labels(tmp_path / "a.seg.nrrd")
    assert of_child.segments == labels.segments
    np.testing.assert_array_equal(of_child.voxels, voxels)
    np.testing.assert_array_equal(of_child.affine, labels.affine)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("unsigned char", "block", "labels are whole numbers"),
        ("gzip", "hex", "encoding 'hex': known are raw"),
        ("sizes: 30 20 12", "sizes: 30 20", "the dimension is 3"),
        ("sizes: 30 20 12", "sizes: 30000 20000 12", "crop it"),
        ("sizes: 30 20 12", "sizes: 30 20 13", "ends after 7200 of 7800 voxels"),
        ("(2.0,0.0,0.0)", "(0.0,0.0,0.0)", "span no volume"),
        ("(2.0,0.0,0.0)", "(nan,0.0,0.0)", "not finite"),
        ("(2.0,0.0,0.0)", "(2.0,x,0.0)", "expected a number, found 'x'"),
        ("(2.0,0.0,0.0)", "none", "2 axes in space"),
        ("kinds:", 'space units: "furlong"\nkinds:', "expected one of mm, m and um"),
        ("kinds:", "Segment0_LabelValue:=0\nSegment0_Name:=x\nkinds:", "segment 'x': label '0'"),
        ("kinds:", "Segmentation_MasterRepresentation:=Fractional labelmap\nkinds:", "fractional"),
        ("NRRD0004", "NRRX0004", "not an NRRD file"),
        ("\n\n", "\n", "expected `field: value`"),
    ],
)
def test_a_wrong_nrrd_is_refused_by_its_field(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = files.nrrd(tmp_path / "a.nrrd", files.shape(SPACING), files.straight(SPACING))
    data = path.read_bytes()
    assert old.encode() in data
    path.write_bytes(data.replace(old.encode(), new.encode(), 1))
    assert says in _refused(path)


def test_values_that_are_not_labels_are_refused(tmp_path: Path) -> None:
    voxels, affine = files.shape(SPACING).astype("f4"), files.straight(SPACING)
    assert "probability" in _refused(files.nrrd(tmp_path / "a.nrrd", voxels * 0.5, affine))
    assert "probability" in _refused(files.nrrd(tmp_path / "a.nrrd", voxels * np.float32(np.nan), affine))
    assert "segment it first" in _refused(files.nrrd(tmp_path / "a.nrrd", (voxels - 1024).astype("i2"), affine))
    assert "segment it first" in _refused(files.nifti(tmp_path / "a.nii", (voxels * 70000).astype("i4"), affine))


def test_a_small_file_cannot_take_all_memory(tmp_path: Path) -> None:
    path = files.nrrd(tmp_path / "a.nrrd", files.shape(SPACING), files.straight(SPACING))
    head, _, _ = path.read_bytes().partition(b"\n\n")
    bomb = gzip.compress(bytes(1 << 28), 1)
    path.write_bytes(head + b"\n\n" + bomb)
    labels = mesh_reading.labels(path)  # reads what the sizes announce, and no more
    assert labels.voxels.shape == (1, 30, 20, 12)
    assert "are skipped" in labels.notes[0]


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("form", ["sform", "qform", "both"])
def test_nifti_lies_at_the_same_place(tmp_path: Path, form: str, mirrored: bool, version: int) -> None:
    voxels, affine = files.shape(SPACING), files.oblique(SPACING, mirrored=mirrored)
    labels = _read(files.nifti(tmp_path / "a.nii.gz", voxels, affine, form=form, version=version))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-6)
    np.testing.assert_array_equal(labels.voxels[0], voxels)
    assert labels.notes == []


@pytest.mark.parametrize("unit", [1, 2, 3, 2 | 8])
def test_nifti_of_any_unit(tmp_path: Path, unit: int) -> None:
    affine = files.oblique(SPACING)
    labels = _read(files.nifti(tmp_path / "a.nii", files.shape(SPACING), affine, unit=unit))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-6)
    assert labels.notes == []


def test_nifti_without_a_unit_or_an_orientation_says_what_is_taken(tmp_path: Path) -> None:
    voxels, affine = files.shape(SPACING), files.oblique(SPACING)
    labels = _read(files.nifti(tmp_path / "a.nii", voxels, affine, unit=0))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-6)
    assert labels.notes == ["names no unit of length, and is taken as millimetres"]
    labels = _read(files.nifti(tmp_path / "a.nii", voxels, affine, form="none"))
    np.testing.assert_allclose(labels.affine, np.diag([-2e-3, -3e-3, 5e-3, 1]), atol=1e-9)
    assert "has no orientation" in labels.notes[0]
    labels = _read(files.nifti(tmp_path / "a.nii", voxels, affine, form="both", wrong_qform=True))
    np.testing.assert_allclose(labels.affine, affine, atol=1e-6)
    assert "differ by up to 8.66 in its unit; the sform is used" in labels.notes[0]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["u1", "i1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_nifti_of_any_type(tmp_path: Path, kind: str, order: Literal["<", ">"]) -> None:
    voxels = files.shape(SPACING)
    path = files.nifti(tmp_path / "a.nii", voxels.astype(kind), files.straight(SPACING), order=order)
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)


@pytest.mark.parametrize(("slope", "intercept"), [(1.0, 0.0), (0.0, 7.0), (float("nan"), 0.0), (0.5, -3.0)])
def test_nifti_with_scaled_values(tmp_path: Path, slope: float, intercept: float) -> None:
    voxels = files.shape(SPACING)
    stored = voxels if slope != 0.5 else (2 * (voxels.astype("i2") + 3))
    path = files.nifti(
        tmp_path / "a.nii", stored.astype("i2"), files.straight(SPACING), slope=slope, intercept=intercept
    )
    np.testing.assert_array_equal(_read(path).voxels[0], voxels)


@pytest.mark.parametrize(
    ("at", "data", "says"),
    [
        (0, b"\0\0\0\0", "not a NIfTI file"),
        (344, b"ni1\0", "pair (.hdr and .img)"),
        (40, b"\x09\0", "dim[0] 9"),
        (40, b"\x04\0\x1e\0\x14\0\x0c\0\x05\0", "several volumes"),
        (42, b"\xff\xff", "each must be at least 1"),
        (42, b"\xff\x7f\xff\x7f", "crop it"),
        (70, b"\x80\0", "colours"),
        (72, b"\x20\0", "bitpix 32"),
        (108, b"\0\0\x80\x3f", "vox_offset 1"),
        (112, b"\0\0\x80\x7f", "not finite"),
        (123, b"\x04", "its unit of length"),
        (280, b"\0\0\xc0\x7f", "not finite"),
        (296, bytes(12), "span no volume"),
    ],
)
def test_a_wrong_nifti_is_refused_by_its_field(tmp_path: Path, at: int, data: bytes, says: str) -> None:
    path = files.nifti(tmp_path / "a.nii", files.shape(SPACING), files.straight(SPACING))
    content = bytearray(path.read_bytes())
    content[at : at + len(data)] = data
    path.write_bytes(content)
    assert says in _refused(path)


def test_a_file_that_is_cut_off_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = files.nifti(tmp_path / "a.nii", files.shape(SPACING), files.straight(SPACING))
    path.write_bytes(path.read_bytes()[:-100])
    assert "ends after 7100 of 7200 voxels" in _refused(path)
    packed = files.nifti(tmp_path / "a.nii.gz", files.shape(SPACING), files.straight(SPACING))
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size // 2])
    _refused(packed)
    other = tmp_path / "a.mha"
    other.write_bytes(b"ObjectType = Image\n")
    assert "known are .nrrd" in _refused(other)
    with pytest.raises(tm.InvalidArgumentError, match=r"known are \.nrrd"):
        mesh_reading.labels(other)


@pytest.mark.skipif(importlib.util.find_spec("nibabel") is None, reason="nibabel is not installed")
@pytest.mark.parametrize("form", ["sform", "qform", "none"])
def test_nibabel_agrees(tmp_path: Path, form: str) -> None:
    import nibabel

    voxels = files.shape(SPACING)
    path = files.nifti(tmp_path / "a.nii", voxels, files.oblique(SPACING, mirrored=True), form=form)
    image: Any = nibabel.load(path)
    ours = _read(path)
    np.testing.assert_array_equal(np.asarray(image.dataobj), ours.voxels[0])
    if form != "none":  # nibabel then puts the origin into the middle; we keep it at the first voxel
        np.testing.assert_allclose(np.diag([-1e-3, -1e-3, 1e-3, 1]) @ image.affine, ours.affine, atol=1e-6)
    saved = tmp_path / "b.nii.gz"
    nibabel.save(nibabel.Nifti2Image(voxels, image.affine), saved)
    np.testing.assert_array_equal(_read(saved).voxels[0], voxels)


@pytest.mark.skipif(importlib.util.find_spec("nrrd") is None, reason="pynrrd is not installed")
def test_pynrrd_agrees(tmp_path: Path) -> None:
    import nrrd

    voxels, affine = files.shape(SPACING), files.oblique(SPACING)
    path = files.nrrd(tmp_path / "a.nrrd", voxels, affine)
    data, header = nrrd.read(str(path))
    np.testing.assert_array_equal(data, voxels)
    np.testing.assert_allclose(header["space directions"].T, 1e3 * affine[:3, :3])
    saved = tmp_path / "b.nrrd"
    nrrd.write(str(saved), voxels.astype("i2"), header)
    labels = _read(saved)
    np.testing.assert_array_equal(labels.voxels[0], voxels)
    np.testing.assert_allclose(labels.affine, affine, atol=1e-9)
