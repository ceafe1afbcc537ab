"""Findings reach Python, the commands and the log. tests/model/mistakes_test.cpp has the scenes of each kind."""

from __future__ import annotations

import json
import pickle
import re
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from service_parts import DEADLINE_S, block

import tensormass as tm
from tensormass._shared.findings import code_of, of_results, text_of
from tensormass._src import findings
from tensormass.v1 import control_pb2, finding_pb2, stream_pb2
from tensormass_tools.cli import main

ROOT = Path(__file__).resolve().parents[2]


def finding(code: str = "FINDING_CODE_LOCKING", **fields: Any) -> finding_pb2.Finding:  # noqa: ANN401
    return finding_pb2.Finding(code=code, message="it locks", remedy="mend it", **fields)


@pytest.fixture(scope="module")
def server() -> object:
    with tm.launch(backend="cpu") as running:
        yield running


def eye(size_m: float) -> tm.Scene:
    """A cube of tissue."""
    mesh = tm.grid([4, 4, 4], [size_m] * 3)
    return tm.Scene.from_mesh(mesh, name="eye", fixed_nodes=mesh.nodes[:, 2] < 1e-9)


def ligament(cg_max_iterations: int | None = None, *, coarse_level: bool | None = None) -> tm.Scene:
    """A ligament of 40 × 5 × 4 mm and 1 MPa that bends under its weight."""
    mesh = tm.grid([32, 4, 4], [0.04, 0.005, 0.004])
    scene = tm.Scene.from_mesh(
        mesh,
        name="ligament",
        young_modulus_pa=1e6,
        poisson_ratio=0.45,
        quadrature="selective",
        fixed_nodes=mesh.nodes[:, 0] < 1e-9,
        gravity_m_per_s2=(0, 0, -9.81),
    )
    scene.set_solver(cg_max_iterations=cg_max_iterations, coarse_level=coarse_level)
    return scene


# --- without a daemon


def test_a_warning_has_everything_of_a_finding() -> None:
    fields: dict[str, Any] = {
        "value": 0.495,
        "limit": 0.47,
        "place": "body 'a'.quadrature",
        "body": "a",
        "other": "b",
        "tool": "t",
    }
    warning = pickle.loads(pickle.dumps(tm.FindingWarning(finding(unit="m", **fields))))
    assert (str(warning), warning.code, warning.unit) == ("it locks; mend it", "locking", "m")
    assert {name: getattr(warning, name) for name in fields} == fields
    assert (warning.message, warning.remedy) == ("it locks", "mend it")


def test_a_code_of_a_newer_daemon_is_its_number() -> None:
    assert code_of(finding_pb2.Finding(code=999)) == "999"  # type: ignore[arg-type]


def test_accepted_findings_warn_nobody() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        findings.warn_of([finding(accepted="a test")])
    with pytest.warns(tm.FindingWarning, match="it locks"):
        findings.warn_of([finding()])


def test_findings_of_the_load_are_not_about_results() -> None:
    result = finding("FINDING_CODE_INVERTED_ELEMENTS")
    accepted = finding("FINDING_CODE_LAW_RANGE", accepted="a test")
    assert of_results(stream_pb2.SceneStatus(findings=[finding(), result, accepted])) == [result]


def test_a_scene_accepts_a_finding_by_name() -> None:
    scene = tm.Scene()
    scene.accept("locking", reason="a test", body="liver")
    (accepted,) = scene.message.accepted_findings
    assert accepted == finding_pb2.AcceptedFinding(code="FINDING_CODE_LOCKING", body="liver", reason="a test")
    with pytest.raises(tm.InvalidArgumentError, match=r"code: unknown value 'lock'; .*locking"):
        scene.accept("lock", reason="a test")


def test_every_code_is_in_the_document() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/findings.md").read_text("utf-8"), re.MULTILINE)
    assert rows == [
        name.removeprefix("FINDING_CODE_").lower() for name, number in finding_pb2.FindingCode.items() if number
    ]


# --- with one


def test_load_and_inspect_warn(server: tm.Server) -> None:
    with pytest.warns(tm.FindingWarning) as caught:
        report = server.inspect(eye(24.0))
    (warning,) = [one.message for one in caught if isinstance(one.message, tm.FindingWarning)]
    assert (warning.code, warning.value, warning.limit, warning.unit) == ("mesh_unit", 24.0, 5.0, "m")
    assert (warning.place, warning.body) == ("body 'body'.mesh.scale", "body")
    assert caught[0].filename == __file__
    assert list(report.findings) == [warning.finding]
    assert list(report.warnings) == [str(warning)]
    with pytest.warns(tm.FindingWarning, match="millimetres"):
        loaded = server.load(eye(24.0), lockstep=True)
    with loaded as handle:
        assert list(handle.status().findings) == [warning.finding]
        assert list(handle.status().warnings) == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(server.inspect(eye(0.024)).findings) == []


def test_a_load_that_fails_by_a_finding_leaves_nothing(server: tm.Server) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=tm.FindingWarning)
        with pytest.raises(tm.FindingWarning, match="millimetres"):
            server.load(eye(24.0))
        assert server.scenes() == []
        scene = eye(24.0)
        scene.accept("mesh_unit", reason="an eye of a giant")
        with server.load(scene, lockstep=True) as handle:
            assert handle.report is not None
            assert [one.accepted for one in handle.report.findings] == ["an eye of a giant"]


def test_solves_that_end_above_their_tolerance_are_said_once_and_shown_while_they_do(server: tm.Server) -> None:
    with server.load(ligament(coarse_level=False), lockstep=True) as handle:
        with pytest.warns(tm.FindingWarning, match="solves ended above cg_tolerance = 0.001") as caught:
            status = handle.step(8)
        assert [one.message.code for one in caught if isinstance(one.message, tm.FindingWarning)] == [
            "solve_above_tolerance"
        ]
        assert [code_of(one) for one in status.findings] == ["solve_above_tolerance"]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert len(handle.step().findings) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for solved in (ligament(2000, coarse_level=False), ligament()):
            with server.load(solved, lockstep=True) as handle:
                assert list(handle.step(8).findings) == []


@pytest.mark.parametrize("name", tm.builtin_scenes())
def test_a_builtin_scene_has_a_reason_beside_each_finding(name: str, server: tm.Server) -> None:
    report = server.inspect(name)
    assert [text_of(one) for one in report.findings if not one.accepted] == []
    found = {one.code for one in report.findings}
    assert {one.code for one in tm.Scene.from_file(name).message.accepted_findings} <= found, "accepted for nothing"


def test_the_commands_print_findings(capsys: pytest.CaptureFixture[str], tmp_path: Path, server: tm.Server) -> None:
    scene = tmp_path / "large.yaml"
    scene.write_text(
        "name: large\nbodies:\n  - name: eye\n    mesh: {grid: {size_m: {x: 24, y: 24, z: 24}, cells_x: 1, cells_y: 1, "
        "cells_z: 1}}\n    law: {stable_neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.45}}\n"
        "    density_kg_per_m3: 1000\n    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 25, y: 25, z: 0}}}]\n"
    )
    assert main(["inspect", str(scene), "--backend", "cpu"]) == 0
    said = capsys.readouterr()
    assert "  mesh_unit: body 'eye' is 24 × 24 × 24 m large" in said.out
    assert said.err == ""
    assert (
        main(["solve", str(scene), "--steps", "1", "--out", str(tmp_path / "out.vtu"), "--server", server.address]) == 0
    )
    assert "tensormass: warning: body 'eye' is 24 × 24 × 24 m large" in capsys.readouterr().err


def test_the_log_has_a_line_for_each_finding() -> None:
    with tm.launch(backend="cpu", options=("--log-format", "json")) as running:
        assert running.log_file is not None
        with pytest.warns(tm.FindingWarning):
            running.load(eye(24.0), lockstep=True)
        lines: list[dict[str, object]] = []
        deadline = time.monotonic() + DEADLINE_S
        while not lines and time.monotonic() < deadline:  # the daemon publishes a scene after its load returns
            # The last line may be half written.
            said = running.log_file.read_text("utf-8").split("\n")[:-1]
            lines = [one for one in map(json.loads, said) if one["event"] == "finding"]
    (line,) = lines
    assert (line["level"], line["scene"], line["code"], line["value"]) == ("warning", "eye", "mesh_unit", 24)
    assert line["place"] == "body 'body'.mesh.scale"


def test_a_tool_inside_tissue_and_overlapping_bodies_are_found_by_name(server: tm.Server) -> None:
    scene = block()
    scene.message.tools[0].position_m.z = 0.03
    inner = tm.grid([2, 2, 2], [0.02] * 3, origin_m=(0.01, 0.01, 0.01))
    scene.add_body("other", inner, density_kg_per_m3=1000, fixed_nodes=inner.nodes[:, 2] < 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = server.inspect(scene)
    found = {code_of(one): one for one in report.findings}
    assert found["tool_inside_tissue"].tool == "probe"
    assert (found["overlap"].body, found["overlap"].other) == ("tissue", "other")
    assert found["softening_law"].body == "tissue"


def test_a_report_without_findings_is_not_about_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "demo", "--backend", "cpu"]) == 0
    assert "finding" not in capsys.readouterr().out
    assert control_pb2.SceneReport().findings == []
