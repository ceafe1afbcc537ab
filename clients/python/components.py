"""What a release is made of: a list of every package that is pinned or bundled, as CycloneDX JSON.

requirements.lock, docs/site/requirements.txt, toolchain.txt     pypi
clients/web/package-lock.json                                    npm
server/bus/zenoh/rust/Cargo.lock                                 cargo
shared libraries in the wheel                                    deb, of the machine that made it
"""

from __future__ import annotations

import base64
import json
import re
import subprocess
import tomllib
import uuid
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

ROOT = Path(__file__).resolve().parents[2]
PYTHON_LOCKS = ("clients/python/requirements.lock", "docs/site/requirements.txt", ".setup/toolchain.txt")
NPM_LOCK = "clients/web/package-lock.json"
CARGO_LOCK = "server/bus/zenoh/rust/Cargo.lock"


@dataclass(frozen=True, order=True)
class Component:
    """A package in one version."""

    ecosystem: str
    """pypi, npm, cargo or deb"""
    name: str
    version: str
    shipped: bool = True
    """Whether users get it; else it only builds or tests."""
    sha256: str = ""
    sha512: str = ""
    licence: str = ""

    @property
    def purl(self) -> str:
        """Returns the package URL, the name that databases of advisories know."""
        path = "/".join(quote(part, safe="") for part in self.name.split("/"))
        space = "debian/" if self.ecosystem == "deb" else ""
        return f"pkg:{self.ecosystem}/{space}{path}@{quote(self.version, safe='.')}"


def pinned(root: Path = ROOT) -> list[Component]:
    """Returns everything that a lock file of the checkout names."""
    found = {*_npm(root / NPM_LOCK), *_cargo(root / CARGO_LOCK)}
    for lock in PYTHON_LOCKS:
        found |= set(_python(root / lock, shipped=lock == PYTHON_LOCKS[0]))
    return sorted(found)


def bundled(wheel: Path) -> list[Component]:
    """Returns the Debian packages on this machine whose shared libraries are in a wheel."""
    if not zipfile.is_zipfile(wheel):
        return []
    with zipfile.ZipFile(wheel) as archive:
        names = {PurePosixPath(name).name for name in archive.namelist() if "/_bundle/lib/" in name}
    return sorted(set(_debian(sorted(name for name in names if ".so" in name))))


def linked(program: Path) -> list[Component]:
    """Returns the Debian packages on this machine that have the shared libraries of a program."""
    libraries = re.findall(r"=> \S*/(\S+)", _output("ldd", str(program)))
    return sorted(set(_debian(libraries)))


def bill_of_materials(version: str, time: str, components: Iterable[Component]) -> dict[str, Any]:
    """Returns a CycloneDX document. The same components give the same bytes.

    Args:
        version: of this project.
        time: of the commit, as ISO 8601.
    """
    listed = [_as_json(component) for component in sorted(components)]
    name = json.dumps([version, time, listed], sort_keys=True)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, name)}",
        "version": 1,
        "metadata": {
            "timestamp": time,
            "component": {
                "type": "application",
                "bom-ref": f"pkg:pypi/tensormass@{version}",
                "name": "tensormass",
                "version": version,
                "purl": f"pkg:pypi/tensormass@{version}",
                "licenses": [{"license": {"id": "Apache-2.0"}}],
            },
        },
        "components": listed,
    }


def _as_json(component: Component) -> dict[str, Any]:
    out: dict[str, Any] = {
        "type": "library",
        "bom-ref": component.purl,
        "name": component.name,
        "version": component.version,
        "purl": component.purl,
        "scope": "required" if component.shipped else "excluded",
    }
    sums = {"SHA-256": component.sha256, "SHA-512": component.sha512}
    if any(sums.values()):
        out["hashes"] = [{"alg": kind, "content": value} for kind, value in sums.items() if value]
    if component.licence:
        out["licenses"] = [{"expression": component.licence}]
    return out


def _python(lock: Path, *, shipped: bool) -> Iterator[Component]:
    pattern = r"^([A-Za-z0-9_.-]+)(?:\[[^]]*\])?==(\S+)"
    for name, version in re.findall(pattern, lock.read_text("utf-8"), re.MULTILINE):
        yield Component("pypi", re.sub(r"[-_.]+", "-", name).lower(), version, shipped)


def _npm(lock: Path) -> Iterator[Component]:
    for path, package in json.loads(lock.read_text("utf-8"))["packages"].items():
        if not path:
            continue  # the viewer itself
        kind, _, value = str(package.get("integrity", "")).partition("-")
        sha512 = base64.b64decode(value).hex() if kind == "sha512" else ""
        name = package.get("name") or path.rpartition("node_modules/")[2]
        shipped = not (package.get("dev") or package.get("devOptional"))
        yield Component(
            "npm", name, package["version"], shipped, sha512=sha512, licence=str(package.get("license", ""))
        )


def _cargo(lock: Path) -> Iterator[Component]:
    for package in tomllib.loads(lock.read_text("utf-8"))["package"]:
        # Our own crate has no source; neither has a published one with our changes (third_party/).
        if "source" in package or not package["name"].startswith("tensormass"):
            yield Component("cargo", package["name"], package["version"], sha256=package.get("checksum", ""))


def _debian(libraries: list[str]) -> Iterator[Component]:
    for library in libraries:
        owner = _output("dpkg-query", "--search", f"*/{library}").partition(":")[0]
        if owner:
            version = _output("dpkg-query", "--show", "--showformat", "${Version}\n", owner).partition("\n")[0]
            yield Component("deb", owner, version)


def _output(*command: str) -> str:
    """Returns what a command says; nothing if it fails or is not there, as on another system than Debian."""
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""
