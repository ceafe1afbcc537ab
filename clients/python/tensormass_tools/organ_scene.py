"""The scene file of `tensormass organ`: bodies, the sources of their moduli, what holds them, and a probe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tensormass import BoolArray, FloatArray, boundary_triangles, write_mesh
from tensormass_tools.organ_bodies import HELD, Body
from tensormass_tools.organ_gaps import GAP

#: Laws that Young's modulus and Poisson's ratio give.
LAWS = ("stable_neo_hookean", "neo_hookean", "corotational", "hencky", "st_venant_kirchhoff", "hooke")
# Smallest radius of the probe [m].
_MIN_RADIUS_M = 5e-3
# Distance from the tissue to the probe's surface, in radii.
_GAP = 1.0
_MAX_COMMENT = 118
# Colour of a body whose file names none: that of the demo's liver.
_COLOR = (0.55, 0.17, 0.14)


@dataclass(frozen=True)
class Source:
    """What the scene was made from, for its first lines."""

    file: str
    notes: Sequence[str]


def write(path: Path, bodies: Sequence[Body], law: str, source: Source) -> list[Path]:
    """Writes the scene and a mesh beside it for each body. Returns the paths of all."""
    meshes = [path.with_name(f"{path.stem}_{body.name}.msh") for body in bodies]
    for body, mesh_path in zip(bodies, meshes, strict=True):
        sets = {HELD: np.flatnonzero(body.held).astype(np.uint32)}
        sets |= {f"touches_{name}": np.flatnonzero(nodes).astype(np.uint32) for name, nodes in body.touches.items()}
        kept = {name: nodes for name, nodes in sets.items() if len(nodes)}
        write_mesh(mesh_path, replace(body.mesh, sets=kept))
    lines = _head(path, source)
    lines.append("bodies:")
    for body, mesh_path in zip(bodies, meshes, strict=True):
        lines += _body(body, mesh_path, law)
    lines += _links(bodies)
    lines += _probe(bodies)
    lines.append("solver: {cg_tolerance: 0.01}")
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return [path, *meshes]


def _head(path: Path, source: Source) -> list[str]:
    lines = _comment(
        f"Made by `tensormass organ` of {source.file}. Positions are LPS in metres: x to the patient's left, "
        "y to the back, z to the head."
    )
    lines += _comment(
        "Without gravity: the image shows the organs under their weight already. A patient who lies on the "
        "back has gravity_m_per_s2: {y: 9.81}."
    )
    for note in source.notes:
        lines += _comment(f"The file {note}.")
    return [*lines, f'name: "{scene_name(path)}"']


def scene_name(path: Path) -> str:
    """Returns the scene's name, after its file."""
    from tensormass._shared.names import as_name

    return as_name(path.stem) or "organ"


def _comment(text: str, indent: str = "") -> list[str]:
    """Returns a text as lines of comments. Names from files may hold anything, also ends of lines."""
    words = "".join(c if c.isprintable() else " " for c in text).split()
    lines = [f"{indent}#"]
    for word in words:
        if len(lines[-1]) + 1 + len(word) > _MAX_COMMENT and lines[-1].strip() != "#":
            lines.append(f"{indent}#")
        lines[-1] += f" {word}"
    return lines


def _body(body: Body, mesh_path: Path, law: str) -> list[str]:
    tissue = body.tissue
    lines = _comment(
        f"{body.title}: {body.mesh.element_count:,} tetrahedra with an edge of {1e3 * body.edge_m:.3g} mm; "
        f"{1e6 * body.mesh_volume_m3:.4g} mL, {1e6 * body.volume_m3:.4g} mL in the file. Tissue: {tissue.name}.",
        "  ",
    )
    for note in body.notes:
        lines += _comment(f"{note}.", "  ")
    red, green, blue = body.color or _COLOR
    lines += [f"  - name: {body.name}", f'    mesh: {{file: "{mesh_path.name}"}}', "    quadrature: selective"]
    for key in ("young_modulus_pa", "poisson_ratio", "density_kg_per_m3"):
        lines += _comment(f"{key}: {getattr(tissue, key).why or 'a choice'}", "    ")
    lines += [
        f"    law: {{{law}: {{young_modulus_pa: {_number(tissue.young_modulus_pa.value)}, "
        f"poisson_ratio: {_number(tissue.poisson_ratio.value)}}}}}",
        f"    density_kg_per_m3: {_number(tissue.density_kg_per_m3.value)}",
        *_comment("Damping: a choice, as in the built-in scenes.", "    "),
        "    rayleigh_mass_per_s: 0.5",
        "    rayleigh_stiffness_s: 0.01",
        f"    color_srgb: {_vector((red, green, blue))}",
    ]
    if body.held.any():
        lines.append(f"    fixed: [{{set: {HELD}}}]")
    return lines


def _links(bodies: Sequence[Body]) -> list[str]:
    """Connects bodies where they touch: springs against tearing apart, contact against passing through."""
    pairs = [
        (body, other)
        for index, body in enumerate(bodies)
        for other in bodies[index + 1 :]
        if other.name in body.touches and body.name in other.touches
    ]
    if not pairs:
        return []
    contacts, springs = ["body_contacts:"], ["attachments:"]
    for body, other in pairs:
        distance_m = GAP / 2 * min(body.edge_m, other.edge_m)
        contacts.append(f"  - {{body: {body.name}, other: {other.name}, distance_m: {_number(distance_m)}}}")
        area_m2 = _area(body, body.touches[other.name])
        softer_pa = min(body.tissue.young_modulus_pa.value, other.tissue.young_modulus_pa.value)
        edge_m = max(body.edge_m, other.edge_m)
        stiffness = softer_pa * area_m2 / edge_m
        springs += _comment(
            f"A layer of the softer tissue, as thick as an edge ({1e3 * edge_m:.3g} mm), over the {1e4 * area_m2:.3g} "
            "cm2 where the two touch: a choice, not a measurement.",
            "  ",
        )
        springs += [
            f"  - name: {f'{body.name}-{other.name}'[:64]}",
            f"    body: {body.name}",
            f"    region: {{set: touches_{other.name}}}",
            f"    other: {other.name}",
            f"    other_region: {{set: touches_{body.name}}}",
            f"    stiffness_n_per_m: {_number(stiffness)}",
        ]
    return [*contacts, *springs]


def _area(body: Body, nodes: BoolArray) -> float:
    """Returns the area of the boundary at some nodes, a third of each triangle for each of its corners."""
    triangles = boundary_triangles(body.mesh)
    corner = body.mesh.nodes[triangles]
    areas = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    return float((areas * nodes[triangles].mean(axis=1)).sum())


def _probe(bodies: Sequence[Body]) -> list[str]:
    """Puts a probe before the tissue, where it is farthest from all that holds it."""
    body = bodies[0]
    radius_m = max(_MIN_RADIUS_M, body.edge_m)
    triangles = boundary_triangles(body.mesh)
    nodes = body.mesh.nodes
    corner = nodes[triangles]
    center = corner.mean(axis=1)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    skin = np.concatenate([of.mesh.nodes[np.unique(boundary_triangles(of.mesh))] for of in bodies])
    free = _distance(center, nodes[body.held]) if body.held.any() else np.zeros(len(center))
    reach = radius_m * (1 + _GAP)
    for index in np.argsort(-free, kind="stable")[:200]:
        away = normal[index]
        at = center[index] + away * reach
        if np.linalg.norm(skin - at, axis=1).min() > radius_m * (1 + _GAP / 2):
            break
    else:
        low, high = skin.min(axis=0), skin.max(axis=0)
        away = np.array([0.0, -1.0, 0.0])
        at = np.array([(low[0] + high[0]) / 2, low[1] - reach, (low[2] + high[2]) / 2])
    return [
        "tools:",
        *_comment(
            "A probe no smaller than the triangles that it touches. Its shaft points away from the tissue.", "  "
        ),
        "  - name: probe",
        f"    spherical_probe: {{radius_m: {_number(radius_m)}}}",
        f"    position_m: {_vector(at)}",
        f"    orientation: {_quaternion(away)}",
    ]


def _quaternion(direction: FloatArray) -> str:
    """Returns a rotation that turns z into a direction of length 1."""
    x, y, z = (float(part) for part in direction)
    if z < -1 + 1e-6:
        return "{w: 0, x: 1, y: 0, z: 0}"
    length = np.sqrt(2 * (1 + z))
    w, a, b = ((1 + z) / length, -y / length, x / length)
    return f"{{w: {_number(w)}, x: {_number(a)}, y: {_number(b)}, z: 0}}"


def _distance(points: FloatArray, others: FloatArray) -> FloatArray:
    """Returns the distance of each point from the nearest of others, [n]."""
    out = np.full(len(points), np.inf)
    for first in range(0, len(others), 256):
        piece = others[first : first + 256]
        out = np.minimum(out, np.linalg.norm(points[:, np.newaxis] - piece, axis=2).min(axis=1))
    return out


def _vector(values: Sequence[float] | FloatArray) -> str:
    x, y, z = (_number(float(value)) for value in values)
    return f"{{x: {x}, y: {y}, z: {z}}}"


def _number(value: float) -> str:
    """Returns a number as YAML has it: an exponent needs a point before it."""
    text = f"{value:.6g}"
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if mark and "." not in mantissa else text
