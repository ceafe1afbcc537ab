"""The surface of a segment: marching cubes, smoothed without a change of volume.

T. Lewiner et al., "Efficient implementation of marching cubes' cases with topological guarantees", J. Graphics Tools
2003 (scikit-image's). G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tensormass import BoolArray, FloatArray, TriangleSurface

if TYPE_CHECKING:
    from tensormass_tools.segments import Chosen

# Taubin's weights (his example): they keep what is longer than about ten edges, and remove the steps between voxels.
_SHRINK, _GROW = 0.5, -0.53
_ROUNDS = 15
# Level of a voxel's share at which the surface lies. Not 1/2 exactly, which blocks of voxels often have: a vertex on a
# corner of the grid would make flat triangles.
_LEVEL = 0.4999
# Steps that restore the volume. Each is exact but for the surface's curvature.
_CORRECTIONS = 4


def surface_of(chosen: Chosen, step_m: float) -> TriangleSurface:
    """Returns the closed surface of a segment in LPS [m], with the volume of its voxels.

    Args:
        step_m: wanted size of triangles. Smaller voxels are joined to blocks.
    """
    share, affine = _blocks(chosen.mask, chosen.affine, step_m)
    vertices, triangles = _march(share)
    vertices = vertices @ affine[:3, :3].T + affine[:3, 3]
    if np.linalg.det(affine[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    vertices = _smoothed(vertices, triangles)
    return TriangleSurface(with_volume(vertices, triangles, chosen.volume_m3), triangles.astype(np.uint32))


def enclosed_volume(vertices: FloatArray, triangles: npt.NDArray[np.integer]) -> float:
    """Returns the volume within a closed surface; negative if its triangles are turned inwards."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def open_edges(triangles: npt.NDArray[np.integer]) -> int:
    """Returns the number of edges that do not lie between two triangles which go along them in opposite directions."""
    start = triangles.reshape(-1).astype(np.int64)
    end = np.roll(triangles, -1, axis=1).reshape(-1).astype(np.int64)
    count = int(triangles.max()) + 1
    forth, repeats = np.unique(start * count + end, return_counts=True)
    back = np.unique(end * count + start)
    return int((repeats > 1).sum()) + len(np.setdiff1d(forth, back, assume_unique=True))


def _blocks(
    mask: BoolArray, affine: npt.NDArray[np.float64], step_m: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Joins voxels to blocks of about a step. Returns the share of each block and its affine map."""
    factors = np.maximum(1, np.floor(step_m / np.linalg.norm(affine[:3, :3], axis=0) + 1e-9).astype(int))
    # A block of the margin stays empty on each side.
    after = [int(-size % factor + factor) for size, factor in zip(mask.shape, factors, strict=True)]
    padded = np.pad(mask, [(int(factor), end) for factor, end in zip(factors, after, strict=True)])
    shape = [part for size, factor in zip(padded.shape, factors, strict=True) for part in (size // factor, factor)]
    share = padded.reshape(shape).mean(axis=(1, 3, 5), dtype=np.float32)
    out = affine.copy()
    out[:3, :3] = affine[:3, :3] * factors
    # The centre of the first block.
    out[:3, 3] = affine[:3, 3] + affine[:3, :3] @ ((factors - 1) / 2 - factors)
    return share, out


def _march(share: npt.NDArray[np.float32]) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Returns vertices, in indices, and triangles that turn outwards where the axes are right-handed."""
    from skimage import measure

    vertices, triangles, _, _ = measure.marching_cubes(share, _LEVEL, gradient_direction="descent")
    triangles = triangles.astype(np.int64)
    vertices = vertices.astype(np.float64)
    return vertices, triangles if enclosed_volume(vertices, triangles) > 0 else triangles[:, ::-1]


def _smoothed(vertices: FloatArray, triangles: npt.NDArray[np.int64]) -> FloatArray:
    from scipy import sparse

    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    edges = sparse.coo_array((np.ones(len(start)), (start, end)), (len(vertices), len(vertices))).tocsr()
    edges = edges + edges.T
    edges.data[:] = 1.0
    mean = sparse.diags_array(1.0 / np.maximum(edges.sum(axis=1), 1.0)) @ edges
    for _ in range(_ROUNDS):
        for weight in (_SHRINK, _GROW):
            vertices = vertices + weight * (mean @ vertices - vertices)
    return vertices


def with_volume(
    vertices: FloatArray, triangles: npt.NDArray[np.int64], volume: float, free: BoolArray | None = None
) -> FloatArray:
    """Moves the vertices of a closed surface along their normals until it has a volume. Points of no triangle stay, and
    those outside the mask `free`."""
    for _ in range(_CORRECTIONS):
        corner = vertices[triangles]
        areas = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
        normals = np.stack(
            [
                np.bincount(triangles.reshape(-1), np.repeat(areas[:, axis], 3), minlength=len(vertices))
                for axis in range(3)
            ],
            axis=1,
        )
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        if free is not None:
            normals[~free] = 0
        missing = volume - enclosed_volume(vertices, triangles)
        # Change of volume for each metre: the mean of the corners' normals on each triangle.
        rate = float(np.einsum("ti,ti->", areas, normals[triangles].mean(axis=1)))
        vertices = vertices + normals * (missing / max(rate, 1e-300))
    return vertices
