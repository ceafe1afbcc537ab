"""`tensormass view`: the gateway as a command."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
from pathlib import Path

from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.options import options_from


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


def run(args: argparse.Namespace) -> int:
    """Serves until SIGINT or SIGTERM. `args` come from `add_arguments` and hold `server`, the control address."""
    try:
        asyncio.run(_run(args))
    except (OSError, ValueError) as error:
        print(f"tensormass: gateway: {error}", file=sys.stderr)
        return 1
    return 0


async def _run(args: argparse.Namespace) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with serve(options_from(args, args.server)) as gateway:
        if args.gateway_ready_file is not None:
            write_ready_file(args.gateway_ready_file, gateway)
        if getattr(args, "json", False):
            print(json.dumps({"url": gateway.url, "look_url": gateway.look_url, "server": args.server}), flush=True)
        else:
            print(f"viewer: {gateway.url}\nto look only: {gateway.look_url}\ndaemon: {args.server}", flush=True)
        await stopped.wait()
