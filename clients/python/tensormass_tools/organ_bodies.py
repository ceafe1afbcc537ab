"""Bodies of `tensormass organ`: tetrahedra in a segment or in a closed surface, and the nodes that hold them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tensormass import (
    BoolArray,
    InvalidArgumentError,
    Labels,
    MeshFileWarning,
    Segment,
    TriangleSurface,
    VolumeMesh,
    boundary_triangles,
    guess_unit_m,
    read_labels,
    read_surface,
    signed_volumes,
    tetrahedralize,
)
from tensormass._shared.components import components
from tensormass._shared.names import as_name
from tensormass_tools import segment_surface, segments, tissues

#: Set of the nodes that hold a body.
HELD = "held"
#: Largest difference of a mesh's volume from that of the voxels.
MAX_VOLUME_ERROR = 0.02
#: Tetrahedra that a body gets, roughly, without --edge: two cores step them in real time.
TETRAHEDRA = 10_000
# Triangles of the surface for an edge of a tetrahedron, along it. Finer ones take fTetWild longer.
_SURFACE_STEPS = 1.5
# A neighbour that covers more of a body than this surrounds it. Held there, the body could not move.
_SURROUNDS = 0.5
# fTetWild keeps the boundary within this share of an edge from the surface.
_ENVELOPE = 1 / 20
# Share of a body's extent that is held if nothing touches it.
_BACK = 0.1
# Volumes outside these [m³] are rarely those of an organ, and hint at a wrong unit.
_SMALL_M3, _LARGE_M3 = 1e-6, 3e-2
# Volume of a regular tetrahedron with an edge of 1.
_REGULAR = 1 / (6 * np.sqrt(2))
# Name of 3D Slicer's space in the header of surfaces that it writes [bytes that are searched].
_SLICER_HEAD = 512


@dataclass
class Body:
    """A body before it is written."""

    name: str
    #: The segment's name in the file.
    title: str
    tissue: tissues.Tissue
    #: Nodes in LPS [m].
    mesh: VolumeMesh
    #: Volume of the voxels or within the surface, before crumbs and holes.
    volume_m3: float
    edge_m: float
    held: BoolArray
    #: [name of another body]: nodes that touch it.
    touches: dict[str, BoolArray] = field(default_factory=dict)
    color: tuple[float, float, float] | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def mesh_volume_m3(self) -> float:
        """Returns the volume of the tetrahedra."""
        return float(signed_volumes(self.mesh).sum())


@dataclass(frozen=True)
class Wish:
    """What a user asks for."""

    segments: tuple[str, ...]
    tissues: tuple[str, ...] = ()
    young_modulus_pa: float | None = None
    edge_m: float | None = None
    unit_m: float | None = None
    supports: tuple[str, ...] = ()
    fill_holes: bool = False
    largest: bool = False


def from_labels(path: Path, wish: Wish) -> tuple[list[Body], list[str]]:
    """Makes a body of each segment. Returns them, and notes about the file.

    Raises:
        InvalidArgumentError: a segment that does not exist, is empty, or has no tissue or no mesh.
    """
    labels = scaled(read_labels(path), wish.unit_m)
    found = [segments.find(labels, name, str(path)) for name in wish.segments]
    if twice := [of.name for index, of in enumerate(found) if of in found[:index]]:
        raise InvalidArgumentError(f"{path}: --segment {twice[0]!r} is given twice; a body needs it once")
    supports = [segments.find(labels, name, str(path)) for name in wish.supports]
    of_segments = [_tissue(wish, index, of.name, of.term) for index, of in enumerate(found)]
    bodies: list[Body] = []
    chosen = segments.choose(labels, found, str(path), fill_holes=wish.fill_holes, largest=wish.largest)
    for segment, tissue, cut in zip(found, of_segments, chosen, strict=True):
        edge_m = wish.edge_m or _edge_for(cut.volume_m3)
        surface = segment_surface.surface_of(cut, edge_m / _SURFACE_STEPS)
        mesh, notes = _fill(surface, cut.volume_m3, edge_m, f"{path}: segment {segment.name!r}", wish)
        name = body_name(segment.name, [body.name for body in bodies])
        bodies.append(
            Body(name, segment.name, tissue, mesh, cut.file_volume_m3, edge_m, np.zeros(len(mesh.nodes), bool))
        )
        bodies[-1].color = segment.color
        bodies[-1].notes += [*cut.notes, *notes]
    for body, cut in zip(bodies, chosen, strict=True):
        _touch(labels, body, cut, list(zip(found, bodies, strict=True)), supports, str(path))
        _hold_loose_parts(body)
    return bodies, labels.notes


def from_surface(path: Path, wish: Wish) -> tuple[list[Body], list[str]]:
    """Makes one body of a closed surface. Returns it, and notes about the file.

    Raises:
        InvalidArgumentError: a surface that is open or turned, several names, or no tissue.
    """
    if len(wish.segments) > 1 or wish.supports:
        raise InvalidArgumentError(f"{path}: a surface is one body: give one --segment, as its name, and no --support")
    title = wish.segments[0] if wish.segments else path.stem
    tissue = _tissue(wish, 0, title, "")
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeshFileWarning)
        surface = read_surface(path)
    notes += [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    unit_m = wish.unit_m
    if unit_m is None:
        unit_m = guess_unit_m(surface.vertices) or 1.0
        size = " × ".join(f"{length:.3g}" for length in np.ptp(surface.vertices, axis=0))
        unit = "metres" if unit_m == 1.0 else "millimetres"
        notes.append(f"is {size} in a unit that the file does not name, and is taken as {unit}; --unit names it")
    vertices = surface.vertices * unit_m
    if _is_ras(path):
        vertices *= [-1, -1, 1]
        notes.append("says SPACE=RAS, and is turned into LPS")
    triangles = surface.triangles.astype(np.int64)
    if edges := segment_surface.open_edges(triangles):
        raise InvalidArgumentError(
            f"{path}: the surface is not closed: {edges} edges do not lie between two triangles of one side; close it "
            "in the program that made it, or fill it as it is with `tensormass mesh --edge LENGTH`"
        )
    volume_m3 = segment_surface.enclosed_volume(vertices, triangles)
    if volume_m3 < 0:
        triangles, volume_m3 = triangles[:, ::-1], -volume_m3
    if not volume_m3 > 0:
        raise InvalidArgumentError(f"{path}: the surface encloses no volume")
    edge_m = wish.edge_m or _edge_for(volume_m3)
    closed = TriangleSurface(vertices, np.ascontiguousarray(triangles, np.uint32))
    mesh, more = _fill(closed, volume_m3, edge_m, str(path), wish)
    body = Body(body_name(title, []), title, tissue, mesh, volume_m3, edge_m, np.zeros(len(mesh.nodes), bool))
    body.notes += more
    _hold_loose_parts(body)
    return [body], notes


def scaled(labels: Labels, unit_m: float | None) -> Labels:
    """Gives a label map another unit than the one that its file names (or does not); None keeps it."""
    if unit_m is None:
        return labels
    affine = labels.affine.copy()
    affine[:3] *= unit_m / labels.unit_m
    notes = [f"--unit replaces the file's unit by {unit_m:g} m", *labels.notes]
    return replace(labels, affine=affine, notes=notes, unit_m=unit_m)


def body_name(title: str, taken: Sequence[str]) -> str:
    """Returns a name for a body that YAML and the daemon take: never a bare number, never one that is taken."""
    name = as_name("_".join(title.split())).strip("_-")[:48] or "segment"
    if not name[0].isalpha() or name.lower() in ("null", "true", "false", "yes", "no", "on", "off", "y", "n"):
        name = f"label_{name}"
    number, out = 2, name
    while out in taken:
        out, number = f"{name}_{number}", number + 1
    return out


def _tissue(wish: Wish, index: int, title: str, term: str) -> tissues.Tissue:
    if wish.young_modulus_pa is not None:
        return tissues.by_hand(wish.young_modulus_pa)
    if wish.tissues:
        if len(wish.tissues) not in (1, max(1, len(wish.segments))):
            raise InvalidArgumentError(
                f"--tissue: {len(wish.tissues)} tissues for {len(wish.segments)} segments; give one for all or one each"
            )
        return tissues.by_name(wish.tissues[index if len(wish.tissues) > 1 else 0])
    found = tissues.of_segment(title, term)
    if found is None:
        raise InvalidArgumentError(
            f"segment {title!r}: no tissue of the table fits its name; give --tissue ({', '.join(tissues.known())}) or "
            "--young-modulus in Pa. Bones are far stiffer than organs: let them hold an organ instead (--support)"
        )
    return found


def _edge_for(volume_m3: float) -> float:
    return float((volume_m3 / (_REGULAR * TETRAHEDRA)) ** (1 / 3))


def _fill(
    surface: TriangleSurface, volume_m3: float, edge_m: float, where: str, wish: Wish
) -> tuple[VolumeMesh, list[str]]:
    """Fills a closed surface. Returns the mesh, which has its volume, and notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeshFileWarning)
        mesh = tetrahedralize(surface, edge_m, largest=wish.largest)
    for warning in caught:
        if not issubclass(warning.category, MeshFileWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    triangles = boundary_triangles(mesh).astype(np.int64)
    nodes = segment_surface.with_volume(mesh.nodes, triangles, volume_m3)
    before = signed_volumes(mesh)
    moved = replace(mesh, nodes=nodes)
    # Keeps the mesher's boundary if moving it spoils an element. It moves by far less than an edge.
    if (signed_volumes(moved) > before / 2).all():
        mesh = moved
    error = float(signed_volumes(mesh).sum()) / volume_m3 - 1
    if abs(error) > MAX_VOLUME_ERROR:
        raise InvalidArgumentError(
            f"{where}: its mesh has {100 * error:+.1f} % of the volume of the file, more than "
            f"{100 * MAX_VOLUME_ERROR:g} %: parts of it are thinner than an edge of {1e3 * edge_m:.3g} mm; give a "
            f"shorter one, such as --edge {1e3 * edge_m / 2:.2g}mm"
        )
    notes = list(mesh.notes)
    if not _SMALL_M3 < volume_m3 < _LARGE_M3:
        notes.append(f"it has {1e6 * volume_m3:.3g} mL, which is rare for an organ; --unit names another unit")
    return replace(mesh, notes=()), notes


def _touch(
    labels: Labels,
    body: Body,
    cut: segments.Chosen,
    others: list[tuple[Segment, Body]],
    supports: list[Segment],
    where: str,
) -> None:
    """Finds the nodes that touch other bodies, and those that segments without a body hold."""
    outer = np.unique(boundary_triangles(body.mesh))
    slack_m = max(body.edge_m * _ENVELOPE, body.edge_m / _SURFACE_STEPS / 2)
    own = {segment for segment, _ in others}
    of_bodies = {segment: other.name for segment, other in others if other is not body}
    candidates = supports or [segment for segment in segments.named(labels) if segment not in own]
    for segment in [*of_bodies, *candidates]:
        if segment.name == body.title:
            continue
        near = segments.touching(labels, cut, segments.mask_of(labels, segment), body.mesh.nodes[outer], slack_m)
        nodes = np.zeros(len(body.mesh.nodes), bool)
        nodes[outer[near]] = True
        share = 100 * near.mean()
        if segment in of_bodies:
            if near.any():
                body.touches[of_bodies[segment]] = nodes
        elif not near.any():
            if supports:
                raise InvalidArgumentError(f"{where}: --support {segment.name!r}: does not touch {body.title!r}")
        elif near.mean() > _SURROUNDS and not supports:
            body.notes.append(
                f"{segment.name!r} touches {share:.0f} % of its surface and does not hold it; --support "
                f"{segment.name!r} lets it"
            )
        else:
            body.held |= nodes
            body.notes.append(f"{segment.name!r} holds it at {int(near.sum())} nodes, {share:.0f} % of its surface")


def _hold_loose_parts(body: Body) -> None:
    """Holds the back of each part that nothing holds, so that it does not drift away."""
    part = components(len(body.mesh.nodes), [elements for _, elements in body.mesh.blocks])
    anchored = body.held.copy()
    for nodes in body.touches.values():
        anchored |= nodes
    for label in np.setdiff1d(part, part[anchored]):
        own = np.flatnonzero(part == label)
        back = body.mesh.nodes[own, 1]
        chosen = own[back >= back.max() - _BACK * max(float(np.ptp(back)), 1e-9)]
        body.held[chosen] = True
        what = "it" if len(own) == len(part) else f"a part of {len(own)} nodes"
        body.notes.append(
            f"nothing that touches {what} holds it; its back is held ({len(chosen)} nodes, the last tenth towards +y);"
            " change `fixed` in the scene if it hangs elsewhere"
        )
    if not body.held.any() and not body.touches:
        raise InvalidArgumentError(f"segment {body.title!r}: nothing holds it")


def _is_ras(path: Path) -> bool:
    with path.open("rb") as file:
        return b"SPACE=RAS" in file.read(_SLICER_HEAD)
