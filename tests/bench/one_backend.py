"""The frame of scripts that measure one backend: their options, a daemon, and a line of JSON for each row."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import tensormass as tm


def print_rows(
    file: str, description: str | None, measure: Callable[[tm.Server, str], Iterable[Mapping[str, Any]]]
) -> None:
    """Prints what `measure` yields, each row with backend, device, commit and command.

    Args:
        file: the script's `__file__`.
        description: of the script, for --help.
        measure: takes a server and the name of its backend.
    """
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    command = f"python tests/bench/{Path(file).name} --backend {args.backend}"
    with tm.launch(backend=args.backend, zenoh=False) as server:
        said = server.version()
        where = {"backend": said.backend, "device": said.device, "commit": args.commit, "command": command}
        for row in measure(server, args.backend):
            print(json.dumps({**row, **where}), flush=True)
