"""`tensormass solve`: a scene computed step by step in lockstep, and its fields written as VTU.

A quasi-static scene makes one step, or as many as its schedules take. A dynamic one goes on until it is at rest: the
kinetic energy at each of the last looks is below a share of its peak. One look alone would take the turning point of an
oscillation for rest. Every step is checked: a result of steps that missed their tolerance is not written unless asked.
Only a preset that itself says how many iterations a step may take is taken at its word, and the residuals are said.
Where a scene does not say, the precision is double here, which tight tolerances need, and conjugate gradients go on
until they reach theirs: there is no real time to keep up with.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import shutil
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src import defaults, mesh_files, meshes
from tensormass._src.errors import InvalidArgumentError, NotConvergedError
from tensormass._src.fields import FIELD_NAMES, NODE_FIELDS, FieldName, Fields, field_numbers
from tensormass._src.files import replacing
from tensormass._src.launching import launch
from tensormass._src.packing import volume_mesh
from tensormass._src.processes import end_explained
from tensormass._src.scene_handle import SceneHandle
from tensormass._src.server import Server, connect
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools import presets
from tensormass_tools.output import Warnings, check_writable, load_line, load_silently, print_json, table

# At rest: so many looks, so many steps apart, all below this share of the largest kinetic energy seen.
_REST_LOOKS = 5
_REST_LOOK_STEPS = 10
_REST_SHARE = 1e-8
# A scene that does not come to rest is given up after so much simulated time.
_REST_LIMIT_S = 60.0
_PROGRESS_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0
# Of conjugate-gradient iterations, where the scene names none.
_CG_LIMIT = 10_000
# The knobs by which a preset ends a step before its tolerance.
_PRESET_LIMITS = ("cg_max_iterations", "newton_max_iterations")
# More steps or seconds than these are a slip.
_MOST = 1e9
_QUASI_STATIC = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
_INTEGRATORS = {
    scene_pb2.Solver.INTEGRATOR_UNSPECIFIED: "implicit Euler",
    scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER: "implicit Euler",
    scene_pb2.Solver.INTEGRATOR_BDF2: "BDF2",
    _QUASI_STATIC: "quasi-static",
}


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """The options of `tensormass solve`."""
    parser.add_argument("scene", help=scene_help)
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FILE.vtu", help="the state after the last step"
    )
    parser.add_argument("--preset", choices=tuple(presets.PROMISES), help="a measured setting of a built-in scene")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, metavar="N", help="make N steps")
    length.add_argument("--seconds", type=float, metavar="T", help="go on until T s of simulated time")
    parser.add_argument(
        "--every",
        type=int,
        metavar="N",
        help="write every Nth step too, as FILE_<step>.vtu, and FILE.pvd with their times",
    )
    parser.add_argument("--fields", metavar="A,B", help=f"what to write, by default all: {', '.join(FIELD_NAMES)}")
    parser.add_argument(
        "--precision", choices=("float", "double"), help="instead of the scene's; double where it does not say"
    )
    parser.add_argument("--allow-unconverged", action="store_true", help="write results of steps that did not converge")
    parser.add_argument("--server", metavar="HOST:PORT", help="a running daemon; without it one is started for this")
    parser.add_argument("--backend", choices=("auto", "cpu", "cuda"), default="auto", help="of the daemon to start")
    parser.add_argument("--cpu-threads", type=int, metavar="N", help="threads of the scene on the CPU")
    parser.description = (
        "Computes a scene in lockstep and writes displacements, forces and stresses. A quasi-static scene makes one "
        "step, or as many as its schedules take; a dynamic one goes on until it is at rest (kinetic energy below "
        f"{_REST_SHARE:g} of its peak at {_REST_LOOKS} looks {_REST_LOOK_STEPS} steps apart), for {_REST_LIMIT_S:g} s "
        "at most. Exit status 1 if a step did not converge, and --out is not written then, only what --every wrote "
        "before; and if a scene is not at rest at that limit, whose last state is written. A --preset that sets "
        f"{' or '.join(_PRESET_LIMITS)} asks for steps that end there: those above their tolerance are written, "
        "warned of and counted, and are no failure."
    )


def run(args: argparse.Namespace) -> int:
    """Computes, prints a summary and writes; 0 if everything converged or was allowed not to."""
    # Mistakes are said before anything starts.
    if args.out.suffix != ".vtu":
        raise InvalidArgumentError(f"--out {args.out}: must end in .vtu")
    check_writable("--out", args.out)
    if args.every is not None:
        check_writable("--every", args.out.with_suffix(".pvd"))
    for option in ("steps", "seconds", "every"):
        value = getattr(args, option)
        if value is not None and not 0 < value <= _MOST:
            raise InvalidArgumentError(f"--{option} {value}: must be positive and at most {_MOST:g}")
    names = list(FIELD_NAMES) if args.fields is None else [name.strip() for name in args.fields.split(",")]
    field_numbers(names)

    scene = presets.read_scene(args.scene, args.preset)
    solver = scene.message.solver
    if args.precision is not None or solver.precision == scene_pb2.Solver.PRECISION_UNSPECIFIED:
        single = args.precision == "float"
        solver.precision = scene_pb2.Solver.PRECISION_FLOAT if single else scene_pb2.Solver.PRECISION_DOUBLE
    if not solver.HasField("cg_max_iterations"):
        solver.cg_max_iterations = _CG_LIMIT
    with _server(args) as server, end_explained(server.process, server.log_file):
        # A daemon of others may have a scene of this name.
        name = f"{scene.name[:40]}-solve-{os.getpid()}" if args.server else None
        progress = load_line(quiet=args.json) or load_silently
        handle = server.load(scene, lockstep=True, name=name, progress=progress)
        try:
            # Grids are cut here only now, when the daemon has found them to be of a size that can be.
            volumes = [volume_mesh(body) for body in scene.message.bodies]
            writer = _Writer(args.out, handle, volumes, names)
            solution = _Solution(args, scene.message, handle, writer)
            summary = solution.compute()
        finally:
            handle.unload()
        version = server.version()
        summary = {"scene": scene.name, "backend": version.backend, "device": version.device, **summary}
    print_json(summary) if args.json else print(_text(summary))
    return 0 if solution.at_rest or args.allow_unconverged else 1


def _server(args: argparse.Namespace) -> Server:
    if args.server:
        return connect(args.server)
    return launch(backend=args.backend, cpu_threads=args.cpu_threads, zenoh=False)


def _preset_limits(args: argparse.Namespace) -> str:
    """The limits of iterations that the preset sets, for people; empty: none."""
    if args.preset is None:
        return ""
    setting = presets.all_presets()[args.scene][args.preset]
    return ", ".join(f"{knob} {setting[knob]}" for knob in _PRESET_LIMITS if knob in setting)


class _Writer:
    """Writes the scene's state: points at rest, all bodies in one file, cell data `body` telling them apart."""

    def __init__(
        self, out: Path, handle: SceneHandle, volumes: list[meshes.VolumeMesh], names: list[FieldName]
    ) -> None:
        self._out = out
        self._handle = handle
        self._names = names
        self.bodies = [body.name for body in handle.topology().bodies]
        self._points = np.concatenate([handle.positions(body) for body in self.bodies])
        self._blocks = []
        first = 0
        for volume in volumes:
            self._blocks += [
                meshes.ElementBlock(shape, elements + np.uint32(first)) for shape, elements in volume.blocks
            ]
            first += len(volume.nodes)
        self._body_of = np.repeat(np.arange(len(volumes), dtype=np.int32), [v.element_count for v in volumes])
        self._series: list[tuple[float, Path]] = []

    def write(self, path: Path | None = None) -> list[Fields]:
        """Writes the present state to `path` (None: the file asked for) and returns what was measured."""
        measured = [self._handle.fields(body, list(dict.fromkeys([*self._names, *_SUMMED]))) for body in self.bodies]
        nodes: dict[str, npt.NDArray[np.generic]] = {}
        cells: dict[str, npt.NDArray[np.generic]] = {"body": self._body_of}
        for name in self._names:
            values = np.concatenate([fields[name] for fields in measured])
            if name == "cauchy_stress":
                values = values[:, [0, 1, 2, 5, 3, 4]]  # VTK's symmetric tensor: xx yy zz xy yz xz
            (nodes if name in NODE_FIELDS else cells)[name] = values
        mesh_files.write_blocks(path or self._out, self._points, self._blocks, nodes, cells)
        return measured

    def write_one_of_series(self, step: int, time_s: float) -> None:
        """Writes the present state as a file of its own, and the list of all of them."""
        path = self._out.with_name(f"{self._out.stem}_{step:06d}.vtu")
        self.write(path)
        self._series.append((time_s, path))
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
        collection = ElementTree.SubElement(root, "Collection")
        for at_s, file in self._series:
            ElementTree.SubElement(collection, "DataSet", timestep=repr(at_s), part="0", file=file.name)
        ElementTree.indent(root)
        listing = self._out.with_suffix(".pvd")
        try:
            with replacing(listing) as aside:
                ElementTree.ElementTree(root).write(aside, encoding="utf-8", xml_declaration=True)
        except OSError as error:
            raise InvalidArgumentError(f"{listing}: cannot be written: {error.strerror}") from error

    @property
    def so_far(self) -> str:
        """What there is before the last step."""
        if not self._series:
            return "Nothing is written"
        states = "1 state" if len(self._series) == 1 else f"{len(self._series)} states"
        return f"{self._out.with_suffix('.pvd')} lists {states} before it, --out is not written"

    @property
    def files(self) -> list[str]:
        """What was asked for; of a series, the list."""
        return [str(self._out), *([str(self._out.with_suffix(".pvd"))] if self._series else [])]


_SUMMED: tuple[FieldName, ...] = ("displacement", "reaction_force")


class _Solution:
    """The steps of one run."""

    def __init__(self, args: argparse.Namespace, scene: scene_pb2.Scene, handle: SceneHandle, writer: _Writer) -> None:
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
        #: False: it had to come to rest and did not.
        self.at_rest = True
        self._unconverged_steps = 0

    def compute(self) -> dict[str, Any]:
        """Makes the steps, writes, and returns the summary.

        Raises:
            NotConvergedError: unless that is allowed.
        """
        began = time.monotonic()
        count = self._step_count()
        newton = cg = 0
        residual = 0.0
        if self._args.every:
            self._writer.write_one_of_series(0, 0.0)
        with _Progress(count, self._dt_s) as progress:
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
        """None: until at rest."""
        if self._args.steps is not None:
            return int(self._args.steps)
        if self._args.seconds is not None:
            return self._steps_until(self._args.seconds)
        if self._solver.integrator == _QUASI_STATIC:
            return self._steps_until(self._scheduled_s)
        return None

    def _steps_until(self, time_s: float) -> int:
        # A thousandth of a step is rounding.
        return max(1, math.ceil(time_s / self._dt_s - 1e-3))

    def _steps(self, count: int | None) -> Iterator[stream_pb2.SceneStatus]:
        if count is not None:
            for _ in range(count):
                yield self._handle.step()
            return
        energies: deque[float] = deque(maxlen=_REST_LOOKS)
        peak = 0.0
        for step in range(1, self._steps_until(max(_REST_LIMIT_S, 2 * self._scheduled_s)) + 1):
            status = self._handle.step()
            yield status
            if step % _REST_LOOK_STEPS == 0:
                energies.append(sum(self._handle.fields(body).kinetic_energy_j for body in self._writer.bodies))
                peak = max(peak, energies[-1])
                self._kinetic_share = max(energies) / peak if peak > 0 else 0.0
                rested = len(energies) == _REST_LOOKS and self._kinetic_share <= _REST_SHARE
                if rested and status.simulated_time_s >= self._scheduled_s:
                    return
        self.at_rest = False

    def _check(self, status: stream_pb2.SceneStatus, count: int | None) -> None:
        where = f"step {status.step}" + (f" of {count}" if count is not None else "")
        if status.fault:
            raise NotConvergedError(f"{where}: {status.fault}")
        solver = self._solver
        if defaults.newton_max_iterations(solver) > 1:
            tolerance = defaults.newton_tolerance(solver)
            before, self._unconverged_steps = self._unconverged_steps, status.unconverged_steps
            if status.unconverged_steps > before:
                single = solver.precision != scene_pb2.Solver.PRECISION_DOUBLE
                self._did_not_converge(
                    f"{where} did not converge: an imbalance of {status.newton_residual:.1e} of the forces after "
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
        """What the user should know of the result."""
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
                    f"body {name!r}: elements are turned inside out, det F down to {fields.min_det_f:.2g}: this is no "
                    "state of a tissue; take a finer mesh, smaller steps, or a law that stands compression"
                )
        # The daemon's own words on convergence are about the last step only.
        return findings + [text for text in self._warnings.latest if "newton_tolerance" not in text]


class _Progress(contextlib.AbstractContextManager["_Progress"]):
    """A line on stderr: rewritten in place on a terminal, now and then in a log."""

    def __init__(self, count: int | None, dt_s: float) -> None:
        self._count = count
        self._dt_s = dt_s
        self._live = sys.stderr.isatty()
        self._period_s = _PROGRESS_PERIOD_S if self._live else _LOG_PERIOD_S
        self._shown = time.monotonic()
        self._width = 0

    def show(self, status: stream_pb2.SceneStatus, kinetic_share: float | None) -> None:
        """If it is time to. `kinetic_share`: of the peak, where a scene has to come to rest."""
        if time.monotonic() - self._shown < self._period_s:
            return
        self._shown = time.monotonic()
        parts = [f"step {status.step}" + (f"/{self._count}" if self._count is not None else "")]
        parts += [f"{status.simulated_time_s:.4g} s", f"CG {status.cg_iterations} to {status.cg_relative_residual:.0e}"]
        if status.newton_iterations > 0:
            parts.append(f"Newton {status.newton_iterations} to {status.newton_residual:.0e}")
        if kinetic_share is not None:
            parts.append(f"kinetic energy {kinetic_share:.0e} of its peak")
        text = "  ".join(parts)
        if self._live:
            text = text[: shutil.get_terminal_size().columns - 1]
            print(f"\r{text:<{self._width}}", end="", file=sys.stderr, flush=True)
            self._width = len(text)
        else:
            print(text, file=sys.stderr, flush=True)

    def __exit__(self, *_: object) -> None:
        if self._width > 0:
            print(f"\r{'':<{self._width}}\r", end="", file=sys.stderr, flush=True)


def _text(summary: dict[str, Any]) -> str:
    """The summary for people."""
    solves = [f"{summary['cg_iterations']} CG iterations, the last to {summary['cg_relative_residual']:.1e}"]
    if summary["newton_iterations"] > 0:
        solves.insert(
            0, f"{summary['newton_iterations']} Newton iterations, imbalance {summary['newton_residual']:.1e} at most"
        )
    steps = "1 step" if summary["steps"] == 1 else f"{summary['steps']} steps"
    head = (
        f"{summary['scene']}: {summary['integrator']}, {summary['precision']}, {steps}, "
        f"{summary['simulated_time_s']:.4g} s simulated in {summary['wall_time_s']:.2g} s "
        f"on {summary['backend']} ({summary['device']})"
    )
    rows = [["body", "displacement", "reaction sum [N]", "elastic", "kinetic", "min det F"]]
    for body in summary["bodies"]:
        rows.append(
            [
                body["name"],
                f"{body['max_displacement_m']:.4g} m",
                _vector(body["reaction_sum_n"]),
                f"{body['elastic_energy_j']:.4g} J",
                f"{body['kinetic_energy_j']:.4g} J",
                f"{body['min_det_f']:.4g}",
            ]
        )
    sections = ["\n".join([head, *solves]), table(rows)]
    if summary["warnings"]:
        sections.append("warnings:\n" + "\n".join(f"  {text}" for text in summary["warnings"]))
    sections.append("written: " + ", ".join(summary["files"]))
    return "\n\n".join(sections)


def _vector(values: Sequence[float]) -> str:
    """Components that are rounding of the largest one are zero."""
    largest = max(map(abs, values))
    return ", ".join(f"{value:.4g}" if abs(value) > 1e-6 * largest else "0" for value in values)
