"""Collects the licences of what a wheel of make_wheel.py contains beside our own code.

| part | text from |
|---|---|
| shared libraries, headers compiled in | `copyright` of their Debian packages |
| CUDA runtime, linked statically | its wheel in .venv, or the CUDA toolkit |
| Rust crates of zenoh's bridge, linked statically | licence files of each crate |
| packages of the viewer | licence files in node_modules |
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

# Debian packages that give only headers. No library leads to them.
HEADERS = ("cppzmq-dev", "libboost1.74-dev", "libcli11-dev", "libeigen3-dev", "libexpected-dev", "nlohmann-json3-dev")
_LICENCE_FILE = re.compile(r"(?i)(licen[cs]e|copying|copyright|notice|unlicense)")
_COMMON = Path("/usr/share/common-licenses")
_DOCS = Path("/usr/share/doc")


@dataclass(frozen=True)
class Part:
    name: str
    #: Where it comes from, with its version.
    origin: str
    text: str


def third_party_notices(root: Path, libraries: Iterable[Path]) -> str:
    """Returns the licences as one text, each once, with the parts under it.

    Raises:
        FileNotFoundError: a part has no licence text on this machine.
    """
    parts = [*debian_parts(libraries), *rust_parts(root), *web_parts(root), *cuda_parts()]
    under: dict[str, list[str]] = {}
    for part in parts:
        if not part.text:
            raise FileNotFoundError(f"no licence text of {part.name} ({part.origin})")
        under.setdefault(part.text.strip(), []).append(f"{part.name} ({part.origin})")
    head = (
        "This wheel contains the following software of others. The shared libraries in tensormass/_bundle/lib are\n"
        "those of the Debian packages named below; only their search path was changed. They can be replaced there by\n"
        "others. Their sources are Debian's source packages of the same version.\n"
    )
    line = "=" * 100
    texts = [f"{line}\n" + "\n".join(sorted(set(names))) + f"\n{line}\n\n{text}\n" for text, names in under.items()]
    common = sorted({name for text in texts for name in re.findall(rf"{_COMMON}/([\w.+-]*\w)", text)})
    texts += [f"{line}\n{_COMMON / name}\n{line}\n\n{(_COMMON / name).read_text()}\n" for name in common]
    return "\n".join([head, *texts])


def debian_parts(libraries: Iterable[Path]) -> Iterator[Part]:
    """Finds the package of each library. Libraries of the C library are left out: they are not copied."""
    packages = {package for library in libraries if (package := debian_package(library)) != "libc6"}
    for package in sorted(packages | set(HEADERS)):
        version = output_of(["dpkg-query", "-W", "-f=${source:Package} ${source:Version}", package])
        text = (_DOCS / package / "copyright").read_text(errors="replace")
        yield Part(package, f"Debian source package {version}", text)


def debian_package(library: Path) -> str:
    """Returns the package of a file. With a merged /usr, dpkg may know it by the path without /usr."""
    real = library.resolve()
    for path in (real, Path("/") / real.relative_to("/usr") if real.is_relative_to("/usr") else real):
        found = subprocess.run(["dpkg-query", "-S", path], capture_output=True, text=True)
        if found.returncode == 0:
            return found.stdout.partition(":")[0]
    raise FileNotFoundError(f"{library} is of no Debian package, so its licence is not known")


def rust_parts(root: Path) -> Iterator[Part]:
    """Crates that are linked: what the bridge needs on this platform, without build scripts and procedural macros."""
    command = ["cargo", "metadata", "--offline", "--locked", "--format-version=1"]
    command += [
        "--filter-platform=x86_64-unknown-linux-gnu",
        f"--manifest-path={root}/server/bus/zenoh/rust/Cargo.toml",
    ]
    metadata = json.loads(output_of(command))
    crates = {crate["id"]: crate for crate in metadata["packages"]}
    needs = {
        node["id"]: [of["pkg"] for of in node["deps"] if any(kind["kind"] is None for kind in of["dep_kinds"])]
        for node in metadata["resolve"]["nodes"]
    }
    linked: set[str] = set()
    waiting = [metadata["resolve"]["root"]]
    while waiting:
        crate = waiting.pop()
        macro = any("proc-macro" in target["kind"] for target in crates[crate]["targets"])
        if crate not in linked and not macro:
            linked.add(crate)
            waiting += needs[crate]
    for crate in sorted(linked - {metadata["resolve"]["root"]}):
        about = crates[crate]
        texts = licence_texts(Path(about["manifest_path"]).parent)
        # Some crates name an SPDX licence and carry no text. The text itself is in another crate.
        stated = f"SPDX licence {about['license']}; authors: {', '.join(about['authors']) or 'not named'}"
        for text in texts or [stated]:
            yield Part(about["name"], f"Rust crate {about['version']}, {about['license']}", text)
    rust = output_of(["rustc", "--version"]).strip()
    sysroot = Path(output_of(["rustc", "--print", "sysroot"]).strip())
    folder = sysroot / "share/doc/rust/licenses"
    own = [folder / "MIT.txt", folder / "Apache-2.0.txt"] if folder.is_dir() else [_DOCS / "rustc-web/copyright"]
    for file in own:
        yield Part("Rust standard library", rust, file.read_text(errors="replace"))


def web_parts(root: Path) -> Iterator[Part]:
    modules = root / "clients/web/node_modules"
    for name in json.loads((root / "clients/web/package.json").read_text())["dependencies"]:
        about = json.loads((modules / name / "package.json").read_text())
        texts = licence_texts(modules / name)
        for text in texts or [f"SPDX licence {about['license']}; authors: {about.get('author', 'not named')}"]:
            yield Part(name, f"npm package {about['version']}, {about['license']}", text)


def cuda_parts() -> Iterator[Part]:
    """Runtime and CCCL (templates compiled in) of the CUDA compiler that Makefile and set-up chose."""
    if os.environ.get("CUDA") == "OFF":
        return
    toolkit = Path(os.environ["CUDACXX"]).resolve().parents[1]
    if (toolkit / "EULA.txt").is_file():
        yield Part("CUDA runtime, CCCL", f"CUDA toolkit {toolkit.name}", (toolkit / "EULA.txt").read_text())
        return
    for package in ("nvidia_cuda_runtime", "nvidia_cuda_cccl"):
        about = next(toolkit.parents[1].glob(f"{package}-*.dist-info"), None)  # toolkit: site-packages/nvidia/cu13
        origin = f"wheel {about.name}" if about else f"neither EULA.txt nor a wheel for {toolkit}"
        yield Part(package, origin, "".join(licence_texts(about / "licenses")) if about else "")


def licence_texts(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    files = sorted(path for path in folder.iterdir() if path.is_file() and _LICENCE_FILE.match(path.name))
    # One crate has an empty file.
    return [text for path in files if (text := path.read_text(errors="replace").strip())]


def output_of(command: list[str]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
