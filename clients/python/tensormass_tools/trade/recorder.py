"""Runs scenes through the script in a daemon, and measures their times and energy."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tensormass import (
    DurationHistogram,
    FailedPreconditionError,
    FloatArray,
    SceneHandle,
    Server,
    TensormassError,
    UnavailableError,
    VolumeMesh,
    body_mesh,
    signed_volumes,
)
from tensormass._shared import defaults
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools.trade.energy import EnergyMeter
from tensormass_tools.trade.interpolation import Interpolation
from tensormass_tools.trade.recording import Costs, Recording
from tensormass_tools.trade.script import Script, rest_nodes

#: Number of steps to time; the script is repeated until then. A 99th percentile of a hundred steps is their second
#: slowest and scatters by a quarter.
TIMED_STEPS = 500
# Length of a call that makes steps while energy is counted [s]: long against the overhead of a call, short against the
# counter, which moves about ten times a second.
_ENERGY_CALL_S = 0.05
_KEPT_INTERPOLATIONS = 4


class Recorder:
    """Runs scenes through a script."""

    def __init__(self, server: Server, scene: scene_pb2.Scene, script: Script) -> None:
        self._server = server
        self._script = script
        volumes = [body_mesh(body) for body in scene.bodies]
        self._points = [rest_nodes(body, volume.nodes) for body, volume in zip(scene.bodies, volumes, strict=True)]
        #: Volume of each point [m³], the weight in means: [body][point].
        self.weights = [node_volumes(volume) for volume in volumes]
        self._interpolations: OrderedDict[str, list[Interpolation]] = OrderedDict()
        self._energy = EnergyMeter(wanted=server.version().backend == "cuda")

    def record(self, scene: scene_pb2.Scene) -> Recording:
        """Runs a scene once. The times are those of this run.

        Raises:
            TensormassError: the scene was refused or stopped; the message says why.
        """
        with self._loaded(scene, "trade") as run:
            return run.record()

    def measure(
        self, scenes: Sequence[scene_pb2.Scene], limit_s: float, *, beside: Sequence[scene_pb2.Scene] = ()
    ) -> list[Recording | TensormassError]:
        """Records each scene, then repeats all in turns for their times, at least once. If the machine is slower for a
        while, it is slower for all of them. Counts the energy of a step where the counter can be read.

        Args:
            limit_s: time for these turns, for each scene. Fewer steps than wanted may be timed by then.
            beside: further scenes that take turns, for comparison of times; their energy is not counted.

        Returns:
            Recordings in the order of `scenes`, then `beside`; for a refused or stopped scene, its error.

        Raises:
            UnavailableError: the daemon is gone.
        """
        with contextlib.ExitStack() as loaded:
            results: dict[int, Recording | TensormassError] = {}
            runs: dict[int, tuple[_Run, Recording]] = {}
            for number, scene in enumerate([*scenes, *beside]):
                with _kept(results, number):
                    run = loaded.enter_context(self._loaded(scene, f"trade_{number}"))
                    runs[number] = run, run.record()
            until = time.monotonic() + limit_s * len(runs)
            while any(run.timed_steps < TIMED_STEPS for run, _ in runs.values()):
                if time.monotonic() >= until and all(run.timed_steps for run, _ in runs.values()):
                    break
                for number, (run, _) in list(runs.items()):
                    with _kept(results, number):
                        run.again()
                    if number in results:
                        del runs[number]
            for number, (run, recording) in runs.items():
                results[number] = replace(recording, costs=run.costs(energy=number < len(scenes)))
        return [results[number] for number in sorted(results)]

    @contextlib.contextmanager
    def _loaded(self, scene: scene_pb2.Scene, name: str) -> Iterator[_Run]:
        message = scene_pb2.Scene()
        message.CopyFrom(scene)
        message.name = name
        handle = self._server.load(message, lockstep=True)
        try:
            yield _Run(self._script, handle, message, self)
        finally:
            handle.unload()

    def interpolations(self, volumes: list[VolumeMesh]) -> list[Interpolation]:
        """Returns the interpolations to the points of each body. The last few are kept."""
        digest = hashlib.sha256()
        for volume in volumes:
            digest.update(volume.nodes.tobytes() + b"".join(nodes.tobytes() for _, nodes in volume.blocks))
        key = digest.hexdigest()
        if key not in self._interpolations:
            self._interpolations[key] = [Interpolation(v, p) for v, p in zip(volumes, self._points, strict=True)]
            while len(self._interpolations) > _KEPT_INTERPOLATIONS:
                self._interpolations.popitem(last=False)
        return self._interpolations[key]

    @property
    def energy(self) -> EnergyMeter:
        return self._energy


@contextlib.contextmanager
def _kept(results: dict[int, Recording | TensormassError], number: int) -> Iterator[None]:
    """Stores an error of the body as the result of a scene, unless the daemon is gone, which says nothing about it."""
    try:
        yield
    except UnavailableError:
        raise
    except TensormassError as error:
        results[number] = error


class _Run:
    """Runs one loaded scene through the script."""

    def __init__(self, script: Script, handle: SceneHandle, scene: scene_pb2.Scene, recorder: Recorder) -> None:
        self._script = script
        self._handle = handle
        self._names = [body.name for body in scene.bodies]
        self._rest = [handle.positions(name) for name in self._names]
        of_message = [body_mesh(body) for body in scene.bodies]
        self._volumes = [replace(v, nodes=rest) for v, rest in zip(of_message, self._rest, strict=True)]
        self._interpolations = recorder.interpolations(self._volumes)
        self._weights = recorder.weights
        self._energy = recorder.energy
        dt_s = defaults.dt_s(scene)
        self._steps_a_sample = 1 if script.one_step else round(script.sample_s / dt_s)
        self._dt_s = script.sample_s / self._steps_a_sample
        self._frame_bytes = sum(12 * body.vertex_count for body in handle.topology().bodies)
        self._latencies_s: list[float] = []
        self._times = DurationHistogram()
        self._wall_s = 0.0

    def record(self) -> Recording:
        """Makes the first run and records all that is compared. The costs are those of this run.

        It makes one step a call, to read positions after it. Each step then also checks the elements and gathers a
        frame, so its times are an upper bound; `again` makes the steps that are timed.
        """
        script = self._script
        began = time.monotonic()
        before = self._handle.step_times()
        samples: list[list[FloatArray]] = []
        volumes, forces, free, free_times = [], [], [], []
        work_j = work_most_j = 0.0
        last: tuple[FloatArray, FloatArray] | None = None
        for step, status in self._steps():
            at_s = step * self._dt_s
            force, position = _felt(status, script.tool)
            if last is not None:
                # Negative, because the force of the tissue opposes the motion.
                work_j -= float((force + last[0]) @ (position - last[1])) / 2
                work_most_j = max(work_most_j, work_j)
            last = force, position
            is_sample = step % self._steps_a_sample == 0
            # Allows a thousandth of a step for rounding.
            is_free = script.free_s[0] < at_s < script.free_s[1] + 1e-3 * self._dt_s
            if is_sample or is_free:
                positions = [self._handle.positions(name) for name in self._names]
                taken = [
                    of(now - rest) for of, now, rest in zip(self._interpolations, positions, self._rest, strict=True)
                ]
            if is_free:
                free_times.append(at_s)
                free.append(self._mean(taken))
            if is_sample:
                samples.append(taken)
                forces.append(force)
                volumes.append([self._volume_share(body, nodes) for body, nodes in enumerate(positions)])
        fields = [self._handle.fields(name) for name in self._names]
        of_this_run = self._handle.step_times() - before
        self._wall_s = time.monotonic() - began
        points = sum(len(weights) for weights in self._weights)
        return Recording(
            displacement=[np.stack(of_body) for of_body in zip(*samples, strict=True)],
            volume=np.array(volumes).T,
            force=np.array(forces),
            work_j=work_most_j,
            free_times_s=np.array(free_times),
            free_m=_along_own_direction(free),
            element_count=sum(volume.element_count for volume in self._volumes),
            outside_share=sum(of.outside_count for of in self._interpolations) / points,
            unconverged_steps=status.unconverged_steps,
            min_det_f=min([status.min_det_f, *(of.min_det_f for of in fields)]),
            costs=self._costs(of_this_run, energy=False),
            warnings=list(status.warnings),
        )

    def _steps(self) -> Iterator[tuple[int, stream_pb2.SceneStatus]]:
        for step in range(1, self._steps_a_sample * self._script.sample_count + 1):
            began = time.perf_counter()
            if self._script.tool is not None:
                # Position of the tool at the end of the step, because the step is implicit.
                self._handle.move_tool(self._script.tool, self._script.pose(step * self._dt_s))
            status = self._handle.step()
            self._latencies_s.append(time.perf_counter() - began)
            if status.fault:
                raise FailedPreconditionError(status.fault)
            yield step, status

    def again(self) -> None:
        """Makes another run, for its times: many steps a call, like a scene that runs by the clock."""
        self._handle.reset()
        before = self._handle.step_times()
        steps = range(1, self._steps_a_sample * self._script.sample_count + 1)
        if self._script.tool is None:
            status = self._handle.step(len(steps))
        else:
            # Position of the tool at the end of the step, because the step is implicit.
            poses = [(self._script.pose(step * self._dt_s), None, ()) for step in steps]
            status = self._handle.follow(self._script.tool, poses)
        if status.fault:
            raise FailedPreconditionError(status.fault)
        self._times += self._handle.step_times() - before

    @property
    def timed_steps(self) -> int:
        """Number of steps that `again` made."""
        return self._times.count

    def _energy_of_a_step(self, step_s: float) -> float | None:
        """Returns the energy of a step [J], over steps without pauses, with the tool at its deepest point. None if the
        counter moved too seldom, or the scene was stopped.

        Runs end where the script ends, because a scene may leave its bounds later. The energy of a reset is counted in
        runs of one step (without steps, if the script has only one) and subtracted.
        """
        steps = self._steps_a_sample * self._script.sample_count
        short_steps = min(1, steps - 1)
        at_once = max(1, round(_ENERGY_CALL_S / max(step_s, 1e-9)))
        try:
            whole, short = (self._energy.count(self._runs(of, at_once)) for of in (steps, short_steps))
        except FailedPreconditionError:
            return None
        if whole is None or short is None:
            return None
        more_steps = whole.steps - whole.runs * short_steps
        more_j = whole.energy_j - whole.runs * short.energy_j / short.runs
        return more_j / more_steps if more_steps > 0 and more_j > 0 else None

    def _runs(self, steps: int, at_once: int) -> Iterator[tuple[int, int]]:
        """Resets and makes `steps`, endlessly. Yields the number of runs started and of steps made."""
        made = 0
        for runs in itertools.count(1):
            self._handle.reset()
            if self._script.tool is not None:
                self._handle.move_tool(self._script.tool, self._script.pose(self._script.deepest_s))
            if steps == 0:
                yield runs, made
            for first in range(0, steps, at_once):
                now = min(at_once, steps - first)
                self._handle.step(now)
                made += now
                yield runs, made

    def costs(self, *, energy: bool) -> Costs:
        """Returns the costs of the runs for their times; `energy`: also that of a step, which takes more runs."""
        return self._costs(self._times, energy=energy)

    def _costs(self, times: DurationHistogram, *, energy: bool) -> Costs:
        report = self._handle.report
        assert report is not None
        steps = self._steps_a_sample * self._script.sample_count
        counted = energy and self._energy.readable
        return Costs(
            step_p50_s=times.p50_s,
            step_p99_s=times.p99_s,
            latency_p50_s=float(np.median(self._latencies_s)),
            memory_bytes=report.bytes_total,
            frame_bytes=self._frame_bytes,
            step_count=steps,
            timed_steps=times.count,
            wall_s=self._wall_s,
            step_energy_j=self._energy_of_a_step(times.p50_s) if counted else None,
        )

    def _mean(self, taken: list[FloatArray]) -> FloatArray:
        total = sum(float(weights.sum()) for weights in self._weights)
        mean: FloatArray = sum(w @ u for w, u in zip(self._weights, taken, strict=True)) / total  # type: ignore[assignment]
        return mean

    def _volume_share(self, body: int, nodes: FloatArray) -> float:
        volume = self._volumes[body]
        now = signed_volumes(replace(volume, nodes=nodes)).sum()
        return float(now / signed_volumes(volume).sum())


def _felt(status: stream_pb2.SceneStatus, tool: str | None) -> tuple[FloatArray, FloatArray]:
    """Returns the force on a tool [N] and its position [m]."""
    for of in status.tools:
        if of.tool == tool:
            f, p = of.force_n, of.position_m
            return np.array([f.x, f.y, f.z]), np.array([p.x, p.y, p.z])
    return np.zeros(3), np.zeros(3)


def _along_own_direction(means: list[FloatArray]) -> FloatArray:
    if not means:
        return np.empty(0)
    path = np.stack(means)
    mean = path.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return path @ (mean / length) if length > 0 else np.zeros(len(path))


def node_volumes(mesh: VolumeMesh) -> FloatArray:
    """Divides the volume of each element among its nodes, [node_count] m³."""
    weights = np.zeros(len(mesh.nodes))
    first = 0
    volumes = signed_volumes(mesh)
    for shape, elements in mesh.blocks:
        share = volumes[first : first + len(elements)] / shape.node_count
        np.add.at(weights, elements, share[:, None])
        first += len(elements)
    return weights
