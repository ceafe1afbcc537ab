"""Edits that cannot be done, and edits beside other calls. A refusal says why, and nothing is half done."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_parts import DEADLINE_S

import tensormass as tm
from tensormass.v1 import adjustment_pb2, control_pb2, stream_pb2
from tensormass_tools.cli import main

#: A block that may be edited, a lobe that hangs from it, and a pebble of one element in the air.
SCENE = """
name: edited
stepping: {dt_s: 0.005}
bodies:
  - name: block
    mesh: {grid: {origin_m: {z: 0.06}, size_m: {x: 0.06, y: 0.06, z: 0.03}, cells_x: 4, cells_y: 4, cells_z: 2}}
    law: {stable_neo_hookean: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 5
    fixed: [{box: {min_m: {x: -1, y: -1, z: 0.089}, max_m: {x: 1, y: 1, z: 1}}}]
  - name: lobe
    mesh: {grid: {size_m: {x: 0.06, y: 0.06, z: 0.03}, cells_x: 4, cells_y: 4, cells_z: 2}}
    law: {stable_neo_hookean: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 5
  - name: pebble
    mesh: {grid: {origin_m: {x: 0.2}, size_m: {x: 0.01, y: 0.01, z: 0.01}, cells_x: 1, cells_y: 1, cells_z: 1}}
    law: {stable_neo_hookean: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: 0.19, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
attachments:
  - name: ligament
    body: lobe
    region: {box: {min_m: {x: -1, y: -1, z: 0.029}, max_m: {x: 0.1, y: 1, z: 0.031}}}
    other: block
    other_region: {box: {min_m: {x: -1, y: -1, z: 0.059}, max_m: {x: 1, y: 1, z: 0.061}}}
    stiffness_n_per_m: 200
gravity_m_per_s2: {z: -9.81}
tools:
  - name: hook
    spherical_probe: {radius_m: 0.01}
    position_m: {x: 0.03, y: 0.03, z: -0.02}
    cautery: {power_w: 30}
  - name: probe
    spherical_probe: {radius_m: 0.01}
    position_m: {x: 0.03, y: -0.03, z: 0.01}
editing: {max_new_triangles: 60, max_new_vertices: 60}
"""
NAN = float("nan")
Edit = dict[str, Any]


def scene_of(text: str = SCENE) -> tm.Scene:
    return tm.Scene.from_yaml(text)


@contextlib.contextmanager
def edited(server: tm.Server, name: str) -> Iterator[tm.SceneHandle]:
    """A scene in lockstep that has lost some elements and springs already."""
    with server.load(scene_of(), name=name, lockstep=True) as scene:
        scene.step(3)
        scene.edit(ablate={"lobe": [3, 4]})
        scene.edit(ablate={"lobe": [7]}, kept=0.5)
        scene.edit(sever={"ligament": [2]})
        scene.step(3)
        yield scene


def state_of(scene: tm.SceneHandle) -> tuple[object, ...]:
    """All that an edit may change, to the last bit."""
    status, frame = scene.status(), scene.frame()
    tissue = [scene.positions(body).tobytes() for body in ("block", "lobe", "pebble")]
    fields = [scene.fields(body, ["velocity"])["velocity"].tobytes() for body in ("block", "lobe", "pebble")]
    surface = frame.surface.changes.SerializeToString(deterministic=True)
    topology = scene.topology()
    known = (status.removed_volume_m3, status.removed_mass_kg, status.broken_springs, status.step)
    return (*tissue, *fields, surface, topology.version, [tool.name for tool in topology.tools], known)


def attach(scene: tm.SceneHandle, **arguments: Any) -> None:  # noqa: ANN401
    clip: dict[str, Any] = {"name": "clip", "body": "lobe", "nodes": [0, 1], "other": "block", "other_nodes": [0]}
    scene.attach(**{**clip, "stiffness_n_per_m": 100.0, **arguments})


REFUSED: dict[str, tuple[Callable[[tm.SceneHandle], object], type[tm.TensormassError], str]] = {
    "an unknown body": (
        lambda scene: scene.edit(ablate={"lobe": [5], "liver": [1]}),
        tm.NotFoundError,
        r"edit.ablations\[1\].body: the scene has no body 'liver'; it has: block, lobe, pebble",
    ),
    "an unknown element": (
        lambda scene: scene.edit(ablate={"lobe": [5, 100_000]}),
        tm.NotFoundError,
        r"edit.ablations\[0\].elements\[1\]: body 'lobe' has \d+ elements, from 0 on, and not 100000",
    ),
    "an element twice": (lambda scene: scene.edit(ablate={"lobe": [5, 5]}), tm.InvalidArgumentError, "named twice"),
    "an element that is gone": (
        lambda scene: scene.edit(ablate={"lobe": [5, 3]}),
        tm.FailedPreconditionError,
        "body 'lobe': element 3 is gone already; only a reset brings it back",
    ),
    "more material than there is": (
        lambda scene: scene.edit(ablate={"lobe": [7]}, kept=0.6),
        tm.FailedPreconditionError,
        "element 7 has a share of 0.5 left; give less, only a reset brings material back",
    ),
    "a share that is NaN": (
        lambda scene: scene.edit(ablate={"lobe": [5]}, kept=NAN),
        tm.InvalidArgumentError,
        r"element 5: a kept share of nan is not within \[0, 1\]",
    ),
    "the last element": (
        lambda scene: scene.edit(ablate={"lobe": [5], "pebble": range(6)}),
        tm.FailedPreconditionError,
        "body 'pebble': element 5 is the last one that the body has; leave one, or unload the scene",
    ),
    "more surface than there is room for": (
        lambda scene: scene.edit(ablate={"block": range(2, 190, 11)}),
        tm.ResourceExhaustedError,
        r"scene.editing.max_new_\w+ = 60; raise it, or reset the scene",
    ),
    "more elements than one edit takes": (
        lambda scene: scene.edit(ablate={"lobe": [5] * 1025}),
        tm.ResourceExhaustedError,
        "limits::kMaxElementsOfEdit = 1024; make several edits",
    ),
    "a spring that is severed": (
        lambda scene: scene.edit(sever={"ligament": [1, 2]}),
        tm.FailedPreconditionError,
        "spring 2 is broken already; only a reset mends it",
    ),
    "an unknown attachment, beside elements": (
        lambda scene: scene.edit(ablate={"lobe": [5]}, sever={"omentum": None}),
        tm.NotFoundError,
        "the scene has no attachment 'omentum'; it has: ligament",
    ),
    "an unknown spring": (
        lambda scene: scene.edit(sever={"ligament": [1, 4711]}),
        tm.NotFoundError,
        r"attachment 'ligament' has \d+ springs, from 0 on, and not 4711",
    ),
    "nothing": (lambda scene: scene.edit(), tm.InvalidArgumentError, "edit: is empty; give ablations, severings"),
    "a cut without room for it": (
        lambda scene: scene.cut("lobe", np.array([[[0, 0, 0.1], [0, 0.06, 0.1]], [[0, 0, -1], [0, 0.06, -1]]])),
        tm.FailedPreconditionError,
        "editing.cutting",
    ),
    "an unknown tool": (
        lambda scene: scene.remove_tool("probe", "needle"),
        tm.NotFoundError,
        "no tool 'needle'; it has: hook, probe",
    ),
    "a tool that is there": (
        lambda scene: scene.add_tool("probe", "spherical_probe", position_m=(0, 0, 1), radius_m=0.01),
        tm.AlreadyExistsError,
        "the scene has a tool 'probe' already",
    ),
    "an attachment that is there": (
        lambda scene: attach(scene, name="ligament"),
        tm.AlreadyExistsError,
        "the scene has an attachment 'ligament' already",
    ),
    "an attachment to an unknown body": (
        lambda scene: attach(scene, other="liver"),
        tm.InvalidArgumentError,
        "attachment 'clip'.other: no body has the name 'liver'; the scene has 'block', 'lobe', 'pebble'",
    ),
    "an attachment to an unknown node": (
        lambda scene: attach(scene, other_nodes=[4711]),
        tm.InvalidArgumentError,
        r"attachment 'clip'.other_region.nodes: node 4711 does not exist; the body has 75",
    ),
    "an attachment of negative stiffness": (
        lambda scene: attach(scene, stiffness_n_per_m=-1.0),
        tm.InvalidArgumentError,
        "attachment 'clip'.stiffness_n_per_m",
    ),
    "an attachment whose length is NaN": (
        lambda scene: attach(scene, rest_length_m=NAN),
        tm.InvalidArgumentError,
        r"attachment 'clip'.rest_lengths_m\[0\]",
    ),
    "an attachment that was not added": (
        lambda scene: scene.detach("clip"),
        tm.NotFoundError,
        "no attachment 'clip' was added to the scene; these were: none",
    ),
    "an attachment that was loaded": (
        lambda scene: scene.detach("ligament"),
        tm.FailedPreconditionError,
        "attachment 'ligament' was loaded with the scene; sever its springs instead",
    ),
    "a level of a tool without power": (
        lambda scene: scene.move_tool("probe", (0, 0, 1), level=0.5),
        tm.InvalidArgumentError,
        "tool 'probe' has no power; give it Tool.cautery, or leave level out",
    ),
    **{
        f"a level of {level}": (
            lambda scene, level=level: scene.move_tool("hook", (0.03, 0.03, -0.009), level=level),  # type: ignore[misc]
            tm.InvalidArgumentError,
            "level",
        )
        for level in (NAN, -0.01, 1.01, float("inf"))
    },
}


@pytest.fixture(scope="module")
def unedited(server: tm.Server) -> tuple[object, ...]:
    """The state of a scene without any refused call, some steps later."""
    with edited(server, "undisturbed") as scene:
        scene.step(5)
        return state_of(scene)[:-4]


@pytest.mark.parametrize("what", REFUSED)
def test_a_refused_edit_leaves_every_bit(server: tm.Server, unedited: tuple[object, ...], what: str) -> None:
    call, kind, said = REFUSED[what]
    with edited(server, "disturbed") as scene:
        before = state_of(scene)
        with pytest.raises(kind, match=said):
            call(scene)
        assert state_of(scene) == before
        scene.step(5)
        assert state_of(scene)[:-4] == unedited


def test_one_more_tool_than_there_may_be(server: tm.Server) -> None:
    """The whole call is refused, not only its last tool."""
    with edited(server, "many") as scene:
        before = state_of(scene)
        request = control_pb2.EditSceneRequest(scene=scene.name)
        for i in range(15):
            tool = request.edit.add_tools.add(name=f"t{i}")
            tool.spherical_probe.radius_m = 0.01
            tool.position_m.z = 1
        with pytest.raises(tm.ResourceExhaustedError, match="limits::kMaxTools = 16"):
            scene._connection.call("EditScene", request)  # the SDK adds one tool at a time
        assert state_of(scene) == before


def test_tools_and_tissue_in_one_edit_are_refused(server: tm.Server) -> None:
    with edited(server, "both") as scene:
        before = state_of(scene)
        edit = adjustment_pb2.SceneEdit(remove_tools=["probe"])
        edit.ablations.add(body="lobe", elements=[5])
        with pytest.raises(tm.InvalidArgumentError, match="edit"):
            scene._connection.call("EditScene", control_pb2.EditSceneRequest(scene=scene.name, edit=edit))
        assert state_of(scene) == before


# --- at the same time as other calls ----------------------------------------------------------------------------------


def together(*calls: Callable[[], object]) -> list[object]:
    """Makes calls at once and returns what each returned or raised."""
    start = threading.Barrier(len(calls))

    def run(call: Callable[[], object]) -> object:
        start.wait(DEADLINE_S)
        try:
            return call()
        except tm.TensormassError as error:
            return error

    with futures.ThreadPoolExecutor(len(calls)) as pool:
        return list(pool.map(run, calls))


def test_two_clients_burn_the_same_element_once(server: tm.Server) -> None:
    with server.load(scene_of(), name="shared", lockstep=True) as scene, tm.connect(server.address) as other:
        one_m3 = scene.edit(ablate={"lobe": [0]}).removed_volume_m3
        second = other.scene("shared")
        for element in range(1, 9):
            # Each call has an element of its own, too: of the one that is refused it stays.
            done = together(
                lambda e=element: scene.edit(ablate={"lobe": [e], "block": [e]}),  # type: ignore[misc]
                lambda e=element: second.edit(ablate={"lobe": [e], "pebble": []}),  # type: ignore[misc]
            )
            refused = [str(error) for error in done if isinstance(error, tm.FailedPreconditionError)]
            assert len(refused) == 1
            assert f"element {element} is gone already" in refused[0]
        assert scene.status().removed_volume_m3 > 5 * one_m3
        assert scene.status().state == stream_pb2.SceneStatus.STATE_LOCKSTEP


def test_a_snapshot_has_all_of_an_edit_or_nothing(server: tm.Server) -> None:
    with server.load(scene_of(), name="whole") as scene, server.load(scene_of(), name="copy", lockstep=True) as copy:
        pairs = [(2 * i, 2 * i + 1) for i in range(12)]
        volumes = {0.0}
        for pair in pairs:
            volumes.add(copy.edit(ablate={"lobe": pair}).removed_volume_m3)
        for pair in pairs:
            _, snapshot = together(lambda p=pair: scene.edit(ablate={"lobe": p}), scene.snapshot)  # type: ignore[misc]
            assert isinstance(snapshot, bytes)
            removed = copy.restore(snapshot).removed_volume_m3
            assert min(abs(removed - whole) for whole in volumes) < 1e-12


def test_tissue_burns_while_the_scene_is_prepared_with_another_tool(server: tm.Server) -> None:
    """The next scene is compiled beside the present one, which is edited meanwhile."""
    with server.load(scene_of(), name="busy") as scene, tm.connect(server.address) as other:
        second = other.scene("busy")
        done = 0
        for element in range(10):
            added, burnt = together(
                lambda: scene.add_tool("rod", "capsule", position_m=(0, 0, 1), radius_m=0.01, length_m=0.1),
                lambda e=element: second.edit(ablate={"lobe": [e]}),  # type: ignore[misc]
            )
            assert isinstance(added, list), added
            done += not isinstance(burnt, tm.TensormassError)
            with (
                pytest.raises(tm.FailedPreconditionError, match="gone already")
                if isinstance(burnt, stream_pb2.SceneStatus)
                else contextlib.nullcontext()
            ):
                second.edit(ablate={"lobe": [element]})
            assert [tool.name for tool in scene.topology().tools] == ["hook", "probe", "rod"]
            scene.remove_tool("rod")
        assert done > 0


def test_a_recording_that_starts_among_edits_is_repeated(server: tm.Server, tmp_path: Path) -> None:
    file, path = tmp_path / "edited.yaml", tmp_path / "edited.mcap"
    file.write_text(SCENE)
    with server.load(scene_of(), name="recorded") as scene:
        ends = threading.Event()

        def burn() -> None:
            with tm.connect(server.address) as client:
                other = client.scene("recorded")
                for element in range(90):
                    with contextlib.suppress(tm.ResourceExhaustedError):  # the surface is full
                        other.edit(ablate={"lobe": [element]}, kept=0.0 if element % 3 == 0 else 0.5)
                    if ends.wait(0.02):
                        return

        thread = threading.Thread(target=burn)
        thread.start()
        try:
            arguments = ["record", str(file), "--attach", scene.name, "--server", server.address, "-o", str(path)]
            assert main([*arguments, "--seconds", "1.5", "--check-every", "10"]) == 0
        finally:
            ends.set()
            thread.join()
        assert scene.status().removed_volume_m3 > 0
    assert main(["replay", str(path)]) == 0
