"""Runs the programs of examples/ as their users do, and checks what they print and write.

The C++ haptic client has its test in tests/haptic/test_haptic_example.py.
"""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import tensormass as tm
from tensormass._shared import processes

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
MAX_LINES = 70  # without docstring and empty lines


@pytest.fixture(scope="module")
def daemon() -> None:
    """Skips the test if the daemon is not built. Tests without `demo` name it because their program starts one."""
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def demo(daemon: None) -> Iterator[tuple[tm.Server, tm.SceneHandle]]:
    """The demo scene in real time, on a daemon at free ports."""
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server, server.load("demo")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python code of the protocol as protoc makes it. It hides the SDK from whoever has this folder on PYTHONPATH."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "tensormass").mkdir()
    (folder / "tensormass" / "__init__.py").touch()
    # An editable installation of the SDK would still find its modules.
    (folder / "tensormass" / "_src.py").write_text("raise ImportError('the SDK')", "utf-8")
    protos = [f"tensormass/v1/{name}.proto" for name in ("edit", "finding", "guard", "scene", "solver", "stream")]
    run("-m", "grpc_tools.protoc", "-I", ROOT / "proto", f"--python_out={folder}", *protos)
    return folder


def run(*words: str | Path, folder: Path | None = None, **variables: str | Path) -> str:
    """Runs Python with these arguments in `folder` and returns what it printed. Fails if it fails, and if a scene has a
    finding (tm.FindingWarning, a UserWarning)."""
    given = {name: str(value) for name, value in variables.items()}
    environment = {**os.environ, "MPLBACKEND": "agg", "PYTHONWARNINGS": "error::UserWarning", **given}
    command = [sys.executable, *(str(word) for word in words)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(pattern: str, text: str) -> list[float]:
    """Returns the groups of a pattern that must match the whole text."""
    match = re.fullmatch(pattern, text)
    assert match is not None, text
    return [float(group) for group in match.groups()]


def cells(notebook: Path) -> list[dict[str, Any]]:
    return json.loads(notebook.read_text("utf-8"))["cells"]


def test_force_grows_with_depth(daemon: None, tmp_path: Path) -> None:
    lines = run(EXAMPLES / "force_depth.py", folder=tmp_path).splitlines()
    assert lines.pop() == "wrote force_depth.png"
    assert (tmp_path / "force_depth.png").read_bytes().startswith(b"\x89PNG")
    points = [numbers(r" *(\S+) mm +(\S+) N", line) for line in lines]
    assert all(force_n == 0.0 for depth_mm, force_n in points if depth_mm < 0.0)
    pressed_n = [force_n for depth_mm, force_n in points if depth_mm > 0.0]
    assert len(pressed_n) >= 6
    assert pressed_n == sorted(pressed_n)
    assert 0.5 < pressed_n[-1] < 3.0


def test_the_numpy_mesh_bends_as_a_beam(daemon: None) -> None:
    output = run(EXAMPLES / "numpy_mesh.py")
    pattern = r"1025 nodes, 640 hexahedra\nthe free end sinks by (\S+) mm; beam theory says (\S+) mm\n"
    computed_mm, theory_mm = numbers(pattern, output)
    assert theory_mm == pytest.approx(3.12, abs=0.005)
    assert computed_mm == pytest.approx(theory_mm, rel=0.02)


def test_the_skin_gets_its_picture(demo: tuple[tm.Server, tm.SceneHandle]) -> None:
    server, _ = demo
    pattern = r"loaded textured: ([\d,]+) triangles, a picture of [\d,]+ bytes\n"
    match = re.fullmatch(pattern, run(EXAMPLES / "textured_skin.py", server.address))
    assert match is not None
    textured = server.scene("textured")
    (liver,) = textured.topology().bodies
    triangle_count = int(match.group(1).replace(",", ""))
    assert len(liver.triangles) == 12 * triangle_count
    assert len(liver.texture_coordinates) == 24 * triangle_count
    assert liver.texture_image.startswith(b"\x89PNG")
    textured.unload()


@pytest.mark.alone
def test_the_zeromq_client_feels_the_liver_and_lifts_off(
    demo: tuple[tm.Server, tm.SceneHandle], generated: Path
) -> None:
    server, scene = demo
    version = server.version()
    endpoints = [version.zeromq_publish_endpoint, version.zeromq_pose_endpoint]
    output = run(EXAMPLES / "zeromq_client.py", *endpoints, "demo", "probe", PYTHONPATH=generated)
    pattern = r"(\d+) forces, the largest (\S+) N\nfrom pose to force: (\S+) ms \(median\)\n"
    count, force_n, delay_ms = numbers(pattern, output)
    assert count >= 5, "3 s at 60 Hz give 180 on a machine with nothing else to do"
    assert 0.3 < force_n < 3.0
    assert 0.0 < delay_ms < 1000.0
    check_lifted(scene)


@pytest.mark.alone
def test_the_zenoh_client_sees_the_liver_move_and_lifts_off(
    demo: tuple[tm.Server, tm.SceneHandle], generated: Path
) -> None:
    server, scene = demo
    locator = server.version().zenoh_locator
    output = run(EXAMPLES / "zenoh_client.py", locator, "demo", "probe", PYTHONPATH=generated)
    pattern = r"(\d+) frames of (\d+) vertices, (\d+) skipped\nliver moved by (\S+) mm; largest force (\S+) N\n"
    count, vertex_count, skipped, moved_mm, force_n = numbers(pattern, output)
    assert count >= 5, "3 s at 60 Hz give 180 on a machine with nothing else to do"
    assert count + skipped <= 200
    assert vertex_count == scene.topology().bodies[0].vertex_count
    assert 3.0 < moved_mm < 40.0
    assert 0.3 < force_n < 3.0
    check_lifted(scene)


def test_clients_show_their_keys(daemon: None, generated: Path, tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="needs the extra `keys`")
    from tensormass_tools.keys.folder import KeyFolder

    folder = KeyFolder(tmp_path / "keys")
    folder.init([], 30)
    keys = folder.add("console", "operator")
    with tm.launch(backend="cpu", cpu_threads=1, options=("--keys", str(folder.path)), keys=keys) as server:
        scene = server.load("demo")
        version = server.version()
        assert run(EXAMPLES / "textured_skin.py", server.address, keys.path).startswith("loaded textured")
        server.scene("textured").unload()
        endpoints = [version.zeromq_publish_endpoint, version.zeromq_pose_endpoint]
        zeromq = run(EXAMPLES / "zeromq_client.py", *endpoints, "demo", "probe", keys.path, PYTHONPATH=generated)
        assert " forces, the largest " in zeromq
        check_lifted(scene)
        locator = version.zenoh_locator
        seen = run(EXAMPLES / "zenoh_client.py", locator, "demo", "probe", keys.path, PYTHONPATH=generated)
        assert "liver moved by" in seen
        check_lifted(scene)


def test_the_zenoh_client_says_what_is_missing(demo: tuple[tm.Server, tm.SceneHandle]) -> None:
    locator = demo[0].version().zenoh_locator
    for words, said in {
        (locator, "demo", "scalpel"): "scene demo has no tool scalpel; it has probe\n",
        ("tcp/127.0.0.1:1", "demo", "probe"): "no daemon at tcp/127.0.0.1:1; `tensormass status` prints its locator",
    }.items():
        command = [sys.executable, str(EXAMPLES / "zenoh_client.py"), *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 1
        assert said in done.stderr
        assert "Traceback" not in done.stderr


def check_lifted(scene: tm.SceneHandle) -> None:
    """The tool comes back to the height of the demo's start, although the client is gone."""
    with scene.feedbacks("probe") as feedbacks:
        for _ in range(300):
            tool = feedbacks.receive(5.0)
            if tool.position_m.z == pytest.approx(0.085, abs=0.001):
                return
    pytest.fail(f"the tool stays at {tool.position_m.z} m")


def test_the_notebook_shows_the_force_relax(daemon: None, tmp_path: Path) -> None:
    # Runs the code cells as one program, without the packages of Jupyter.
    code = ["".join(cell["source"]) for cell in cells(EXAMPLES / "relaxation.ipynb") if cell["cell_type"] == "code"]
    program = tmp_path / "relaxation.py"
    program.write_text("\n".join(code), "utf-8")
    pattern = r"the force relaxes from (\S+) N to (\S+) N: (\d+)%\n"
    peak_n, rest_n, percent = numbers(pattern, run(program))
    assert peak_n > rest_n > 0.3
    assert 40 < percent < 65, "half of the stress relaxes; the peak has some inertia and some relaxation in it"


def test_notebooks_have_no_outputs() -> None:
    for file in EXAMPLES.rglob("*.ipynb"):
        for cell in cells(file):
            assert cell.get("outputs", []) == [], file
            assert cell.get("execution_count") is None, file


def test_every_example_is_tested_listed_and_short() -> None:
    files = [file for file in EXAMPLES.rglob("*") if file.suffix in {".py", ".ipynb", ".cpp"}]
    tests = "".join(file.read_text("utf-8") for file in (ROOT / "tests").glob("*/test_*example*.py"))
    listed = (EXAMPLES / "README.md").read_text("utf-8")
    for file in files:
        name = file.stem if file.suffix == ".cpp" else file.name
        assert f'"{name}"' in tests, f"no test runs {file}"
        assert f"]({file.relative_to(EXAMPLES)})" in listed, f"examples/README.md does not list {file}"
        if file.suffix == ".py":
            text = file.read_text("utf-8")
            docstring = ast.get_docstring(ast.parse(text)) or ""
            assert all(word in docstring for word in ("Shows:", "Needs:", "Run:")), file
            lines = [line for line in text.replace(docstring, "").splitlines() if line.strip()]
            assert len(lines) <= MAX_LINES, f"{file}: {len(lines)} lines of code"
