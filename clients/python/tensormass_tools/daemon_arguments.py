"""The options of commands that use a running daemon, or start one for themselves.

`tensormass` refuses those that contradict each other (cli.py).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tensormass import Server, connect, launch


def add_keys_argument(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Adds --keys."""
    parser.add_argument(
        "--keys", type=Path, metavar="FILE", help="this client's keys (`tensormass keys add`), if the daemon has keys"
    )


def add_daemon_arguments(
    parser: argparse.ArgumentParser,
    *,
    backend_help: str = "backend of the daemon to start",
    threads_help: str | None = "threads of the scene on the CPU",
) -> None:
    """Adds --server, --backend and --cpu-threads. Without `threads_help` the command has no --cpu-threads."""
    parser.add_argument("--server", metavar="HOST:PORT", help="a running daemon; without it one is started for this")
    add_keys_argument(parser)
    parser.add_argument("--backend", choices=("auto", "cpu", "cuda"), default="auto", help=backend_help)
    if threads_help is not None:
        parser.add_argument("--cpu-threads", type=int, metavar="N", help=threads_help)


def daemon_of(args: argparse.Namespace, *, backend: str | None = None, zenoh: bool = False) -> Server:
    """Connects to the daemon at --server, or starts one. `backend` stands for --backend, if given."""
    if args.server:
        return connect(args.server, keys=args.keys)
    threads = getattr(args, "cpu_threads", None)
    return launch(backend=args.backend if backend is None else backend, cpu_threads=threads, zenoh=zenoh)
