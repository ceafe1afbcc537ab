"""What each step of a scene did: the record of `SceneHandle.steps`.

`SceneStatus` counts rejected attempts and steps that did not converge since the load. A record has the differences
between two statuses, so it tells them for one step.
"""

from __future__ import annotations

from dataclasses import dataclass

from tensormass._shared import defaults
from tensormass._src import notebook
from tensormass.v1 import scene_pb2, stream_pb2


@dataclass(frozen=True)
class StepRecord:
    """One step of a scene."""

    #: Number of the step; the first one after a load or a reset is 1.
    step: int
    #: Simulated time at the end of the step [s].
    simulated_time_s: float
    #: Conjugate-gradient iterations.
    cg_iterations: int
    #: Residual at which they ended, relative to the right-hand side.
    cg_relative_residual: float
    #: Newton iterations; 0 if a step is one linear solve.
    newton_iterations: int
    #: Last residual of Newton's method, relative to the forces at work; 0 if a step is one linear solve.
    newton_residual: float
    #: True if the solve reached its tolerance; None if that is unknown, because another client loaded the scene and
    #: its tolerance is not in the status.
    converged: bool | None
    #: Attempts at this step that a guard rejected before one succeeded.
    rejected_attempts: int
    #: True if the step belongs to a recovery: tools backed off, or the tissue was held (`Guard.on_fault`).
    recovering: bool
    #: Kinetic energy after the step [J].
    kinetic_energy_j: float
    #: Everything that the daemon reports. Its elastic energy, smallest det F and rates are of their last check, which
    #: may lie some steps back.
    status: stream_pb2.SceneStatus

    def _repr_html_(self) -> str:
        return notebook.status_html(self.status)

    @staticmethod
    def between(
        before: stream_pb2.SceneStatus, after: stream_pb2.SceneStatus, solver: scene_pb2.Solver | None
    ) -> StepRecord:
        """Makes the record of the step between two statuses.

        Args:
            solver: settings of the scene; None if they are unknown.
        """
        return StepRecord(
            step=after.step,
            simulated_time_s=after.simulated_time_s,
            cg_iterations=after.cg_iterations,
            cg_relative_residual=after.cg_relative_residual,
            newton_iterations=after.newton_iterations,
            newton_residual=after.newton_residual,
            converged=_converged(before, after, solver),
            rejected_attempts=after.guard_events - before.guard_events,
            recovering=after.recovering,
            kinetic_energy_j=after.kinetic_energy_j,
            status=after,
        )


def _converged(
    before: stream_pb2.SceneStatus, after: stream_pb2.SceneStatus, solver: scene_pb2.Solver | None
) -> bool | None:
    if after.newton_iterations > 0:
        # A residual above the tolerance may be rounding that moves no node, so only the counter tells.
        return after.unconverged_steps == before.unconverged_steps
    if solver is None:
        return None
    # Tolerance 0 asks for all iterations, whatever residual they reach.
    tolerance = defaults.cg_tolerance(solver)
    return tolerance == 0 or after.cg_relative_residual <= tolerance
