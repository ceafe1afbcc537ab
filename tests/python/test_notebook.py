"""What objects show of themselves in a notebook."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import Any

import grpc
import numpy as np
import pytest
from conftest import Recorder

import tensormass as tm
from tensormass._src import notebook
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

EVIL = "<script>alert(1)</script>&\"'"


class Cells(HTMLParser):
    """Collects the texts of captions and cells, in rows, and checks that tags are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ("table", "caption", "tr", "th", "td")
        self._open.append(tag)
        if tag in ("tr", "caption"):
            self.rows.append([])
        if tag in ("td", "th", "caption"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.rows[-1][-1] += data


def rows_of(shown: Any) -> list[list[str]]:  # noqa: ANN401
    return Cells(shown._repr_html_()).rows


def value(shown: Any, name: str) -> str:  # noqa: ANN401
    """Returns what stands beside a name."""
    return next(row[1] for row in rows_of(shown) if row[0] == name)


@pytest.fixture
def scene() -> tm.Scene:
    mesh = tm.grid([2, 1, 1], [0.2, 0.1, 0.1])
    scene = tm.Scene.from_mesh(
        mesh, body="muscle", young_modulus_pa=4000, poisson_ratio=0.45, gravity_m_per_s2=(0, 0, -9.81), fixed_nodes=[0]
    )
    scene.add_tool("probe", "spherical_probe", radius_m=0.01, position_m=(0, 0, 0.2))
    return scene


def status(**fields: Any) -> stream_pb2.SceneStatus:  # noqa: ANN401
    force = scene_pb2.Vector3(x=1.5, z=-0.25)
    return stream_pb2.SceneStatus(
        scene="demo",
        state=stream_pb2.SceneStatus.STATE_RUNNING,
        step=1200,
        simulated_time_s=20,
        reached_rate_hz=59.9,
        target_rate_hz=60,
        step_time_p50_s=0.0041,
        tools=[stream_pb2.ToolFeedback(tool="probe", force_n=force)],
        **fields,
    )


def test_a_scene_shows_bodies_tools_and_gravity(scene: tm.Scene) -> None:
    rows = rows_of(scene)
    assert rows[0] == ["scene scene"]
    nodes = "12 nodes, 12 × tetrahedron"
    law = "stable_neo_hookean: young_modulus_pa 4000 Pa, poisson_ratio 0.45"
    assert ["muscle", nodes, law, "1060 kg/m³", "fixed: 1"] in rows
    assert ["probe", "spherical probe", "(0, 0, 0.2) m", "with its pose"] in rows
    assert ["gravity", "(0, 0, -9.81) m/s²"] in rows
    assert rows_of(scene.message) == rows
    assert value(scene.body("muscle"), "density") == "1060 kg/m³"
    assert rows_of(tm.Scene("empty"))[0] == ["scene empty"]


def test_meshes_that_are_not_packed_are_shown() -> None:
    grid = tm.Scene.from_yaml("bodies: [{name: b, mesh: {grid: {cells_x: 2, cells_y: 3, cells_z: 4}}}]")
    assert value(grid, "b") == "grid of 2 × 3 × 4 cells, shape tetrahedron"
    body = scene_pb2.Body(name="b", mesh=scene_pb2.Mesh(file="liver.msh"))
    body.mesh.scale = 2
    assert value(body, "mesh") == "file liver.msh"
    body.mesh.packed.elements.add(shape=77, nodes=b"1234")
    assert value(body, "mesh") == "0 nodes, 0 × shape 77"


def test_a_law_shows_its_constants() -> None:
    law = tm.law_message("mooney_rivlin", {"c10_pa": 2000, "c01_pa": 500, "bulk_modulus_pa": 2e5}, [(0.25, 0.5)])
    assert rows_of(law) == [
        ["law mooney_rivlin"],
        ["c10_pa", "2000 Pa"],
        ["c01_pa", "500 Pa"],
        ["bulk_modulus_pa", "2e+05 Pa"],
        ["Prony term 0", "share 0.25, relaxes in 0.5 s"],
    ]
    assert rows_of(scene_pb2.Law()) == [["law none"]]


def test_a_status_is_in_si_units() -> None:
    shown = status(newton_iterations=3, newton_residual=2e-7, guard_events=1, warnings=["body 'liver': stretched"])
    assert value(shown, "state") == "running"
    assert value(shown, "step") == "1,200 at 20 s"
    assert value(shown, "rate") == "59.9 of 60 Hz"
    assert value(shown, "step time") == "0.0041 s, p99 0 s"
    assert value(shown, "Newton") == "3 iterations to 2.0e-07"
    assert value(shown, "warning") == "body 'liver': stretched"
    assert value(shown, "force on probe") == "(1.5, 0, -0.25) N"
    assert value(status(fault="a body left its bounds"), "fault") == "a body left its bounds"
    assert ["recoveries"] not in [row[:1] for row in rows_of(shown)]
    assert value(status(recoveries=1, recovering_steps=1), "recoveries") == "1, 1 step"
    recovering = status(recoveries=2, recovering_steps=1500, held_steps=3, recovering=True)
    assert value(recovering, "recoveries") == "2, 1,500 steps, tissue held in 3, recovering now"


def test_a_handle_shows_its_plan_and_its_status(recorder: tuple[Recorder, tm.Server]) -> None:
    daemon, server = recorder
    body = control_pb2.BodyReport(name="liver", node_count=4000, mass_kg=1.2345678, volume_m3=1.5e-3)
    report = control_pb2.SceneReport(scene="demo", bodies=[body], bytes_total=12_345_678, expected_rate_hz=120)
    daemon.replies["LoadScene"] = control_pb2.LoadSceneResponse(report=report)
    daemon.replies["GetStatus"] = control_pb2.GetStatusResponse(status=status())
    handle = server.load(tm.Scene("demo"))
    assert ["liver", "4,000", "0", "0", "0.0015 m³", "1.235 kg"] in rows_of(handle)
    assert value(handle, "memory") == "12,345,678 bytes"
    assert value(handle, "state") == "running"
    daemon.failure = (grpc.StatusCode.NOT_FOUND, f"no scene {EVIL}")
    assert value(handle, "no status") == f"no scene {EVIL}"


def test_a_server_shows_its_scenes(recorder: tuple[Recorder, tm.Server]) -> None:
    daemon, server = recorder
    daemon.replies["GetVersion"] = control_pb2.GetVersionResponse(version="1.2", backend="cpu", device="a CPU")
    daemon.replies["ListScenes"] = control_pb2.ListScenesResponse(scenes=[status()])
    assert value(server, "backend") == "cpu (a CPU)"
    assert value(server, "scene demo") == "running, step 1,200"
    daemon.failure = (grpc.StatusCode.UNAVAILABLE, "gone")
    assert "gone" in value(server, "no answer")


def test_meshes_show_their_elements_and_extent() -> None:
    mesh = tm.VolumeMesh.from_arrays(
        [[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]],
        [("tetrahedron", [[0, 1, 2, 3]])],
        sets={EVIL: [0, 1]},
        element_fields={"young_modulus_pa": [1000]},
    )
    assert value(mesh, "nodes") == "4"
    assert value(mesh, "shape tetrahedron") == "1"
    assert value(mesh, "to") == "(0.1, 0.2, 0.3)"
    assert value(mesh, f"set {EVIL}") == "2 nodes"
    surface = tm.TriangleSurface.from_arrays(mesh.nodes, [[0, 2, 1]])
    assert (value(surface, "vertices"), value(surface, "triangles")) == ("4", "1")


def test_fields_feedback_and_frames_are_shown() -> None:
    values = {
        "displacement": np.array([[3.0, 4, 0], [0, 0, 0]]),
        "det_f": np.array([0.9]),
        "velocity": np.empty((0, 3)),
    }
    fields = tm.Fields(7, 0.5, values, 1.0, 2.0, 0.9)  # type: ignore[arg-type]
    rows = rows_of(fields)
    assert ["displacement", "2 × 3", "0 m", "5 m"] in rows
    assert ["det_f", "1", "0.9", "0.9"] in rows
    assert ["velocity", "0 × 3", "", ""] in rows
    assert ["kinetic energy", "", "", "2 J"] in rows
    message = stream_pb2.ToolFeedback(
        tool="probe", force_n=scene_pb2.Vector3(x=3, y=4), joint_values=[0.5], retired=True
    )
    feedback = tm.Feedback.from_message(message)
    assert value(feedback, "force") == "(3, 4, 0) N, 5 N"
    assert value(feedback, "retired") == "it touches nothing"
    topology = stream_pb2.Topology(scene="demo", bodies=[stream_pb2.BodySurface(name="liver", vertex_count=1)])
    frame = tm.Frame.from_message(stream_pb2.Frame(step=3, positions=bytes(12), tools=[message]), topology)
    assert value(frame, "body liver") == "1 vertices, 0 triangles"
    assert value(frame, "force on probe") == "(3, 4, 0) N"


def test_text_from_outside_is_escaped() -> None:
    shown = scene_pb2.Scene(name=EVIL, bodies=[scene_pb2.Body(name=EVIL)], tools=[scene_pb2.Tool(name=EVIL)])
    html = shown._repr_html_() + status(warnings=[EVIL])._repr_html_()  # type: ignore[attr-defined]
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 4


def test_a_long_table_says_what_it_leaves_out() -> None:
    bodies = [scene_pb2.Body(name=f"body-{i}") for i in range(notebook.MAX_ROWS + 5)]
    rows = rows_of(tm.Scene(message=scene_pb2.Scene(name="many", bodies=bodies)))
    assert rows[-1] == ["... and 5 more"]
    assert sum(bool(re.match("body-", row[0])) for row in rows) == notebook.MAX_ROWS
