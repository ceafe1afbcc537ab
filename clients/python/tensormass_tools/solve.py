"""`tensormass solve`: computes a scene step by step in lockstep and writes its fields as VTU.

A quasi-static scene makes one step, or as many as its schedules take. A dynamic scene continues until it is at rest:
its kinetic energy is below a share of its peak at several checks in a row. A single check could mistake the turning
point of an oscillation for rest.

Every step is checked. If one missed its tolerance, the result is not written unless asked for. A preset that limits
the iterations of a step is the exception: its result is written with a warning that names the residuals.

Settings that the scene leaves open are chosen for analysis, because there is no real time to keep up with: double
precision, which tight tolerances need, and conjugate gradients that continue to their tolerance.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from tensormass import FIELD_NAMES, Fields, InvalidArgumentError, body_mesh
from tensormass._shared.processes import end_explained
from tensormass.v1 import scene_pb2
from tensormass_tools import presets
from tensormass_tools.daemon_arguments import add_daemon_arguments, daemon_of
from tensormass_tools.output import check_writable, load_line, load_silently, print_json
from tensormass_tools.solve_files import Writer
from tensormass_tools.solve_steps import (
    PRESET_LIMITS,
    REST_CHECK_STEPS,
    REST_CHECKS,
    REST_LIMIT_S,
    REST_SHARE,
    Solution,
)
from tensormass_tools.solve_text import text

# Limit of conjugate-gradient iterations if the scene sets none.
_CG_LIMIT = 10_000
# Larger numbers of steps or seconds are mistakes.
_MOST = 1e9


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """Adds the options of `tensormass solve`."""
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
        "--precision",
        choices=("float", "double"),
        help="replaces the scene's choice; default: double if the scene has none",
    )
    parser.add_argument("--allow-unconverged", action="store_true", help="write results of steps that did not converge")
    add_daemon_arguments(parser)
    parser.description = (
        "Computes a scene in lockstep and writes displacements, forces and stresses. A quasi-static scene makes one "
        "step, or as many as its schedules take; a dynamic one goes on until it is at rest (kinetic energy below "
        f"{REST_SHARE:g} of its peak at {REST_CHECKS} checks {REST_CHECK_STEPS} steps apart), for {REST_LIMIT_S:g} s "
        "at most. Exit status 1 if a step did not converge, and --out is not written then, only what --every wrote "
        "before; and if a scene is not at rest at that limit, whose last state is written. A --preset that sets "
        f"{' or '.join(PRESET_LIMITS)} asks for steps that end there: those above their tolerance are written, "
        "warned of and counted, and are not a failure."
    )


def run(args: argparse.Namespace) -> int:
    """Computes, writes and prints a summary. Returns 0 if every step converged, or was allowed not to."""
    # Reports mistakes before anything starts.
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
    Fields.check_names(names)

    scene = presets.read_scene(args.scene, args.preset)
    solver = scene.message.solver
    if args.precision is not None or solver.precision == scene_pb2.Solver.PRECISION_UNSPECIFIED:
        single = args.precision == "float"
        solver.precision = scene_pb2.Solver.PRECISION_FLOAT if single else scene_pb2.Solver.PRECISION_DOUBLE
    if solver.integrator == scene_pb2.Solver.INTEGRATOR_QUASI_STATIC and (args.allow_unconverged or args.preset):
        solver.allow_unconverged = True  # the daemon would stop at such a step; Solution judges it
    if not solver.HasField("cg_max_iterations"):
        solver.cg_max_iterations = _CG_LIMIT
    with daemon_of(args) as server, end_explained(server.process, server.log_file):
        # A shared daemon may have a scene of this name.
        name = f"{scene.name[:40]}-solve-{os.getpid()}" if args.server else None
        progress = load_line(quiet=args.json) or load_silently
        handle = server.load(scene, lockstep=True, name=name, progress=progress)
        try:
            # Cuts grids only after the daemon has checked their size.
            volumes = [body_mesh(body) for body in scene.message.bodies]
            writer = Writer(args.out, handle, volumes, names)
            solution = Solution(args, scene.message, handle, writer)
            summary = solution.compute()
        finally:
            handle.unload()
        version = server.version()
        summary = {"scene": scene.name, "backend": version.backend, "device": version.device, **summary}
    print_json(summary) if args.json else print(text(summary))
    return 0 if solution.at_rest or args.allow_unconverged else 1
