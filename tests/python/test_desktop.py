"""The desktop window: shapes of tools, colours, what it follows, and its picture without a screen."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from service_parts import BLOCK, DEADLINE_S, block
from surfaces import attached, frame_at, two_balls

import tensormass as tm
from tensormass._shared.surfaces import Surface
from tensormass.v1 import changes_pb2, scene_pb2, stream_pb2
from tensormass_tools.cli import main

pv = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'tensormass[desktop]'")

from tensormass_tools.desktop import window  # noqa: E402
from tensormass_tools.desktop.picture import Picture  # noqa: E402
from tensormass_tools.desktop.shapes import pose_matrix, tool_mesh  # noqa: E402

SCENE_RADIUS_M = 0.1
# VTK draws with EGL here, also after a test has set DISPLAY.
OFF_SCREEN = {"VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow"}
PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=[64, 64])
plotter.add_mesh(pyvista.Sphere(), color="red")
assert plotter.screenshot().std() > 1
"""


@pytest.fixture(scope="module")
def can_draw() -> None:
    """Skips where VTK cannot draw without a screen. It may crash, so another process tries."""
    command = [sys.executable, "-c", PROBE]
    try:
        tried = subprocess.run(command, env=os.environ | OFF_SCREEN, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        pytest.skip("VTK draws too slowly here")
    if tried.returncode != 0:
        pytest.skip(f"VTK cannot draw off screen here: {tried.stderr.strip().splitlines()[-1:]}")


@pytest.fixture
def off_screen(can_draw: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", OFF_SCREEN["VTK_DEFAULT_OPENGL_WINDOW"])
    monkeypatch.delenv("DISPLAY", raising=False)


def shape(radius_m: float = 0.01, **tool: Any) -> stream_pb2.ToolShape:  # noqa: ANN401
    offset = scene_pb2.Vector3(z=0.5)
    return stream_pb2.ToolShape(name="tool", radius_m=radius_m, tip_offset_m=offset, tool=scene_pb2.Tool(**tool))


def bounds(of: stream_pb2.ToolShape, joints: tuple[float, ...] = ()) -> Any:  # noqa: ANN401
    """Returns the lower and upper corner of a tool, moved back by the offset of its tip."""
    found = np.array(tool_mesh(of, joints, SCENE_RADIUS_M).bounds).reshape(3, 2).T - [0, 0, 0.5]
    return pytest.approx(found.ravel(), abs=3e-4)


def test_tools_have_their_sizes() -> None:
    r = 0.01
    shaft = 1.1 * SCENE_RADIUS_M
    assert bounds(shape(spherical_probe=scene_pb2.SphericalProbe())) == [-r, -r, -r, r, r, shaft]
    assert bounds(shape()) == [-r, -r, -r, r, r, shaft], "an unknown kind is a sphere"
    assert bounds(shape(capsule=scene_pb2.Capsule(length_m=0.2))) == [-r, -r, -r, r, r, 0.2 + r]
    retractor = scene_pb2.Retractor(blade_length_m=0.05, shaft_length_m=0.2)
    assert bounds(shape(retractor=retractor)) == [-r, -r, -r, 0.05 + r, r, 0.2 + r]
    box = scene_pb2.BoxSolid(size_x_m=0.1, size_y_m=0.2, size_z_m=0.3)
    assert bounds(shape(box=box)) == [-0.05, -0.1, -0.15, 0.05, 0.1, 0.15]
    side = 2.5 * SCENE_RADIUS_M
    assert bounds(shape(plane=scene_pb2.Plane())) == [-side, -side, 0, side, side, 0]


def test_the_blades_of_scissors_open() -> None:
    scissors = shape(scissors=scene_pb2.Scissors(blade_length_m=0.05, edge_offset_m=0.002))
    shut, opened = (tool_mesh(scissors, joints, SCENE_RADIUS_M).bounds for joints in ([0.0], [1.0]))
    assert opened[1] - shut[1] == pytest.approx(0.05 * np.sin(0.5), rel=0.05)


def test_the_jaws_of_a_grasper_open() -> None:
    grasper = shape(0.002, grasper=scene_pb2.Grasper(jaw_length_m=0.03))
    closed, opened = (tool_mesh(grasper, joints, SCENE_RADIUS_M).bounds for joints in ([0.0], [1.0]))
    assert closed[1] == pytest.approx(0.002, abs=1e-4)
    assert opened[1] == pytest.approx(0.03 * np.sin(0.5) + 0.002, abs=3e-4)
    assert opened[1] == pytest.approx(-opened[0])


def test_a_mesh_as_a_tool_is_scaled_and_checked() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f8")
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u4")
    packed = scene_pb2.PackedTriangles(vertex_positions=points.tobytes(), triangles=triangles.tobytes())
    solid = scene_pb2.MeshSolid(surface=scene_pb2.Skin(packed=packed), scale=0.02)
    assert bounds(shape(mesh=solid)) == [0, 0, 0, 0.02, 0.02, 0.02]
    packed.triangles = np.array([[0, 1, 4]], "<u4").tobytes()
    solid.surface.packed.CopyFrom(packed)
    with pytest.raises(tm.InternalError, match="tool 'tool': a triangle names vertex 4, but there are 4"):
        tool_mesh(shape(mesh=solid), (), SCENE_RADIUS_M)


def test_a_pose_turns_and_moves() -> None:
    turned = pose_matrix(np.array([1.0, 2, 3]), np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
    np.testing.assert_allclose(turned @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)  # a quarter turn about z


def frame(step: int, height_m: float, force_n: float = 0.0) -> tm.Frame:
    """A square of 0.1 m, lifted, with a probe."""
    topology = stream_pb2.Topology(
        scene="square",
        version=1,
        bodies=[
            stream_pb2.BodySurface(
                name="square", vertex_count=4, triangles=np.array([[0, 1, 2], [0, 2, 3]], "<u4").tobytes()
            )
        ],
        tools=[stream_pb2.ToolShape(name="tool", radius_m=0.005)],
    )
    points = np.array([[0, 0, height_m], [0.1, 0, height_m], [0.1, 0.1, height_m], [0, 0.1, height_m]], "<f4")
    feedback = stream_pb2.ToolFeedback(
        tool="tool", force_n=scene_pb2.Vector3(z=force_n), orientation=scene_pb2.Quaternion(w=1)
    )
    message = stream_pb2.Frame(topology_version=1, step=step, positions=points.tobytes(), tools=[feedback])
    return tm.Frame.from_message(message, topology)


@pytest.fixture
def plotter(off_screen: None) -> Iterator[Any]:
    plotter = pv.Plotter(off_screen=True, window_size=[320, 240])
    yield plotter
    plotter.close()


def amber(pixels: Any) -> int:  # noqa: ANN401
    """Counts the pixels that have the colour of the arrow."""
    red, green, blue = pixels[..., 0].astype(int), pixels[..., 1].astype(int), pixels[..., 2].astype(int)
    return int(((red > 120) & (green > 80) & (green < red) & (blue < red / 4)).sum())


def test_displacement_counts_from_rest(plotter: Any) -> None:  # noqa: ANN401
    rest_m = frame(0, 0.0).positions
    picture = Picture(plotter, frame(1, 0.002), rest_m)
    assert picture.largest_displacement_m == pytest.approx(0.002)
    picture.update(frame(2, 0.004))
    picture.update(frame(0, 0.003))  # a reset
    assert picture.largest_displacement_m == pytest.approx(0.003)


def test_without_rest_displacement_counts_from_the_first_frame_and_from_a_reset(plotter: Any) -> None:  # noqa: ANN401
    picture = Picture(plotter, frame(5, 0.002), None)
    assert picture.largest_displacement_m == 0
    picture.update(frame(6, 0.005))
    assert picture.largest_displacement_m == pytest.approx(0.003)
    picture.update(frame(0, 0.001))
    assert picture.largest_displacement_m == 0


def test_a_force_is_an_arrow(plotter: Any) -> None:  # noqa: ANN401
    picture = Picture(plotter, frame(1, 0.0), None)
    counts = []
    for step, force_n in enumerate([0.0, 2.0, 0.0], start=2):
        picture.update(frame(step, 0.0, force_n))
        plotter.render()
        counts.append(amber(plotter.screenshot()))
    assert counts[1] > counts[0] == counts[2]


def test_a_spring_is_a_line_until_it_breaks(plotter: Any) -> None:  # noqa: ANN401
    topology, places = two_balls()
    topology = attached(topology)
    points = np.zeros((13, 3), "<f4")
    points[:, 2] = 0.2  # above the balls
    points[:12, 0] = np.linspace(0, 0.1, 12)
    points[12] = (0.05, 0, 0.1)

    def frame_with(broken: bytes) -> tm.Frame:
        message = frame_at(topology, 1, places)
        message.attachment_points, message.broken_springs = points.tobytes(), broken
        return tm.Frame.from_message(message, topology)

    picture = Picture(plotter, frame_with(b""), None)
    shots = []
    for broken in (b"", bytes([0xFF, 0]), bytes([0xFF, 7]), b""):
        picture.update(frame_with(broken))
        plotter.render()
        shots.append(plotter.screenshot().astype(int))
    all_torn = shots[2]
    strands = [int((np.abs(shot - all_torn).max(axis=2) > 20).sum()) for shot in shots]
    assert strands[0] > strands[1] > 0
    assert strands[3] == strands[0], "a reset mends them"


def test_a_burnt_face_is_dark_and_what_is_dead_is_gone(plotter: Any) -> None:  # noqa: ANN401
    plain = frame(1, 0.0)
    picture = Picture(plotter, plain, None)
    plotter.render()
    before = plotter.screenshot().astype(int)
    # One half of the square dies, and a burnt triangle of the same corners but one takes its place.
    changes = changes_pb2.SurfaceChanges(topology_version=1, revision=1, appended_vertex_count=1)
    changes.bodies.add(
        dead_triangles=np.array([0, 1], "<u4").tobytes(),
        appended_vertices=np.array([4], "<u4").tobytes(),
        appended_triangles=np.array([0, 1, 4], "<u4").tobytes(),
        appended_kinds=b"\2",
    )
    points = np.vstack([plain.positions, [[0.1, 0.1, 0.0]]]).astype("<f4")
    message = stream_pb2.Frame(topology_version=1, step=2, revision=1, positions=points.tobytes())

    def burnt(shown: Any) -> int:  # noqa: ANN401
        return int((shown.max(axis=2) < 60).sum())

    def changed(shown: changes_pb2.SurfaceChanges | None) -> tm.Frame:
        return tm.Frame.from_message(message, plain.topology, Surface(plain.topology, shown))

    for shown, is_dark in ((None, False), (changes, True), (None, False)):
        picture.update(changed(shown))
        plotter.render()
        shot = plotter.screenshot().astype(int)
        assert (burnt(shot) > burnt(before) + 100) == is_dark
        assert (np.abs(shot - before).max(axis=2) > 40).sum() > 100 if is_dark else True
    picture.update(frame(3, 0.01))
    assert picture.largest_displacement_m == pytest.approx(0.01, rel=1e-5)


def test_coagulated_tissue_is_pale(plotter: Any) -> None:  # noqa: ANN401
    plain = frame(1, 0.0)
    picture = Picture(plotter, plain, None)
    revisions = itertools.count(1)

    def pale_pixels(coagulation: bytes) -> int:
        changes = changes_pb2.SurfaceChanges(topology_version=1, revision=next(revisions))
        message = stream_pb2.Frame(
            topology_version=1, step=2, revision=changes.revision, positions=plain.positions.tobytes()
        )
        changes.bodies.add(coagulation=coagulation)
        picture.update(tm.Frame.from_message(message, plain.topology, Surface(plain.topology, changes)))
        plotter.render()
        red, green, blue = np.moveaxis(plotter.screenshot().astype(int), 2, 0)
        return int(((red > green) & (green > blue) & (red - blue > 20) & (blue > 60)).sum())

    raw = pale_pixels(b"")
    assert pale_pixels(bytes([255, 255, 85, 0])) == raw, "no triangle has three pale corners"
    assert pale_pixels(bytes([255] * 4)) > raw + 100
    assert pale_pixels(b"") == raw


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "block.yaml"
    path.write_text(BLOCK)
    return path


def test_a_screenshot_shows_the_present_state(
    server: tm.Server, scene_file: Path, off_screen: None, capsys: pytest.CaptureFixture[str]
) -> None:
    output = scene_file.with_suffix(".png")
    view = ["view", "--desktop", "--server", server.address, "--screenshot", str(output)]
    with server.load(block(), lockstep=True) as scene:
        scene.move_tool("probe", (0.05, 0.05, 0.055))
        scene.step(60)
        assert main([*view, str(scene_file), "--json"]) == 0
        said = json.loads(capsys.readouterr().out)
        moved_m = np.linalg.norm(scene.fields("tissue", ["displacement"])["displacement"], axis=1).max()
    assert (said["scene"], said["step"], said["from_rest"]) == ("block", 60, True)
    assert said["largest_displacement_m"] == pytest.approx(moved_m, rel=1e-5)
    pixels = imread(output)
    assert pixels.shape[:2] == (800, 1280)
    white = (pixels[..., :3] == 1).all(axis=2).mean()
    assert 0.3 < white < 0.95, "a body before a white background"


def test_the_only_scene_needs_no_name(
    server: tm.Server, tmp_path: Path, off_screen: None, capsys: pytest.CaptureFixture[str]
) -> None:
    view = ["view", "--desktop", "--server", server.address, "--screenshot", str(tmp_path / "a.png"), "--json"]
    assert main(view) == 1
    assert "no scene is loaded" in capsys.readouterr().out
    with server.load(block(), name="a", lockstep=True), server.load(block(), name="b", lockstep=True) as b:
        assert main(view) == 1
        assert "several scenes are loaded: a, b; name one" in capsys.readouterr().out
        assert main([*view, "c"]) == 1
        assert "no scene 'c' is loaded; there are: a, b" in capsys.readouterr().out
        assert main([*view, "b"]) == 0
        b.unload()
        capsys.readouterr()
        assert main(view) == 0
        said = json.loads(capsys.readouterr().out)
        assert (said["scene"], said["from_rest"]) == ("a", False)


def test_another_scene_has_no_rest_positions(
    server: tm.Server, scene_file: Path, off_screen: None, capsys: pytest.CaptureFixture[str]
) -> None:
    scene_file.write_text(BLOCK.replace("name: tissue", "name: other"))
    view = ["view", "--desktop", "--server", server.address, "--screenshot", str(scene_file.with_name("a.png"))]
    with server.load(block(), lockstep=True):
        assert main([*view, str(scene_file)]) == 0
    assert "counts from the first frame: another scene of the same name is loaded" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["block"], "block: not a recording (.mcap); the page shows every loaded scene, so name none"),
        (["--screenshot", "a.png"], "--screenshot a.png: needs --desktop"),
        (["--desktop", "--screenshot", "a.jpg"], "must end in .png"),
        (["--desktop", "--screenshot", "none/a.png"], "no folder that can be written to"),
        (["--desktop"], "there is no screen (DISPLAY is not set)"),
    ],
)
def test_bad_options_are_refused(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", *arguments]) == 1
    assert says in capsys.readouterr().err


@pytest.fixture
def screen(can_draw: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A screen of Xvfb."""
    reads, writes = os.pipe()
    try:
        command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
        process = subprocess.Popen(command, pass_fds=[writes], stderr=subprocess.DEVNULL)
    except FileNotFoundError:
        os.close(reads)
        os.close(writes)
        pytest.skip("there is no Xvfb for a window")
    os.close(writes)
    try:
        with os.fdopen(reads) as display:
            monkeypatch.setenv("DISPLAY", f":{display.readline().strip()}")
        monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW", raising=False)
        yield
    finally:
        process.terminate()
        process.wait(DEADLINE_S)


def test_the_window_follows_the_scene_until_it_is_closed(
    server: tm.Server, screen: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = 3
    seen: list[int] = []
    update = Picture.update
    shown = threading.Event()

    def look(picture: Picture, frame: tm.Frame) -> None:
        update(picture, frame)
        seen.append(frame.step)
        shown.set()
        if len(seen) > wanted:
            picture._plotter.iren.interactor.ExitCallback()  # as a click on the window's cross

    monkeypatch.setattr(Picture, "update", look)
    with server.load(block(), lockstep=True) as scene:

        def steps() -> None:
            while len(seen) <= wanted and shown.wait(DEADLINE_S):
                shown.clear()
                scene.step()

        stepper = threading.Thread(target=steps)
        stepper.start()
        assert main(["view", "--desktop", "--server", server.address]) == 0
        stepper.join()
    assert seen[-1] >= wanted - 1
    assert seen == sorted(seen)


def test_the_window_ends_with_its_scene(
    server: tm.Server, screen: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(window, "_STATUS_S", 0.0)
    with server.load(block(), lockstep=True) as scene:
        update = Picture.update

        def unload(picture: Picture, frame: tm.Frame) -> None:
            update(picture, frame)
            scene.unload()
            monkeypatch.setattr(Picture, "update", update)

        monkeypatch.setattr(Picture, "update", unload)
        assert main(["view", "--desktop", "--server", server.address]) == 1
    assert "block" in capsys.readouterr().err
