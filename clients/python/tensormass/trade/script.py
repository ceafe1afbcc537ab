"""The test run that every setting is put through, and what is recorded of it.

The scene starts at rest and takes its loads at once. Where it has tools, the first of them then goes straight to the
nearest point of the surface, presses in by half its radius, stays, and lifts off; the others stay where they are. (By a
whole radius the elements of a thin or coarse tissue may turn inside out, and there is no answer to converge to.) All
settings see the same path and are looked at at the same times, in the same points: the nodes of the scene's own mesh.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from tensormass import defaults, meshes
from tensormass.client import SceneHandle, Server
from tensormass.errors import FailedPreconditionError, InvalidArgumentError, TensormassError, UnavailableError
from tensormass.meshes import FloatArray
from tensormass.scene import volume_mesh
from tensormass.trade.energy import EnergyMeter
from tensormass.trade.interpolation import Interpolation
from tensormass.v1 import scene_pb2, stream_pb2

# Shares of the duration: the tool begins to move, is all the way in, leaves, is back.
_PATH_SHARES = (0.35, 0.6, 0.75, 0.9)
#: How deep the tool goes, against its radius.
PRESS_RADII = 0.5
_TOOL_DURATION_S = 1.6
_FREE_DURATION_S = 1.0
# The longest step that is tried, in steps of the scene; the fields are compared at multiples of it.
SAMPLE_STEPS = 2
#: A 99th percentile of a hundred steps is the second slowest of them, and scatters by a quarter. So the script is run
#: again until so many steps are timed.
TIMED_STEPS = 500
# Steps go in calls of so long while energy is counted: what a call uses besides is small against it, and its counter,
# which moves about ten times a second, is read in time.
_ENERGY_CALL_S = 0.05
_KEPT_INTERPOLATIONS = 4
# Of a step, as somebody writes it in a file.
_ROUNDING = 1e-3

_Point = tuple[float, float, float]


@dataclass(frozen=True)
class Script:
    """What happens in the run. Times in s, lengths in m."""

    duration_s: float
    #: Fields are compared at its multiples.
    sample_s: float
    #: The whole is one step to equilibrium.
    one_step: bool
    #: Free motion, of which frequency and damping are taken: from, to.
    free_s: tuple[float, float]
    tool: str | None = None
    start_m: _Point = (0.0, 0.0, 0.0)
    travel_m: _Point = (0.0, 0.0, 0.0)

    @staticmethod
    def of(scene: scene_pb2.Scene, seconds: float | None = None, press_radii: float = PRESS_RADII) -> Script:
        """Of the scene as it is; `seconds`: instead of the usual duration; `press_radii`: how deep the tool goes.

        Raises:
            InvalidArgumentError: nothing would move.
        """
        dt_s = defaults.dt_s(scene)
        scheduled_s = defaults.scheduled_s(scene)
        loaded = scene.HasField("gravity_m_per_s2") or any(body.loads or body.prescribed for body in scene.bodies)
        if not loaded and not scene.tools:
            raise InvalidArgumentError("the scene has no gravity, no load and no tool: nothing would move")
        quasi_static = scene.solver.integrator == scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
        if quasi_static and not scene.tools and scheduled_s == 0:
            return Script(dt_s, dt_s, True, (0.0, 0.0))
        sample_s = SAMPLE_STEPS * dt_s
        usual_s = _TOOL_DURATION_S if scene.tools else 0 if quasi_static else _FREE_DURATION_S
        wanted_s = seconds or max(scheduled_s, usual_s)
        duration_s = sample_s * max(1, math.ceil(wanted_s / sample_s - 1e-3))
        if not scene.tools:
            return Script(duration_s, sample_s, False, (0.0, duration_s))
        free_s = (0.0, _PATH_SHARES[0] * duration_s) if loaded else (_PATH_SHARES[3] * duration_s, duration_s)
        tool = scene.tools[0]
        start, travel = _press(scene, tool, press_radii)
        return Script(duration_s, sample_s, False, free_s, tool.name, start, travel)

    def pose(self, time_s: float) -> FloatArray:
        """Where the tool is."""
        begin, inside, leave, back = (share * self.duration_s for share in _PATH_SHARES)
        if time_s < leave:
            share = min(max((time_s - begin) / (inside - begin), 0.0), 1.0)
        else:
            share = 1.0 - min(max((time_s - leave) / (back - leave), 0.0), 1.0)
        smooth = (1 - math.cos(math.pi * share)) / 2
        return np.array(self.start_m) + smooth * np.array(self.travel_m)

    @property
    def sample_count(self) -> int:
        return max(1, round(self.duration_s / self.sample_s))

    def text(self) -> str:
        """For the report."""
        if self.one_step:
            return "one step from rest to equilibrium"
        what = f"{self.duration_s:g} s from rest under its loads, compared every {self.sample_s:.4g} s"
        if self.tool is not None:
            begin, inside, leave, back = (share * self.duration_s for share in _PATH_SHARES)
            travel_mm = 1e3 * float(np.linalg.norm(self.travel_m))
            what += (
                f"; {self.tool!r} moves by {travel_mm:.1f} mm from {begin:.2g} to {inside:.2g} s, stays to "
                f"{leave:.2g} s, and is back at {back:.2g} s"
            )
        return what


def check_same_scene(scene: scene_pb2.Scene, own: scene_pb2.Scene, script: Script) -> None:
    """Whether a scene is `own` with other choices, so far that it can be put through the script of that.

    Raises:
        InvalidArgumentError: it is another one, and in what.
    """
    named, wanted = ([body.name for body in of.bodies] for of in (scene, own))
    if named != wanted:
        raise InvalidArgumentError(
            f"bodies are {', '.join(named)}, those of the scene that is measured {', '.join(wanted)}; give that scene "
            "with other choices"
        )
    if script.tool is not None and script.tool not in [tool.name for tool in scene.tools]:
        raise InvalidArgumentError(f"tools: has no {script.tool!r}, which moves in the test run; leave it in")
    if script.one_step:
        if scene.solver.integrator != scene_pb2.Solver.INTEGRATOR_QUASI_STATIC:
            raise InvalidArgumentError("solver.integrator: the test run is one step to equilibrium; take quasi_static")
        return
    dt_s = defaults.dt_s(scene)
    steps = script.sample_s / dt_s
    if abs(steps - round(steps)) > _ROUNDING * steps:
        raise InvalidArgumentError(
            f"stepping.dt_s: {dt_s:g} does not divide the {script.sample_s:g} s after which results are compared; take "
            f"{script.sample_s:g} s or a whole part of it"
        )


def _press(scene: scene_pb2.Scene, tool: scene_pb2.Tool, press_radii: float) -> tuple[_Point, _Point]:
    """Start of a tool and its way straight to the nearest point of the surface at rest and `press_radii` beyond."""
    start = np.array([tool.position_m.x, tool.position_m.y, tool.position_m.z])
    probe, q = tool.spherical_probe, tool.orientation
    centre = start + _rotated(q, np.array([probe.tip_offset_m.x, probe.tip_offset_m.y, probe.tip_offset_m.z]))
    surface = np.concatenate([rest_nodes(body, meshes.boundary(volume_mesh(body)).vertices) for body in scene.bodies])
    way = surface[np.linalg.norm(surface - centre, axis=1).argmin()] - centre
    distance = float(np.linalg.norm(way))
    if distance > 0:
        way = way * (distance + (press_radii - 1) * probe.radius_m) / distance
    return (start[0], start[1], start[2]), (way[0], way[1], way[2])


def _rotated(q: scene_pb2.Quaternion, v: FloatArray) -> FloatArray:
    axis = np.array([q.x, q.y, q.z])
    norm = q.w**2 + axis @ axis
    turned: FloatArray = v + 2 * np.cross(axis, np.cross(axis, v) + q.w * v) / norm if norm > 0 else v
    return turned


def rest_nodes(body: scene_pb2.Body, nodes: FloatArray) -> FloatArray:
    """The nodes of a body's mesh where the scene puts them."""
    of = body.mesh
    scale = of.scale if of.HasField("scale") else 1.0
    return nodes * scale + np.array([of.translation_m.x, of.translation_m.y, of.translation_m.z])


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


class Recorder:
    """Puts scenes through a script."""

    def __init__(self, server: Server, scene: scene_pb2.Scene, script: Script) -> None:
        self._server = server
        self._script = script
        volumes = [volume_mesh(body) for body in scene.bodies]
        self._points = [rest_nodes(body, volume.nodes) for body, volume in zip(scene.bodies, volumes, strict=True)]
        #: [body][point]: the volume that a point stands for [m³], for means.
        self.weights = [node_volumes(volume) for volume in volumes]
        self._interpolations: OrderedDict[str, list[Interpolation]] = OrderedDict()
        self._energy = EnergyMeter(wanted=server.version().backend == "cuda")

    def record(self, scene: scene_pb2.Scene) -> Recording:
        """Runs a scene once; times are those of this run.

        Raises:
            TensormassError: it was refused or stopped, and why.
        """
        with self._loaded(scene, "trade") as run:
            return run.record()

    def measure(
        self, scenes: Sequence[scene_pb2.Scene], limit_s: float, *, beside: Sequence[scene_pb2.Scene] = ()
    ) -> list[Recording | TensormassError]:
        """Records each scene, then runs all again in turns for their times, so that a machine that is slower for a
        while is so for all of them; and counts the energy of a step where it can be read.

        Args:
            limit_s: for these turns, of each scene; by then fewer steps than wanted may be timed.
            beside: scenes that take their turns only for the sake of the others' times; no energy is counted.

        Returns:
            In the order of `scenes`, then of `beside`; of one that was refused or stopped, why.

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
            while any(run.timed_steps < TIMED_STEPS for run, _ in runs.values()) and time.monotonic() < until:
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

    def interpolations(self, volumes: list[meshes.VolumeMesh]) -> list[Interpolation]:
        """To the points of each body; the last few are kept."""
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
    """What keeps one scene from being run is its result; that the daemon is gone says nothing about the scene."""
    try:
        yield
    except UnavailableError:
        raise
    except TensormassError as error:
        results[number] = error


class _Run:
    """One scene on its way through the script."""

    def __init__(self, script: Script, handle: SceneHandle, scene: scene_pb2.Scene, recorder: Recorder) -> None:
        self._script = script
        self._handle = handle
        self._names = [body.name for body in scene.bodies]
        self._rest = [handle.positions(name) for name in self._names]
        of_message = [volume_mesh(body) for body in scene.bodies]
        self._volumes = [replace(v, nodes=rest) for v, rest in zip(of_message, self._rest, strict=True)]
        self._interpolations = recorder.interpolations(self._volumes)
        self._weights = recorder.weights
        self._energy = recorder.energy
        dt_s = defaults.dt_s(scene)
        self._steps_a_sample = 1 if script.one_step else round(script.sample_s / dt_s)
        self._dt_s = script.sample_s / self._steps_a_sample
        self._frame_bytes = sum(12 * body.vertex_count for body in handle.topology().bodies)
        self._latencies_s: list[float] = []
        self._status = stream_pb2.SceneStatus()
        self._wall_s = 0.0

    def record(self) -> Recording:
        """The first run, with all that is compared; its times are its own."""
        script = self._script
        began = time.monotonic()
        samples: list[list[FloatArray]] = []
        volumes, forces, free, free_times = [], [], [], []
        work_j = work_most_j = 0.0
        last: tuple[FloatArray, FloatArray] | None = None
        for step, status in self._steps():
            at_s = step * self._dt_s
            force, position = _felt(status, script.tool)
            if last is not None:
                work_j -= float((force + last[0]) @ (position - last[1])) / 2  # the tissue's force is against it
                work_most_j = max(work_most_j, work_j)
            last = force, position
            is_sample = step % self._steps_a_sample == 0
            # A thousandth of a step is rounding.
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
            costs=self.costs(energy=False),
            warnings=list(status.warnings),
        )

    def _steps(self) -> Iterator[tuple[int, stream_pb2.SceneStatus]]:
        for step in range(1, self._steps_a_sample * self._script.sample_count + 1):
            began = time.perf_counter()
            if self._script.tool is not None:
                # Where the tool will be when the step ends: the step is implicit.
                self._handle.move_tool(self._script.tool, self._script.pose(step * self._dt_s))
            status = self._handle.step()
            self._latencies_s.append(time.perf_counter() - began)
            if status.fault:
                raise FailedPreconditionError(status.fault)
            self._status = status
            yield step, status

    def again(self) -> None:
        """Another run, for its times."""
        self._handle.reset()
        for _ in self._steps():
            pass

    @property
    def timed_steps(self) -> int:
        return len(self._latencies_s)

    def _energy_of_a_step(self, step_s: float) -> float | None:
        """Of steps that follow each other with nothing between, the tool held where it presses most [J]. None: the
        counter moved too seldom, or the scene was stopped.

        Runs go no further than the script does: farther on, a scene may leave its bounds. What it uses to get back to
        the start is counted in runs of one step (of none, if the script is but one), and taken off."""
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
        """Goes back to the start and makes `steps`, for ever; how many runs were begun, how many steps made."""
        made = 0
        for runs in itertools.count(1):
            self._handle.reset()
            if self._script.tool is not None:
                deepest_s = _PATH_SHARES[1] * self._script.duration_s
                self._handle.move_tool(self._script.tool, self._script.pose(deepest_s))
            if steps == 0:
                yield runs, made
            for first in range(0, steps, at_once):
                now = min(at_once, steps - first)
                self._handle.step(now)
                made += now
                yield runs, made

    def costs(self, *, energy: bool) -> Costs:
        """Of the runs so far; `energy`: where it can be read, that of a step besides, for which it runs more."""
        report = self._handle.report
        assert report is not None
        steps = self._steps_a_sample * self._script.sample_count
        counted = energy and self._energy.readable
        return Costs(
            step_p50_s=self._status.step_time_p50_s,
            step_p99_s=self._status.step_time_p99_s,
            latency_p50_s=float(np.median(self._latencies_s)),
            memory_bytes=report.bytes_total,
            frame_bytes=self._frame_bytes,
            step_count=steps,
            timed_steps=self.timed_steps,
            wall_s=self._wall_s,
            step_energy_j=self._energy_of_a_step(self._status.step_time_p50_s) if counted else None,
        )

    def _mean(self, taken: list[FloatArray]) -> FloatArray:
        total = sum(float(weights.sum()) for weights in self._weights)
        mean: FloatArray = sum(w @ u for w, u in zip(self._weights, taken, strict=True)) / total  # type: ignore[assignment]
        return mean

    def _volume_share(self, body: int, nodes: FloatArray) -> float:
        volume = self._volumes[body]
        now = meshes.signed_volumes(replace(volume, nodes=nodes)).sum()
        return float(now / meshes.signed_volumes(volume).sum())


def _felt(status: stream_pb2.SceneStatus, tool: str | None) -> tuple[FloatArray, FloatArray]:
    """Force on a tool [N] and its position [m]."""
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


def node_volumes(mesh: meshes.VolumeMesh) -> FloatArray:
    """[node_count] m³: each element's volume, divided among its nodes."""
    weights = np.zeros(len(mesh.nodes))
    first = 0
    volumes = meshes.signed_volumes(mesh)
    for shape, elements in mesh.blocks:
        share = volumes[first : first + len(elements)] / shape.node_count
        np.add.at(weights, elements, share[:, None])
        first += len(elements)
    return weights


def script_fields(script: Script) -> dict[str, object]:
    """Plain values, for the key of a measurement."""
    return asdict(script)
