"""The folder of keys: an authority, the daemon's keys, the list of clients, and a file for each client.

    authority.json   signs; stays with whoever makes keys, no daemon reads it
    daemon.json      keys of the daemon: certificate, private key, CURVE
    clients.json     who has a key, and which role; the daemon follows it
    clients/NAME.json  all that a client needs; move it to the client

Every change holds a lock and replaces whole files, so that two commands at once lose nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import json
import os
import re
import secrets
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zmq

from tensormass import AlreadyExistsError, InvalidArgumentError, NotFoundError
from tensormass._shared.client_keys import DAEMON_NAME, ClientKeys, write_secret
from tensormass_tools.keys.certificates import Certified, make_authority, make_client, make_server

ROLES = ("operator", "hand", "viewer", "recorder", "metrics")
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
# The name of a certificate, NAME.KEY, has at most 64 characters.
_CLIENT_NAME = re.compile(r"[A-Za-z0-9_-]{1,55}")
_MOST_DAYS = 3650


@dataclass(frozen=True)
class Entry:
    """A client in clients.json."""

    id: str
    role: str
    curve_public: str
    expires_s: int
    made_s: int
    scene: str = ""
    tool: str = ""
    pages: list[str] = field(default_factory=list)
    """Names and addresses of a gateway that uses the keys."""

    @property
    def name(self) -> str:
        return self.id.rpartition(".")[0]


class KeyFolder:
    """A folder of keys on disk."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def client_file(self, name: str) -> Path:
        return self.path / "clients" / f"{name}.json"

    def init(self, hosts: Sequence[str], days: float) -> None:
        """Makes authority, daemon and an empty list.

        Args:
            hosts: names and addresses under which clients reach the daemon, besides those of this machine.
        """
        _check_days(days)
        for host in hosts:
            _check_host(host)
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.chmod(self.path, 0o700)
        (self.path / "clients").mkdir(mode=0o700, exist_ok=True)
        with self._locked():
            if (self.path / "daemon.json").exists() or (self.path / "authority.json").exists():
                raise AlreadyExistsError(
                    f"{self.path} has keys already; use another folder, or renew them: tensormass keys renew --keys "
                    f"{self.path}"
                )
            now = int(time.time())
            authority, page = (make_authority(f"tensormass {of}", now) for of in ("authority", "page authority"))
            self._write("authority.json", {"authority": asdict(authority), "page": asdict(page)})
            (self.path / "page-authority.pem").write_text(page.certificate)
            public, secret = _curve_pair()
            curve = {"curve_public": public, "curve_secret": secret}
            self._write("clients.json", {"tensormass": "client list", "clients": []})
            self._write_daemon(authority, hosts, days, curve)

    def add(
        self,
        name: str,
        role: str,
        *,
        of: str | None = None,
        days: float = 365,
        output: Path | None = None,
        pages: Sequence[str] = (),
    ) -> ClientKeys:
        """Makes the keys of a client.

        Args:
            of: SCENE/TOOL of a hand.
            output: the file to write; None: clients/NAME.json.
            pages: names and addresses of a gateway that uses these keys.
        """
        scene, tool = _check_role(name, role, of)
        _check_days(days)
        with self._locked():
            entries = self._entries()
            if any(entry.name == name for entry in entries):
                raise AlreadyExistsError(
                    f"client {name!r} has keys already; renew them (tensormass keys renew {name}) or remove them first"
                )
            return self._make(entries, name, role, scene, tool, days, output, pages)

    def remove(self, name: str) -> None:
        """Takes a client's rights away. A daemon that runs cuts the client within 5 s."""
        with self._locked():
            entries = self._entries()
            left = [entry for entry in entries if entry.name != name]
            if len(left) == len(entries):
                raise _no_client(name, entries)
            self._write_entries(left)
            self.client_file(name).unlink(missing_ok=True)

    def renew(self, name: str | None, days: float, hosts: Sequence[str] = (), output: Path | None = None) -> Path:
        """Makes new keys for a client, or for the daemon. The old ones of a client end at once."""
        _check_days(days)
        with self._locked():
            if name is None:
                return self._renew_daemon(hosts, days)
            entries = self._entries()
            old = next((entry for entry in entries if entry.name == name), None)
            if old is None:
                raise _no_client(name, entries)
            left = [entry for entry in entries if entry is not old]
            return self._make(left, name, old.role, old.scene, old.tool, days, output, old.pages).path

    def entries(self) -> list[Entry]:
        """Returns all clients."""
        with self._locked():
            return self._entries()

    def _make(
        self,
        entries: list[Entry],
        name: str,
        role: str,
        scene: str,
        tool: str,
        days: float,
        output: Path | None,
        pages: Sequence[str],
    ) -> ClientKeys:
        authorities, daemon = self._read("authority.json"), self._read("daemon.json")
        authority, page_authority = Certified(**authorities["authority"]), Certified(**authorities["page"])
        now = int(time.time())
        id_ = f"{name}.{secrets.token_hex(4)}"
        certified = make_client(authority, id_, now, days)
        public, secret = _curve_pair()
        page = {}
        if pages:
            for host in pages:
                _check_host(host)
            of_page = make_server(page_authority, "tensormass page", [*pages, "localhost", "127.0.0.1"], now, days)
            page = {"page_certificate": of_page.certificate, "page_private_key": of_page.private_key}
        entry = Entry(id_, role, public, now + int(days * 86_400), now, scene, tool, list(pages))
        keys = ClientKeys(
            path=output or self.client_file(name),
            id=id_,
            role=role,
            scene=scene,
            tool=tool,
            expires_s=entry.expires_s,
            made_s=now,
            authority=authority.certificate,
            certificate=certified.certificate,
            private_key=certified.private_key,
            curve_public=public,
            curve_secret=secret,
            curve_server=daemon["curve_public"],
            **page,
        )
        # The client's file first: a list without the file is a client who can never connect.
        keys.write()
        self._write_entries([*entries, entry])
        return keys

    def _renew_daemon(self, hosts: Sequence[str], days: float) -> Path:
        for host in hosts:
            _check_host(host)
        old = self._read("daemon.json")
        authority = Certified(**self._read("authority.json")["authority"])
        curve = {name: old[name] for name in ("curve_public", "curve_secret")}
        self._write_daemon(authority, hosts or old.get("hosts", []), days, curve)
        return self.path / "daemon.json"

    def _write_daemon(self, authority: Certified, hosts: Sequence[str], days: float, curve: dict[str, str]) -> None:
        now = int(time.time())
        names = [DAEMON_NAME, *hosts, *_own_hosts()]
        certified = make_server(authority, DAEMON_NAME, names, now, days)
        content = {
            "tensormass": "daemon keys",
            "hosts": list(hosts),
            "expires_s": now + int(days * 86_400),
            "certificate": certified.certificate,
            "private_key": certified.private_key,
            "authority": authority.certificate,
            **curve,
        }
        self._write("daemon.json", content)

    def _entries(self) -> list[Entry]:
        content = self._read("clients.json")
        try:
            return [Entry(**entry) for entry in content["clients"]]
        except (KeyError, TypeError) as error:
            raise self._damaged("clients.json") from error

    def _write_entries(self, entries: Sequence[Entry]) -> None:
        self._write("clients.json", {"tensormass": "client list", "clients": [asdict(entry) for entry in entries]})

    def _read(self, name: str) -> dict[str, Any]:
        try:
            content = json.loads((self.path / name).read_text("utf-8"))
        except FileNotFoundError:
            raise NotFoundError(
                f"{self.path / name} is missing; make keys with `tensormass keys init {self.path}`, or name their "
                "folder with --keys"
            ) from None
        except ValueError:
            raise self._damaged(name) from None
        if not isinstance(content, dict):
            raise self._damaged(name)
        return content

    def _damaged(self, name: str) -> InvalidArgumentError:
        return InvalidArgumentError(f"{self.path / name} is damaged; restore it from a copy, or make all keys anew")

    def _write(self, name: str, content: dict[str, Any]) -> None:
        write_secret(self.path / name, content)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        if not self.path.is_dir():
            raise NotFoundError(
                f"{self.path} is not a folder of keys; make one with `tensormass keys init {self.path}`"
            )
        descriptor = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _check_role(name: str, role: str, of: str | None) -> tuple[str, str]:
    """Returns scene and tool of a hand, else empty names."""
    if not _CLIENT_NAME.fullmatch(name):
        raise InvalidArgumentError(f"client {name!r}: must be 1 to 55 characters out of [A-Za-z0-9_-]")
    if role not in ROLES:
        raise InvalidArgumentError(f"role {role!r}: unknown; there are: {', '.join(ROLES)}")
    if role != "hand":
        if of is not None:
            raise InvalidArgumentError(
                f"--of {of}: only a hand has a scene and a tool; leave it out, or use --role hand"
            )
        return "", ""
    scene, _, tool = (of or "").partition("/")
    if not (_NAME.fullmatch(scene) and _NAME.fullmatch(tool)):
        raise InvalidArgumentError(f"--of {of or ''}: a hand needs its scene and tool, as --of demo/probe")
    return scene, tool


def _check_days(days: float) -> None:
    if not 0 < days <= _MOST_DAYS:
        raise InvalidArgumentError(f"--days {days:g}: must be above 0 and at most {_MOST_DAYS}")


def _check_host(host: str) -> None:
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host.strip("[]"))
        return
    if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?", host):
        raise InvalidArgumentError(f"host {host!r}: neither a name nor an address; write it without scheme and port")


def _own_hosts() -> list[str]:
    """Names and addresses of this machine."""
    hosts = ["localhost", "127.0.0.1", "::1"]
    name = socket.gethostname()
    with contextlib.suppress(InvalidArgumentError):
        _check_host(name)
        hosts.append(name)
    with contextlib.suppress(OSError):
        hosts += sorted({str(info[4][0]).partition("%")[0] for info in socket.getaddrinfo(name, None)})
    return hosts


def _curve_pair() -> tuple[str, str]:
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def _no_client(name: str, entries: Sequence[Entry]) -> NotFoundError:
    known = ", ".join(entry.name for entry in entries) or "none"
    return NotFoundError(f"no client {name!r} has keys; there are: {known}")
