"""Stand-ins for a running daemon in the tests of `tensormass trade`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import tensormass as tm
from tensormass._src.meshes import FloatArray
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import scene_pb2
from tensormass_tools.trade.knobs import Knobs, Setting
from tensormass_tools.trade.measures import Errors
from tensormass_tools.trade.recording import Costs, Recording
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine, Measurement

BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
bodies:
  - name: block
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 3, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}, prony: [{share: 0.2, relaxation_time_s: 0.1}]}
    density_kg_per_m3: 1000
    quadrature: selective
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - {name: probe, spherical_probe: {radius_m: 0.01}, position_m: {x: 0.05, y: 0.05, z: 0.08}}
solver: {cg_tolerance: 0.01}
"""
MACHINE = Machine("cpu", "some processor", None, "1", "abc")
COSTS = Costs(1e-3, 2e-3, 3e-3, 10, 20, 5, 500, 0.1)


def knobs_of(text: str, folder: Path) -> Knobs:
    return Knobs(SceneFile.parse(text, folder, "scene.yaml"), folder / "meshes")


def measurement(setting: Setting, cost_s: float, error: float, failure: str = "") -> Measurement:
    errors = None if failure else Errors(error, error, 0)
    return Measurement(
        repr(setting), dict(setting), MACHINE, 6, errors, None if failure else COSTS, cost_s=cost_s, failure=failure
    )


def _cells_of(scene: scene_pb2.Scene) -> int:
    """A mesh from a file is as fine as the grid."""
    return scene.bodies[0].mesh.grid.cells_x or 4


class Formula:
    """Stands for a recorder: displacement (1 + error) u, error = (h² + dt²) / 100, both against the scene's own."""

    def __init__(self, scene: scene_pb2.Scene, script: Script, broken_law: str = "") -> None:
        self.weights = [np.ones(2)]
        self.runs = 0
        #: Number of scenes in each call of `measure`.
        self.together = list[int]()
        #: Likewise, how long it may take [s].
        self.limits_s = list[float]()
        #: The run that ends the daemon.
        self.last_run = 0
        self.felt = True
        #: Factors of the times of the next runs, for a machine that changes its speed; 1 afterwards.
        self.slowness = list[float]()
        #: Factors of the errors of the next runs, likewise.
        self.wrongness = list[float]()
        #: `cg_tolerance` whose residual happens to cancel nine tenths of the error; 0 without one.
        self.lucky_tolerance = 0.0
        #: False if the device has no room for a scene and the one timed in turns with it.
        self.room_for_both = True
        self.unconverged_steps = 0
        self.min_det_f = 0.9
        self._cells = _cells_of(scene)
        self._own_dt_s = script.sample_s / 2
        self._samples = script.sample_count
        self._broken_law = broken_law

    def record(self, scene: scene_pb2.Scene) -> Recording:
        self.runs += 1
        if self.runs == self.last_run:
            raise tm.UnavailableError("the daemon is gone")
        if scene.bodies[0].law.WhichOneof("kind") == self._broken_law:
            raise tm.FailedPreconditionError("left the numbers")
        return self._recording(scene, *(of.pop(0) if of else 1.0 for of in (self.wrongness, self.slowness)))

    def _recording(self, scene: scene_pb2.Scene, wrongness: float, slowness: float) -> Recording:
        cells = _cells_of(scene)
        dt = (scene.stepping.dt_s or self._own_dt_s) / self._own_dt_s
        if scene.solver.cg_tolerance == self.lucky_tolerance:
            wrongness *= 0.1
        error = wrongness * (0.01 * (self._cells / cells) ** 2 + 0.01 * dt**2)
        costs = replace(
            COSTS, step_p50_s=1e-3 * slowness * (cells / self._cells) ** 3, wall_s=(cells / self._cells) ** 3 / dt
        )
        u = (1 + error) * np.ones((self._samples, 2, 3))
        force = self.felt * (1 + error / 2) * np.full((self._samples, 3), [0, 0, 2.0])
        empty = np.empty(0)
        return Recording(
            [u],
            np.ones((1, self._samples)),
            force,
            1.0,
            empty,
            empty,
            cells**3,
            0.0,
            self.unconverged_steps,
            self.min_det_f,
            costs,
        )

    def measure(
        self, scenes: Sequence[scene_pb2.Scene], limit_s: float, *, beside: Sequence[scene_pb2.Scene] = ()
    ) -> list[Recording | tm.TensormassError]:
        self.limits_s.append(limit_s)
        self.together.append(len(scenes))
        turns = [self._recording(scene, 1.0, self.slowness[0] if self.slowness else 1.0) for scene in beside]
        recordings: list[Recording | tm.TensormassError] = []
        for scene in scenes:
            try:
                recordings.append(self.record(scene))
            except tm.FailedPreconditionError as error:
                recordings.append(error)
        return [*recordings, *(of if self.room_for_both else tm.ResourceExhaustedError("full") for of in turns)]


def recording(scale: float = 1.0, force_scale: float = 1.0, turn_rad: float = 0.0) -> Recording:
    """Two samples of one body of three points."""
    displacement: FloatArray = scale * np.array([np.full((3, 3), 0.5), np.eye(3)])
    force = force_scale * np.array([[0, 0, 1.0], [0, 2 * math.sin(turn_rad), 2 * math.cos(turn_rad)]])
    times = np.linspace(0, 1, 200)
    swing = np.exp(-scale * times) * np.cos(2 * math.pi * 5 * times)
    volume = np.array([[1.0, 1.0 + 0.01 * scale]])
    return Recording([displacement], volume, force, 3.0 * force_scale, times, swing, 6, 0.0, 0, 0.9, COSTS)
