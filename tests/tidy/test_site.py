"""The documentation site has a place for every page and every name. `make docs` checks links and descriptions."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "docs" / "site"


def literal(path: Path, name: str) -> object:
    """Returns what a module assigns to a name, without importing the module."""
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and any(isinstance(to, ast.Name) and to.id == name for to in node.targets):
            return ast.literal_eval(node.value)
    raise AssertionError(f"{path} assigns nothing to {name}")


def test_the_reference_describes_every_name_of_the_sdk() -> None:
    exported = literal(ROOT / "clients/python/tensormass/__init__.py", "__all__")
    assert isinstance(exported, list)
    page = (SITE / "python.rst").read_text("utf-8")
    described = re.findall(r"^\.\. (?:auto\w+|py:(?:data|type)):: (\w+)$", page, re.MULTILINE)
    assert sorted(described) == sorted(exported)


def test_the_table_of_contents_has_every_page() -> None:
    contents = literal(SITE / "front_page.py", "CONTENTS")
    assert isinstance(contents, dict)
    listed = {entry.rpartition("<")[2].rstrip(">") for entries in contents.values() for entry in entries}
    pages = {f"docs/{path.stem}" for path in (ROOT / "docs").glob("*.md")}
    pages |= {path.stem for path in ROOT.glob("*.md")} - {"README"}
    assert pages <= listed
    missing = [name for name in listed if not any((ROOT / f"{name}{end}").is_file() for end in (".md", ".rst"))]
    assert missing == []


@pytest.mark.parametrize("directive", ["doxygenclass", "doxygenstruct"])
def test_the_reference_names_types_that_the_haptic_client_has(directive: str) -> None:
    headers = "".join(path.read_text("utf-8") for path in (ROOT / "clients/haptic").glob("*.h"))
    names = re.findall(rf"^\.\. {directive}:: tensormass::haptic::(\w+)$", (SITE / "haptic.rst").read_text(), re.M)
    assert names
    kind = directive.removeprefix("doxygen")
    assert [name for name in names if not re.search(rf"^{kind} {name}\b", headers, re.M)] == []
