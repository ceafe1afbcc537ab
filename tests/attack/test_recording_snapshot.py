"""Snapshots with a correct checksum whose numbers no step ends with: refused, and nothing of them is published."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from service_parts import block

import tensormass as tm
from tensormass.v1 import recording_pb2

HEADER = struct.Struct("<8sIIQQ")
WORD = (1 << 64) - 1


@pytest.fixture(scope="module")
def handle() -> Iterator[tm.SceneHandle]:
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as server:
        yield server.load(block(), lockstep=True)


def checksum_of(data: bytes) -> int:
    """As server/world/hashes.h."""
    value = 0
    for word in [len(data), *(int.from_bytes(data[at : at + 8], "little") for at in range(0, len(data), 8))]:
        x = ((value ^ word) + 0x9E3779B97F4A7C15) & WORD
        x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & WORD
        x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & WORD
        value = x ^ (x >> 31)
    return value


def sealed(state: recording_pb2.SnapshotState) -> bytes:
    content = state.SerializeToString()
    return HEADER.pack(b"\x89TMSNAP\n", 2, 0, len(content), checksum_of(content)) + content


def numbers(name: str, value: float) -> Callable[[recording_pb2.SnapshotState], None]:
    def put(state: recording_pb2.SnapshotState) -> None:
        values = np.frombuffer(getattr(state, name), "<f8").copy()
        values[1] = value
        setattr(state, name, values.tobytes())

    return put


def of_tool(name: str, value: float) -> Callable[[recording_pb2.SnapshotState], None]:
    return lambda state: setattr(state.tools[0], name, value)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (numbers("displacement", 1e39), "displacement: has 1e+39, beyond"),
        (numbers("displacement", -1e300), "displacement: has -1e+300, beyond"),
        (numbers("displacement", float("inf")), "displacement: has numbers that are not finite"),
        (numbers("displacement", 1e5), "farther than"),
        (numbers("velocity", 1e39), "velocity: has 1e+39, beyond"),
        (of_tool("reach_m", 1e300), "reach_m"),
        (of_tool("young_modulus_pa", 1e300), "young_modulus_pa"),
        (of_tool("target_age_s", float("nan")), "target_age_s"),
        (lambda state: setattr(state, "largest_force_squared", 1e300), "largest_force_squared"),
        (lambda state: setattr(state, "stuck_s", 1e300), "stuck_s"),
    ],
)
def test_numbers_that_no_step_ends_with_are_refused(
    handle: tm.SceneHandle, change: Callable[[recording_pb2.SnapshotState], None], part: str
) -> None:
    handle.step(1)
    snapshot = handle.snapshot()
    state = recording_pb2.SnapshotState.FromString(snapshot[HEADER.size :])
    assert sealed(state) == snapshot
    change(state)
    with pytest.raises(tm.InvalidArgumentError) as refusal:
        handle.restore(sealed(state))
    assert part in str(refusal.value)
    handle.restore(snapshot)
    handle.step(1)
    assert np.isfinite(handle.positions("tissue")).all()
