"""Bad values in every number of a scene and of a pose.

The fields are found by walking the protocol's descriptors. test_stability.py fails for a new field that is not in
`whole_scene`.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, cast

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

import tensormass as tm
from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import box
from accuracy.problem import Problem
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

from .case import Case, Check, Found, Group
from .tissue import CUBE_M, clamped, packed, real_time, tissue

INPUT = Group(
    "input",
    "Every input field",
    "NaN, ±∞, denormals, ±10³⁰⁰, negatives: refused by name, or harmless",
    "Each number of a scene that uses every field, and of a tool's pose, is in turn NaN, ±∞, a denormal (5·10⁻³²⁴, "
    "10⁻³¹⁰), ±10³⁰⁰, −1 and its own negative. Must hold: it is refused with a message that names the field, or it "
    "does no harm. A denormal must step as zero does. Any other value must leave a finite state after 5 steps, or a "
    "fault. The daemon must still answer.",
)
VALUES = (np.nan, np.inf, -np.inf, 5e-324, 1e-310, 1e300, -1e300, -1.0)
STEPS = 5
_REAL = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT)
# Packed arrays of uint32; all others hold float64.
_BYTES_WITHOUT_REALS = ("nodes", "triangles", "image")
#: Fields of packed float32; the others have float64.
_FLOAT32_BYTES = ("coordinates",)


@dataclass(frozen=True)
class Place:
    """One number of a message.

    path: as it stands in the scene. kind: message and field, to count what was visited.
    get(message): the number. set(message, value): replaces it.
    """

    path: str
    kind: tuple[str, str]
    get: Callable[[Message], float]
    set: Callable[[Message, float], None]

    @property
    def name(self) -> str:
        """The name that a refusal must contain: the field, or the vector or displacement that it is a component of."""
        *_, parent, field = [re.sub(r"\[\d+\]", "", part) for part in ("", *self.path.split("."))]
        return parent if field.removesuffix("_m") in "wxyz" else field


def whole_scene(engine: Engine) -> scene_pb2.Scene:
    """A scene that uses every field of `Scene` that holds real numbers."""
    mesh = box("hexahedron", (2, 1, 1), (CUBE_M,) * 3)
    scene = real_time(engine, Problem(mesh, tissue("hooke"), [clamped(mesh)]))
    scene.stepping.dt_s, scene.stepping.rate_hz = 1 / 60, 60
    scene.solver.cg_tolerance, scene.solver.newton_tolerance = 1e-3, 1e-3
    scene.solver.floor_tolerance, scene.solver.budget_s = 1e-2, 1.0
    scene.solver.newton_max_iterations = 2
    scene.streams.frame_rate_hz, scene.streams.status_rate_hz = 60, 4
    scene.guard.max_move_m, scene.guard.max_distance_m, scene.guard.max_energy_ratio = 1, 10, 4
    scene.gravity_m_per_s2.z = -1
    scene.gravity_schedule.time_s.extend([0, 1])
    scene.gravity_schedule.factor.extend([0, 1])
    first = scene.bodies[0]
    first.rayleigh_mass_per_s, first.rayleigh_stiffness_s = 1, 1e-3
    first.color_srgb.x = 0.5
    first.ablation_j_per_m3 = 2e9
    first.fracture_toughness_j_per_m2 = 200
    first.coagulated_stiffness_factor = 4
    first.mesh.scale = 1.0
    first.mesh.translation_m.x = 0.25
    first.fixed.add().sphere.radius_m = 1e-3
    first.fixed[-1].sphere.center_m.x = 0.25
    first.sets.add(name="all").regions.add().box.max_m.CopyFrom(scene_pb2.Vector3(x=1, y=1, z=1))
    first.sets[0].regions[0].box.min_m.x = -1
    end = [int(node) for node in mesh.where(lambda x, y, z: x > CUBE_M * 0.9)]
    for _ in range(3):
        first.loads.add().region.nodes.indices.extend(end)
    first.loads[0].force_n.x = 0.1
    first.loads[1].traction_pa.x = 1
    first.loads[2].pressure_pa = 1
    first.loads[2].schedule.time_s.extend([0, 1])
    first.loads[2].schedule.factor.extend([0, 1])
    prescribed = first.prescribed.add(x_m=0.001, y_m=0.001, z_m=0.001)
    prescribed.region.nodes.indices.append(end[0])
    prescribed.schedule.time_s.extend([0, 1])
    prescribed.schedule.factor.extend([0, 1])
    middle = mesh.where(lambda x, y, z: (x > 0.01) & (x < 0.09))
    moved = np.zeros(mesh.nodes.shape)
    moved[middle] = 1e-4
    first.initial_displacement_m = first.initial_velocity_m_per_s = packed(moved)
    first.law.prony.add(share=0.2, relaxation_time_s=0.1)
    triangle = mesh.nodes[:3]
    first.skin.packed.vertex_positions = packed(triangle)
    first.skin.packed.triangles = np.array([0, 1, 2], "<u4").tobytes()
    first.texture.image = b"\x89PNG\r\n\x1a\n"
    first.texture.coordinates = np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    scene.body_contacts.add(
        body=first.name, distance_m=1e-3, penalty_stiffness_pa_per_m=1e6, friction_coefficient=0.1, reach_m=0.01
    )
    ligament = scene.attachments.add(name="ligament", body=first.name, other=first.name)
    ligament.region.nodes.indices.append(end[0])
    ligament.other_region.nodes.indices.append(end[1])
    ligament.stiffness_n_per_m, ligament.breaking_force_n = 1, 1e6
    ligament.rest_lengths_m.append(0.001)
    for law in LAWS:
        body = scene.bodies.add(name=law, density_kg_per_m3=1000, law=tissue(law).message)
        grid = body.mesh.grid
        grid.cells_x = grid.cells_y = grid.cells_z = 1
        grid.shape = scene_pb2.SHAPE_HEXAHEDRON
        grid.size_m.x = grid.size_m.y = grid.size_m.z = CUBE_M
        grid.origin_m.y = 1 + len(scene.bodies)
        if law in ("st_venant_kirchhoff", "transversely_isotropic"):
            body.element_fields.young_modulus_pa = packed([[5000]])
            body.element_fields.poisson_ratio = packed([[0.3]])
        if law == "transversely_isotropic":
            body.element_fields.fibre_directions = packed([[1, 0, 0]])
    for kind in scene_pb2.Tool.DESCRIPTOR.oneofs_by_name["kind"].fields:
        if kind.name in ("scalpel", "scissors"):
            continue  # `cutting_scene` has them
        tool = scene.tools.add(name=kind.name, max_speed_m_per_s=0.5)
        tool.mass_kg, tool.coupling_stiffness_n_per_m, tool.coupling_damping_n_s_per_m = 0.05, 500, 1
        tool.max_force_n, tool.max_torque_n_m, tool.max_joint_load = 30, 1, 1
        shape = getattr(tool, kind.name)
        for field in shape.DESCRIPTOR.fields:
            if field.type == FieldDescriptor.TYPE_DOUBLE:
                setattr(shape, field.name, 1e6 if field.name.endswith("pa_per_m") else 0.01)
        shape.tip_offset_m.z = 0.001
        tool.position_m.z = -1 if kind.name == "plane" else 1  # below the bodies, above them
        tool.orientation.w = 1
        if kind.name == "grasper":
            tool.joint_values.append(0.5)
        elif kind.name == "retractor":
            tool.dissection.reach_m, tool.dissection.length_m = 1e-3, 0.01
        elif kind.name == "box":
            tool.box.edge_radius_m = 0.002
        elif kind.name == "mesh":
            surface = tool.mesh.surface.packed
            surface.vertex_positions = packed([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
            surface.triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u4").tobytes()
    return scene


def burning_scene(engine: Engine) -> scene_pb2.Scene:
    """A scene with what `whole_scene` cannot have beside its skin and Newton's method: editing, a tool that burns, and
    lagged tangents."""
    mesh = box("hexahedron", (2, 1, 1), (CUBE_M,) * 3)
    scene = real_time(engine, Problem(mesh, tissue("hooke"), [clamped(mesh)]))
    scene.solver.tangent_lag_steps, scene.solver.tangent_lag_strain = 8, 0.02
    scene.editing.SetInParent()
    tool = scene.tools.add(name="hook")
    tool.spherical_probe.radius_m = 0.01
    tool.position_m.z = 1
    tool.cautery.power_w, tool.cautery.efficiency = 30, 0.3
    return scene


def cutting_scene(engine: Engine) -> scene_pb2.Scene:
    """A scene that a scalpel and scissors may cut."""
    mesh = box("tetrahedron", (2, 1, 1), (CUBE_M,) * 3)
    scene = real_time(engine, Problem(mesh, tissue("hooke"), [clamped(mesh)]))
    scene.editing.cutting.SetInParent()
    scene.bodies[0].fracture_toughness_j_per_m2 = 200
    tool = scene.tools.add(name="scalpel")
    tool.scalpel.length_m, tool.scalpel.thickness_m, tool.scalpel.spacing_m = 0.02, 5e-4, 1e-3
    tool.scalpel.tip_offset_m.z = -0.01
    tool.position_m.z = 0.05
    tool = scene.tools.add(name="scissors")
    shape = tool.scissors
    shape.radius_m, shape.blade_length_m, shape.edge_offset_m = 2e-3, 0.02, 1e-3
    shape.thickness_m, shape.spacing_m = 5e-4, 1e-3
    shape.tip_offset_m.z = -0.01
    tool.position_m.z = 0.1
    tool.joint_values.append(0.5)
    return scene


#: Every number of a scene is in one of these.
SCENES = (whole_scene, burning_scene, cutting_scene)


def _is_real_bytes(kind: int, name: str) -> bool:
    return kind == FieldDescriptor.TYPE_BYTES and name not in _BYTES_WITHOUT_REALS


def places(message: Message, path: str = "") -> Iterator[Place]:
    """Yields every number of the message and of the sub-messages that it has; the first one of a repeated field."""
    for field in message.DESCRIPTOR.fields:
        here = f"{path}.{field.name}" if path else field.name
        kind = (message.DESCRIPTOR.name, field.name)
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            if field.is_repeated:
                for index, item in enumerate(getattr(message, field.name)):
                    for place in places(item, f"{here}[{index}]"):
                        yield _through(place, _item(field.name, index))
            elif message.HasField(field.name):
                for place in places(getattr(message, field.name), here):
                    yield _through(place, attrgetter(field.name))
        elif field.cpp_type in _REAL:
            if field.containing_oneof is not None and not message.HasField(field.name):
                continue
            if field.is_repeated:
                if getattr(message, field.name):
                    yield Place(f"{here}[0]", kind, _item(field.name, 0), _set_first(field.name))
            else:
                yield Place(here, kind, attrgetter(field.name), _set(field.name))
        elif _is_real_bytes(field.type, field.name) and getattr(message, field.name):
            yield Place(here, kind, _last(field.name), _set_last(field.name))


def _through(place: Place, enter: Callable[[Message], Message]) -> Place:
    return Place(place.path, place.kind, lambda m: place.get(enter(m)), lambda m, value: place.set(enter(m), value))


def _item(name: str, index: int) -> Callable[[Message], Any]:
    return lambda message: getattr(message, name)[index]


def _last(name: str) -> Callable[[Message], float]:
    return lambda message: float(_number(message, name)[-1])


def _set(name: str) -> Callable[[Message, float], None]:
    return lambda message, value: setattr(message, name, value)


def _set_first(name: str) -> Callable[[Message, float], None]:
    return lambda message, value: operator.setitem(getattr(message, name), 0, value)


def _number(message: Message, name: str) -> np.ndarray:
    return np.frombuffer(getattr(message, name), "<f4" if name in _FLOAT32_BYTES else "<f8").copy()


def _set_last(name: str) -> Callable[[Message, float], None]:
    def change(message: Message, value: float) -> None:
        numbers = _number(message, name)
        if abs(value) > float(np.finfo(numbers.dtype).max):
            value = math.copysign(math.inf, value)
        # For an initial state: a node that is neither fixed nor prescribed.
        numbers[len(numbers) // 2 if name.startswith("initial") else -1] = value
        setattr(message, name, numbers.tobytes())

    return change


def real_fields(descriptor: Descriptor) -> set[tuple[str, str]]:
    """Returns (message, field) of every real number that a message of this type can hold."""
    return {
        (message.name, field.name)
        for message in _messages(descriptor)
        for field in message.fields
        if field.cpp_type in _REAL or _is_real_bytes(field.type, field.name)
    }


def _messages(descriptor: Descriptor) -> list[Descriptor]:
    found, waiting = {descriptor.full_name: descriptor}, [descriptor]
    while waiting:
        for field in waiting.pop().fields:
            if field.message_type is not None and field.message_type.full_name not in found:
                found[field.message_type.full_name] = field.message_type
                waiting.append(field.message_type)
    return list(found.values())


def _harm(engine: Engine, scene: scene_pb2.Scene) -> tuple[str, np.ndarray]:
    """Steps the scene. Returns what harm it did, empty if none, and the positions of its bodies."""
    try:
        with engine.loaded(scene) as handle:
            handle.step(STEPS)
            moved = np.concatenate([handle.positions(body.name) for body in scene.bodies])
    except tm.FailedPreconditionError:
        return "", np.empty(0)  # caught while running
    if not np.isfinite(moved).all():
        return "positions are not finite, without a fault", moved
    return "", moved


def _spoil_scene(engine: Engine, place: Place, good_scene: Callable[[Engine], scene_pb2.Scene]) -> Found:
    good = good_scene(engine)
    refused = harmless = 0
    bad: list[str] = []
    for value in (*VALUES, -place.get(good)):
        scene = scene_pb2.Scene()
        scene.CopyFrom(good)
        place.set(scene, value)
        try:
            engine.server.inspect(scene)
        except tm.InvalidArgumentError as refusal:
            refused += 1
            if not _names_it(str(refusal), place, value):
                bad.append(f"{value:g}: the refusal does not name it: {refusal}")
            continue
        why, moved = _harm(engine, scene)
        if not why and 0 < value < 1e-300:
            place.set(scene, 0.0)
            try:
                why, as_zero = _harm(engine, scene)
                if not why and not np.allclose(moved, as_zero, rtol=0, atol=1e-6 * CUBE_M):
                    why = "not as zero"
            except tm.InvalidArgumentError:
                why = "zero is refused"
        if why:
            bad.append(f"{value:g}: {why}")
        harmless += not why
    return _counted(refused, harmless, bad)


def _counted(refused: int, harmless: int, bad: list[str]) -> Found:
    note = "; ".join([f"{refused} refused, {harmless} harmless", *bad])
    return Found([Check("values that do harm", float(len(bad)), 0)], note=note)


def _names_it(refusal: str, place: Place, value: float) -> bool:
    """Whether the refusal says where the bad value is.

    Values that are not finite or absurdly large must be named by their field. Any other value may be valid by itself
    and wrong in its effect: a region without nodes, a flat element, a skin outside. Then that is named, with its body
    or tool.
    """
    if np.isfinite(value) and abs(value) < 1e300:
        return place.name in refusal or "body '" in refusal or "tool '" in refusal
    by_row = place.name.endswith("positions") and re.search(r"(node|point|vertex) \d+ of", refusal)
    return bool(by_row) or place.name.removesuffix("s") in refusal  # an element has one of its fibre_directions


def _spoil_pose(engine: Engine, place: Place, good: stream_pb2.ToolPose) -> Found:
    refused = harmless = 0
    bad: list[str] = []
    scene = whole_scene(engine)
    with engine.loaded(scene) as handle:
        for sequence, value in enumerate((*VALUES, -place.get(good)), 1):
            pose = stream_pb2.ToolPose()
            pose.CopyFrom(good)
            pose.sequence = sequence
            place.set(pose, value)
            try:
                engine.server.call(
                    "MoveTool", control_pb2.MoveToolRequest(scene=scene.name, tool=scene.tools[0].name, pose=pose)
                )
            except tm.InvalidArgumentError as refusal:
                refused += 1
                if place.name not in str(refusal):
                    bad.append(f"{value:g}: the refusal does not name it: {refusal}")
                continue
            handle.step()
            position = handle.feedback(scene.tools[0].name).position_m
            harmless += bool(np.isfinite(position).all())
            if not np.isfinite(position).all():
                bad.append(f"{value:g}: the position of the tool is not finite")
    return _counted(refused, harmless, bad)


def input_cases() -> Iterator[Case]:
    unused = Engine(cast("tm.Server", None), "float")
    seen: set[str] = set()
    all_places = ((scene, place) for scene in SCENES for place in places(scene(unused)))
    for scene, place in all_places:
        # The same field of another body adds nothing; each law has fields of its own.
        short = re.sub(r"\[\d+\]", "", place.path)
        if short in seen:
            continue
        seen.add(short)
        yield Case(
            INPUT,
            short,
            "any",
            "any",
            partial(_spoil_scene, place=place, good_scene=scene),
            precisions=("float",),
            quick=True,
            solves=STEPS * (len(VALUES) + 1),
        )
    pose = stream_pb2.ToolPose(client_id=1, position_m=scene_pb2.Vector3(z=1), orientation=scene_pb2.Quaternion(w=1))
    for place in places(pose):
        yield Case(
            INPUT,
            f"pose: {place.path}",
            "any",
            "any",
            partial(_spoil_pose, place=place, good=pose),
            precisions=("float",),
            quick=True,
            solves=len(VALUES) + 1,
        )
