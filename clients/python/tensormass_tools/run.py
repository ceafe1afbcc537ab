"""`tensormass run`: starts a daemon, a scene, a simulated haptic device for each tool, and the viewer's gateway.

A built-in scene may have a scripted hand (hand.py), which then moves its tool instead of a device.

All parts run until Ctrl-C, SIGTERM or the end of --seconds. They end in the order of their dependencies.

A built-in scene is fitted to the machine first (fitting.py), before a hand or a viewer comes: a coarser mesh takes its
place if its steps leave too little of their period.

A guard may stop the scene. A run with --seconds then ends at once, because nobody watches it. Without --seconds the run
continues: users can inspect the stopped scene and reset it over the control address. A run that ends with its scene
stopped has failed. It writes the report of `SceneHandle.write_report` to NAME-fault.npz, because the daemon, which has
the state, ends with the run.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tensormass import (
    FailedPreconditionError,
    InvalidArgumentError,
    Scene,
    SceneHandle,
    Server,
    TensormassError,
    UnavailableError,
    launch,
)
from tensormass._shared.extras import require
from tensormass._shared.plain import to_plain
from tensormass._shared.processes import ChildProcess, end_explained, find_program, log_tail
from tensormass.v1 import scene_pb2
from tensormass_gateway.options import add_arguments as add_gateway_arguments
from tensormass_gateway.options import options_from
from tensormass_tools import fitting, hand, presets, priority
from tensormass_tools.daemon_arguments import add_keys_argument
from tensormass_tools.fit_scene import Fitted, fit_scene
from tensormass_tools.output import Warnings, check_writable, load_line, print_json, report_text, status_line
from tensormass_tools.running import announced

if TYPE_CHECKING:
    from tensormass_gateway.gateway import Gateway  # needs the extra `viewer`

_STATUS_PERIOD_S = 0.5
# Period of status lines that are not rewritten in place, as in a log.
_LOG_PERIOD_S = 5.0
_MAX_PORT = 65_535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `tensormass run`."""
    parser.add_argument("scene", nargs="?", default="demo", help="a scene file or a built-in scene (default: demo)")
    parser.add_argument("--backend", choices=("auto", "cpu", "cuda"), default="auto", help="default: %(default)s")
    parser.add_argument("--cpu-threads", type=int, metavar="N", help="threads of the scene on the CPU")
    parser.add_argument(
        "--haptic-transport", choices=("zeromq", "zenoh"), default="zeromq", help="default: %(default)s"
    )
    parser.add_argument("--preset", choices=tuple(presets.PROMISES), help="a measured setting of a built-in scene")
    parser.add_argument("--rate", type=float, metavar="HZ", help="steps a second, each of 1/HZ s; default: the scene's")
    parser.add_argument(
        "--no-fit",
        action="store_true",
        help="keep mesh, threads and priorities of a built-in scene also where its steps are late",
    )
    parser.add_argument("--no-haptic", action="store_true", help="without simulated haptic devices")
    parser.add_argument("--no-viewer", action="store_true", help="without the viewer's gateway")
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="T",
        help="end by itself after stepping so long, or when a guard stops the scene; its report is NAME-fault.npz then",
    )
    parser.add_argument("--verbose", action="store_true", help="print the scene's plan")
    add_keys_argument(parser)
    add_gateway_arguments(parser)
    parser.add_argument(
        "--json", action="store_true", help="one JSON object a line: where control and viewer are, then statuses"
    )


def run(args: argparse.Namespace) -> int:
    """Runs until told to end. Returns 0 if every part ran and ended without an error."""
    # Reports mistakes before anything starts.
    if args.seconds is not None and not 0 < args.seconds < math.inf:
        raise InvalidArgumentError(f"--seconds {args.seconds:g}: must be positive and finite")
    if not args.no_viewer:
        require("viewer", "run without --no-viewer")
        check_gateway_options(args)
    scene = presets.read_scene(args.scene, args.preset)
    if args.rate is not None:
        if not args.rate > 0:
            raise InvalidArgumentError(f"--rate {args.rate:g}: must be positive")
        scene.message.stepping.rate_hz = args.rate
        scene.message.stepping.dt_s = 1 / args.rate
    streams = scene.message.streams
    if streams.HasField("frame_rate_hz") and streams.frame_rate_hz == 0 and not (args.no_viewer and args.no_haptic):
        without = "it runs without viewer and simulated haptic devices, which need them"
        _say(args, f"scene {scene.name!r} has no frames (streams.frame_rate_hz is 0): {without}")
        args.no_viewer = args.no_haptic = True
    return asyncio.run(_run(args, scene))


def check_gateway_options(args: argparse.Namespace) -> None:
    """Refuses values with which no viewer's gateway could start."""
    if not 0 <= args.port <= _MAX_PORT:
        raise InvalidArgumentError(f"--port {args.port}: must be 0 (a free one) to {_MAX_PORT}")
    if args.max_browsers < 1:
        raise InvalidArgumentError(f"--max-browsers {args.max_browsers}: at least one browser must be let in")
    if args.gateway_ready_file is not None:
        check_writable("--gateway-ready-file", args.gateway_ready_file)


async def _run(args: argparse.Namespace, scene: Scene) -> int:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with contextlib.AsyncExitStack() as parts:
        server = await asyncio.to_thread(launch, backend=args.backend, cpu_threads=args.cpu_threads)
        parts.callback(server.close)
        parts.enter_context(end_explained(server.process, server.log_file))
        version = server.version()
        fitted = Fitted(scene)
        if args.preset is None and args.rate is None:
            of_backend = await asyncio.to_thread(presets.read_for_backend, args.scene, version.backend)
            fitted = Fitted(scene if of_backend is None else of_backend)
            if not args.no_fit:
                fitted = await asyncio.to_thread(
                    fit_scene, server, version.backend, args.scene, fitted, args.cpu_threads
                )
        scene = fitted.scene
        if fitted.sentence:
            _say(args, fitted.sentence)
        handle = await asyncio.to_thread(server.load, scene, lockstep=False, progress=load_line(quiet=args.json))
        parts.enter_context(announced(server.address, handle.name))
        if args.seconds is not None:
            asyncio.get_running_loop().call_later(args.seconds, stop.set)
        backend = f"{version.backend} ({version.device}; {version.backend_reason})"
        _say(args, f"tensormassd {version.version} on {backend}, control {server.address}")
        if args.verbose and handle.report is not None:
            _say(args, report_text(handle.report, scene.message))
        viewer = (
            None
            if args.no_viewer
            else await parts.enter_async_context(_viewer(args, server, {handle.name: scene.message}))
        )
        if args.json:
            with_viewer = {"viewer": viewer.once_url} if viewer is not None else {}
            print_json(
                {"control": server.address, **with_viewer, **({"fit": fitted.sentence} if fitted.sentence else {})}
            )
        hands = [] if args.no_haptic else _start_hands(args, server, handle, parts)
        # The scene's own threads are new since the daemon got its priority.
        if fitted.realtime and server.process is not None and priority.raise_threads(server.process.process.pid):
            _say(args, "the daemon has real-time priority, because the viewer shares its cores")
        await _report_until(stop, args, server, handle, viewer, hands, advise=not (fitted.sentence or args.no_fit))
        _say(args, "ending")
    _say(args, "ended: haptic devices, viewer, daemon")
    return 0


@contextlib.asynccontextmanager
async def _viewer(
    args: argparse.Namespace, server: Server, known: dict[str, scene_pb2.Scene]
) -> AsyncIterator[Gateway]:
    from tensormass_gateway.command import tell_next_addresses, write_ready_file
    from tensormass_gateway.gateway import serve

    async with contextlib.AsyncExitStack() as parts:
        try:
            running = await parts.enter_async_context(
                serve(options_from(args, server.address, daemon_has_keys=False), known)
            )
        except FileNotFoundError as error:
            raise UnavailableError(f"{error}; or run with --no-viewer") from error
        except (OSError, ValueError) as error:  # ValueError: an impossible host name, or no certificate for it
            reason = getattr(error, "strerror", None) or error
            where = f"--host {args.host} --port {args.port}"
            raise UnavailableError(f"{where}: no viewer can be served: {reason}") from error
        if args.gateway_ready_file is not None:
            write_ready_file(args.gateway_ready_file, running)
        _say(args, f"\n  viewer: {running.once_url}\n  to look only: {running.look_once_url}\n")
        if not args.json:
            tell_next_addresses(running, partial(_say, args))
        yield running


def _start_hands(
    args: argparse.Namespace, server: Server, handle: SceneHandle, parts: contextlib.AsyncExitStack
) -> list[tuple[ChildProcess, Path]]:
    device = find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
    scripts = hand.scripts_of(args.scene)
    folder = Path(parts.enter_context(tempfile.TemporaryDirectory(prefix="tensormass-run-")))
    hands = []
    for tool in handle.topology().tools:
        if tool.tool.fixed:
            continue
        log_file = folder / f"{tool.name}.log"
        where = ["--server", server.address, "--scene", handle.name]
        command: list[str | Path] = [device, *where, "--tool", tool.name, "--transport", args.haptic_transport]
        if script := scripts.get(tool.name):
            command = [sys.executable, "-m", "tensormass", "hand", script, *where, "--transport", args.haptic_transport]
        with log_file.open("wb") as log:
            process = ChildProcess(command, output=log)
        parts.callback(process.stop)
        hands.append((process, log_file))
    return hands


async def _report_until(
    stop: asyncio.Event,
    args: argparse.Namespace,
    server: Server,
    handle: SceneHandle,
    viewer: Gateway | None,
    hands: list[tuple[ChildProcess, Path]],
    *,
    advise: bool,
) -> None:
    """Prints the live status, and once what a late scene needs. Returns when told to end; raises if a part ended by
    itself."""
    live = sys.stdout.isatty() and not args.json
    period_s = _STATUS_PERIOD_S if live or args.json else _LOG_PERIOD_S
    warnings = Warnings()
    fault = ""
    while True:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), period_s)
        for process, log_file in hands:
            if not process.running:
                raise UnavailableError(f"a haptic device ended by itself:\n{log_tail(log_file)}")
        status = await asyncio.to_thread(handle.status)
        clients = len(hands) + (viewer.browser_count if viewer is not None else 0)
        width = shutil.get_terminal_size().columns - 1
        lines = warnings.lines(status)
        if advise and (needed := fitting.advice(status)):
            advise = False
            lines.append(needed)
        for line in lines:
            # On a terminal, the warning replaces the status line.
            _say(args, f"\r{line:<{width}}" if live else line)
        if args.json:
            print_json({"status": to_plain(status), "clients": clients})
        elif live:
            print(f"\r{status_line(status, clients)[:width]:<{width}}", end="", flush=True)
        else:
            print(status_line(status, clients), flush=True)
        ends = stop.is_set() or (args.seconds is not None and status.fault != "")
        if ends and live:
            print()
        if ends and status.fault:
            kept = await asyncio.to_thread(_keep_report, handle)
            raise FailedPreconditionError(f"scene {handle.name!r} is stopped: {status.fault}\n{kept}")
        if ends:
            return
        if status.fault and status.fault != fault:
            still = f"scene {handle.name!r} stands still until it is reset (control {server.address})"
            _say(args, f"\n{still}: {status.fault}" if live else still)
        fault = status.fault


def _keep_report(handle: SceneHandle) -> str:
    """Writes the report of a stopped scene into the current folder. Returns its path in words, or why it is missing."""
    try:
        path = handle.write_report(Path.cwd() / f"{handle.name}-fault.npz")
    except TensormassError as error:  # the fault itself is more important
        return f"no report of it: {error}"
    return f"its status and state: {path}"


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.json:
        print(text, flush=True)
