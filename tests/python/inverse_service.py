"""A simulated Inverse service of Haply, with devices whose hand follows a path; it can misbehave.

Written from the service's documentation (docs.haply.co, Inverse SDK 3.5, "WebSocket Protocol"; 3.4, "Simulation
Channel") and independent of the client. It answers each message with one state, checks every command against its own
dialect, and writes down what it got.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Self

from aiohttp import WSMsgType, web

Vector = tuple[float, float, float]
#: 3.5 calls the force "vector", older services call it "values".
Dialect = Literal["3.5", "3.4"]
Message = dict[str, Any]

#: What `misbehave` returns to send nothing, or to close the connection.
SILENT, HANG_UP = "<silent>", "<hang up>"
START = (0.01, -0.12, 0.15)
#: The status of a device that can be used.
FIT = {"calibrated": True, "in_use": False, "power_supply": True, "ready": True, "started": True}
DEADLINE_S = 60.0


def honest(number: int, message: Message) -> Message:
    return message


@dataclass
class InverseService:
    """Serves from `with` on, in a thread of its own, on a free port of 127.0.0.1."""

    dialect: Dialect = "3.5"
    inverses: tuple[str, ...] = ("049D",)
    #: Ids of wired grips.
    grips: tuple[str, ...] = ()
    #: Position of the hand relative to START after this many commands [m].
    path: Callable[[int], Vector] = lambda count: (0.0, 0.0, 0.0)
    #: Changes what is sent: message 0 is the snapshot, then come the states. A text is sent as it stands.
    misbehave: Callable[[int, Message], Message | str] = honest
    #: (w, x, y, z) of every grip.
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    status: Message = field(default_factory=lambda: dict(FIT))
    #: Whether the button of every grip is down after this many commands.
    presses: Callable[[int], bool] = lambda count: False

    #: Every force that came [N], in the device's frame.
    forces: list[Vector] = field(default_factory=list)
    #: What was wrong with commands.
    complaints: list[str] = field(default_factory=list)
    #: How the client closed the connection; None while it is open or if it broke.
    close_code: int | None = None

    def __post_init__(self) -> None:
        self._changed = threading.Condition()
        self._started = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run)
        self._port = 0

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self._port}"

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._started.wait(DEADLINE_S)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def wait_for(self, condition: Callable[[], bool]) -> bool:
        """Waits until the condition on what came holds; returns whether it does after DEADLINE_S."""
        with self._changed:
            return self._changed.wait_for(condition, DEADLINE_S)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        app = web.Application()
        app.router.add_get("/", self._session)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        self._port = runner.addresses[0][1]
        self._started.set()
        await self._stop.wait()
        await runner.cleanup()

    async def _session(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        count = 0
        await self._send(socket, count, self._snapshot())
        async for message in socket:
            if message.type is not WSMsgType.TEXT:
                self.complaints.append(f"a message of type {message.type}")
                continue
            with self._changed:
                self._take(message.data)
                self._changed.notify_all()
            count += 1
            await self._send(socket, count, self._state(count))
        with self._changed:
            self.close_code = socket.close_code
            self._changed.notify_all()
        return socket

    async def _send(self, socket: web.WebSocketResponse, number: int, message: Message) -> None:
        text = self.misbehave(number, message)
        if text == HANG_UP:
            await socket.close()
        elif text != SILENT and not socket.closed:
            await socket.send_str(text if isinstance(text, str) else json.dumps(text))

    def _take(self, text: str) -> None:
        """Reads a command as strictly as the documentation allows."""
        name = "vector" if self.dialect == "3.5" else "values"
        try:
            (device,) = json.loads(text)["inverse3"]
            force = device["commands"]["set_cursor_force"][name]
            vector = (force["x"], force["y"], force["z"])
            if device["device_id"] not in self.inverses:
                self.complaints.append(f"a force for {device['device_id']}")
            if not all(isinstance(value, float) and math.isfinite(value) for value in vector):
                self.complaints.append(f"a force that is not finite: {text}")
            self.forces.append(vector)
        except (KeyError, TypeError, ValueError) as error:
            self.complaints.append(f"{error!r} in {text}")

    def _position(self, count: int) -> Message:
        return {axis: start + moved for axis, start, moved in zip("xyz", START, self.path(count), strict=True)}

    def _state(self, count: int) -> Message:
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        state: Message = {"cursor_position": self._position(count), "cursor_velocity": zero, "mode": "idle"}
        if self.dialect == "3.5":
            state |= {"current_cursor_force": zero, "control_domain": "cartesian", "control_mode": "force"}
        w, x, y, z = self.orientation
        grip = {"button": self.presses(count), "hall": 0, "orientation": {"x": x, "y": y, "z": z, "w": w}}
        return {
            "inverse3": [{"device_id": name, "state": state, "status": self.status} for name in self.inverses],
            "verse_grip": [
                {"device_id": name, "state": grip, "status": {"error": 0, "ready": True}} for name in self.grips
            ],
            "wireless_verse_grip": [],
            "custom_verse_grip": [],
        }

    def _snapshot(self) -> Message:
        """Returns the state of all devices together with their configuration."""
        snapshot = self._state(0)
        for device in snapshot["inverse3"]:
            name = device["device_id"]
            info: Message = {"major_version": 7, "minor_version": 4, "id": name, "uuid": "0"}
            device["config"] = {
                "type": "inverse3",
                "port": "COM12",
                "device_info": info,
                "extended_device_id": "0",
                "extended_firmware_version": "0",
                "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
                "handedness": "right",
                "torque_scaling": {"enabled": True},
            }
            if self.dialect == "3.5":
                info["device_type"] = 4
                device["config"] |= {
                    "streaming_mode": "USB",
                    "home_return": {"enabled": False},
                    "preset": "defaults",
                    "basis": {"permutation": "XYZ"},
                    "filters": {"force_gate": {"gain": 0.3}, "damping": {"scalar": 0.0}},
                }
            else:
                info["model"] = 4
        for grip in snapshot["verse_grip"]:
            grip["config"] = {"port": "COM3", "type": "verse_grip"}
        return {"session_id": 7} | snapshot
