"""`tensormass keys`: what the files hold, and what is refused when they are not as they should be."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="needs the extra `keys`")

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

import tensormass as tm
from tensormass._shared.client_keys import CLOCK_SKEW_S, ClientKeys
from tensormass_tools import cli
from tensormass_tools.keys.folder import ROLES, KeyFolder


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    made = KeyFolder(tmp_path / "keys")
    made.init(["trainer.example", "192.0.2.10"], 30)
    return made


def test_secrets_are_for_their_owner_alone(folder: KeyFolder) -> None:
    folder.add("alice", "operator")
    assert folder.path.stat().st_mode & 0o777 == 0o700
    for file in ("authority.json", "daemon.json", "clients.json", "clients/alice.json"):
        assert (folder.path / file).stat().st_mode & 0o777 == 0o600, file
    text = (folder.path / "clients.json").read_text()
    assert "PRIVATE" not in text, "the list says who may connect, without a secret"
    assert "curve_secret" not in text


def test_a_client_has_all_that_it_needs_and_shows_none_of_it(folder: KeyFolder) -> None:
    keys = folder.add("hand-1", "hand", of="demo/probe", days=7)
    read = ClientKeys.read(keys.path)
    assert read == keys
    assert (read.role, read.scene, read.tool) == ("hand", "demo", "probe")
    assert read.expires_s == pytest.approx(time.time() + 7 * 86_400, abs=60)
    assert read.curve_server == json.loads((folder.path / "daemon.json").read_text())["curve_public"]
    for secret in (read.private_key, read.curve_secret):
        assert secret not in repr(read)


def test_certificates_say_what_they_are_for(folder: KeyFolder) -> None:
    keys = folder.add("alice", "viewer", pages=["viewer.example"])
    daemon = x509.load_pem_x509_certificate(
        json.loads((folder.path / "daemon.json").read_text())["certificate"].encode()
    )
    client = x509.load_pem_x509_certificate(keys.certificate.encode())
    page = x509.load_pem_x509_certificate(keys.page_certificate.encode())

    def uses(certificate: x509.Certificate) -> list[x509.ObjectIdentifier]:
        return list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)

    assert uses(daemon) == uses(page) == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert uses(client) == [ExtendedKeyUsageOID.CLIENT_AUTH], "no client can pose as a daemon"
    assert page.issuer != daemon.issuer, "browsers trust the page's authority for every address"
    names = daemon.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"tensormassd", "trainer.example", "localhost"} <= set(names.get_values_for_type(x509.DNSName))
    assert "192.0.2.10" in {str(address) for address in names.get_values_for_type(x509.IPAddress)}
    page_authority = x509.load_pem_x509_certificate((folder.path / "page-authority.pem").read_bytes())
    for certificate, signer in (
        (client, x509.load_pem_x509_certificate(keys.authority.encode())),
        (page, page_authority),
        (page_authority, page_authority),
    ):
        named = certificate.extensions.get_extension_for_class(x509.AuthorityKeyIdentifier).value
        own = signer.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
        assert named.key_identifier == own.digest
    now = datetime.datetime.now(datetime.UTC)
    assert client.not_valid_before_utc < now - datetime.timedelta(hours=23), "clocks may differ"


def test_keys_end_and_come_anew(folder: KeyFolder) -> None:
    first = folder.add("alice", "recorder")
    folder.renew("alice", 30)
    second = ClientKeys.read(folder.client_file("alice"))
    assert second.id != first.id
    assert second.role == "recorder"
    assert [entry.id for entry in folder.entries()] == [second.id]
    folder.remove("alice")
    assert folder.entries() == []
    assert not folder.client_file("alice").exists()
    old = json.loads((folder.path / "daemon.json").read_text())
    folder.renew(None, 30, ["other.example"])
    new = json.loads((folder.path / "daemon.json").read_text())
    assert new["certificate"] != old["certificate"]
    assert new["curve_public"] == old["curve_public"], "clients know it"


def test_new_keys_of_a_gateway_are_for_its_page_too(folder: KeyFolder) -> None:
    first = folder.add("gateway", "operator", pages=["viewer.example"])
    folder.renew("gateway", 30)
    second = ClientKeys.read(folder.client_file("gateway"))
    assert second.page_certificate != first.page_certificate
    page = x509.load_pem_x509_certificate(second.page_certificate.encode())
    names = page.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "viewer.example" in names.get_values_for_type(x509.DNSName)


def test_keys_are_not_written_where_another_user_wants_them(folder: KeyFolder, tmp_path: Path) -> None:
    """Whoever may write in a folder can lay a link under a name that is known before."""
    victim = tmp_path / "victim"
    (tmp_path / f".alice.json.{os.getpid()}").symlink_to(victim)
    folder.add("alice", "viewer", output=tmp_path / "alice.json")
    assert not victim.exists()
    assert (tmp_path / "alice.json").stat().st_mode & 0o777 == 0o600


def test_two_commands_at_once_lose_nothing(folder: KeyFolder) -> None:
    names = [f"client-{i}" for i in range(12)]
    add = "from tensormass_tools.cli import main; import sys; sys.exit(main(sys.argv[1:]))"
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", add, "keys", "add", name, "--role", "viewer", "--keys", folder.path],
            stdout=subprocess.DEVNULL,
        )
        for name in names
    ]
    assert [run.wait(600) for run in runs] == [0] * len(runs)
    assert sorted(entry.name for entry in folder.entries()) == sorted(names)


@pytest.mark.parametrize(
    ("arguments", "refusal"),
    [
        (("alice", "king", None), "role 'king': unknown; there are: operator, hand, viewer, recorder, metrics"),
        (("alice", "hand", None), "--of : a hand needs its scene and tool, as --of demo/probe"),
        (("alice", "hand", "demo"), "--of demo: a hand needs its scene and tool"),
        (("alice", "viewer", "demo/probe"), "only a hand has a scene and a tool"),
        (("../alice", "viewer", None), "client '../alice': must be 1 to 55 characters"),
        ((56 * "a", "viewer", None), "a': must be 1 to 55 characters"),
    ],
)
def test_wrong_roles_are_refused(folder: KeyFolder, arguments: tuple[str, str, str | None], refusal: str) -> None:
    name, role, of = arguments
    with pytest.raises(tm.InvalidArgumentError, match="(?s)" + refusal.replace("(", r"\(")):
        folder.add(name, role, of=of)
    assert folder.entries() == []
    assert ClientKeys.read(folder.add(55 * "a", "viewer").path).role == "viewer"


def test_mistakes_in_the_folder_are_named(folder: KeyFolder, tmp_path: Path) -> None:
    with pytest.raises(tm.AlreadyExistsError, match="has keys already; use another folder, or renew"):
        folder.init([], 1)
    folder.add("alice", "viewer")
    with pytest.raises(tm.AlreadyExistsError, match="client 'alice' has keys already"):
        folder.add("alice", "viewer")
    with pytest.raises(tm.NotFoundError, match="no client 'bob' has keys; there are: alice"):
        folder.remove("bob")
    with pytest.raises(tm.InvalidArgumentError, match="--days 0: must be above 0"):
        folder.renew("alice", 0)
    with pytest.raises(tm.InvalidArgumentError, match="host 'https://x': neither a name nor an address"):
        folder.renew(None, 1, ["https://x"])
    with pytest.raises(tm.NotFoundError, match="not a folder of keys; make one with `tensormass keys init"):
        KeyFolder(tmp_path / "elsewhere").entries()
    (folder.path / "clients.json").write_text("{")
    with pytest.raises(tm.InvalidArgumentError, match=r"clients\.json is damaged; restore it"):
        folder.entries()


def test_a_secret_may_be_roots(folder: KeyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Kubernetes mounts it, for a program of another user."""
    keys = folder.add("alice", "viewer")
    os.chmod(keys.path, 0o440)
    found = os.stat(keys.path)
    of_root = os.stat_result((found.st_mode, *found[1:4], 0, *found[5:]))
    monkeypatch.setattr(os, "fstat", lambda _: of_root)
    monkeypatch.setattr(os, "geteuid", lambda: 10001)
    assert ClientKeys.read(keys.path).id == keys.id


def damaged(keys: ClientKeys, **changes: object) -> Path:
    content = json.loads(keys.path.read_text())
    content.update(changes)
    keys.path.write_text(json.dumps(content))
    return keys.path


def test_a_client_refuses_files_that_it_cannot_use(folder: KeyFolder, tmp_path: Path) -> None:
    """The message names file and remedy."""

    def refusal(path: Path) -> str:
        with pytest.raises(tm.InvalidArgumentError) as refused:
            tm.connect("127.0.0.1:1", keys=path)
        assert str(path) in str(refused.value)
        return str(refused.value)

    assert "cannot be read: No such file or directory; get the file" in refusal(tmp_path / "none.json")
    keys = folder.add("alice", "viewer")
    os.chmod(keys.path, 0o644)
    assert (
        f"every user of this machine can use it; if a stranger may have read it, renew it (`tensormass keys renew`), "
        f"else: chmod o-rwx {keys.path}" in refusal(keys.path)
    )
    os.chmod(keys.path, 0o640)  # as Kubernetes mounts a Secret
    assert ClientKeys.read(keys.path).id == keys.id
    if os.geteuid() == 0:  # nobody else gives files away
        os.chown(keys.path, 12345, -1)
        assert (
            f"user 12345 owns it, who is neither the user of this program, 0, nor root; run it as user 12345, or: "
            f"chown 0 {keys.path}" in refusal(keys.path)
        )
        os.chown(keys.path, 0, -1)
    assert "not a client's keys, or damaged" in refusal(damaged(keys, private_key=""))
    assert "not a client's keys, or damaged" in refusal(damaged(keys, private_key=keys.private_key, expires_s="soon"))
    past = int(time.time()) - 10
    assert "expired on 20" in refusal(damaged(keys, expires_s=past))
    future = int(time.time()) + CLOCK_SKEW_S + 100
    assert "which is in the future; set this machine's clock" in refusal(
        damaged(keys, expires_s=future + 9, made_s=future)
    )
    keys.path.write_bytes(b"\xff\xfe")
    assert "not text" in refusal(keys.path)
    keys.path.write_text("{")
    assert "not a client's keys, or damaged" in refusal(keys.path)
    assert "not a client's keys, or damaged" in refusal(folder.path / "daemon.json")


def test_the_command_says_what_it_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["keys", "init"]) == 0
    assert "tensormassd --keys keys" in capsys.readouterr().out
    for role in ROLES:
        of = ["--of", "demo/probe"] if role == "hand" else []
        assert cli.main(["keys", "add", f"a-{role}", "--role", role, *of]) == 0
    capsys.readouterr()
    assert cli.main(["keys", "list"]) == 0
    listed = capsys.readouterr().out
    assert "a-hand  hand of demo/probe  until 20" in listed
    assert len(listed.splitlines()) == len(ROLES)
    assert cli.main(["keys", "remove", "a-hand"]) == 0
    assert cli.main(["keys", "renew", "a-viewer"]) == 0
    assert cli.main(["keys", "remove", "a-hand"]) == 1
    assert "no client 'a-hand' has keys" in capsys.readouterr().err
