"""The window of `tensormass view --desktop`, and its picture without a screen."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyvista as pv

from tensormass import (
    DeadlineExceededError,
    Frame,
    InvalidArgumentError,
    NotFoundError,
    Scene,
    SceneHandle,
    Server,
    connect,
)
from tensormass._shared.files import replacing
from tensormass.v1 import scene_pb2
from tensormass_gateway.surface import MismatchError, rest_positions
from tensormass_tools.desktop.picture import Picture
from tensormass_tools.output import check_writable, print_json
from tensormass_tools.running import find_server

_SIZE = (1280, 800)
# Longest time without a look at the window's events [s].
_EVENTS_S = 1 / 60
# A scene that sends no frames is paused or gone; the status tells which [s].
_STATUS_S = 1.0


def run(args: argparse.Namespace) -> int:
    """Shows the window until it is closed, or writes the screenshot."""
    if args.screenshot is not None:
        check_writable("--screenshot", args.screenshot)
    elif sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InvalidArgumentError("--desktop: there is no screen (DISPLAY is not set); --screenshot needs none")
    with connect(find_server(args.server), keys=args.keys) as server:
        handle, known = _find_scene(server, args.scene)
        first = handle.frame()
        rest_m = _rest_of(known, first)
        if args.screenshot is not None:
            return _write_screenshot(args.screenshot, first, rest_m, as_json=args.json)
        _follow(handle, known, first, rest_m)
    return 0


def _find_scene(server: Server, name: str | None) -> tuple[SceneHandle, scene_pb2.Scene | None]:
    """Returns the scene to show, and its message if `name` is also a scene file or a built-in scene."""
    loaded = [status.scene for status in server.scenes()]
    if name is None:
        if len(loaded) != 1:
            raise InvalidArgumentError(
                f"several scenes are loaded: {', '.join(loaded)}; name one" if loaded else "no scene is loaded"
            )
        return server.scene(loaded[0]), None
    try:
        message = Scene.from_file(name).message
    except NotFoundError:
        message = None
    wanted = name if name in loaded or message is None else message.name
    if wanted not in loaded:
        raise NotFoundError(f"no scene {wanted!r} is loaded; there are: {', '.join(loaded) or 'none'}")
    return server.scene(wanted), message


def _rest_of(known: scene_pb2.Scene | None, frame: Frame) -> npt.NDArray[np.float32] | None:
    """Returns the rest positions of a frame's vertices; None if they are not known."""
    if known is None:
        return None
    try:
        return rest_positions(known, frame.topology)
    except MismatchError as error:
        print(f"displacement counts from the first frame: {error}", file=sys.stderr)
        return None


def _write_screenshot(path: Path, frame: Frame, rest_m: npt.NDArray[np.float32] | None, *, as_json: bool) -> int:
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # VTK would try a screen first, and warn.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    plotter = pv.Plotter(off_screen=True, window_size=list(_SIZE))
    try:
        picture = Picture(plotter, frame, rest_m)
        with replacing(path) as aside:
            plotter.screenshot(aside)
    except OSError as error:
        raise InvalidArgumentError(f"--screenshot {path}: cannot be written: {error.strerror}") from error
    finally:
        plotter.close()
    if as_json:
        print_json(
            {
                "screenshot": str(path),
                "scene": frame.topology.scene,
                "step": frame.step,
                "from_rest": rest_m is not None,
                "largest_displacement_m": picture.largest_displacement_m,
            }
        )
    else:
        print(f"wrote {path}: scene {frame.topology.scene}, step {frame.step}")
    return 0


def _follow(
    handle: SceneHandle, known: scene_pb2.Scene | None, first: Frame, rest_m: npt.NDArray[np.float32] | None
) -> None:
    """Shows the newest frame until the window is closed. Raises if the scene or the daemon ends."""
    plotter = pv.Plotter(title=f"Tensormass: {handle.name}", window_size=list(_SIZE))
    is_closed: list[bool] = []
    try:
        picture = Picture(plotter, first, rest_m)
        plotter.show(interactive_update=True, auto_close=False)
        plotter.iren.add_observer("ExitEvent", lambda *_: is_closed.append(True))
        version = first.topology.version
        last_s = time.monotonic()
        with handle.frames(timeout_s=_EVENTS_S) as frames:
            while not is_closed:
                try:
                    frame = next(frames)
                except DeadlineExceededError:
                    if time.monotonic() - last_s > _STATUS_S:
                        handle.status()  # raises if the scene or the daemon is gone
                        last_s = time.monotonic()
                else:
                    last_s = time.monotonic()
                    if frame.topology.version != version:
                        plotter.clear()
                        picture = Picture(plotter, frame, _rest_of(known, frame))
                        version = frame.topology.version
                    picture.update(frame)
                plotter.update()
    except KeyboardInterrupt:
        pass
    finally:
        plotter.close()
