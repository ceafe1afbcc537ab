"""Key files of a daemon that are missing, broken, expired, foreign or open to everybody: a refusal with the remedy."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="needs the extra `keys`")

import attack_parts  # noqa: F401  skips all this without a build

import tensormass as tm
from tensormass._shared.client_keys import write_secret
from tensormass_tools.keys.folder import KeyFolder


def expire(path: Path) -> None:
    KeyFolder(path).renew(None, 1e-5)
    time.sleep(1)


def move_to_the_future(path: Path) -> None:
    """Makes the daemon's certificate again, on a machine whose clock is ten days ahead."""
    ahead_s = 10 * 86_400
    with pytest.MonkeyPatch.context() as clock:
        clock.setattr(time, "time", lambda now=time.time: now() + ahead_s)
        KeyFolder(path).renew(None, 30)


def change_daemon_file(**values: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = json.loads((path / "daemon.json").read_text())
        write_secret(path / "daemon.json", {**content, **values})

    return change


def take_key_of_another(path: Path) -> None:
    other = KeyFolder(path.parent / "other")
    other.init([], 30)
    change_daemon_file(private_key=json.loads((other.path / "daemon.json").read_text())["private_key"])(path)


def replace_by_folder(path: Path) -> None:
    (path / "daemon.json").unlink()
    (path / "daemon.json").mkdir(0o700)


@pytest.mark.parametrize(
    ("damage", "refusal"),
    [
        (lambda path: (path / "daemon.json").unlink(), "make keys with: tensormass keys init"),
        (replace_by_folder, "daemon.json: not a file"),
        (lambda path: (path / "daemon.json").chmod(0o644), "every user of this machine can use it"),
        (lambda path: (path / "daemon.json").write_text("{}"), "does not hold a daemon's keys"),
        (lambda path: (path / "clients.json").write_text("[]"), "not a list of clients"),
        (lambda path: (path / "clients.json").unlink(), "make keys with: tensormass keys init"),
        (lambda path: (path / "clients.json").chmod(0o646), "every user of this machine can use it"),
        (change_daemon_file(certificate="x"), "the certificate is damaged; renew it with: tensormass keys renew"),
        (
            take_key_of_another,
            "the private key is damaged or of another certificate; renew it with: tensormass keys renew",
        ),
        (expire, "the daemon's certificate has expired; renew it with: tensormass keys renew"),
        (move_to_the_future, "the daemon's certificate is not valid yet; set this machine's clock"),
    ],
)
def test_a_daemon_refuses_a_folder_that_it_cannot_use(
    tmp_path: Path, damage: Callable[[Path], object], refusal: str
) -> None:
    folder = KeyFolder(tmp_path / "keys")
    folder.init([], 30)
    damage(folder.path)
    with pytest.raises(tm.UnavailableError) as refused:
        tm.launch(backend="cpu", options=("--keys", str(folder.path)))
    assert refusal in str(refused.value)
    assert str(folder.path) in str(refused.value)
