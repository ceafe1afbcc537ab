"""Runs a daemon, its scenes and the gateway for the browser's test, controlled over stdin and stdout.

Each line on stdin is a JSON request {"do": name, ...}; each gets one line on stdout, {"result": ...} or {"error": ...}.
The first line on stdout is {"url": ..., "look_url": ...}. The end of stdin ends everything.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import tensormass as tm
from tensormass.v1 import scene_pb2
from tensormass_gateway.gateway import serve
from tensormass_gateway.options import GatewayOptions

#: Bounds hanging only: a busy machine steps far below real time.
DEADLINE_S = 90.0
MAX_BROWSERS = 2


class Stack:
    """The daemon and its scenes. Every public method is a request."""

    def __init__(self, viewer: Path) -> None:
        self.viewer = viewer
        self.server = tm.launch(backend="cpu")
        self.scenes: dict[str, tm.SceneHandle] = {}

    def close(self) -> None:
        self.server.close()

    def load(self, scene: str, name: str) -> int:
        """Loads the built-in `scene` under `name`. Returns the number of vertices that a viewer shows."""
        self.scenes[name] = self.server.load(scene, name=name)
        return self._vertex_count(name)

    def load_grid(
        self,
        name: str,
        cells: int,
        frame_rate_hz: float = 60.0,
        status_rate_hz: float = 4.0,
        budget_s: float | None = None,
        lockstep: bool = False,
        turned_tool: bool = False,
    ) -> int:
        """Loads a cube of 1 m with `cells` per side under `name`. Returns the number of vertices that a viewer shows.

        `turned_tool` adds a probe above the cube, rotated by a quarter turn about x.
        """
        one = scene_pb2.Vector3(x=1, y=1, z=1)
        body = scene_pb2.Body(
            name="cube",
            mesh=scene_pb2.Mesh(grid=scene_pb2.Grid(size_m=one, cells_x=cells, cells_y=cells, cells_z=cells)),
            law=scene_pb2.Law(hooke=scene_pb2.IsotropicElastic(young_modulus_pa=1e5, poisson_ratio=0.3)),
            density_kg_per_m3=1000,
        )
        streams = scene_pb2.Streams(frame_rate_hz=frame_rate_hz, status_rate_hz=status_rate_hz)
        solver = None if budget_s is None else scene_pb2.Solver(budget_s=budget_s, floor_cg_iterations=1)
        probe = scene_pb2.SphericalProbe(radius_m=0.1, tip_offset_m=scene_pb2.Vector3(z=0.4))
        tool = scene_pb2.Tool(
            name="probe",
            spherical_probe=probe,
            position_m=scene_pb2.Vector3(x=0.5, y=0.9, z=1.5),
            orientation=scene_pb2.Quaternion(w=0.5**0.5, x=0.5**0.5),
        )
        scene = scene_pb2.Scene(
            name=name,
            bodies=[body],
            tools=[tool] if turned_tool else [],
            stepping=scene_pb2.Stepping(lockstep=lockstep),
            streams=streams,
            solver=solver,
        )
        self.scenes[name] = self.server.load(scene)
        return self._vertex_count(name)

    def load_picture(self, name: str) -> int:
        """Loads a cube of 1 m with a picture on its front: red on the left, blue on the right. Returns the number of
        vertices that a viewer shows."""
        front = [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]
        corners = np.array([[0, 1, 2], [0, 2, 3]])
        places = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[corners]
        skin = tm.TriangleSurface.from_arrays(front, corners, texture_coordinates=places)
        pixels = np.zeros((8, 8, 3), np.uint8)
        pixels[:, :4, 0] = pixels[:, 4:, 2] = 255
        png = io.BytesIO()
        Image.fromarray(pixels).save(png, "PNG")
        scene = tm.Scene(name)
        scene.add_body(
            "cube",
            tm.grid([2, 2, 2], [1, 1, 1]),
            density_kg_per_m3=1000,
            skin=skin,
            texture=png.getvalue(),
        )
        self.scenes[name] = self.server.load(scene)
        return self._vertex_count(name)

    def load_recovering(self, name: str) -> int:
        """Loads a block in lockstep under `name`, whose probe presses until the scene recovers. Returns the number of
        vertices that a viewer shows."""
        scene = tm.Scene(name)
        # A law that softens in compression, so that the press ends a step.
        block = tm.grid([5, 5, 3], [0.1, 0.1, 0.05])
        scene.add_body("block", block, law="st_venant_kirchhoff", density_kg_per_m3=1000)
        scene.body("block").fixed.add(
            box=scene_pb2.Box(min_m=scene_pb2.Vector3(x=-1, y=-1, z=-1), max_m=scene_pb2.Vector3(x=1, y=1, z=0.001))
        )
        scene.add_spherical_probe("probe", radius_m=0.01, position_m=(0.05, 0.05, 0.07))
        scene.set_stepping(dt_s=0.005)
        scene.set_guard(max_move_m=1e-4)
        handle = self.scenes[name] = self.server.load(scene, lockstep=True)
        handle.move_tool("probe", (0.05, 0.05, 0.05))
        for _ in range(20):
            if handle.step().recovering:
                return self._vertex_count(name)
        raise RuntimeError("no step was a recovery")

    def load_hanging(self, name: str) -> int:
        """Loads two cubes of 1 m in lockstep under `name`. Returns the number of vertices that a viewer shows.

        The upper one is fixed. The lower one hangs from it by 9 springs, and 16 others break when it falls.
        """
        one = scene_pb2.Vector3(x=1, y=1, z=1)
        scene = tm.Scene(name)
        for body, height_m, cells in (("upper", 1.5, 2), ("lower", 0.0, 3)):
            scene.message.bodies.add(
                name=body,
                mesh=scene_pb2.Mesh(
                    grid=scene_pb2.Grid(size_m=one, cells_x=cells, cells_y=cells, cells_z=cells),
                    translation_m=scene_pb2.Vector3(z=height_m),
                ),
                law=scene_pb2.Law(hooke=scene_pb2.IsotropicElastic(young_modulus_pa=1e6, poisson_ratio=0.3)),
                density_kg_per_m3=1000,
            )
        everywhere = scene_pb2.Box(min_m=scene_pb2.Vector3(x=-9, y=-9, z=-9), max_m=scene_pb2.Vector3(x=9, y=9, z=9))
        scene.message.bodies[0].fixed.add(box=everywhere)
        scene.message.gravity_m_per_s2.z = -9.81
        scene.message.stepping.lockstep = True
        top = scene_pb2.Region(box=scene_pb2.Box(min_m=scene_pb2.Vector3(x=-9, y=-9, z=0.99), max_m=everywhere.max_m))
        bottom = scene_pb2.Region(box=scene_pb2.Box(min_m=everywhere.min_m, max_m=scene_pb2.Vector3(x=9, y=9, z=1.51)))
        holds = {"body": "upper", "region": bottom, "other": "lower", "other_region": top}
        tears = {"body": "lower", "region": top, "other": "upper", "other_region": bottom, "breaking_force_n": 1.0}
        scene.message.attachments.add(name="holds", stiffness_n_per_m=1e5, **holds)
        scene.message.attachments.add(name="tears", stiffness_n_per_m=1e4, **tears)
        self.scenes[name] = self.server.load(scene)
        return self._vertex_count(name)

    def lift_off(self, name: str) -> None:
        """Takes the probe of `load_recovering` off the block."""
        self.scenes[name].move_tool("probe", (0.05, 0.05, 0.09))
        self.scenes[name].step(20)

    def reset(self, name: str) -> None:
        self.scenes[name].reset()

    def pause(self, name: str) -> None:
        self.scenes[name].pause()

    def step(self, name: str, count: int) -> None:
        self.scenes[name].step(count)

    def unload(self, name: str) -> None:
        self.scenes.pop(name).unload()

    def unload_all(self) -> None:
        for status in self.server.scenes():
            self.server.scene(status.scene).unload()

    def settle(self, name: str, speed_m_per_s: float = 2e-3) -> float:
        """Waits until nothing moves faster than `speed_m_per_s`. Returns the remaining speed [m/s]."""
        handle = self.scenes[name]
        deadline = time.monotonic() + DEADLINE_S
        before = handle.frame()
        with handle.frames() as frames:
            for frame in frames:
                elapsed_s = frame.simulated_time_s - before.simulated_time_s
                # Average over 0.25 s of simulated time, so that the turning point of an oscillation does not count.
                if elapsed_s < 0.25:
                    continue
                moved = np.abs(frame.positions - before.positions).max()
                if moved / elapsed_s < speed_m_per_s:
                    return float(moved / elapsed_s)
                if time.monotonic() > deadline:
                    raise TimeoutError(f"scene {name} still moves at {moved / elapsed_s:g} m/s")
                before = frame
        raise AssertionError("frames never end")

    def press(self, name: str, depth_m: float) -> dict[str, Any]:
        """Pushes the first tool into the top of the tissue below it. Returns contact point [m] and force [N]."""
        handle = self.scenes[name]
        tool = handle.topology().tools[0]
        position = np.array(handle.feedback(tool.name).position_m)
        surface = handle.frame().positions
        below = surface[np.linalg.norm(surface[:, :2] - position[:2], axis=1) < tool.radius_m]
        contact = below[np.argmax(below[:, 2])]
        handle.move_tool(tool.name, [position[0], position[1], contact[2] + tool.radius_m - depth_m])
        deadline = time.monotonic() + DEADLINE_S
        while np.linalg.norm(handle.feedback(tool.name).force_n) < 0.01:
            if time.monotonic() > deadline:
                raise TimeoutError(f"tool {tool.name} feels no force at {position}")
        self.settle(name)
        return {
            "contact_m": [position[0], position[1], float(contact[2])],
            "force_n": float(np.linalg.norm(handle.feedback(tool.name).force_n)),
        }

    def stop_daemon(self) -> None:
        """Kills the daemon as a crash would."""
        process = self.server.process
        assert process is not None
        process.process.kill()
        process.process.wait()

    def start_daemon(self) -> None:
        """Starts a daemon on the control address of the previous one, with other data endpoints."""
        address = self.server.address
        self.server.close()
        self.server = tm.launch(backend="cpu", control=address)

    def _vertex_count(self, name: str) -> int:
        return sum(body.vertex_count for body in self.scenes[name].topology().bodies)


async def main() -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("viewer", type=Path, help="folder of the built viewer")
    stack = Stack(parser.parse_args().viewer)
    try:
        options = GatewayOptions(
            control=stack.server.address,
            viewer=stack.viewer,
            poll_interval_s=0.2,
            allow_poses=True,
            max_browsers=MAX_BROWSERS,
        )
        async with serve(options) as gateway:
            answer({"url": gateway.url, "look_url": gateway.look_url})
            while line := await asyncio.to_thread(sys.stdin.readline):
                request = json.loads(line)
                work: Callable[..., Any] = getattr(stack, request.pop("do"))
                try:
                    answer({"result": await asyncio.to_thread(work, **request)})
                except Exception as error:  # the test decides what a failure means
                    answer({"error": f"{type(error).__name__}: {error}"})
    finally:
        stack.close()


def answer(reply: dict[str, Any]) -> None:
    print(json.dumps(reply), flush=True)


if __name__ == "__main__":
    asyncio.run(main())
