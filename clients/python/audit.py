"""Known vulnerabilities of everything that is pinned: `make audit`.

    python audit.py                                     compares the lock files with advisories.json, without network
    python audit.py --renew --osv FOLDER --rustsec FOLDER    writes advisories.json anew

advisories.json has the advisories about packages that we pin, and the day and origin of each list. To renew it, clone
the databases, which need no account, and name their folders:

    PyPI                https://github.com/pypa/advisory-database          --osv
    PyPI, npm           https://github.com/github/advisory-database        --osv
    Rust                https://github.com/rustsec/advisory-db             --rustsec
    Debian              by hand: the packages of the daemon's libraries

An advisory that does not concern us is accepted in advisories.json with its reason: `"accepted": "why"`. Renewing
keeps it.
"""

from __future__ import annotations

import argparse
import datetime
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import yaml
from packaging.version import InvalidVersion, Version

from components import ROOT, Component, linked, pinned

ADVISORIES = Path(__file__).with_name("advisories.json")
MAX_AGE_DAYS = 90
"""An older list is said to be old."""

ECOSYSTEMS = {"pypi": "PyPI", "npm": "npm", "cargo": "Rust", "deb": "Debian"}

Advisory = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--renew", action="store_true", help="write advisories.json anew")
    parser.add_argument("--osv", type=Path, action="append", default=[], help="folder with advisories in OSV's JSON")
    parser.add_argument("--rustsec", type=Path, help="clone of RustSec's database")
    parser.add_argument("--file", type=Path, default=ADVISORIES, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    known = json.loads(args.file.read_text("utf-8"))
    components = [*pinned(), *linked(ROOT / "build/bin/tensormassd")]
    if args.renew:
        known = renewed(known, components, args.osv, args.rustsec)
        args.file.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n")
    lines, failed = report(known, components, datetime.date.today())
    print("\n".join(lines))
    return 1 if failed else 0


def report(known: dict[str, Any], components: list[Component], today: datetime.date) -> tuple[list[str], bool]:
    """Returns what is known of the components, and whether one of them is vulnerable and not accepted."""
    lines, failed = [], False
    stale: list[str] = []
    for ecosystem, label in ECOSYSTEMS.items():
        count = sum(component.ecosystem == ecosystem for component in components)
        source = known["sources"].get(label)
        if source is None:
            if count:
                lines.append(f"audit: {label}: {count} packages were never compared; renew advisories.json (--renew)")
                stale.append(label)
            continue
        age = (today - datetime.date.fromisoformat(source["date"])).days
        old = f", {age} days old: renew advisories.json (--renew)" if age > MAX_AGE_DAYS else ""
        if old:
            stale.append(label)
        lines.append(f"audit: {label}: {count} packages, advisories of {source['date']}{old}; {source['from']}")
    for component, advisory in findings(known["advisories"], components):
        accepted = advisory.get("accepted", "")
        failed |= not accepted
        state = f"accepted: {accepted}" if accepted else "VULNERABLE"
        lines.append(f"audit: {component.name} {component.version}: {state}: https://osv.dev/{advisory['id']}")
    done = f"audit: done, but not for {', '.join(stale)}: too old or missing lists" if stale else "audit: done"
    lines.append("audit: something pinned is vulnerable; update it, or accept it with a reason" if failed else done)
    return lines, failed


def findings(advisories: Iterable[Advisory], components: Iterable[Component]) -> Iterator[tuple[Component, Advisory]]:
    """Yields each component with each advisory about its version."""
    by_name: dict[tuple[str, str], list[Component]] = {}
    for component in components:
        by_name.setdefault((ECOSYSTEMS[component.ecosystem], component.name), []).append(component)
    for advisory in advisories:
        for component in by_name.get((advisory["ecosystem"], advisory["package"]), []):
            if is_affected(component.version, advisory):
                yield component, advisory


def is_affected(version: str, advisory: Advisory) -> bool:
    """Says whether an advisory is about a version. One that cannot be compared counts, so that somebody looks."""
    if version in advisory.get("versions", []):
        return True
    try:
        # Debian's: [epoch:]upstream[-revision].
        own = Version(re.sub(r"^\d+:|-[^-]*$", "", version) if advisory["ecosystem"] == "Debian" else version)
        if "safe" in advisory:
            return not any(_satisfies(own, requirement) for requirement in advisory["safe"])
        return any(
            Version(begin or "0") <= own and (not end or own < Version(end))
            for begin, end in advisory.get("ranges", [])
        )
    except InvalidVersion:
        return True


def _satisfies(version: Version, requirement: str) -> bool:
    """Says whether a version meets a requirement as Cargo writes it: `>= 1.2, < 1.5`, `^1.2`."""
    for part in requirement.split(","):
        match = re.fullmatch(r"\s*(>=|<=|>|<|=|\^|~)?\s*(\S+)\s*", part)
        if match is None:
            raise InvalidVersion(part)
        operator, bound = match[1] or "^", Version(match[2])
        numbers = [int(number) for number in match[2].split("-")[0].split(".")]
        first = (
            next((at for at, number in enumerate(numbers) if number), len(numbers) - 1)
            if operator == "^"
            else min(1, len(numbers) - 1)
        )
        above = Version(".".join(map(str, [*numbers[:first], numbers[first] + 1])))
        meets = {
            ">=": version >= bound,
            "<=": version <= bound,
            ">": version > bound,
            "<": version < bound,
            "=": version == bound,
            "^": bound <= version < above,
            "~": bound <= version < above,
        }
        if not meets[operator]:
            return False
    return True


# --- renewing --------------------------------------------------------------------------------------------------------


def renewed(
    known: dict[str, Any], components: list[Component], osv: list[Path], rustsec: Path | None
) -> dict[str, Any]:
    """Returns the advisories of these folders about packages that we pin. What they lack stays as it was known."""
    names = {(ECOSYSTEMS[component.ecosystem], component.name) for component in components}
    sources, fresh = dict(known["sources"]), []
    for folder in osv:
        found = list(_read_osv(folder))
        for ecosystem in {advisory["ecosystem"] for advisory in found}:
            sources[ecosystem] = _origin(folder)
        fresh += found
    if rustsec is not None:
        fresh += _read_rustsec(rustsec)
        sources["Rust"] = _origin(rustsec)
    accepted = {(old["id"], old["package"]): old["accepted"] for old in known["advisories"] if "accepted" in old}
    mine = [advisory for advisory in fresh if (advisory["ecosystem"], advisory["package"]) in names]
    for advisory in mine:
        if reason := accepted.get((advisory["id"], advisory["package"])):
            advisory["accepted"] = reason
    of_fresh = {advisory["ecosystem"] for advisory in fresh}
    kept = [advisory for advisory in known["advisories"] if advisory["ecosystem"] not in of_fresh]
    unique = {(advisory["ecosystem"], advisory["package"], advisory["id"]): advisory for advisory in kept + mine}
    return {**known, "sources": sources, "advisories": [unique[key] for key in sorted(unique)]}


def _origin(folder: Path) -> dict[str, str]:
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", folder, *arguments], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    return {"date": git("log", "-1", "--format=%cs"), "from": f"{folder.name} at {git('log', '-1', '--format=%h')}"}


def _read_osv(folder: Path) -> Iterator[Advisory]:
    for path in sorted([*folder.rglob("*.json"), *folder.rglob("*.yaml")]):
        entry = (json.loads if path.suffix == ".json" else yaml.safe_load)(path.read_text("utf-8"))
        if not isinstance(entry, dict) or "affected" not in entry or "withdrawn" in entry:
            continue
        for affected in entry["affected"]:
            package = affected.get("package", {})
            ecosystem = str(package.get("ecosystem", "")).partition(":")[0]
            if ecosystem in ECOSYSTEMS.values():
                yield {
                    "id": entry["id"],
                    "ecosystem": ecosystem,
                    "package": _name(ecosystem, package["name"]),
                    "ranges": list(_ranges(affected)),
                    "versions": affected.get("versions", []) if not affected.get("ranges") else [],
                }


def _ranges(affected: dict[str, Any]) -> Iterator[list[str]]:
    for span in affected.get("ranges", []):
        if span.get("type") == "GIT":
            continue
        begin = None
        for event in span["events"]:
            if "introduced" in event:
                begin = event["introduced"]
            elif begin is not None:
                # `last_affected` is the last version that is vulnerable; the next one is not known.
                yield [begin, event.get("fixed") or event["last_affected"] + ".post0"]
                begin = None
        if begin is not None:
            yield [begin, ""]


def _read_rustsec(folder: Path) -> Iterator[Advisory]:
    for path in sorted((folder / "crates").rglob("RUSTSEC-*.md")):
        head = path.read_text("utf-8").partition("```toml\n")[2].partition("\n```")[0]
        entry = tomllib.loads(head)
        advisory, versions = entry["advisory"], entry.get("versions", {})
        if "withdrawn" in advisory or advisory.get("informational"):
            continue
        yield {
            "id": advisory["id"],
            "ecosystem": "Rust",
            "package": advisory["package"],
            "safe": [*versions.get("patched", []), *versions.get("unaffected", [])],
        }


def _name(ecosystem: str, name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower() if ecosystem == "PyPI" else name


if __name__ == "__main__":
    sys.exit(main())
