"""The list of what is pinned, and the comparison with known vulnerabilities."""

from __future__ import annotations

import datetime
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

PYTHON = Path(__file__).resolve().parents[2] / "clients" / "python"
sys.path.insert(0, str(PYTHON))

import audit  # noqa: E402
import components  # noqa: E402
import lock  # noqa: E402
from components import Component  # noqa: E402

TODAY = datetime.date(2030, 1, 31)
KNOWN: dict[str, Any] = {"sources": {}, "advisories": []}


def test_every_lock_file_is_listed() -> None:
    listed = {component.purl: component for component in components.pinned()}
    for purl in ("pkg:pypi/aiohttp@", "pkg:npm/three@", "pkg:cargo/zenoh@", "pkg:pypi/cmake@", "pkg:pypi/sphinx@"):
        assert any(name.startswith(purl) for name in listed), purl
    assert any(name.startswith("pkg:npm/%40") for name in listed), "scopes are escaped"
    cargo = [component for component in listed.values() if component.ecosystem == "cargo"]
    assert {component.name for component in cargo if len(component.sha256) != 64} == {"zenoh-link-tls"}  # changed by us
    assert not [name for name in listed if "tensormass" in name], "our own crate is not a package of others"


def test_the_sums_are_those_of_the_lock_file() -> None:
    lines = [line for line in lock.SUMS.read_text("utf-8").splitlines() if not line.startswith("#")]
    assert lock.pinned("\n".join(lines)) == lock.pinned(lock.LOCK.read_text("utf-8")), "run clients/python/lock.py"
    project = tomllib.loads((PYTHON / "pyproject.toml").read_text("utf-8"))["project"]
    extras = {"base", *project["optional-dependencies"]}
    for line in lines:
        match = re.fullmatch(r"[\w.-]+==\S+((?: --hash=sha256:[0-9a-f]{64})+) # ([a-z ]+)", line)
        assert match is not None, line
        assert set(match[2].split()) <= extras


def test_what_an_extra_needs_is_marked() -> None:
    """As the set-up chooses: with the lines of an extra and of `base`, nothing is missing."""
    marked = {}
    for line in lock.SUMS.read_text("utf-8").splitlines():
        marked[line.partition("==")[0]] = set(line.partition(" # ")[2].split())
    for name, extras in lock.extras_of(lock.pinned(lock.LOCK.read_text("utf-8"))).items():
        assert marked[name] == {"base"} or set(extras) <= marked[name], name  # a newer Python needs less


def test_the_same_components_give_the_same_bill() -> None:
    parts = [Component("npm", "b", "1", shipped=False, sha512="ab", licence="MIT"), Component("cargo", "a", "2")]
    bill = components.bill_of_materials("1.0", "2030-01-31T00:00:00+00:00", parts)
    assert bill == components.bill_of_materials("1.0", "2030-01-31T00:00:00+00:00", reversed(parts))
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.6", 1)
    assert bill["components"] == [
        {
            "type": "library",
            "bom-ref": "pkg:cargo/a@2",
            "name": "a",
            "version": "2",
            "purl": "pkg:cargo/a@2",
            "scope": "required",
        },
        {
            "type": "library",
            "bom-ref": "pkg:npm/b@1",
            "name": "b",
            "version": "1",
            "purl": "pkg:npm/b@1",
            "scope": "excluded",
            "hashes": [{"alg": "SHA-512", "content": "ab"}],
            "licenses": [{"expression": "MIT"}],
        },
    ]


@pytest.mark.parametrize(
    ("version", "advisory", "affected"),
    [
        ("1.4.9", {"ranges": [["1.2", "1.5"]]}, True),
        ("1.5", {"ranges": [["1.2", "1.5"]]}, False),
        ("1.1", {"ranges": [["1.2", "1.5"], ["0", "1.1"]]}, False),
        ("9", {"ranges": [["1.2", ""]]}, True),
        ("1.2.3", {"versions": ["1.2.3"]}, True),
        ("1.2.4", {"versions": ["1.2.3"]}, False),
        ("0.10.0", {"safe": [">= 0.11.6, < 0.12.0", ">= 0.12.1"]}, True),
        ("0.11.7", {"safe": [">= 0.11.6, < 0.12.0", ">= 0.12.1"]}, False),
        ("0.12.0", {"safe": [">= 0.11.6, < 0.12.0", ">= 0.12.1"]}, True),
        ("0.3.5", {"safe": ["^0.3.4"]}, False),
        ("0.4.0", {"safe": ["^0.3.4"]}, True),
        ("1.9", {"safe": ["1.2"]}, False),
        ("1.3.1", {"safe": ["~1.2"]}, True),
        ("1:1.51.1-3+b1", {"ranges": [["0", "1.53.2"]]}, True),
        ("1.53.2-1", {"ranges": [["0", "1.53.2"]]}, False),
        ("one", {"ranges": [["0", "1"]]}, True),
        ("1.0", {"safe": ["nonsense !"]}, True),
    ],
)
def test_versions_are_compared(version: str, advisory: dict[str, Any], affected: bool) -> None:
    ecosystem = "Debian" if "-" in version else "Rust"
    assert audit.is_affected(version, {"ecosystem": ecosystem, **advisory}) == affected


def test_a_vulnerability_fails_until_it_is_accepted_and_lists_say_their_age() -> None:
    parts = [Component("cargo", "a", "1.0"), Component("npm", "a", "1.0"), Component("pypi", "b", "1.0")]
    advisory = {"id": "X-1", "ecosystem": "Rust", "package": "a", "ranges": [["0", "2"]]}
    sources = {
        "Rust": {"date": "2030-01-30", "from": "here"},
        "PyPI": {"date": "2029-01-31", "from": "there"},
    }
    lines, failed = audit.report({"sources": sources, "advisories": [advisory]}, parts, TODAY)
    assert failed
    assert "audit: a 1.0: VULNERABLE: https://osv.dev/X-1" in lines
    assert [line for line in lines if "a 1.0" in line] == ["audit: a 1.0: VULNERABLE: https://osv.dev/X-1"], (
        "cargo only"
    )
    assert any("npm: 1 packages were never compared" in line for line in lines)
    assert any("365 days old" in line for line in lines)
    accepted = {**advisory, "accepted": "not compiled"}
    lines, failed = audit.report({"sources": sources, "advisories": [accepted]}, parts, TODAY)
    assert not failed
    assert any("accepted: not compiled" in line for line in lines)
    assert lines[-1] == "audit: done, but not for PyPI, npm: too old or missing lists"
    fresh = {label: {"date": "2030-01-30", "from": "here"} for label in ("Rust", "PyPI", "npm")}
    assert audit.report({"sources": fresh, "advisories": []}, parts, TODAY)[0][-1] == "audit: done"


def test_the_list_says_of_each_source_its_day_and_origin() -> None:
    known = json.loads(audit.ADVISORIES.read_text("utf-8"))
    for label, source in known["sources"].items():
        assert set(source) == {"date", "from"}, label
        assert datetime.date.fromisoformat(source["date"]) <= datetime.date.today(), label
    assert {advisory["ecosystem"] for advisory in known["advisories"]} <= set(known["sources"])


def test_renewing_reads_both_kinds_of_database_and_keeps_what_was_accepted(tmp_path: Path) -> None:
    osv, rustsec = tmp_path / "osv", tmp_path / "rustsec"
    (osv / "a").mkdir(parents=True)
    entry = {
        "id": "GHSA-1",
        "affected": [
            {
                "package": {"ecosystem": "PyPI", "name": "Some_Name"},
                "ranges": [{"type": "ECOSYSTEM", "events": [{"introduced": "0"}, {"fixed": "2.0"}]}],
            },
            {"package": {"ecosystem": "PyPI", "name": "other"}, "ranges": []},
        ],
    }
    (osv / "a" / "one.json").write_text(json.dumps(entry))
    (osv / "a" / "gone.json").write_text(json.dumps({**entry, "id": "GHSA-2", "withdrawn": "2030-01-01"}))
    (rustsec / "crates" / "c").mkdir(parents=True)
    text = '```toml\n[advisory]\nid = "RUSTSEC-1"\npackage = "c"\n[versions]\npatched = [">= 1.1"]\n```\n# Title\n'
    (rustsec / "crates" / "c" / "RUSTSEC-1.md").write_text(text)
    for folder in (osv, rustsec):
        for command in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "all"]):
            identity = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
            subprocess.run(["git", "-C", folder, *identity, *command], check=True)
    before = {
        "sources": {"Debian": {"date": "2030-01-01", "from": "by hand"}},
        "advisories": [
            {"id": "RUSTSEC-1", "ecosystem": "Rust", "package": "c", "safe": [], "accepted": "not called"},
            {"id": "CVE-1", "ecosystem": "Debian", "package": "d", "ranges": [["0", "2"]]},
        ],
    }
    parts = [Component("pypi", "some-name", "1.0"), Component("cargo", "c", "1.0"), Component("deb", "d", "1-1")]
    known = audit.renewed(before, parts, [osv], rustsec)
    assert set(known["sources"]) == {"Debian", "PyPI", "Rust"}
    assert [(each["id"], each["package"]) for each in known["advisories"]] == [
        ("CVE-1", "d"),
        ("GHSA-1", "some-name"),
        ("RUSTSEC-1", "c"),
    ]
    assert known["advisories"][2] == {
        "id": "RUSTSEC-1",
        "ecosystem": "Rust",
        "package": "c",
        "safe": [">= 1.1"],
        "accepted": "not called",
    }
    found = {(component.name, advisory["id"]) for component, advisory in audit.findings(known["advisories"], parts)}
    assert found == {("some-name", "GHSA-1"), ("c", "RUSTSEC-1"), ("d", "CVE-1")}


def test_the_committed_list_says_origin_and_day_of_each_part() -> None:
    known = json.loads(audit.ADVISORIES.read_text("utf-8"))
    for label, source in known["sources"].items():
        assert label in audit.ECOSYSTEMS.values()
        assert datetime.date.fromisoformat(source["date"])
        assert source["from"]
    lines, _ = audit.report(known, components.pinned(), TODAY)
    assert not [line for line in lines if "VULNERABLE" in line], "`make audit` says what to do"
