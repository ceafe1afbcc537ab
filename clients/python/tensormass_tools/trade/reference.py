"""The reference: the scene refined until its result no longer moves. All settings are compared with it.

Each level has a finer mesh and a smaller step, and is solved to tight tolerances in double precision. It uses the
second-order scheme and the elements that converge fastest, because the limit is the same: hexahedra for grids, linear
tetrahedra in selective quadrature if the scene has them and they can be refined, quadratic tetrahedra for other
tetrahedral meshes. Richardson extrapolation bounds the remaining error by the differences between levels.

A sequence that converges may still converge to something else. The last levels are therefore also run in another
discretization: linear tetrahedra if the reference has quadratic ones, quadratic tetrahedra for all others. Their
distance from the reference must shrink. If it exceeds the error bar of the other discretization, the rest of it is an
error of the reference, whose own error bar must not be smaller.

    |reference - limit| >= |reference - other| - |other - limit|
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

from tensormass import InvalidArgumentError, TensormassError
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.measures import Errors, compare, richardson
from tensormass_tools.trade.recorder import Recorder
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.scene_edits import Value
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine, Store, key_of

# Refinement of each level against the one before.
_RATIO = 1.5
# The first level is coarser than the scene, so that the order is known early. In quadratic tetrahedra a level costs as
# much as a finer one in linear ones, so the first is coarser still.
_FIRST_LEVEL, _FIRST_QUADRATIC_LEVEL = -1, -2
_LEVELS = 8
# Steps in a sample at level 0: four times as fine as the longest step that is tried.
_STEPS_A_SAMPLE = 4
_NEWTON = {"newton_max_iterations": 50, "newton_tolerance": 1e-6, "cg_max_iterations": 10_000, "cg_tolerance": 1e-3}
#: The reference is accurate enough if its own error is below this share of the tolerance.
SHARE_OF_TOLERANCE = 1 / 3


# Number of levels that are also run in the other discretization, and the share of the reference's time that they may
# take.
_OTHER_LEVELS = 3
_OTHER_TIME = 0.5


@dataclass(frozen=True)
class Level:
    """One level of a sequence. Differences are against the level before; in the other discretization, against the
    reference."""

    setting: dict[str, Value]
    element_count: int
    step_count: int
    wall_s: float
    unconverged_steps: int
    min_det_f: float
    displacement: float | None = None
    force: float | None = None

    def text(self, against: str = "the level before") -> str:
        """Describes it for people."""
        text = f"{self.element_count} elements, {self.step_count} steps, {self.wall_s:.0f} s"
        if self.displacement is not None:
            text += f", displacement {self.displacement:.2%} from {against}"
        if self.force is not None:
            text += f", force {self.force:.2%}"
        if self.min_det_f <= 0:
            text += f", det F down to {self.min_det_f:.2g}"
        return text + (f", {self.unconverged_steps} steps not converged" if self.unconverged_steps else "")


@dataclass(frozen=True)
class Reference:
    """The finest level and its distance from the limit."""

    key: str
    recording: Recording
    levels: list[Level]
    #: Error bars, relative: the limit should not be farther away. tests/accuracy/calibration.py checks that.
    displacement_error: float
    force_error: float | None
    order: float
    #: Reason why it is not refined further.
    ended: str
    #: The last levels in the other discretization, the coarsest first. Empty if the scene has only one discretization.
    other: list[Level] = field(default_factory=list)
    #: True if the distance of the other discretization made an error bar larger.
    raised: bool = False

    @property
    def refines_mesh(self) -> bool:
        """Tells whether the mesh was refined. Otherwise every error, the reference's own too, leaves out that of the
        mesh."""
        return "resolution" in self.levels[-1].setting

    @property
    def raises_order(self) -> bool:
        """Tells whether linear tetrahedra were made quadratic. Then errors contain those of linear ones, even if the
        mesh was not refined."""
        return self.levels[-1].setting.get("element_order") == "quadratic"

    @property
    def other_name(self) -> str:
        return "linear tetrahedra" if self.raises_order else "quadratic tetrahedra"

    @property
    def is_approached(self) -> bool:
        """Tells whether the other discretization, refined, comes closer to the reference, in displacement and in
        force."""
        pairs = [(of.displacement or 0.0, of.force or 0.0) for of in self.other]
        return len(pairs) < 2 or all(last <= first for last, first in zip(pairs[-1], pairs[0], strict=True))

    @property
    def error(self) -> float:
        return max(self.displacement_error, self.force_error or 0.0)

    def text(self) -> list[str]:
        """Describes it for people."""
        lines = [level.text() for level in self.levels]
        force = "" if self.force_error is None else f", force {self.force_error:.2%}"
        mesh = "" if self.refines_mesh else " (without that of the mesh)"
        lines.append(
            f"its own error{mesh}, by Richardson extrapolation of order {self.order:.2f}: displacement "
            f"{self.displacement_error:.2%}{force}; {self.ended}"
        )
        if self.raised:
            lines[-1] += f"; raised, because the error of the {self.other_name} does not explain their distance"
        return lines + [f"in {self.other_name}: {level.text('the reference')}" for level in self.other]

    def to_plain(self) -> dict[str, object]:
        plain = {name: getattr(self, name) for name in ("key", "displacement_error", "force_error", "order", "ended")}
        levels = {"levels": [asdict(of) for of in self.levels], "other": [asdict(of) for of in self.other]}
        return plain | {"raised": self.raised, "refines_mesh": self.refines_mesh, **levels}


def find(
    knobs: Knobs,
    script: Script,
    recorder: Recorder,
    store: Store,
    machine: Machine,
    *,
    tolerance: float,
    limit_s: float,
    say: Callable[[str], None],
    most_levels: int = _LEVELS,
) -> Reference:
    """Refines until the error bar is below a third of `tolerance`, or another level would take longer than `limit_s`.

    Raises:
        TensormassError: the scene cannot be run, or nothing in it moves.
    """
    levels: list[Level] = []
    best: Recording | None = None
    key = ""
    estimates: tuple[float, float | None, float] = (float("inf"), None, 1.0)
    growth = _RATIO ** ((3 if "resolution" in knobs.refinable else 0) + (0 if script.one_step else 1))
    ended = "the last level"
    first = _FIRST_QUADRATIC_LEVEL if _is_quadratic(knobs) else _FIRST_LEVEL
    for number in range(most_levels):
        setting = _setting(knobs, script, number + first)
        if len(levels) > 1:
            expected_s = levels[-1].wall_s * growth
            if sum(level.wall_s for level in levels) + expected_s > limit_s:
                ended = f"another level would take about {expected_s:.0f} s (--reference-seconds {limit_s:g})"
                break
        try:
            own_key, recording = _recording(setting, knobs, script, recorder, store, machine)
        except TensormassError as error:
            if len(levels) < 2:
                raise
            ended = f"the next level failed: {error}"
            break
        if not any(values.any() for values in recording.displacement):
            raise InvalidArgumentError("nothing in the scene moves in this run; a load or a tool has to reach a body")
        errors = compare(best, recording, recorder.weights) if best is not None else None
        levels.append(_level(setting, recording, errors))
        key, best = own_key, recording
        said = f"reference, level {number}: {levels[-1].text()}"
        if len(levels) > 1:
            estimates = _estimates(levels)
            error_now = max(estimates[0], estimates[1] or 0.0)
            said += f"; own error about {error_now:.2%}, wanted {tolerance * SHARE_OF_TOLERANCE:.2%}"
        say(said)
        # Two levels alone say nothing about the order.
        if len(levels) > 2 and error_now < tolerance * SHARE_OF_TOLERANCE:
            ended = "below a third of the tolerance"
            break
    assert best is not None
    found = Reference(key, best, levels, *estimates, ended)
    other: list[Level] = []
    differences: list[Errors] = []
    before: Recording | None = None
    for setting in _other_settings(levels, knobs):
        if other and sum(of.wall_s for of in other) + growth * other[-1].wall_s > _OTHER_TIME * limit_s:
            break
        try:
            recording = _recording(setting, knobs, script, recorder, store, machine)[1]
        except TensormassError as error:
            say(f"reference, in {found.other_name}: {error}")
            break
        if recording.min_det_f <= 0:
            say(f"reference, in {found.other_name}: inverted elements, det F down to {recording.min_det_f:.2g}")
            break
        if before is not None:
            differences.append(compare(before, recording, recorder.weights))
        before = recording
        other.append(_level(setting, recording, compare(recording, best, recorder.weights)))
        say(f"reference, in {found.other_name}: {other[-1].text('the reference')}")
    return _not_below_the_gap(replace(found, other=other), differences)


def _other_settings(levels: list[Level], knobs: Knobs) -> list[dict[str, Value]]:
    """Returns the settings of the other discretization, coarse to fine; none if the mesh is not refined."""
    if "resolution" not in knobs.refinable:
        return []
    if _is_quadratic(knobs):
        return [level.setting | {"element_order": "as_given"} for level in levels[-_OTHER_LEVELS:]]
    if "shape" in knobs.refinable:
        quadratic: dict[str, Value] = {"shape": "quadratic_tetrahedron"}
    elif "element_order" in knobs.refinable:
        quadratic = {"element_order": "quadratic", "quadrature": "full"}
    else:
        return []
    # Without the finest level, because quadratic tetrahedra have twice as many nodes along an edge.
    return [level.setting | quadratic for level in levels[-1 - _OTHER_LEVELS : -1]]


def _is_quadratic(knobs: Knobs) -> bool:
    """Tells whether the reference has quadratic tetrahedra in place of linear ones. Those in selective quadrature stay
    if they can be refined: they converge as far in less time."""
    stays = knobs.is_selective and "resolution" in knobs.refinable
    return "element_order" in knobs.refinable and not stays


def _not_below_the_gap(found: Reference, differences: Sequence[Errors]) -> Reference:
    """Raises error bars to the distance that the other discretization's own error does not explain.

    Args:
        differences: between each level of the other discretization and the next.
    """
    if not differences:  # its own error is not known
        return found

    def gap(distance: float | None, steps: Sequence[float | None]) -> float:
        known = [step for step in steps if step is not None]
        return distance - richardson(known, _RATIO)[0] if distance is not None and known else 0.0

    displacement = gap(found.other[-1].displacement, [of.displacement for of in differences])
    force = gap(found.other[-1].force, [of.force for of in differences])
    return replace(
        found,
        displacement_error=max(found.displacement_error, displacement),
        force_error=None if found.force_error is None else max(found.force_error, force),
        raised=displacement > found.displacement_error or force > (found.force_error or math.inf),
    )


def _recording(
    setting: dict[str, Value], knobs: Knobs, script: Script, recorder: Recorder, store: Store, machine: Machine
) -> tuple[str, Recording]:
    """Returns the recording of a setting and its key. Takes it from the store if it is there."""
    scene = knobs.apply(setting).message()
    key = key_of(scene, script, machine, "reference")
    recording = store.recording(key)
    if recording is None:
        recording = recorder.record(scene)
        store.keep(key, recording)
    return key, recording


def _level(setting: dict[str, Value], recording: Recording, errors: Errors | None) -> Level:
    return Level(
        setting,
        recording.element_count,
        recording.costs.step_count,
        recording.costs.wall_s,
        recording.unconverged_steps,
        recording.min_det_f,
        errors.displacement if errors else None,
        errors.force if errors else None,
    )


def _estimates(levels: list[Level]) -> tuple[float, float | None, float]:
    """Returns the error bars of displacement and force, and the order of the displacement."""
    displacement, order = richardson([level.displacement for level in levels if level.displacement is not None], _RATIO)
    forces = [level.force for level in levels if level.force is not None]
    return displacement, richardson(forces, _RATIO)[0] if forces else None, order


def _setting(knobs: Knobs, script: Script, level: int) -> dict[str, Value]:
    factor = _RATIO**level
    setting: dict[str, Value] = {"precision": "double", **_NEWTON}
    if "resolution" in knobs.refinable:
        setting["resolution"] = factor
    if "shape" in knobs.refinable:
        setting |= {"shape": "hexahedron", "quadrature": "selective"}
    if _is_quadratic(knobs):
        setting["element_order"] = "quadratic"
    if not script.one_step:
        setting["dt_s"] = script.sample_s / max(1, round(_STEPS_A_SAMPLE * factor))
    if not knobs.quasi_static:
        setting["integrator"] = "bdf2"
    return setting
