"""The steps of `tensormass solve`: how many there are, whether each converged, when a scene is at rest."""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from tensormass import FailedPreconditionError, Fields, NotConvergedError, SceneHandle
from tensormass._shared import defaults
from tensormass.v1 import finding_pb2, scene_pb2, stream_pb2
from tensormass_tools import presets
from tensormass_tools.output import Warnings
from tensormass_tools.solve_files import Writer
from tensormass_tools.solve_text import Progress

# A scene is at rest if so many checks in a row, so many steps apart, find a kinetic energy below this share of the
# largest so far.
REST_CHECKS = 5
REST_CHECK_STEPS = 10
REST_SHARE = 1e-8
# Simulated time after which a scene that does not come to rest is given up [s].
REST_LIMIT_S = 60.0
# Knobs by which a preset ends a step before its tolerance.
PRESET_LIMITS = ("cg_max_iterations", "newton_max_iterations")
_QUASI_STATIC = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
_INTEGRATORS = {
    scene_pb2.Solver.INTEGRATOR_UNSPECIFIED: "implicit Euler",
    scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER: "implicit Euler",
    scene_pb2.Solver.INTEGRATOR_BDF2: "BDF2",
    _QUASI_STATIC: "quasi-static",
    scene_pb2.Solver.INTEGRATOR_IMPLICIT_MIDPOINT: "implicit midpoint",
}


def _preset_limits(args: argparse.Namespace) -> str:
    """Returns the limits of iterations that the preset sets, for people; empty if it sets none."""
    if args.preset is None:
        return ""
    setting = presets.all_presets()[args.scene][args.preset]
    return ", ".join(f"{knob} {setting[knob]}" for knob in PRESET_LIMITS if knob in setting)


class Solution:
    """The steps of one run."""

    def __init__(self, args: argparse.Namespace, scene: scene_pb2.Scene, handle: SceneHandle, writer: Writer) -> None:
        self._args = args
        self._solver = scene.solver
        self._handle = handle
        self._writer = writer
        self._dt_s = defaults.dt_s(scene)
        self._scheduled_s = defaults.scheduled_s(scene)
        self._warnings = Warnings()
        self._preset_limits = _preset_limits(args)
        self._unconverged_count = 0
        self._unconverged = ""
        self._worst_residual = 0.0
        self._kinetic_share = 1.0
        #: False if the scene had to come to rest and did not.
        self.at_rest = True
        self._unconverged_steps = 0

    def compute(self) -> dict[str, Any]:
        """Makes the steps, writes, and returns the summary.

        Raises:
            NotConvergedError: a step missed its tolerance, and neither option nor preset allows that.
        """
        began = time.monotonic()
        count = self._step_count()
        newton = cg = 0
        residual = 0.0
        if self._args.every:
            self._writer.write_one_of_series(0, 0.0)
        with Progress(count, self._dt_s) as progress:
            for status in self._steps(count):
                newton += status.newton_iterations
                cg += status.cg_iterations
                residual = max(residual, status.newton_residual)
                self._check(status, count)
                self._warnings.take(status)
                if self._args.every and status.step % self._args.every == 0:
                    self._writer.write_one_of_series(status.step, status.simulated_time_s)
                progress.show(status, self._kinetic_share if count is None else None)
        measured = self._writer.write()
        return {
            "integrator": _INTEGRATORS[self._solver.integrator],
            "precision": "double" if self._solver.precision == scene_pb2.Solver.PRECISION_DOUBLE else "float",
            "steps": status.step,
            "simulated_time_s": status.simulated_time_s,
            "wall_time_s": time.monotonic() - began,
            "newton_iterations": newton,
            "newton_residual": residual,
            "unconverged_steps": self._unconverged_count,
            "cg_iterations": cg,
            "cg_relative_residual": status.cg_relative_residual,
            "bodies": [
                {
                    "name": name,
                    "max_displacement_m": float(np.linalg.norm(fields["displacement"], axis=1).max()),
                    "reaction_sum_n": fields["reaction_force"].sum(axis=0).tolist(),
                    "elastic_energy_j": fields.elastic_energy_j,
                    "kinetic_energy_j": fields.kinetic_energy_j,
                    "min_det_f": fields.min_det_f,
                }
                for name, fields in zip(self._writer.bodies, measured, strict=True)
            ],
            "warnings": self._findings(status, measured),
            "files": self._writer.files,
        }

    def _step_count(self) -> int | None:
        """Returns the number of steps; None to continue until the scene is at rest."""
        if self._args.steps is not None:
            return int(self._args.steps)
        if self._args.seconds is not None:
            return self._steps_until(self._args.seconds)
        if self._solver.integrator == _QUASI_STATIC:
            return self._steps_until(self._scheduled_s)
        return None

    def _steps_until(self, time_s: float) -> int:
        # Allows a thousandth of a step for rounding.
        return max(1, math.ceil(time_s / self._dt_s - 1e-3))

    def _steps(self, count: int | None) -> Iterator[stream_pb2.SceneStatus]:
        if count is not None:
            for step in range(1, count + 1):
                yield self._step(f"step {step} of {count}")
            return
        energies: deque[float] = deque(maxlen=REST_CHECKS)
        peak = 0.0
        for step in range(1, self._steps_until(max(REST_LIMIT_S, 2 * self._scheduled_s)) + 1):
            status = self._step(f"step {step}")
            yield status
            if step % REST_CHECK_STEPS == 0:
                energies.append(sum(self._handle.fields(body).kinetic_energy_j for body in self._writer.bodies))
                peak = max(peak, energies[-1])
                self._kinetic_share = max(energies) / peak if peak > 0 else 0.0
                rested = len(energies) == REST_CHECKS and self._kinetic_share <= REST_SHARE
                if rested and status.simulated_time_s >= self._scheduled_s:
                    return
        self.at_rest = False

    def _step(self, where: str) -> stream_pb2.SceneStatus:
        try:
            return self._handle.step()
        except FailedPreconditionError as error:  # a guard stopped the scene
            raise NotConvergedError(f"{where}: {error}") from error

    def _check(self, status: stream_pb2.SceneStatus, count: int | None) -> None:
        where = f"step {status.step}" + (f" of {count}" if count is not None else "")
        solver = self._solver
        if defaults.newton_max_iterations(solver) > 1:
            tolerance = defaults.newton_tolerance(solver)
            before, self._unconverged_steps = self._unconverged_steps, status.unconverged_steps
            if status.unconverged_steps > before:
                single = solver.precision != scene_pb2.Solver.PRECISION_DOUBLE
                self._did_not_converge(
                    f"{where} did not converge: a residual of {status.newton_residual:.1e} of the forces after "
                    f"{status.newton_iterations} Newton iterations, above newton_tolerance {tolerance:g}",
                    status.newton_residual,
                    ("take --precision double, or " if single else "")
                    + "give it more newton_max_iterations or cg_max_iterations, or reach the load in smaller steps",
                )
            return
        tolerance = defaults.cg_tolerance(solver)
        if tolerance > 0 and status.cg_relative_residual > tolerance:
            self._did_not_converge(
                f"{where} did not converge: a residual of {status.cg_relative_residual:.1e} after "
                f"{status.cg_iterations} conjugate-gradient iterations, above cg_tolerance {tolerance:g}",
                status.cg_relative_residual,
                "raise cg_max_iterations",
            )

    def _did_not_converge(self, what: str, residual: float, remedy: str) -> None:
        if self._preset_limits:
            remedy = f"--preset {self._args.preset} asks for no more: {self._preset_limits}"
        elif not self._args.allow_unconverged:
            raise NotConvergedError(f"{what}; {remedy}. {self._writer.so_far}; with --allow-unconverged it is")
        self._unconverged_count += 1
        self._unconverged = self._unconverged or f"{what}; {remedy}"
        self._worst_residual = max(self._worst_residual, residual)

    def _findings(self, status: stream_pb2.SceneStatus, measured: list[Fields]) -> list[str]:
        """Returns warnings about the result."""
        findings = []
        if self._unconverged:
            others = self._unconverged_count - 1
            more = f" ({others} more steps like this, {self._worst_residual:.1e} at most)" if others > 0 else ""
            findings.append(self._unconverged + more)
        if not self.at_rest:
            findings.append(
                f"not at rest after {status.simulated_time_s:g} s, the kinetic energy is {self._kinetic_share:.1e} of "
                "its peak; say how long with --seconds, give the scene damping, or integrator: quasi_static"
            )
        for name, fields in zip(self._writer.bodies, measured, strict=True):
            if fields.min_det_f <= 0:
                findings.append(
                    f"body {name!r}: elements are inverted, det F down to {fields.min_det_f:.2g}: no tissue "
                    "can be in this state; take a finer mesh, smaller steps, or a law that stands compression"
                )
        # Leaves out the daemon's finding on convergence, which is about the last step only.
        return findings + self._warnings.latest(without=(finding_pb2.FINDING_CODE_UNCONVERGED_STEP,))
