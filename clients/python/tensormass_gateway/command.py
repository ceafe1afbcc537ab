"""`tensormass view`: the gateway as a command."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.options import options_from
from tensormass_gateway.player import Recording


def write_ready_file(path: Path, gateway: Gateway) -> None:
    """Writes the ready file in one step, readable by its owner only, because it holds the tokens."""
    content = {
        "url": gateway.url,
        "host": gateway.options.host,
        "port": gateway.port,
        "token": gateway.options.token,
        "operator_token": gateway.options.operator_token,
        "pid": os.getpid(),
    }
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=path.name, delete=False) as file:
        json.dump(content, file)
    os.replace(file.name, path)


def run(args: argparse.Namespace, recording: Recording | None = None) -> int:
    """Serves until SIGINT or SIGTERM.

    Args:
        args: of `add_arguments`; they hold `server`, the control address.
        recording: served in place of the daemon at `server`.
    """
    try:
        asyncio.run(_run(args, recording))
    except (OSError, ValueError) as error:
        print(f"tensormass: gateway: {error}", file=sys.stderr)
        return 1
    return 0


def tell_next_addresses(gateway: Gateway, say: Callable[[str], None]) -> None:
    """Says the next addresses whenever one was opened, because each opens one browser.

    Only a terminal is told. Elsewhere the output is a log, whose readers would always have a code that counts.
    """
    if sys.stdout.isatty():
        gateway.on_code_used(lambda: say(f"another browser: {gateway.once_url}\nto look only: {gateway.look_once_url}"))


def print_line(text: str) -> None:
    print(text, flush=True)


async def _run(args: argparse.Namespace, recording: Recording | None) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    source = {"server": args.server} if recording is None else {"recording": recording.name}
    async with serve(options_from(args, args.server or ""), recording=recording) as gateway:
        if args.gateway_ready_file is not None:
            write_ready_file(args.gateway_ready_file, gateway)
        if getattr(args, "json", False):
            addresses = {"url": gateway.once_url, "look_url": gateway.look_once_url}
            print(json.dumps({**addresses, **source}), flush=True)
        else:
            what = f"daemon: {args.server}" if recording is None else f"recording: {recording.name}"
            print_line(f"viewer: {gateway.once_url}\nto look only: {gateway.look_once_url}\n{what}")
            tell_next_addresses(gateway, print_line)
        await stopped.wait()
