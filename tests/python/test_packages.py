"""The three Python packages: which may import which, no import circles, and only public names outside of the SDK."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tensormass as tm

ROOT = Path(__file__).resolve().parents[2]
CODE = ROOT / "clients" / "python"
#: Packages by layer: each may import from itself and from the layers before it.
LAYERS = ("tensormass", "tensormass_gateway", "tensormass_tools")
# `python -m tensormass` is the command; importing the SDK does not run it.
COMMAND = "tensormass.__main__"


def modules() -> dict[str, ast.Module]:
    """[module name]: its code, of all three packages but the generated protocol."""
    found = {}
    for layer in LAYERS:
        for file in sorted((CODE / layer).rglob("*.py")):
            parts = file.relative_to(CODE).with_suffix("").parts
            if parts[:2] != ("tensormass", "v1"):
                name = ".".join(parts).removesuffix(".__init__")
                found[name] = ast.parse(file.read_text("utf-8"))
    return found


def imported(code: ast.Module, known: set[str]) -> Iterator[str]:
    """The modules that `code` imports anywhere, in functions and for type checkers too."""
    for node in ast.walk(code):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                yield submodule if submodule in known else node.module or ""


def circle(graph: dict[str, set[str]]) -> list[str] | None:
    """The modules of a circle, the first of them again at its end."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return None


def test_no_module_imports_itself_through_others() -> None:
    code = modules()
    assert len(code) > 60
    assert circle({name: {to for to in imported(of, set(code)) if to in code} for name, of in code.items()}) is None


def test_a_circle_would_be_found() -> None:
    code = {"a.b": ast.parse("from a import c"), "a.c": ast.parse("def f():\n    import a.b")}
    assert circle({name: set(imported(of, set(code))) for name, of in code.items()}) is not None


def test_imports_name_their_module_in_full() -> None:
    for name, of in modules().items():
        assert not [node for node in ast.walk(of) if isinstance(node, ast.ImportFrom) and node.level > 0], name


def test_each_package_imports_only_from_the_layers_before_it() -> None:
    code = modules()
    for name, of in code.items():
        above = LAYERS[LAYERS.index(name.partition(".")[0]) + 1 :]
        wrong = [to for to in imported(of, set(code)) if to.partition(".")[0] in above]
        assert name == COMMAND or not wrong, f"{name} imports {wrong}"


def test_no_module_imports_one_that_is_not_there() -> None:
    # Python itself may not notice: an editable installation of another checkout finds modules that this one has lost.
    code = modules()
    tests = {file: ast.parse(file.read_text("utf-8")) for file in sorted((ROOT / "tests").rglob("*.py"))}
    for name, of in [*code.items(), *tests.items()]:
        ours = {to for to in imported(of, set(code)) if to.partition(".")[0] in LAYERS}
        assert {to for to in ours if not to.startswith("tensormass.v1")} <= set(code), name


def test_importing_the_sdk_loads_neither_gateway_nor_tools() -> None:
    check = "import sys, tensormass; print([m for m in sys.modules if m.startswith(('tensormass_', 'aiohttp'))])"
    ran = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=CODE)
    assert ran.stdout.strip() == "[]"


def test_the_sdk_offers_its_public_names_and_nothing_else() -> None:
    visible = {name for name in vars(tm) if not name.startswith("_")}
    assert visible - {"v1"} == set(tm.__all__)


def documents() -> list[Path]:
    files = [ROOT / "README.md", CODE / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").rglob("*.*")]
    return [file for file in files if file.suffix in (".md", ".py", ".ipynb")]


@pytest.mark.parametrize("file", documents(), ids=lambda file: str(file.relative_to(ROOT)))
def test_documents_and_examples_use_public_names_only(file: Path) -> None:
    text = file.read_text("utf-8")
    assert "tensormass._src" not in text
    assert "tensormass._shared" not in text
