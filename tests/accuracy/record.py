"""The head of a results file, and how it is written: one row a line, so that diffs are readable."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tensormass.v1 import control_pb2

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Head:
    """How the rows of one command were made."""

    backend: str
    device: str
    machine: str
    commit: str
    command: str
    date: str
    seconds: int

    @staticmethod
    def of_run(version: control_pb2.GetVersionResponse, module: str, began: float) -> Head:
        """Describes the running command: `python -m module` with its arguments, begun at time.monotonic() `began`."""
        return Head(
            version.backend,
            version.device,
            machine(),
            commit(),
            " ".join([f"python -m {module}", *sys.argv[1:]]),
            time.strftime("%Y-%m-%d"),
            round(time.monotonic() - began),
        )

    def head(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(Head)}


def machine() -> str:
    model = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        names = [line.split(":", 1)[1].strip() for line in cpu_info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} threads"


def commit() -> str:
    """The short commit. A tree without history takes it from TENSORMASS_COMMIT."""
    command = ["git", "-C", str(HERE), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return os.environ.get("TENSORMASS_COMMIT") or done.stdout.strip() or "unknown"


def write(path: Path, head: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the head and its rows as JSON, numbers to nine digits. Empty texts and lists are omitted."""
    path.parent.mkdir(exist_ok=True)
    lines = ",\n".join(f"    {json.dumps(_rounded(row), ensure_ascii=False)}" for row in rows)
    start = json.dumps(head, ensure_ascii=False, indent=2).rstrip("}\n")
    path.write_text(f'{start},\n  "rows": [\n{lines}\n  ]\n}}\n')


def _rounded(row: Mapping[str, Any]) -> dict[str, Any]:
    def short(value: object) -> object:
        if isinstance(value, float):
            return float(f"{value:.9g}")
        return [short(item) for item in value] if isinstance(value, list | tuple) else value

    return {key: short(value) for key, value in row.items() if value not in ("", [])}
