"""The rules of this repository that a machine can check. A rule takes a path and a text, and returns what is wrong."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Callable, Iterable
from pathlib import PurePosixPath

NATIVE = {".h", ".cc", ".cpp", ".cu", ".cuh"}
SOURCES = NATIVE | {".py", ".ts", ".js", ".mjs", ".rs", ".proto", ".css", ".html", ".sh", ".cmake"}
MAX_SOURCE_LINES = 600
MAX_FILE_BYTES = 600_000
TOP_LEVEL = {
    ".ci",
    ".clang-format",
    ".devcontainer",
    ".dockerignore",
    ".github",
    ".gitignore",
    ".setup",
    "CHANGELOG.md",
    "CITATION.cff",
    "CMakeLists.txt",
    "CONTRIBUTING.md",
    "LICENSE",
    "Makefile",
    "README.md",
    "SECURITY.md",
    "clients",
    "docker",
    "docs",
    "examples",
    "proto",
    "server",
    "tests",
}

_PRIVATE = "tensormass._src"
_WITHOUT_PRIVATE_IMPORTS = (
    "clients/python/tensormass/_shared",
    "clients/python/tensormass_gateway",
    "clients/python/tensormass_tools",
)

_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*"([^"]+)"', re.MULTILINE)
_BUILD_INCLUDE = re.compile(r"-include \S*/(\S+\.h)")
_BARE_MARK = re.compile(r"\b(TODO|FIXME|XXX|HACK)\b")
_LINK = re.compile(r"\]\(([^)\s]+)(?: \"[^\"]*\")?\)")
# Absolute paths of somebody's machine. In a URL or a relative path, another character comes before the slash.
_MACHINE_PATH = re.compile(r"(?<![\w.$}\])>/-])/(?:home|root|Users|work|workspace|mnt|var/tmp)/[\w.]")


def server_folders(cmake_lists: str) -> list[str]:
    """Returns the folders under server/ in the order in which server/CMakeLists.txt builds them."""
    match = re.search(r"foreach\(folder ([^)]*)\)", cmake_lists)
    if match is None:
        raise ValueError("server/CMakeLists.txt has no foreach(folder ...)")
    return match.group(1).split()


def include_direction(path: PurePosixPath, text: str, folders: list[str]) -> list[str]:
    """A file under server/ may include files of its own folder and of the folders before it."""
    if path.parts[0] != "server" or len(path.parts) < 3 or path.suffix not in NATIVE:
        return []
    own = path.parts[1]
    if own not in folders:
        return [f"{path}: server/CMakeLists.txt does not list {own}; say there where it stands"]
    problems = []
    for included in _INCLUDE.findall(text):
        folder = included.split("/")[0]
        if folder in folders and folders.index(folder) > folders.index(own):
            problems.append(f"{path}: includes {included}, and {folder} comes after {own}")
    return problems


def bare_marks(path: PurePosixPath, text: str) -> list[str]:
    """Work left over belongs in an issue."""
    if path.suffix not in SOURCES:
        return []
    return [f"{path}:{line}: {mark}; do it or open an issue" for line, mark in _matches(_BARE_MARK, text)]


def machine_paths(path: PurePosixPath, text: str) -> list[str]:
    """Committed files must not name paths of one machine."""
    return [f"{path}:{line}: absolute path {found}..." for line, found in _matches(_MACHINE_PATH, text)]


def source_length(path: PurePosixPath, text: str) -> list[str]:
    """A source file has at most MAX_SOURCE_LINES lines; aim at half of that."""
    lines = text.count("\n")
    if path.suffix not in SOURCES or lines <= MAX_SOURCE_LINES:
        return []
    return [f"{path}: {lines} lines; the limit is {MAX_SOURCE_LINES}"]


def dead_links(path: PurePosixPath, text: str, exists: Callable[[PurePosixPath], bool]) -> list[str]:
    """A document links only to files and folders of the repository that exist. Addresses on the web are not checked."""
    if path.suffix != ".md":
        return []
    problems = []
    for match in _LINK.finditer(text):
        target = match.group(1).split("#")[0]
        if not target or "://" in target or target.startswith("mailto:"):
            continue
        if not exists(PurePosixPath(os.path.normpath(path.parent / target))):
            line = text.count("\n", 0, match.start()) + 1
            problems.append(f"{path}:{line}: links to {target}, which does not exist")
    return problems


def top_level(paths: Iterable[PurePosixPath]) -> list[str]:
    """The top level holds only the entries of TOP_LEVEL."""
    return [f"{name}: not expected at the top level" for name in sorted({path.parts[0] for path in paths} - TOP_LEVEL)]


def untested_folders(paths: Iterable[PurePosixPath], folders: list[str]) -> list[str]:
    """Tests mirror the source: a folder under server/ that has sources, not only headers, has tests of its name."""
    sources = {path.parts[:2] for path in paths if path.suffix in {".cpp", ".cu"}}
    return [
        f"server/{name}: tests/{name} has no tests of it"
        for name in folders
        if ("server", name) in sources and ("tests", name) not in sources
    ]


def orphans(sources: dict[PurePosixPath, str]) -> list[str]:
    """Finds dead files: C++ sources that no CMakeLists.txt above them names, and headers that nothing includes.

    `sources`: path and text of every C++ file and CMakeLists.txt.
    """
    included = {name for text in sources.values() for name in _INCLUDE.findall(text) + _BUILD_INCLUDE.findall(text)}
    endings = {"/" + name for name in included}
    lists = {path.parent: text for path, text in sources.items() if path.name == "CMakeLists.txt"}
    problems = []
    for path in sources:
        if path.suffix in {".h", ".cuh"}:
            if not any(f"/{path}".endswith(ending) for ending in endings):
                problems.append(f"{path}: nothing includes it")
        elif path.suffix in NATIVE and not any(path.name in lists.get(parent, "") for parent in path.parents):
            problems.append(f"{path}: no CMakeLists.txt builds it")
    return problems


def private_imports(path: PurePosixPath, text: str) -> list[str]:
    """Gateway and tools import what is public in the SDK, or what it shares with them on purpose.

    What is shared knows nothing of the private parts, so that these can change alone.
    """
    if path.suffix != ".py" or not any(folder in map(str, path.parents) for folder in _WITHOUT_PRIVATE_IMPORTS):
        return []
    problems = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        package = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
        modules = [f"{package}{alias.name}" for alias in node.names]
        problems += [
            f"{path}:{node.lineno}: imports {module}; take it from tensormass, or share it in tensormass._shared"
            for module in modules
            if f"{module}.".startswith(f"{_PRIVATE}.")
        ]
    return problems


def full_option_names(path: PurePosixPath, text: str) -> list[str]:
    """No command line takes an abbreviation: an option that is gone would be read as one that begins alike."""
    if path.suffix != ".py" or "ArgumentParser" not in text:
        return []
    problems = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or ast.unparse(node.func).rpartition(".")[2] != "ArgumentParser":
            continue
        given = {word.arg: ast.unparse(word.value) for word in node.keywords}
        if given.get("allow_abbrev") != "False":
            problems.append(f"{path}:{node.lineno}: ArgumentParser without allow_abbrev=False")
    return problems


def _matches(pattern: re.Pattern[str], text: str) -> list[tuple[int, str]]:
    return [(text.count("\n", 0, match.start()) + 1, match.group()) for match in pattern.finditer(text)]
