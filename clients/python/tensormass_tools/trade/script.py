"""The script: the test run of every setting.

The scene starts at rest, and its loads act at once. Then the first tool, if there is one, moves straight to the nearest
point of the surface. It presses in by half its radius, stays, and lifts off. With two depths it stays at the first one,
presses on to the second, and stays there. Other tools do not move. At a depth of a whole radius, elements of a thin or
coarse tissue may become inverted, and there is no solution to converge to.

All settings see the same path. They are compared at the same times and at the same points, the nodes of the scene's own
mesh.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from tensormass import BoolArray, FloatArray, InvalidArgumentError, body_mesh, boundary_surface
from tensormass._shared import defaults
from tensormass.v1 import scene_pb2
from tensormass_tools.tool_sizes import movable_tools, radius_m, shape_of

# Shares of the duration at which the tool starts to move, is at its deepest, starts back, and is back.
_PATH_SHARES = (0.35, 0.6, 0.75, 0.9)
# With two depths: starts to move, is at the first depth, presses on, is at its deepest, starts back, and is back. Times
# in seconds are as with one depth, because the duration is longer by `_LONGER`.
_TWO_DEPTHS_SHARES = (0.25, 0.43, 0.535, 0.715, 0.82, 0.93)
_LONGER = 1.4
#: Depth to which the tool presses, in radii.
PRESS_RADII = 0.5
_TOOL_DURATION_S = 1.6
_FREE_DURATION_S = 1.0
# Longest step that is tried, in steps of the scene. Fields are compared at its multiples.
SAMPLE_STEPS = 2
# Rounding of a step in a scene file.
_ROUNDING = 1e-3
_Point = tuple[float, float, float]


@dataclass(frozen=True)
class Script:
    """Course of a run. Times in s, lengths in m."""

    duration_s: float
    #: Interval at which fields are compared.
    sample_s: float
    #: True if the run is one step to equilibrium.
    one_step: bool
    #: Start and end of the free motion, from which frequency and damping are taken.
    free_s: tuple[float, float]
    tool: str | None = None
    start_m: _Point = (0.0, 0.0, 0.0)
    travel_m: _Point = (0.0, 0.0, 0.0)
    #: Depths at which the tool stays, beyond the nearest point of the surface: one, or a shallow one and the deepest.
    depths_m: tuple[float, ...] = ()
    #: Shares of `travel_m` at these depths.
    stays: tuple[float, ...] = ()

    @staticmethod
    def of(scene: scene_pb2.Scene, seconds: float | None = None, *press_radii: float) -> Script:
        """Makes the script of the unmodified scene.

        Args:
            seconds: replaces the usual duration.
            press_radii: one or two depths to which the tool presses, in radii, ascending; default `PRESS_RADII`.

        Raises:
            InvalidArgumentError: nothing in the scene would move.
        """
        dt_s = defaults.dt_s(scene)
        scheduled_s = defaults.scheduled_s(scene)
        loaded = scene.HasField("gravity_m_per_s2") or any(body.loads or body.prescribed for body in scene.bodies)
        tools = movable_tools(scene)
        if not loaded and not tools:
            raise InvalidArgumentError("the scene has no gravity, no load and no tool: nothing would move")
        quasi_static = scene.solver.integrator == scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
        if quasi_static and not tools and scheduled_s == 0:
            return Script(dt_s, dt_s, True, (0.0, 0.0))
        sample_s = SAMPLE_STEPS * dt_s
        depths = press_radii or (PRESS_RADII,)
        of_tool_s = _TOOL_DURATION_S * (1 if len(depths) == 1 else _LONGER)
        usual_s = of_tool_s if tools else 0 if quasi_static else _FREE_DURATION_S
        wanted_s = seconds or max(scheduled_s, usual_s)
        duration_s = sample_s * max(1, math.ceil(wanted_s / sample_s - 1e-3))
        if not tools:
            return Script(duration_s, sample_s, False, (0.0, duration_s))
        tool = tools[0]
        start, travel, depths_m, stays = _press(scene, tool, depths)
        script = Script(duration_s, sample_s, False, (0.0, 0.0), tool.name, start, travel, depths_m, stays)
        moves_s = script._moves_s
        return replace(script, free_s=(0.0, moves_s[0]) if loaded else (moves_s[-1], duration_s))

    @property
    def _moves_s(self) -> list[float]:
        """Returns the times at which the tool starts to move, arrives, starts, .., and is back."""
        shares = _PATH_SHARES if len(self.depths_m) == 1 else _TWO_DEPTHS_SHARES
        return [share * self.duration_s for share in shares]

    @property
    def deepest_s(self) -> float:
        """Returns a time at which the tool is at its deepest."""
        return self._moves_s[-3]

    def pose(self, time_s: float) -> FloatArray:
        """Returns the position of the tool, [3] m."""
        moves_s = self._moves_s
        last = at = 0.0
        for start_s, end_s, to in zip(moves_s[::2], moves_s[1::2], [*self.stays, 0.0], strict=True):
            share = min(max((time_s - start_s) / (end_s - start_s), 0.0), 1.0)
            at += (to - last) * (1 - math.cos(math.pi * share)) / 2
            last = to
        return np.array(self.start_m) + at * np.array(self.travel_m)

    @property
    def sample_count(self) -> int:
        return max(1, round(self.duration_s / self.sample_s))

    def held(self) -> list[BoolArray]:
        """Tells for each depth and sample whether the tool stays there, [sample_count] each; empty without a tool."""
        if self.tool is None:
            return []
        times = self.sample_s * np.arange(1, self.sample_count + 1)
        slack = 1e-6 * self.sample_s
        stays_s = self._moves_s[1:-1]
        return [
            (times > start_s - slack) & (times < end_s + slack)
            for start_s, end_s in zip(stays_s[::2], stays_s[1::2], strict=True)
        ]

    def text(self) -> str:
        """Describes the script for the report."""
        if self.one_step:
            return "one step from rest to equilibrium"
        what = f"{self.duration_s:g} s from rest under its loads, compared every {self.sample_s:.4g} s"
        if self.tool is not None:
            depths = " and ".join(f"{1e3 * depth_m:.3g}" for depth_m in self.depths_m)
            what = f"{self.tool!r} presses {depths} mm deep; {what}"
            begin, *stays_s, back = self._moves_s
            travel_mm = 1e3 * float(np.linalg.norm(self.travel_m))
            stays = " and ".join(
                f"from {start_s:.2g} to {end_s:.2g} s"
                for start_s, end_s in zip(stays_s[::2], stays_s[1::2], strict=True)
            )
            what += (
                f"; {self.tool!r} moves by {travel_mm:.1f} mm from {begin:.2g} s, stays {stays}, and is back at "
                f"{back:.2g} s"
            )
        return what


def check_same_scene(scene: scene_pb2.Scene, own: scene_pb2.Scene, script: Script) -> None:
    """Checks that the script of `own` can be run on a scene, which must be `own` with other choices.

    Raises:
        InvalidArgumentError: it is another scene; the message says in what.
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


def _press(
    scene: scene_pb2.Scene, tool: scene_pb2.Tool, press_radii: Sequence[float]
) -> tuple[_Point, _Point, tuple[float, ...], tuple[float, ...]]:
    """Returns the start of a tool; its way straight to the nearest point of the surface at rest and the last of
    `press_radii` beyond it; for each of these its depth [m] and the share of the way at which it is reached."""
    start = np.array([tool.position_m.x, tool.position_m.y, tool.position_m.z])
    shape, radius, q = shape_of(tool), radius_m(tool), tool.orientation
    centre = start + _rotated(q, np.array([shape.tip_offset_m.x, shape.tip_offset_m.y, shape.tip_offset_m.z]))
    surface = np.concatenate([rest_nodes(body, boundary_surface(body_mesh(body)).vertices) for body in scene.bodies])
    way = surface[np.linalg.norm(surface - centre, axis=1).argmin()] - centre
    distance = float(np.linalg.norm(way))
    lengths = [distance + (depth - 1) * radius for depth in press_radii]
    if distance > 0:
        way = way * lengths[-1] / distance
    stays = tuple(length / lengths[-1] if lengths[-1] != 0 else 1.0 for length in lengths)
    depths_m = tuple(depth * radius for depth in press_radii)
    return (start[0], start[1], start[2]), (way[0], way[1], way[2]), depths_m, stays


def _rotated(q: scene_pb2.Quaternion, v: FloatArray) -> FloatArray:
    axis = np.array([q.x, q.y, q.z])
    norm = q.w**2 + axis @ axis
    turned: FloatArray = v + 2 * np.cross(axis, np.cross(axis, v) + q.w * v) / norm if norm > 0 else v
    return turned


def rest_nodes(body: scene_pb2.Body, nodes: FloatArray) -> FloatArray:
    """Places the nodes of a body's mesh as the scene does."""
    of = body.mesh
    scale = of.scale if of.HasField("scale") else 1.0
    return nodes * scale + np.array([of.translation_m.x, of.translation_m.y, of.translation_m.z])


def script_fields(script: Script) -> dict[str, object]:
    """Returns plain values, for the key of a measurement."""
    return asdict(script)
