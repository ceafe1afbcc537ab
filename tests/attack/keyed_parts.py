"""A daemon with keys for the attacks, and a client of each role. Needs the package cryptography."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import zenoh
import zmq
from attack_parts import DEADLINE_S, block

import tensormass as tm
from tensormass._shared.client_keys import ClientKeys, channel_options
from tensormass.v1 import control_pb2_grpc
from tensormass_tools.keys.folder import ROLES, KeyFolder

SCENES = ("a", "b")
#: A hand's own scene and tool.
OWN = "a/probe"


class Guarded:
    """A daemon with keys on loopback, and a client of each role."""

    def __init__(self, folder: KeyFolder, server: tm.Server, keys: dict[str, ClientKeys]) -> None:
        self.folder, self.server, self.keys = folder, server, keys
        self.version = server.version()

    @contextlib.contextmanager
    def stub(self, keys: ClientKeys) -> Iterator[control_pb2_grpc.ControlStub]:
        options = channel_options(keys, [("grpc.use_local_subchannel_pool", 1)])
        with grpc.secure_channel(self.server.address, keys.channel_credentials(), options) as channel:
            yield control_pb2_grpc.ControlStub(channel)

    @contextlib.contextmanager
    def socket(self, kind: int, keys: ClientKeys) -> Iterator[zmq.Socket[bytes]]:
        with zmq.Context() as context, context.socket(kind) as one:
            one.setsockopt(zmq.LINGER, 0)
            one.setsockopt(zmq.RCVTIMEO, int(1000 * DEADLINE_S))
            keys.guard_socket(one)
            yield one

    @contextlib.contextmanager
    def zenoh(self, keys: ClientKeys, connect_s: float = 30.0) -> Iterator[zenoh.Session]:
        """connect_s: time for the connection. The daemon's session may be closed for a moment, when keys changed."""
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [self.version.zenoh_locator],
            "connect/timeout_ms": int(1000 * connect_s),
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        keys.guard_zenoh(config)
        with zenoh.open(config) as session:
            yield session

    def log(self) -> str:
        assert self.server.log_file is not None
        return self.server.log_file.read_text()

    def entries(self) -> dict[str, Any]:
        """What clients.json holds."""
        content = json.loads((self.folder.path / "clients.json").read_text())
        assert isinstance(content, dict)
        return content

    def malformed(self) -> int:
        return self.server.version().malformed_messages

    def refused_since(self, before: int) -> bool:
        return self.malformed() > before


@contextlib.contextmanager
def guarded(path: Path, *more: str) -> Iterator[Guarded]:
    folder = KeyFolder(path / "keys")
    folder.init([], 30)
    keys = {role: folder.add(f"a-{role}", role, of=OWN if role == "hand" else None) for role in ROLES}
    options = ("--keys", str(folder.path), "--log-format", "json", *more)
    with tm.launch(backend="cpu", cpu_threads=1, options=options, keys=keys["operator"]) as server:
        for scene in SCENES:
            server.load(block(scene))
        yield Guarded(folder, server, keys)
