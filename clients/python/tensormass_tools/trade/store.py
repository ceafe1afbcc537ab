"""Measurements on disk, one JSON object a line, so that a stopped run can continue.

The key of a measurement covers all that it depends on: the scene as sent (meshes included), the script, the reference,
and the machine with the daemon's build. No result of another machine is used, and a changed scene or daemon is measured
again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tensormass import InvalidArgumentError, Server
from tensormass._shared.files import replacing
from tensormass._shared.processes import find_program
from tensormass.v1 import scene_pb2
from tensormass_tools.trade.measures import Errors
from tensormass_tools.trade.recording import Costs, Recording
from tensormass_tools.trade.scene_edits import Value
from tensormass_tools.trade.script import Script


@dataclass(frozen=True)
class Machine:
    """Everything that times depend on, apart from the scene."""

    backend: str
    device: str
    #: Threads of each scene; None leaves it to the daemon.
    cpu_threads: int | None
    #: Version of the daemon and the start of its program's SHA-256.
    version: str
    build: str
    #: Tells machines with the same device apart; empty in older results, which belong to no known machine.
    host: str = ""

    @staticmethod
    def of(server: Server, cpu_threads: int | None) -> Machine:
        said = server.version()
        build = hashlib.sha256(find_program("tensormassd", "TENSORMASSD").read_bytes()).hexdigest()[:12]
        return Machine(said.backend, said.device, cpu_threads, said.version, build, _host())


def _host(id_file: Path = Path("/etc/machine-id")) -> str:
    """Returns the start of a hash of the machine's id, or of its network name. It identifies nobody."""
    try:
        name = id_file.read_text("utf-8").strip()
    except (OSError, ValueError):
        name = ""
    return hashlib.sha256(f"tensormass trade {name or platform.node()}".encode()).hexdigest()[:8]


@dataclass(frozen=True)
class Measurement:
    """Measurement of one setting. If errors and costs are missing, `failure` says why."""

    key: str
    setting: dict[str, Value]
    machine: Machine
    element_count: int = 0
    errors: Errors | None = None
    costs: Costs | None = None
    #: Change of displacement against the unmodified scene, caused by the choice alone.
    moved: float = 0.0
    #: Median time to compute as much as the scene's own step simulates [s], so that settings of any dt compare.
    cost_s: float = 0.0
    #: Median and 99th percentile of the unmodified scene, timed in turns with this setting [s]; 0 if it was not.
    own_p50_s: float = 0.0
    own_p99_s: float = 0.0
    failure: str = ""
    #: Number of steps that ended above the setting's newton_tolerance.
    unconverged_steps: int = 0
    min_det_f: float = 1.0
    outside_share: float = 0.0
    warnings: list[str] = field(default_factory=list)

    @property
    def slow_s(self) -> float:
        """Returns the 99th percentile, scaled like `cost_s`."""
        assert self.costs is not None
        return self.cost_s * self.costs.step_p99_s / self.costs.step_p50_s

    def to_plain(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_plain(line: dict[str, Any]) -> Measurement:
        return Measurement(
            **{
                **line,
                "machine": Machine(**line["machine"]),
                "errors": Errors(**line["errors"]) if line["errors"] else None,
                "costs": Costs(**line["costs"]) if line["costs"] else None,
            }
        )


def key_of(scene: scene_pb2.Scene, script: Script, machine: Machine, against: str) -> str:
    """Returns the key of a measurement. `against`: names the reference and the timing."""
    digest = hashlib.sha256(scene.SerializeToString(deterministic=True))
    digest.update(json.dumps([asdict(script), asdict(machine), against], sort_keys=True).encode())
    return digest.hexdigest()[:16]


class Store:
    """Folder of results: results.jsonl, and recordings/ with the recordings that others are compared with.

    Raises:
        InvalidArgumentError: a line that this program did not write.
    """

    def __init__(self, folder: Path) -> None:
        self._lines_file = folder / "results.jsonl"
        self._recordings = folder / "recordings"
        self._recordings.mkdir(parents=True, exist_ok=True)
        self._measurements: dict[str, Measurement] = {}
        if not self._lines_file.exists():
            return
        text = self._lines_file.read_text("utf-8")
        for number, line in enumerate(text.splitlines(keepends=True), 1):
            if not line.endswith("\n"):
                # The run was stopped during writing.
                with replacing(self._lines_file) as aside:
                    aside.write_text(text[: -len(line)], "utf-8")
                break
            try:
                measurement = Measurement.from_plain(json.loads(line))
            except (ValueError, TypeError, KeyError) as error:
                raise InvalidArgumentError(
                    f"{self._lines_file}:{number}: not a measurement of this version ({error}); "
                    "remove the file, or take another folder with --out"
                ) from error
            self._measurements[measurement.key] = measurement

    def get(self, key: str) -> Measurement | None:
        return self._measurements.get(key)

    def put(self, measurement: Measurement) -> None:
        """Appends a line and flushes it."""
        self._measurements[measurement.key] = measurement
        with self._lines_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(measurement.to_plain()) + "\n")

    def recording(self, key: str) -> Recording | None:
        """Returns the recording that `keep` wrote; None if it is missing or incomplete."""
        with contextlib.suppress(OSError, ValueError, KeyError, zipfile.BadZipFile), np.load(self._path(key)) as arrays:
            plain = json.loads(str(arrays["plain"]))
            return Recording(
                **{**plain, "costs": Costs(**plain["costs"])},
                displacement=[arrays[f"displacement_{body}"] for body in range(int(arrays["bodies"]))],
                **{name: arrays[name] for name in _ARRAYS},
            )
        return None

    def keep(self, key: str, recording: Recording) -> None:
        arrays: dict[str, Any] = {name: getattr(recording, name) for name in _ARRAYS}
        arrays |= {f"displacement_{body}": values for body, values in enumerate(recording.displacement)}
        plain = {name: getattr(recording, name) for name in _PLAIN} | {"costs": asdict(recording.costs)}
        with replacing(self._path(key)) as aside:
            np.savez_compressed(aside, plain=np.array(json.dumps(plain)), bodies=len(recording.displacement), **arrays)

    def _path(self, key: str) -> Path:
        return self._recordings / f"{key}.npz"


_ARRAYS = ("volume", "force", "free_times_s", "free_m")
_PLAIN = ("work_j", "element_count", "outside_share", "unconverged_steps", "min_det_f", "warnings")
