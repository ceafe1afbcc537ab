"""Tissue under a tool that holds still rests, has an equilibrium, and does not fall through."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

import tensormass as tm

SIZE_M = (0.04, 0.02, 0.02)
YOUNG_PA = 1e4
POISSON = {"hooke": 0.3, "neo_hookean": 0.45, "stable_neo_hookean": 0.45}
#: Lowest point below the tool's position while it lies flat [m]. The tool's shape lies along x.
TOOLS: dict[str, tuple[dict[str, Any], float]] = {
    "capsule": ({"radius_m": 0.005, "length_m": 0.02}, 0.005),
    "retractor": ({"radius_m": 0.004, "blade_length_m": 0.02, "shaft_length_m": 0.1}, 0.004),
    "grasper": ({"radius_m": 0.004, "jaw_length_m": 0.02}, 0.004),
    "box": ({"size_x_m": 0.012, "size_y_m": 0.01, "size_z_m": 0.01, "edge_radius_m": 0.001}, 0.005),
}


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions (x, y, z, w)."""
    u, v = a[:3], b[:3]
    return np.append(a[3] * v + b[3] * u + np.cross(u, v), a[3] * b[3] - u @ v)


def about(axis: int, angle_rad: float) -> np.ndarray:
    q = np.zeros(4)
    q[axis], q[3] = np.sin(angle_rad / 2), np.cos(angle_rad / 2)
    return q


def held_block(
    random: np.random.Generator, shape: Literal["hexahedron", "tetrahedron"], law: str
) -> tuple[tm.Scene, np.ndarray]:
    """A block on a held base, and which nodes are held."""
    cells = [int(c) for c in random.integers([5, 4, 3], [10, 8, 5])]
    mesh = tm.grid(cells, list(SIZE_M), shape=shape)
    base = mesh.nodes[:, 2] < 1e-9
    scene = tm.Scene("held")
    numbers: dict[str, Any] = {"young_modulus_pa": YOUNG_PA, "poisson_ratio": POISSON[law]}
    scene.add_body("block", mesh, law=law, **numbers, density_kg_per_m3=1000, fixed_nodes=base)
    scene.body("block").rayleigh_mass_per_s = 20
    return scene, base


def lay(
    scene: tm.Scene, kind: str, random: np.random.Generator, friction: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Adds a tool that lies just above the block, turned by a random angle. Returns its pose."""
    shape, below_m = TOOLS[kind]
    turn = times(about(2, random.uniform(-0.6, 0.6)), about(1, random.uniform(-0.05, 0.05)))
    if kind in ("capsule", "grasper"):
        turn = times(turn, about(1, np.pi / 2))
    middle = np.array([SIZE_M[0] / 2, SIZE_M[1] / 2]) + random.uniform(-0.002, 0.002, 2)
    start = np.array([*middle, SIZE_M[2] + below_m])
    if kind != "box":
        start[0] -= 0.01
    pose: dict[str, Any] = {"position_m": tuple(start), "orientation": tuple(turn)}
    scene.add_tool("tool", kind, **pose, max_speed_m_per_s=1, friction_coefficient=friction, **shape)
    return start, turn


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("kind", TOOLS)
def test_tissue_rests_under_a_tool_that_holds_still(server: tm.Server, kind: str, friction: float) -> None:
    random = np.random.default_rng([len(kind), int(10 * friction)])
    shapes: tuple[Literal["hexahedron", "tetrahedron"], ...] = ("hexahedron", "tetrahedron", "hexahedron")
    for shape, law, rate_hz in zip(shapes, POISSON, (60, 240, 1000), strict=True):
        scene, base = held_block(random, shape, law)
        start, turn = lay(scene, kind, random, friction)
        scene.set_solver(precision="double", cg_tolerance=1e-9, cg_max_iterations=5000)
        scene.set_stepping(dt_s=1 / rate_hz)
        with server.load(scene, lockstep=True) as handle:
            handle.move_tool("tool", tuple(start - [0, 0, 1e-3]), tuple(turn))
            handle.step(3 * rate_hz)
            before = handle.fields("block", ["displacement"])["displacement"]
            handle.step()
            fields = handle.fields("block", ["displacement", "reaction_force"])
            felt_n = handle.feedback("tool").force_n[2]
        what = f"{shape}, {law}, {rate_hz} Hz"
        assert felt_n > 0.01, what
        assert np.abs(fields["displacement"] - before).max() < 1e-6, what
        assert fields["reaction_force"][base, 2].sum() == pytest.approx(felt_n, rel=0.02), what


@pytest.mark.parametrize("kind", ["capsule", "retractor", "box"])
def test_a_press_has_an_equilibrium(server: tm.Server, kind: str) -> None:
    """Newton's method with its default settings finds it in one step."""
    random = np.random.default_rng(len(kind))
    for law in POISSON:
        scene, base = held_block(random, "hexahedron", law)
        start, turn = lay(scene, kind, random)
        scene.set_solver(precision="double", integrator="quasi_static", cg_tolerance=1e-9, cg_max_iterations=5000)
        scene.set_stepping(dt_s=1)
        with server.load(scene, lockstep=True) as handle:
            handle.move_tool("tool", tuple(start - [0, 0, 1e-3]), tuple(turn))
            handle.step()
            held_n = handle.fields("block", ["reaction_force"])["reaction_force"][base, 2].sum()
            felt_n = handle.feedback("tool").force_n[2]
        assert held_n == pytest.approx(felt_n, rel=1e-3)


def test_friction_has_an_equilibrium(server: tm.Server) -> None:
    """A block is pressed on a rough plane; its force lies between that on a smooth plane and that of a glued block."""
    force_n = {}
    for way, friction in (("smooth", 0.0), ("rough", 0.3), ("glued", 0.0)):
        mesh = tm.grid([3, 3, 2], [0.04, 0.04, 0.02], shape="hexahedron")
        top, low = mesh.nodes[:, 2] > 0.02 - 1e-9, mesh.nodes[:, 2] < 1e-9
        scene = tm.Scene(way)
        numbers: dict[str, Any] = {"young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.4, "density_kg_per_m3": 1000.0}
        fixed = low if way == "glued" else None
        scene.add_body("block", mesh, law="neo_hookean", **numbers, fixed_nodes=fixed)
        scene.prescribe("block", [0, 0, -0.001], top)
        if way != "glued":
            scene.add_tool("plane", "plane", position_m=(0, 0, 0), fixed=True, friction_coefficient=friction)
        scene.set_solver(precision="double", integrator="quasi_static", cg_tolerance=1e-9, cg_max_iterations=5000)
        scene.set_stepping(dt_s=1)
        with server.load(scene, lockstep=True) as handle:
            handle.step()
            force_n[way] = -handle.fields("block", ["reaction_force"])["reaction_force"][top, 2].sum()
    assert 1.02 * force_n["smooth"] < force_n["rough"] < 0.98 * force_n["glued"]


def test_two_blocks_pressed_together_have_an_equilibrium(server: tm.Server) -> None:
    """The meshes do not match. Confined at their sides, they are in the homogeneous state of Hooke's law."""
    edge_m, depth_m, penalty = 0.02, 4e-4, 1e8
    scene = tm.Scene("blocks")
    for name, cells, bottom_m in (("a", 3, 0.0), ("b", 4, edge_m)):
        mesh = tm.grid([cells] * 3, [edge_m] * 3, shape="hexahedron", origin_m=(0, 0, bottom_m))
        x = mesh.nodes
        numbers: dict[str, Any] = {"young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.3, "density_kg_per_m3": 1000.0}
        scene.add_body(name, mesh, law="hooke", **numbers)
        for axis, c in (("x", 0), ("y", 1)):
            scene.fix(name, (x[:, c] < 1e-9) | (x[:, c] > edge_m - 1e-9), axes=axis)
    scene.fix("a", tm.grid([3] * 3, [edge_m] * 3, shape="hexahedron").nodes[:, 2] < 1e-9, axes="z")
    scene.prescribe("b", [-depth_m], x[:, 2] > 2 * edge_m - 1e-9, axes="z")
    scene.add_body_contact("a", "b", distance_m=0, penalty_stiffness_pa_per_m=penalty)
    scene.set_solver(precision="double", integrator="quasi_static", cg_tolerance=1e-9, cg_max_iterations=5000)
    scene.set_stepping(dt_s=1)
    with server.load(scene, lockstep=True) as handle:
        handle.step()
        force_n = -handle.fields("b", ["reaction_force"])["reaction_force"][x[:, 2] > 2 * edge_m - 1e-9, 2].sum()
    confined_pa = YOUNG_PA * 0.7 / (1.3 * 0.4)
    assert force_n == pytest.approx(depth_m / (2 * edge_m / confined_pa + 1 / penalty) * edge_m**2, rel=0.03)


@pytest.mark.parametrize(
    ("thickness_m", "height_m", "rate_hz"),
    [(0.02, 0.2, 60), (0.02, 0.1, 60), (0.005, 0.1, 60), (0.005, 0.1, 1000), (0.002, 1e-4, 60)],
)
def test_a_tray_holds_what_falls_on_it(server: tm.Server, thickness_m: float, height_m: float, rate_hz: int) -> None:
    """At 60 Hz the block moves further in a step than the tray is thick."""
    edge_m = 0.05
    scene = tm.Scene.from_mesh(
        tm.grid([4] * 3, [edge_m] * 3, origin_m=(-edge_m / 2, -edge_m / 2, height_m)),
        law="stable_neo_hookean",
        young_modulus_pa=YOUNG_PA,
        poisson_ratio=0.4,
        density_kg_per_m3=1000,
        gravity_m_per_s2=(0, 0, -9.81),
    )
    scene.body("body").rayleigh_stiffness_s = 0.01
    tray: dict[str, Any] = {"size_x_m": 0.4, "size_y_m": 0.4, "size_z_m": thickness_m}
    scene.add_tool("tray", "box", position_m=(0, 0, -thickness_m / 2), fixed=True, friction_coefficient=0.3, **tray)
    scene.set_stepping(dt_s=1 / rate_hz)
    with server.load(scene, lockstep=True) as handle:
        handle.step(int(0.6 * rate_hz))
        assert handle.positions("body")[:, 2].min() > -0.005
        assert handle.positions("body")[:, 2].mean() == pytest.approx(0.024, abs=0.006)
