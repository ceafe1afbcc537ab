"""A client's keys: the file that `tensormass keys add` writes, and what each transport makes of it."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import grpc
import zenoh
import zmq

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.secret_files import read_secret

#: The name in every daemon's certificate. Clients reach daemons under many names; this one tells that it is a daemon.
DAEMON_NAME = "tensormassd"
#: How far clocks of two machines may be apart [s]. Keys are valid from so long before they were made.
CLOCK_SKEW_S = 86_400
_KIND = "client keys"


def date_of(time_s: float) -> str:
    """Writes a day as 2026-11-29."""
    return time.strftime("%Y-%m-%d", time.gmtime(time_s))


@dataclass(frozen=True, repr=False)
class ClientKeys:
    """The keys of one client. `connect(keys=...)` takes one, or the path of its file.

    No representation shows a secret.
    """

    path: Path
    id: str
    role: str
    expires_s: int
    made_s: int
    authority: str
    certificate: str
    private_key: str
    curve_public: str
    curve_secret: str
    curve_server: str
    scene: str = ""
    tool: str = ""
    page_certificate: str = ""
    page_private_key: str = ""

    def __repr__(self) -> str:
        return f"ClientKeys({str(self.path)!r}, id={self.id!r}, role={self.role!r})"

    @staticmethod
    def read(path: str | Path) -> ClientKeys:
        """Reads a file of `tensormass keys add`.

        Raises:
            InvalidArgumentError: it is missing, damaged, expired, or every user of this machine can read it. The
                message names file and remedy.
        """
        path = Path(path)
        text = read_secret(
            path,
            f"keys {path}",
            missing="; get the file that `tensormass keys add` wrote",
            exposed="if a stranger may have read it, renew it (`tensormass keys renew`), else: ",
        )
        keys = ClientKeys._parse(path, text)
        now = time.time()
        if now >= keys.expires_s:
            raise InvalidArgumentError(
                f"keys {path}: expired on {date_of(keys.expires_s)}; get new ones: tensormass keys renew "
                f"{keys.id.rpartition('.')[0]}"
            )
        if now < keys.made_s - CLOCK_SKEW_S:
            raise InvalidArgumentError(
                f"keys {path}: made on {date_of(keys.made_s)}, which is in the future; set this machine's clock"
            )
        return keys

    @staticmethod
    def _parse(path: Path, text: str) -> ClientKeys:
        damaged = InvalidArgumentError(
            f"keys {path}: not a client's keys, or damaged; get the file that `tensormass keys add` wrote"
        )
        try:
            content: Any = json.loads(text)
        except ValueError:
            raise damaged from None
        if not isinstance(content, dict) or content.get("tensormass") != _KIND:
            raise damaged
        values: dict[str, Any] = {}
        for field in fields(ClientKeys):
            if field.name == "path":
                continue
            kind = int if field.name.endswith("_s") else str
            value = content.get(field.name, "")
            optional = field.name in ("scene", "tool", "page_certificate", "page_private_key")
            if not isinstance(value, kind) or not (value or optional):
                raise damaged
            values[field.name] = value
        return ClientKeys(path=path, **values)

    def write(self) -> None:
        """Writes the file in one step, for its owner only."""
        content = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "path"}
        write_secret(self.path, {"tensormass": _KIND, **content})

    def channel_credentials(self) -> grpc.ChannelCredentials:
        return grpc.ssl_channel_credentials(
            self.authority.encode(), self.private_key.encode(), self.certificate.encode()
        )

    def guard_socket(self, socket: zmq.Socket[Any]) -> None:
        """Makes a ZeroMQ socket speak CURVE with the daemon. Call it before the socket connects."""
        socket.setsockopt(zmq.CURVE_SERVERKEY, self.curve_server.encode())
        socket.setsockopt(zmq.CURVE_PUBLICKEY, self.curve_public.encode())
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.curve_secret.encode())

    def guard_zenoh(self, config: zenoh.Config) -> None:
        """Makes a zenoh session speak TLS with the daemon."""
        tls = {
            "root_ca_certificate_base64": _base64(self.authority),
            "connect_certificate_base64": _base64(self.certificate),
            "connect_private_key_base64": _base64(self.private_key),
            "enable_mtls": True,
        }
        for name, value in tls.items():
            config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))
        config.insert_json5("transport/shared_memory/enabled", "false")


KeysSource = str | Path | ClientKeys


def keys_of(source: KeysSource | None) -> ClientKeys | None:
    """Returns keys as an object: reads a file, and passes on an object or None."""
    return source if source is None or isinstance(source, ClientKeys) else ClientKeys.read(source)


def channel_options(keys: ClientKeys | None, options: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Returns a channel's options, with the name that the daemon's certificate must have."""
    return [*options, *([("grpc.ssl_target_name_override", DAEMON_NAME)] if keys is not None else [])]


def guard_socket(keys: ClientKeys | None, socket: zmq.Socket[Any]) -> None:
    """Makes a ZeroMQ socket speak CURVE if there are keys. Call it before the socket connects."""
    if keys is not None:
        keys.guard_socket(socket)


def write_secret(path: Path, content: Mapping[str, Any]) -> None:
    """Writes JSON that only its owner may read. A reader sees the old file or the new one, never a part."""
    # A name that nobody guesses: others may write in the folder, too.
    descriptor, unfinished = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            json.dump(content, file, indent=1)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(unfinished)
        raise


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
