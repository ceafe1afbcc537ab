"""Each rule refuses what it is made for, and accepts the rest."""

from __future__ import annotations

from pathlib import PurePosixPath as Path

import rules


def test_include_direction() -> None:
    folders = rules.server_folders("foreach(folder core mesh world)\n")

    def check(path: str, text: str) -> list[str]:
        return rules.include_direction(Path(path), text, folders)

    assert check("server/mesh/a.h", '#include "mesh/b.h"\n#include "core/result.h"\n#include <vector>\n') == []
    assert check("server/mesh/a.h", '#include "world/b.h"\n') == [
        "server/mesh/a.h: includes world/b.h, and world comes after mesh"
    ]
    assert len(check("server/newcomer/a.h", "")) == 1
    assert check("clients/haptic/a.h", '#include "daemon/b.h"\n') == []


def test_bare_marks() -> None:
    mark = "TO" + "DO"
    assert rules.bare_marks(Path("a.cpp"), f"int a;\n// {mark}: more\n") == [f"a.cpp:2: {mark}; do it or open an issue"]
    assert rules.bare_marks(Path("a.cpp"), "int todo_count;\n") == []
    assert rules.bare_marks(Path("a.md"), f"{mark}\n") == []


def test_full_option_names() -> None:
    text = "import argparse\nparser = argparse.ArgumentParser(prog='a'{})\nparser.add_argument('--a')\n"
    assert rules.full_option_names(Path("a.py"), text.format(", allow_abbrev=False")) == []
    assert rules.full_option_names(Path("a.py"), text.format("")) == [
        "a.py:2: ArgumentParser without allow_abbrev=False"
    ]
    assert len(rules.full_option_names(Path("a.py"), text.format(", allow_abbrev=True"))) == 1
    assert rules.full_option_names(Path("a.md"), text.format("")) == []


def test_private_imports() -> None:
    tool = Path("clients/python/tensormass_tools/trade/a.py")
    for text in (
        "import tensormass._src.meshes",
        "from tensormass._src import meshes",
        "from tensormass import _src",
        "def f():\n    from tensormass._src.meshes import VolumeMesh",
    ):
        (problem,) = rules.private_imports(tool, text)
        assert "imports tensormass._src" in problem
    assert len(rules.private_imports(tool, "from tensormass._src.meshes import ElementBlock, VolumeMesh")) == 2
    allowed = "import tensormass as tm\nfrom tensormass import Scene\nfrom tensormass._shared.names import as_name\n"
    assert rules.private_imports(tool, allowed) == []
    private = "from tensormass._src import meshes"
    assert len(rules.private_imports(Path("clients/python/tensormass_gateway/a.py"), private)) == 1
    assert len(rules.private_imports(Path("clients/python/tensormass/_shared/a.py"), private)) == 1
    assert rules.private_imports(Path("clients/python/tensormass/_src/a.py"), private) == []
    assert rules.private_imports(Path("tests/python/a.py"), private) == []


def test_machine_paths() -> None:
    home = "/ho" + "me/someone/x"
    assert len(rules.machine_paths(Path("a.md"), f"see {home}\n")) == 1
    assert len(rules.machine_paths(Path("a.py"), f'open("{home}")\n')) == 1
    assert rules.machine_paths(Path("a.md"), f"https://example.org{home} and docs{home}\n") == []


def test_source_length() -> None:
    assert rules.source_length(Path("a.py"), "x\n" * rules.MAX_SOURCE_LINES) == []
    assert len(rules.source_length(Path("a.py"), "x\n" * (rules.MAX_SOURCE_LINES + 1))) == 1
    assert rules.source_length(Path("package-lock.json"), "x\n" * 5000) == []


def test_dead_links() -> None:
    text = "# A\n[a](../server/a.h) [b](b.md#part) [c](#part) [d](https://example.org/x) ![e](images)\n"
    present = {Path("server/a.h"), Path("docs/b.md"), Path("docs/images")}
    assert rules.dead_links(Path("docs/a.md"), text, present.__contains__) == []
    assert rules.dead_links(Path("docs/a.md"), text, (present - {Path("docs/b.md")}).__contains__) == [
        "docs/a.md:2: links to b.md, which does not exist"
    ]
    assert rules.dead_links(Path("a.py"), text, set().__contains__) == []


def test_top_level() -> None:
    assert rules.top_level([Path("README.md"), Path("server/core/result.h")]) == []
    assert rules.top_level([Path("notes.txt")]) == ["notes.txt: not expected at the top level"]


def test_untested_folders() -> None:
    paths = [
        Path("server/core/a.h"),
        Path("server/mesh/a.cpp"),
        Path("server/bus/zenoh/a.cpp"),
        Path("tests/bus/b.cpp"),
    ]
    assert rules.untested_folders(paths, ["core", "mesh", "bus"]) == ["server/mesh: tests/mesh has no tests of it"]


def test_orphans() -> None:
    sources = {
        Path("server/CMakeLists.txt"): "",
        Path("server/mesh/CMakeLists.txt"): "add_library(m a.cpp)",
        Path("server/mesh/a.cpp"): '#include "mesh/a.h"',
        Path("server/mesh/a.h"): "",
    }
    assert rules.orphans(sources) == []
    assert rules.orphans(sources | {Path("server/mesh/b.cpp"): ""}) == [
        "server/mesh/b.cpp: no CMakeLists.txt builds it"
    ]
    unused = {Path("server/mesh/aa.h"): ""}
    assert rules.orphans(sources | unused) == ["server/mesh/aa.h: nothing includes it"]
    built_with = {Path("CMakeLists.txt"): "target_compile_options(m PRIVATE -include ${SOURCES}/aa.h)"}
    assert rules.orphans(sources | unused | built_with) == []
