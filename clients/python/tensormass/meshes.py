"""Tetrahedral meshes and triangulated surfaces: reading, writing, repair and quality.

meshio reads the formats; the Gmsh 1 format ($NOD/$ELM), which it does not know, is read here. Readers return what the
file says, in the file's node order (regions may refer to nodes by index); only `repair` changes a mesh.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import numpy.typing as npt

from tensormass.errors import InvalidArgumentError, NotFoundError
from tensormass.processes import ChildProcess

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.uint32]

# Outward faces of a positively wound tetrahedron in VTK node order.
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
# Gmsh element types: those of no volume are passed over, volumes other than tetrahedra are refused.
_GMSH_TETRAHEDRON = 4
_GMSH_WITHOUT_VOLUME = {1, 2, 3, 15}
_MESHIO_WITHOUT_VOLUME = {"vertex", "line", "line3", "triangle", "triangle6", "quad", "quad8", "quad9", "polygon"}


@dataclass(frozen=True)
class TetrahedralMesh:
    """A volume. `nodes` float64 [node_count, 3]; `tetrahedra` uint32 [tetrahedron_count, 4], VTK node order."""

    nodes: FloatArray
    tetrahedra: IndexArray

    @staticmethod
    def from_arrays(nodes: npt.ArrayLike, tetrahedra: npt.ArrayLike, where: str = "mesh") -> TetrahedralMesh:
        """Checks shapes, finiteness and index range.

        Raises:
            InvalidArgumentError: naming `where`, the row and the remedy.
        """
        points = _checked_points(nodes, f"{where}.nodes")
        return TetrahedralMesh(points, _checked_indices(tetrahedra, 4, len(points), f"{where}.tetrahedra"))


@dataclass(frozen=True)
class TriangleSurface:
    """`vertices` float64 [vertex_count, 3]; `triangles` uint32 [triangle_count, 3], counter-clockwise from outside."""

    vertices: FloatArray
    triangles: IndexArray

    @staticmethod
    def from_arrays(vertices: npt.ArrayLike, triangles: npt.ArrayLike, where: str = "surface") -> TriangleSurface:
        """As `TetrahedralMesh.from_arrays`."""
        points = _checked_points(vertices, f"{where}.vertices")
        return TriangleSurface(points, _checked_indices(triangles, 3, len(points), f"{where}.triangles"))


@dataclass(frozen=True)
class MeshQuality:
    """What matters to a solver. Lengths and volumes in the mesh's own unit."""

    node_count: int
    tetrahedron_count: int
    volume: float
    min_dihedral_angle_deg: float
    mean_edge_length: float
    inverted_count: int


# --- reading and writing ----------------------------------------------------------------------------------------------


def read_mesh(path: str | Path) -> TetrahedralMesh:
    """Reads a tetrahedral mesh: Gmsh 1 or anything meshio knows (.msh 2.2/4.x, .vtk, .vtu, .inp, .mesh, .ele ...).

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, or it holds no tetrahedra or other volume elements.
    """
    path = Path(path)
    if _is_gmsh1(path):
        return read_gmsh1(path)
    return from_meshio(_meshio_read(path), str(path))


def from_meshio(mesh: meshio.Mesh, where: str = "meshio.Mesh") -> TetrahedralMesh:
    """The tetrahedra of a `meshio.Mesh`; other elements that have a volume are refused, not dropped."""
    blocks = [block.data for block in mesh.cells if block.type == "tetra"]
    others = sorted({block.type for block in mesh.cells} - {"tetra"} - _MESHIO_WITHOUT_VOLUME)
    if others:
        raise InvalidArgumentError(f"{where}: has elements of type {', '.join(others)}; split them into tetrahedra")
    if not blocks:
        raise InvalidArgumentError(
            f"{where}: has no tetrahedra; if it is a closed surface, fill it with `tensormass mesh --edge LENGTH`"
        )
    return TetrahedralMesh.from_arrays(mesh.points, np.concatenate(blocks), where)


def read_surface(path: str | Path) -> TriangleSurface:
    """Reads a triangulated surface (.obj, .stl, .ply, .off, .vtk ...); quads are split, equal vertices merged.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, or it has no triangles.
    """
    mesh = _meshio_read(Path(path))
    quads = [block.data for block in mesh.cells if block.type == "quad"]
    triangles = [block.data for block in mesh.cells if block.type == "triangle"]
    triangles += [np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]) for quad in quads]
    if not triangles:
        raise InvalidArgumentError(f"{path}: has no triangles; a skin and a surface to be meshed need them")
    surface = TriangleSurface.from_arrays(mesh.points, np.concatenate(triangles), str(path))
    # STL repeats each vertex in each triangle.
    vertices, index = np.unique(surface.vertices, axis=0, return_inverse=True)
    if len(vertices) == len(surface.vertices):
        return surface
    return TriangleSurface(vertices, index.reshape(-1)[surface.triangles].astype(np.uint32))


def write_mesh(path: str | Path, mesh: TetrahedralMesh) -> None:
    """Writes by the name's ending: .msh (Gmsh 2.2), .vtk, .vtu and whatever else meshio writes.

    Raises:
        InvalidArgumentError: unknown ending.
    """
    path = Path(path)
    out = meshio.Mesh(mesh.nodes, [("tetra", mesh.tetrahedra.astype(np.int64))])
    options = {"file_format": "gmsh22"} if path.suffix == ".msh" else {}
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            out.write(path, **options)
    except (meshio.ReadError, meshio.WriteError, SystemExit) as error:
        raise InvalidArgumentError(f"{path}: cannot be written; use .msh, .vtk or .vtu") from error


def read_gmsh1(path: str | Path) -> TetrahedralMesh:
    """Reads the Gmsh 1 format: `$NOD count, id x y z ... $ENDNOD $ELM count, id type physical entity n nodes ...`.

    Raises:
        InvalidArgumentError: naming the line.
    """
    try:
        lines = Path(path).read_text("ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidArgumentError(f"{path}: cannot be read as Gmsh 1: {error}") from error
    node_rows, first_node_line = _gmsh1_section(path, lines, "NOD")
    element_rows, first_element_line = _gmsh1_section(path, lines, "ELM")

    index_of: dict[int, int] = {}
    points = np.empty((len(node_rows), 3))
    for row, text in enumerate(node_rows):
        where = f"{path}:{first_node_line + row}"
        try:
            number, x, y, z = text.split()
            node, points[row] = int(number), (float(x), float(y), float(z))
        except ValueError as error:
            raise InvalidArgumentError(f"{where}: expected `id x y z`, found {text!r}") from error
        if node in index_of:
            raise InvalidArgumentError(f"{where}: node {node} is defined a second time")
        index_of[node] = row

    tetrahedra: list[list[int]] = []
    for row, text in enumerate(element_rows):
        where = f"{path}:{first_element_line + row}"
        try:
            element, kind, _physical, _entity, count, *nodes = (int(word) for word in text.split())
        except ValueError as error:
            raise InvalidArgumentError(f"{where}: expected integers `id type .. .. n nodes`, found {text!r}") from error
        if len(nodes) != count:
            raise InvalidArgumentError(f"{where}: element {element} announces {count} nodes and lists {len(nodes)}")
        if kind in _GMSH_WITHOUT_VOLUME:
            continue
        if kind != _GMSH_TETRAHEDRON or count != 4:
            raise InvalidArgumentError(f"{where}: element {element} has type {kind}; only tetrahedra (4) are read")
        try:
            tetrahedra.append([index_of[node] for node in nodes])
        except KeyError as error:
            raise InvalidArgumentError(f"{where}: element {element} uses node {error}, which is not defined") from None
    if not tetrahedra:
        raise InvalidArgumentError(f"{path}: has no tetrahedra")
    return TetrahedralMesh.from_arrays(points, tetrahedra, str(path))


def _gmsh1_section(path: str | Path, lines: list[str], name: str) -> tuple[list[str], int]:
    """The rows of `$name ... $ENDname` and the line number of the first."""
    try:
        begin = lines.index(f"${name}")
        count = int(lines[begin + 1])
        rows = lines[begin + 2 : begin + 2 + count]
        closed = count >= 0 and [line.strip() for line in lines[begin + 2 + count :][:1]] == [f"$END{name}"]
    except (ValueError, IndexError) as error:
        raise InvalidArgumentError(f"{path}: section ${name} is missing or cut off") from error
    if not closed:
        raise InvalidArgumentError(f"{path}: section ${name} announces {count} rows, but $END{name} is not after them")
    return rows, begin + 3


def _is_gmsh1(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) == b"$NOD"
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be read: {error.strerror}") from error


def _meshio_read(path: Path) -> meshio.Mesh:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file")
    said = io.StringIO()
    try:
        # meshio ends the process on a file that it cannot read, after printing why; it tells ASCII from binary STL by
        # a product that may overflow.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), np.errstate(over="ignore"):
            return meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = " ".join((said.getvalue() or str(error)).split())
        raise InvalidArgumentError(f"{path}: not readable as a mesh: {reason}") from error


# --- checks -----------------------------------------------------------------------------------------------------------


def _checked_points(values: npt.ArrayLike, where: str) -> FloatArray:
    try:
        points = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{where}: not an array of numbers: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InvalidArgumentError(f"{where}: expected shape [n, 3] with n > 0, got {list(points.shape)}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InvalidArgumentError(f"{where}: row {bad[0]} is not finite: {points[bad[0]].tolist()}")
    return points


def _checked_indices(values: npt.ArrayLike, width: int, limit: int, where: str) -> IndexArray:
    indices = np.asarray(values)
    if indices.ndim != 2 or indices.shape[1] != width or len(indices) == 0:
        raise InvalidArgumentError(f"{where}: expected shape [n, {width}] with n > 0, got {list(indices.shape)}")
    if not np.issubdtype(indices.dtype, np.integer):
        raise InvalidArgumentError(f"{where}: expected integers, got {indices.dtype}")
    bad = np.flatnonzero(((indices < 0) | (indices >= limit)).any(axis=1))
    if bad.size:
        raise InvalidArgumentError(
            f"{where}: row {bad[0]} is {indices[bad[0]].tolist()}, but indices run from 0 to {limit - 1}"
        )
    return np.ascontiguousarray(indices, dtype=np.uint32)


# --- geometry ---------------------------------------------------------------------------------------------------------


def signed_volumes(mesh: TetrahedralMesh) -> FloatArray:
    """[tetrahedron_count], negative where inverted."""
    corner = mesh.nodes[mesh.tetrahedra]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    volumes: FloatArray = np.einsum("ij,ij->i", np.cross(a, b), c) / 6.0
    return volumes


def dihedral_angles_deg(mesh: TetrahedralMesh) -> FloatArray:
    """[tetrahedron_count, 6], in no particular order."""
    corner = mesh.nodes[mesh.tetrahedra][:, _FACES]  # [tetrahedron, face, corner, 3]
    normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    first, second = np.triu_indices(4, 1)
    cosine = -np.einsum("eij,eij->ei", normal[:, first], normal[:, second])
    angles: FloatArray = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return angles


def quality(mesh: TetrahedralMesh) -> MeshQuality:
    """Counts, volume, edge length and the worst dihedral angle."""
    volumes = signed_volumes(mesh)
    corner = mesh.nodes[mesh.tetrahedra]
    first, second = np.triu_indices(4, 1)
    return MeshQuality(
        node_count=len(mesh.nodes),
        tetrahedron_count=len(mesh.tetrahedra),
        volume=float(volumes.sum()),
        min_dihedral_angle_deg=float(dihedral_angles_deg(mesh).min()),
        mean_edge_length=float(np.linalg.norm(corner[:, first] - corner[:, second], axis=2).mean()),
        inverted_count=int((volumes <= 0).sum()),
    )


def boundary(mesh: TetrahedralMesh) -> TriangleSurface:
    """Outward triangles that belong to one tetrahedron only, on a compact list of vertices."""
    faces = mesh.tetrahedra[:, _FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[np.sort(first[count == 1])]
    used, index = np.unique(outer, return_inverse=True)
    return TriangleSurface(mesh.nodes[used], index.reshape(outer.shape).astype(np.uint32))


def repair(mesh: TetrahedralMesh) -> TetrahedralMesh:
    """What the daemon would refuse or warn of: inverted elements are rewound, flat ones dropped, and only the largest
    component (by volume, connected over shared nodes) is kept, on a compact list of nodes."""
    volumes = signed_volumes(mesh)
    extent = float(np.ptp(mesh.nodes, axis=0).max())
    solid = np.abs(volumes) > 1e-12 * extent**3
    if not solid.any():
        raise InvalidArgumentError("the mesh encloses no volume")
    tetrahedra = mesh.tetrahedra.copy()
    inverted = volumes < 0
    tetrahedra[inverted] = tetrahedra[inverted][:, [0, 2, 1, 3]]
    tetrahedra, volumes = tetrahedra[solid], np.abs(volumes[solid])
    component = _components(len(mesh.nodes), tetrahedra)[tetrahedra[:, 0]]
    largest = int(np.argmax(np.bincount(component, weights=volumes)))
    return compact(mesh.nodes, tetrahedra[component == largest])


def compact(nodes: FloatArray, tetrahedra: npt.NDArray[np.integer]) -> TetrahedralMesh:
    """Drops the nodes that no tetrahedron uses; the order of the others stays."""
    used, index = np.unique(tetrahedra, return_inverse=True)
    return TetrahedralMesh(
        np.ascontiguousarray(nodes[used]), np.ascontiguousarray(index.reshape(-1, 4), dtype=np.uint32)
    )


def _components(node_count: int, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Label of each node: the smallest node index of its component. Hooks labels together, halving the chains."""
    label = np.arange(node_count, dtype=np.int64)
    while True:
        lowest = label[cells].min(axis=1)
        new = label.copy()
        for corner in range(cells.shape[1]):
            np.minimum.at(new, label[cells[:, corner]], lowest)
        new = new[new]
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


# --- volumes from surfaces --------------------------------------------------------------------------------------------


def tetrahedralize(surface: TriangleSurface, edge_length: float) -> TetrahedralMesh:
    """Fills a closed surface, dirty or not, with tetrahedra (fTetWild); takes seconds to minutes.

    fTetWild draws random numbers: the mesh differs from run to run, so keep what was made.

    Args:
        edge_length: wanted length of an edge, in the surface's unit. The boundary keeps to the surface within a
            twentieth of it.

    Raises:
        InvalidArgumentError: an edge that is not positive or longer than the surface, or nothing enclosed.
    """
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if not 0 < edge_length < diagonal:
        raise InvalidArgumentError(
            f"edge length {edge_length:g}: must be positive and below the surface's diagonal, {diagonal:g}"
        )
    # A process of its own: the mesher writes files into its working directory, prints, and may end the process.
    with tempfile.TemporaryDirectory() as folder:
        surface_file, volume_file = Path(folder) / "surface.npz", Path(folder) / "volume.npz"
        np.savez(surface_file, vertices=surface.vertices, triangles=surface.triangles.astype(np.int32))
        run = [sys.executable, "-P", "-c", _TETWILD]
        run += [str(surface_file), str(volume_file), str(edge_length), str(edge_length / 20 / diagonal)]
        with tempfile.TemporaryFile() as log:
            mesher = ChildProcess(run, output=log, folder=folder)
            try:
                mesher.process.wait()
            finally:
                status = mesher.stop()
            log.seek(0)
            words = log.read().decode(errors="replace").strip()
        if status != 0 or not volume_file.is_file():
            reason = (words or f"it ended with status {status}").splitlines()[-1]
            raise InvalidArgumentError(f"fTetWild could not mesh the surface: {reason}")
        with np.load(volume_file) as volume:
            nodes, tetrahedra = volume["nodes"], volume["tetrahedra"]
    if len(tetrahedra) == 0:
        raise InvalidArgumentError("the surface encloses no volume; close its holes first")
    return repair(TetrahedralMesh.from_arrays(nodes, tetrahedra, "result of fTetWild"))


# Without `coarsen` edges get no longer than the input's.
_TETWILD = """
import sys
import numpy as np
from pytetwild import tetrahedralize
surface = np.load(sys.argv[1])
nodes, tetrahedra = tetrahedralize(
    surface["vertices"], surface["triangles"], edge_length_abs=float(sys.argv[3]), epsilon=float(sys.argv[4]),
    coarsen=True, quiet=True)
np.savez(sys.argv[2], nodes=nodes, tetrahedra=tetrahedra)
"""
