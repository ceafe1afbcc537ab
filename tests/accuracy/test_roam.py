"""The roaming probe: its path, the mesh that is graded along it, and the errors."""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tensormass as tm
from tensormass._shared import processes
from tensormass._src.interface import qualities
from tensormass._src.mesh_geometry import boundary_triangles, signed_volumes
from tensormass._src.organ import ORGANS, liver, liver_held
from tensormass_tools.presets import FOR_BACKEND

from . import roam, roam_mesh, roam_path

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
import leading


def test_the_committed_path_is_the_one_of_its_seed() -> None:
    assert roam_path.FILE.read_text() == roam_path.text(roam_path.make())


def test_the_path_presses_and_stays_away_from_the_held_part() -> None:
    path = roam_path.read()
    assert path.times_s[0] == pytest.approx(roam_path.SAMPLE_S, abs=1e-6)
    assert (path.depths_m > 0).mean() > 0.7
    assert path.depths_m.max() < 2 * roam_path.RADIUS_M, "deeper presses invert elements"
    # The centre is a radius less the depth above the surface.
    above_m = -liver(path.touched_m)
    assert above_m == pytest.approx(roam_path.RADIUS_M - path.depths_m[path.depths_m > 0], abs=5e-4)
    assert (liver_held(path.touched_m) < -0.01).all()
    speed = np.linalg.norm(np.diff(path.positions_m, axis=0), axis=1) / roam_path.SAMPLE_S
    assert speed.max() < 0.1


def test_positions_between_rows_are_smooth_and_meet_the_rows() -> None:
    path = roam_path.read()
    assert path.at(path.times_s) == pytest.approx(path.positions_m, abs=1e-6)
    times_s = np.arange(1, 16 * len(path.times_s) + 1) * roam_path.SAMPLE_S / 16
    steps = np.linalg.norm(np.diff(path.at(times_s), axis=0), axis=1)
    assert steps.max() < 0.1 * roam_path.SAMPLE_S / 16
    between = path.at(path.times_s[:-1] + roam_path.SAMPLE_S / 2)
    straight = (path.positions_m[1:] + path.positions_m[:-1]) / 2
    assert np.linalg.norm(between - straight, axis=1).max() < 2e-4


@pytest.fixture(scope="module")
def coarse() -> tm.VolumeMesh:
    organ = ORGANS["liver"]
    return replace(organ, cell_m=organ.cell_m / 0.5).volume(graded=False)


def test_a_refined_mesh_is_the_same_organ_with_short_edges_along_the_path(coarse: tm.VolumeMesh) -> None:
    path_m = roam_path.read().touched_m[::20]
    fine = roam_mesh.refine(coarse, liver, path_m, [(0.012, 0.009)])
    tetrahedra = fine.elements("tetrahedron").astype(np.int64)
    for a, b in itertools.combinations(range(4), 2):
        middle = fine.nodes[tetrahedra[:, [a, b]]].mean(axis=1)
        near = roam_mesh.distances(middle, path_m) < 0.012
        lengths = np.linalg.norm(fine.nodes[tetrahedra[:, a]] - fine.nodes[tetrahedra[:, b]], axis=1)
        assert lengths[near].max() <= 0.009
    assert len(tetrahedra) > 1.2 * len(coarse.elements("tetrahedron"))
    assert qualities(fine.nodes, tetrahedra).min() > 0.02
    # Halving keeps the volume; moving new nodes onto the curved surface adds a little.
    assert signed_volumes(fine).sum() == pytest.approx(signed_volumes(coarse).sum(), rel=5e-3)
    # A face that belonged to one element only inside of the organ would show a mesh that does not conform.
    furthest = [np.abs(liver(of.nodes[boundary_triangles(of)].mean(axis=1))).max() for of in (coarse, fine)]
    assert furthest[1] <= furthest[0]
    held = fine.nodes[fine.sets["held"]]
    assert len(held) >= len(coarse.sets["held"])
    assert (liver_held(held) > -3e-3).all()


def test_distances_are_those_to_the_nearest_point() -> None:
    points, path = np.random.default_rng(1).random((9000, 3)), np.random.default_rng(2).random((7, 3))
    exact = np.linalg.norm(points[:, None] - path, axis=2).min(axis=1)
    np.testing.assert_allclose(roam_mesh.distances(points, path), exact)
    assert len(roam_mesh.distances(points[:0], path)) == 0


def test_errors_are_shares_of_the_largest_force() -> None:
    reference = np.array([[0, 0, 2.0], [0, 0, 1.0], [0, 0, 0]])
    off = np.array([[0, 0.1, 0], [0, 0, 0], [0.2, 0, 0]])
    found = roam.errors(reference + off, reference)
    assert found["force_error_max"] == pytest.approx(0.1)
    assert found["force_error_rms"] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 3) / 2)


def test_readme_takes_the_settings_of_run() -> None:
    names = {setting.name: setting for setting in roam.SETTINGS}
    of = {backend: names[case.removeprefix("roam: ")] for backend, case in leading.ROAM_DEFAULTS.items()}
    on_gpu = FOR_BACKEND["cuda"]["demo"]
    assert of["cuda"] == roam.Setting("cuda", float(on_gpu["resolution"]), 1 / float(on_gpu["dt_s"]))
    assert "demo" not in FOR_BACKEND.get("cpu", {})
    assert of["cpu"] == roam.Setting("cpu", 1.0, 60)


# --- with a daemon ----------------------------------------------------------------------------------------------------


def test_a_short_part_of_the_path_is_felt_and_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    monkeypatch.setattr(roam, "_LEAST_TIMED_STEPS", 50)
    whole = roam_path.read()
    part = slice(80, 105)  # touches down
    path = roam_path.Path3(whole.times_s[:25], whole.positions_m[part], whole.depths_m[part])
    assert path.depths_m[-1] > 0.001
    with tm.launch(backend="cpu", zenoh=False) as server:
        row = roam.measure(server, roam.Setting("cpu", 0.5, 60), path, np.tile([0, 0, 1.0], (25, 1)))
    assert row["steps"] == 50
    assert 0 < row["step_ms_median"] <= row["step_ms_p99"] <= row["step_ms_max"]
    assert 0.2 < row["force_error_max"] <= 1.5, (
        "before the contact the force is zero, not the 1 N that is compared with"
    )
    assert row["min_det_f"] > 0
