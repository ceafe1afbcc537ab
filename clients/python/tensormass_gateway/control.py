"""Commands of an operator: pause, resume, step, reset, adjust and edit a scene, load a built-in one, unload one.

A recording is also stepped back, moved to a time and played at another speed (playback.py).
"""

from __future__ import annotations

import asyncio
import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import grpc
from google.protobuf import json_format

from tensormass import SceneFile, TensormassError
from tensormass.v1 import adjustment_pb2, control_pb2, finding_pb2, gateway_pb2, scene_pb2
from tensormass_gateway.daemon import Daemon
from tensormass_gateway.requests import PARSE_ERRORS, ProtocolError, finite_number, is_name

MAX_STEPS = 1000
"""Largest number of steps of one command."""

MAX_WAITING = 8
"""Commands of one browser that are not answered yet. A further one is refused."""

MIN_SPEED, MAX_SPEED = 0.05, 20.0
"""Speeds of a recording. Slower is stepping; faster skips nearly all frames."""

COMMAND_TIMEOUT_S = 30.0
LOAD_TIMEOUT_S = 300.0


class Action(enum.StrEnum):
    PAUSE = "pause"
    RESUME = "resume"
    STEP = "step"
    RESET = "reset"
    LOAD = "load"
    UNLOAD = "unload"
    ADJUST = "adjust"
    EDIT = "edit"
    STEP_BACK = "step_back"
    SEEK = "seek"
    SPEED = "speed"


class CommandError(Exception):
    """A command failed. The text is for the operator."""


@dataclass(frozen=True)
class Command:
    """A checked command of a browser."""

    id: int
    """Number by which the browser finds the answer."""
    action: Action
    scene: str
    """Name of a loaded scene; for `load` that of a built-in one."""
    steps: int = 1
    lockstep: bool = False
    time_s: float = 0.0
    """Time of a recording to which `seek` moves."""
    speed: float = 1.0
    changes: adjustment_pb2.SceneAdjustments = field(default_factory=adjustment_pb2.SceneAdjustments)
    edit: adjustment_pb2.SceneEdit = field(default_factory=adjustment_pb2.SceneEdit)


@dataclass(frozen=True)
class Outcome:
    """What a command did."""

    scene: str
    adjustments: adjustment_pb2.SceneAdjustments | None = None
    """All values of a scene after `adjust`."""
    findings: Sequence[finding_pb2.Finding] | None = None
    """The findings of a scene after `load`, those of new tools after `edit`."""


def read_command(request: dict[str, Any]) -> Command:
    """Checks a request of type `control`. Raises ProtocolError if a field is missing, wrong or unknown."""
    given = {key: value for key, value in request.items() if key != "type"}
    action, scene = given.get("action"), given.get("scene")
    if not _is_whole(given.get("id"), 0, 2**53):
        raise ProtocolError("id is not a whole number from 0 to 2^53")
    if not isinstance(action, str) or action not in set(Action):
        raise ProtocolError(f"action is not one of {', '.join(Action)}")
    if not isinstance(scene, str) or not is_name(scene):
        raise ProtocolError("a scene's name is 1 to 64 characters of [A-Za-z0-9_-]")
    time_s, speed = finite_number(given.get("time_s", 0)), finite_number(given.get("speed", 1))
    if time_s is None or time_s < 0:
        raise ProtocolError("time_s is not a finite number from 0 on")
    if speed is None or not MIN_SPEED <= speed <= MAX_SPEED:
        raise ProtocolError(f"speed is not a number from {MIN_SPEED:g} to {MAX_SPEED:g}")
    if not isinstance(given.get("changes", {}), dict):
        raise ProtocolError("changes is not a JSON object")
    if not isinstance(given.get("edit", {}), dict):
        raise ProtocolError("edit is not a JSON object")
    if not _is_whole(given.get("steps", 1), 1, MAX_STEPS):
        raise ProtocolError(f"steps is not a whole number from 1 to {MAX_STEPS}")
    if not isinstance(given.get("lockstep", False), bool):
        raise ProtocolError("lockstep is not true or false")
    if given.keys() - gateway_pb2.ViewerCommand.DESCRIPTOR.fields_by_name.keys():
        raise ProtocolError("a command has unknown fields")
    command = gateway_pb2.ViewerCommand()
    for name, of in (("changes", command.changes), ("edit", command.edit)):
        try:
            json_format.ParseDict(given.pop(name, {}), of)
        except PARSE_ERRORS as error:
            raise ProtocolError(f"{name} is not a {of.DESCRIPTOR.name} as JSON") from error
    json_format.ParseDict(given, command)  # its fields are checked
    return Command(
        int(command.id),
        Action(command.action),
        command.scene,
        steps=command.steps if command.HasField("steps") else 1,
        lockstep=command.lockstep,
        time_s=command.time_s,
        speed=command.speed if command.HasField("speed") else 1.0,
        changes=command.changes,
        edit=command.edit,
    )


class Control:
    """Executes commands on a daemon."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        # A load reads meshes and sends them, which takes much memory.
        self._loading = asyncio.Lock()

    async def execute(self, command: Command) -> Outcome:
        """Executes `command`. Raises CommandError with the reason of a failure."""
        if self._daemon.problem:
            raise CommandError(self._daemon.problem)
        try:
            if command.action is Action.LOAD:
                async with self._loading:
                    return await self._load(command)
            if command.action is Action.ADJUST:
                return await self._adjust(command)
            if command.action is Action.EDIT:
                return await self._edit(command)
            await self._call(command)
        except grpc.aio.AioRpcError as error:
            raise CommandError(error.details() or f"the daemon answered {error.code().name}") from error
        finally:
            # Browsers hear of the change before the answer, not only after the next poll.
            if command.action in (Action.LOAD, Action.UNLOAD):
                await self._daemon.refresh()
        return Outcome(command.scene)

    async def _adjust(self, command: Command) -> Outcome:
        request = control_pb2.AdjustSceneRequest(scene=command.scene, changes=command.changes)
        reply = await self._daemon.control.AdjustScene(request, timeout=LOAD_TIMEOUT_S)
        return Outcome(command.scene, reply.adjustments)

    async def _edit(self, command: Command) -> Outcome:
        request = control_pb2.EditSceneRequest(scene=command.scene, edit=command.edit)
        reply = await self._daemon.control.EditScene(request, timeout=LOAD_TIMEOUT_S)
        return Outcome(command.scene, findings=reply.findings)

    async def _call(self, command: Command) -> None:
        control, scene = self._daemon.control, command.scene
        match command.action:
            case Action.PAUSE:
                await control.PauseScene(control_pb2.PauseSceneRequest(scene=scene), timeout=COMMAND_TIMEOUT_S)
            case Action.RESUME:
                await control.ResumeScene(control_pb2.ResumeSceneRequest(scene=scene), timeout=COMMAND_TIMEOUT_S)
            case Action.STEP:
                request = control_pb2.StepSceneRequest(scene=scene, count=command.steps)
                await control.StepScene(request, timeout=COMMAND_TIMEOUT_S)
            case Action.RESET:
                await control.ResetScene(control_pb2.ResetSceneRequest(scene=scene), timeout=COMMAND_TIMEOUT_S)
            case Action.UNLOAD:
                await control.UnloadScene(control_pb2.UnloadSceneRequest(scene=scene), timeout=COMMAND_TIMEOUT_S)
            case _:
                raise CommandError(f"{command.action} is for recordings; a running scene has no time line")

    async def _load(self, command: Command) -> Outcome:
        try:
            scene = await asyncio.to_thread(_read_builtin, command.scene)
        except (TensormassError, OSError) as error:
            raise CommandError(str(error)) from error
        scene.name = _free_name(command.scene, self._daemon.scenes)
        if command.lockstep:
            scene.stepping.lockstep = True
        reply = await self._daemon.control.LoadScene(control_pb2.LoadSceneRequest(scene=scene), timeout=LOAD_TIMEOUT_S)
        self._daemon.learn(scene)
        return Outcome(scene.name, findings=reply.report.findings)


def _read_builtin(name: str) -> scene_pb2.Scene:
    """Reads a built-in scene and its meshes. Never reads another file, whatever the browser sends."""
    file = SceneFile.read_builtin(name)
    # A scene that is not trusted has its meshes read in another process, so that frames keep flowing meanwhile.
    return replace(file, builtin=None).message()


def _free_name(name: str, taken: set[str]) -> str:
    """Returns `name`, or the first of name-2, name-3, ... that is not taken."""
    candidate, number = name, 1
    while candidate in taken:
        number += 1
        candidate = f"{name}-{number}"
    return candidate


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
