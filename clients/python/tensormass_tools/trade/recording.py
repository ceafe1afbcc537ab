"""Result of a run through the script: values to compare, and costs."""

from __future__ import annotations

from dataclasses import dataclass, field

from tensormass import FloatArray


@dataclass(frozen=True)
class Costs:
    """Costs of one setting on one machine."""

    #: Step time in the daemon, from taking the pose to results, over `timed_steps` [s].
    step_p50_s: float
    step_p99_s: float
    #: Time at the client from sending the pose to its force, in lockstep over the control plane [s].
    latency_p50_s: float
    memory_bytes: int
    frame_bytes: int
    #: Number of steps of the script.
    step_count: int
    #: Number of timed steps; the percentiles span all of them.
    timed_steps: int
    #: Wall time of the recorded run [s].
    wall_s: float
    #: Energy of a step, of the whole GPU, without pauses and with the tool pressed in [J]; None if not counted.
    step_energy_j: float | None = None


@dataclass(frozen=True)
class Recording:
    """Results of a run, at the common points and times."""

    #: Displacements, [body][sample, point, 3] m.
    displacement: list[FloatArray]
    #: Volume of each body against rest, [body, sample].
    volume: FloatArray
    #: Force on the first tool, [sample, 3] N.
    force: FloatArray
    #: Largest work of the tool on the tissue at any time [J].
    work_j: float
    #: Mean displacement of the free motion along its own direction, at each step: [n] s, [n] m.
    free_times_s: FloatArray
    free_m: FloatArray
    element_count: int
    #: Share of the points that lie outside the setting's mesh.
    outside_share: float
    unconverged_steps: int
    min_det_f: float
    costs: Costs
    warnings: list[str] = field(default_factory=list)
