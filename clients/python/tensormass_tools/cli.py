"""The command `tensormass`.

Exit status: 0 done, 1 refused or failed (the message says why), 2 wrong usage, 130 after Ctrl-C and 143 after SIGTERM.
`run`, `view` and `record` end with 0 after both signals, because that is how they are ended.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from types import FrameType
from typing import Any

from tensormass import (
    DEFAULT_ADDRESS,
    FindingWarning,
    InvalidArgumentError,
    MeshFileWarning,
    Scene,
    TensormassError,
    builtin_scenes,
    connect,
)
from tensormass._shared.extras import require
from tensormass._shared.findings import FIRST_OF_RESULTS
from tensormass._shared.plain import to_plain
from tensormass._shared.processes import end_explained
from tensormass_gateway.options import add_arguments as add_gateway_arguments
from tensormass_tools import desktop, export, hand, load_test, mesh_command, modes, organ_command, recording, run, solve
from tensormass_tools.daemon_arguments import add_daemon_arguments, add_keys_argument, daemon_of
from tensormass_tools.keys import command as keys
from tensormass_tools.load_arguments import add_arguments as add_load_test_arguments
from tensormass_tools.output import (
    Warnings,
    load_line,
    print_json,
    report_text,
    state_name,
    status_line,
)
from tensormass_tools.parser import Parser
from tensormass_tools.running import find_server
from tensormass_tools.trade.arguments import add_arguments as add_trade_arguments

_LENGTH = re.compile(r"([0-9.eE+-]+?)\s*(m|dm|cm|mm|um)?")
_METRES = {None: 1.0, "m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
_SCENE_HELP = f"a scene file (.yaml), a mesh file, or a built-in scene ({', '.join(builtin_scenes())})"
# The daemon's own limit (server/core/limits.h).
_MAX_CPU_THREADS = 256


class _Terminated(KeyboardInterrupt):
    """SIGTERM was received. It is cleaned up after like Ctrl-C."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    if sys.stdout is None:  # `>&-`
        print("tensormass: standard output is closed", file=sys.stderr)
        return 1
    try:
        try:
            return _run_command(argv)
        finally:
            sys.stdout.flush()  # reports an error here, and not when the interpreter ends
    except BrokenPipeError:  # `tensormass list | head`
        _output_is_lost()
        return 1
    except OSError as error:
        where = error.filename or ("standard output" if _output_is_lost() else None)
        print(f"tensormass: {where}: {error.strerror}" if where else f"tensormass: {error}", file=sys.stderr)
        return 1


def _run_command(argv: Sequence[str] | None) -> int:
    parser = _parser()
    args = parser.parse_args(argv)
    _check_usage(parser, args)
    handler = signal.signal(signal.SIGTERM, _terminate)
    try:
        with _warnings_are_printed():
            return int(args.command(args))
    except TensormassError as error:
        if getattr(args, "json", None) in (True, "-"):  # load-test names a file
            print_json({"error": str(error), "kind": type(error).__name__})
        else:
            print(f"tensormass: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        return 143 if isinstance(interrupt, _Terminated) else 130
    finally:
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def _warnings_are_printed() -> Iterator[None]:
    """Prints what a mesh file has and a scene does not, and the findings of a scene, as lines like other messages.
    Commands print the findings about results themselves."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any) -> None:  # noqa: ANN401
            if isinstance(message, FindingWarning):
                if message.finding.code < FIRST_OF_RESULTS:
                    print(f"tensormass: warning: {message}", file=sys.stderr)
            elif issubclass(category, MeshFileWarning):
                print(f"tensormass: {message}", file=sys.stderr)
            else:
                others(message, category, *place)

        warnings.showwarning = show  # type: ignore[assignment]
        yield


@contextlib.contextmanager
def _report_has_findings() -> Iterator[None]:
    """Prints no findings, for commands that print a report with them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FindingWarning)
        yield


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second SIGTERM must not interrupt the cleaning up
    raise _Terminated


def _check_usage(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuses options that contradict each other, for every command that has them."""
    threads = getattr(args, "cpu_threads", None)
    if threads is not None and not 1 <= threads <= _MAX_CPU_THREADS:
        parser.error(f"argument --cpu-threads: {threads} is not in 1 to {_MAX_CPU_THREADS}")
    if getattr(args, "server", None) and (threads is not None or getattr(args, "backend", "auto") != "auto"):
        parser.error("--backend and --cpu-threads are for a daemon to start; the one at --server has its own")


def _output_is_lost() -> bool:
    """Tells whether standard output is broken. If so, redirects it, so that the interpreter's last flush is silent."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def parse_length_m(text: str) -> float:
    """Parses a length: `8mm`, `0.8cm`, `0.008` (metres) -> metres."""
    match = _LENGTH.fullmatch(text.strip())
    try:
        length_m = float(match[1]) * _METRES[match[2]] if match else 0.0
    except ValueError:
        length_m = 0.0
    if not 0 < length_m < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive length such as 8mm, 0.8cm or 0.008m")
    return length_m


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="tensormass", description="Soft-tissue simulation for surgical trainers.")
    parser.add_argument("--version", action="version", version=f"tensormass {_version()}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    json_option = Parser(add_help=False)
    json_option.add_argument("--json", action="store_true", help="print JSON")
    server = Parser(add_help=False)
    server.add_argument(
        "--server",
        metavar="HOST:PORT",
        help=f"default: the daemon that runs here, as `tensormass run` starts it or at {DEFAULT_ADDRESS}",
    )
    add_keys_argument(server)

    sub = commands.add_parser("run", help="daemon, scene, simulated haptic device and viewer in one")
    run.add_arguments(sub)
    sub.set_defaults(command=run.run)

    sub = commands.add_parser(
        "solve", parents=[json_option], help="compute a scene in lockstep and write the result as VTU"
    )
    solve.add_arguments(sub, _SCENE_HELP)
    sub.set_defaults(command=solve.run)

    sub = commands.add_parser(
        "modes", parents=[json_option], help="natural frequencies and mode shapes of the bodies of a scene"
    )
    modes.add_arguments(sub, _SCENE_HELP)
    sub.set_defaults(command=modes.run)

    sub = commands.add_parser(
        "trade", parents=[json_option], help="measure what each choice of a scene costs in time and buys in accuracy"
    )
    add_trade_arguments(sub, _SCENE_HELP)
    sub.set_defaults(command=_trade)

    sub = commands.add_parser(
        "record", parents=[json_option], help="record the inputs of a scene and checks of its state to an MCAP file"
    )
    recording.add_record_arguments(sub, _SCENE_HELP)
    sub.set_defaults(command=recording.run_record)

    sub = commands.add_parser(
        "replay", parents=[json_option], help="make the steps of a recording again and compare the state"
    )
    recording.add_replay_arguments(sub)
    sub.set_defaults(command=recording.run_replay)

    sub = commands.add_parser(
        "plot", parents=[json_option], help="draw forces, step time and rate of a recording over time"
    )
    recording.add_plot_arguments(sub)
    sub.set_defaults(command=recording.run_plot)

    sub = commands.add_parser("load", parents=[server, json_option], help="load a scene into a running daemon")
    sub.add_argument("scene", help=_SCENE_HELP)
    sub.add_argument("--name", help="name that replaces the scene's own")
    sub.add_argument("--lockstep", action="store_true", default=None, help="step only when asked")
    sub.set_defaults(command=_load)

    sub = commands.add_parser("unload", parents=[server, json_option], help="end a scene")
    sub.add_argument("name", help="name of the loaded scene")
    sub.set_defaults(command=_unload)

    sub = commands.add_parser("list", parents=[server, json_option], help="loaded scenes")
    sub.set_defaults(command=_list)

    sub = commands.add_parser("status", parents=[server, json_option], help="daemon and scenes, in full")
    sub.add_argument("name", nargs="?", help="name of one scene; default: all")
    sub.set_defaults(command=_status)

    sub = commands.add_parser(
        "report", parents=[server, json_option], help="status and state of a scene in one file, for a report"
    )
    sub.add_argument("name", help="name of the loaded scene")
    sub.add_argument("-o", "--output", type=Path, required=True, help=".npz")
    sub.set_defaults(command=_report)

    sub = commands.add_parser("inspect", parents=[json_option], help="check a scene and print its plan and cost")
    sub.add_argument("scene", help=_SCENE_HELP)
    add_daemon_arguments(sub, threads_help=None)
    sub.set_defaults(command=_inspect)

    sub = commands.add_parser(
        "export", parents=[json_option], help="write a scene with its meshes as one message, for other clients"
    )
    export.add_arguments(sub, _SCENE_HELP)
    sub.set_defaults(command=export.run)

    sub = commands.add_parser(
        "mesh",
        parents=[json_option],
        help="make a volume from a closed surface, or repair and convert one",
        description="With --edge, fills a closed surface with tetrahedra (fTetWild). Without, repairs a volume: "
        "inverted elements are rewound, flat and repeated ones and crumbs dropped, and each is named. Writes metres.",
    )
    mesh_command.add_arguments(sub, parse_length_m)
    sub.set_defaults(command=mesh_command.run)

    sub = commands.add_parser(
        "organ",
        parents=[json_option],
        help="make a scene of a segmentation: tetrahedra, modulus and supports",
        description="Makes a scene of the segments of a label map (3D Slicer, NIfTI, NRRD), or of a closed surface: "
        "tetrahedra with the volume of the voxels, a modulus with its source, and supports where other segments touch. "
        "Without --segment, lists the segments. Positions are LPS in metres.",
    )
    organ_command.add_arguments(sub, parse_length_m)
    sub.set_defaults(command=organ_command.run)

    sub = commands.add_parser(
        "view",
        parents=[server, json_option],
        help="viewer for a running daemon, in a browser or a window, or for a recording",
        description="Serves a page that shows the scenes of a running daemon, or plays a recording of `tensormass "
        "record --frames`, which needs no daemon.",
    )
    desktop.add_arguments(sub)
    add_gateway_arguments(sub)
    sub.set_defaults(command=_view)

    sub = commands.add_parser(
        "hand", parents=[server], help="move a tool of a running scene through the poses of a file"
    )
    hand.add_arguments(sub)
    sub.set_defaults(command=hand.run)

    sub = commands.add_parser("keys", help="keys for daemons that other machines reach, and for their clients")
    keys.add_arguments(sub, json_option)
    sub.set_defaults(command=keys.run)

    sub = commands.add_parser("load-test", help="drive a daemon with real clients and measure")
    add_load_test_arguments(sub)
    sub.set_defaults(command=load_test.run)
    return parser


def _version() -> str:
    try:
        return metadata.version("tensormass")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def _load(args: argparse.Namespace) -> int:
    with connect(find_server(args.server), keys=args.keys) as server:
        progress = load_line(quiet=args.json)
        scene = Scene.from_file(args.scene)
        with _report_has_findings():
            report = server.load(scene, name=args.name, lockstep=args.lockstep, progress=progress).report
        assert report is not None
        if args.json:
            print_json({"server": server.address, **to_plain(report)})
        else:
            print(f"server {server.address}\n{report_text(report, scene.message)}")
    return 0


def _unload(args: argparse.Namespace) -> int:
    with connect(find_server(args.server), keys=args.keys) as server:
        server.scene(args.name).unload()
        if args.json:
            print_json({"server": server.address, "unloaded": args.name})
        else:
            print(f"unloaded {args.name} from {server.address}")
    return 0


def _list(args: argparse.Namespace) -> int:
    with connect(find_server(args.server), keys=args.keys) as server:
        scenes = server.scenes()
    if args.json:
        each = [{"scene": status.scene, "state": state_name(status), "step": status.step} for status in scenes]
        print_json([{"server": server.address, **of} for of in each])
    else:
        print(f"server {server.address}")
        for status in scenes:
            print(f"{status.scene}  {state_name(status)}  step {status.step}")
        if not scenes:
            print("no scene is loaded")
    return 0


def _status(args: argparse.Namespace) -> int:
    with connect(find_server(args.server), keys=args.keys) as server:
        version = server.version()
        statuses = [server.scene(args.name).status()] if args.name else server.scenes()
    if args.json:
        scenes = [to_plain(status) for status in statuses]
        print_json({"address": server.address, "server": to_plain(version), "scenes": scenes})
        return 0
    backend = f"{version.backend} ({version.device}; {version.backend_reason})"
    daemon = f"tensormassd {version.version}, {backend}, server {version.server!r}"
    print(f"{daemon}, control {server.address}")
    print(f"zeromq {version.zeromq_publish_endpoint} {version.zeromq_pose_endpoint} | zenoh {version.zenoh_locator}")
    print(f"malformed messages: {version.malformed_messages}")
    for status in statuses:
        print(f"{status.scene}: {status_line(status)}")
        if status.guard_text not in ("", status.fault):
            print(f"guard: {status.guard_text}")
        for line in Warnings().lines(status):
            print(line)
    return 0


def _report(args: argparse.Namespace) -> int:
    with connect(find_server(args.server), keys=args.keys) as server:
        path = server.scene(args.name).write_report(args.output)
        if args.json:
            print_json({"server": server.address, "output": str(path)})
        else:
            print(f"wrote {path} from {server.address}")
    return 0


def _inspect(args: argparse.Namespace) -> int:
    scene = Scene.from_file(args.scene)
    with daemon_of(args) as server, end_explained(server.process, server.log_file), _report_has_findings():
        report = server.inspect(scene)
    print_json(to_plain(report)) if args.json else print(report_text(report, scene.message))
    return 0


def _trade(args: argparse.Namespace) -> int:
    from tensormass_tools.trade import command  # its modules are for this command alone

    return command.run(args)


def _view(args: argparse.Namespace) -> int:
    if args.scene is not None and args.scene.endswith(recording.SUFFIX):
        return _view_recording(args)
    if args.desktop:
        return desktop.run(args)
    if args.scene is not None:
        raise InvalidArgumentError(
            f"{args.scene}: not a recording ({recording.SUFFIX}); the page shows every loaded scene, so name none, or "
            "add --desktop"
        )
    if args.screenshot is not None:
        raise InvalidArgumentError(f"--screenshot {args.screenshot}: needs --desktop")
    require("viewer", "view")
    from tensormass_gateway import command

    run.check_gateway_options(args)
    args.server = find_server(args.server)
    return command.run(args)


def _view_recording(args: argparse.Namespace) -> int:
    contradicting = {
        "--desktop": args.desktop,
        "--screenshot": args.screenshot,
        "--server": args.server,
        "--allow-poses": args.allow_poses,
    }
    for option, given in contradicting.items():
        if given:
            raise InvalidArgumentError(f"{option}: is for running scenes; {args.scene} is played in a browser as it is")
    require("viewer", "view")
    require("record", "a recording")
    from tensormass_gateway import command
    from tensormass_tools.recording.index import RecordingIndex

    run.check_gateway_options(args)
    return command.run(args, RecordingIndex(Path(args.scene)))
