"""What a run through the script gave: results to compare, and costs."""

from __future__ import annotations

from dataclasses import dataclass, field

from tensormass._src.meshes import FloatArray


@dataclass(frozen=True)
class Costs:
    """Of one setting on one machine."""

    #: Of the daemon, from the pick-up of the pose to results, in `timed_steps`.
    step_p50_s: float
    step_p99_s: float
    #: From the pose in the client's hand to the force in it, in lockstep over the control plane.
    latency_p50_s: float
    memory_bytes: int
    frame_bytes: int
    #: Of the script.
    step_count: int
    #: Of all its runs; the daemon's percentiles are of the last 1024 of them.
    timed_steps: int
    #: Of the recorded run.
    wall_s: float
    #: Of the whole GPU while it makes one step after the other, the tool pressed in; None: not counted.
    step_energy_j: float | None = None


@dataclass(frozen=True)
class Recording:
    """What a run gave, in the common points and times."""

    #: [body][sample, point, 3] m
    displacement: list[FloatArray]
    #: [body, sample]: volume against that at rest
    volume: FloatArray
    #: [sample, 3] N, on the first tool
    force: FloatArray
    #: The largest work of the tool on the tissue so far [J].
    work_j: float
    #: Mean displacement along its own direction in the free motion, at each step: [n] s, [n] m.
    free_times_s: FloatArray
    free_m: FloatArray
    element_count: int
    #: Points that are not inside of the setting's mesh, as a share.
    outside_share: float
    unconverged_steps: int
    min_det_f: float
    costs: Costs
    warnings: list[str] = field(default_factory=list)
