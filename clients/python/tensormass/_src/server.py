"""Control of a daemon: `connect` gives a `Server`, and its `load` gives a `SceneHandle`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import grpc

from tensormass._shared import errors
from tensormass._shared.client_keys import KeysSource
from tensormass._shared.processes import ChildProcess
from tensormass._src import findings, notebook
from tensormass._src.connection import LOAD_TIMEOUT_S, Connection
from tensormass._src.scene import Scene
from tensormass._src.scene_handle import SceneHandle
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

DEFAULT_ADDRESS = "127.0.0.1:50051"
SceneSource = str | Path | Scene | scene_pb2.Scene


def connect(address: str = DEFAULT_ADDRESS, *, timeout_s: float = 5.0, keys: KeysSource | None = None) -> Server:
    """Connects to the daemon whose control plane listens on `address` (host:port).

    Args:
        keys: the file that `tensormass keys add` wrote, for a daemon that was started with --keys.

    Raises:
        InvalidArgumentError: the address has no port, or the keys cannot be used.
        UnavailableError: no daemon answers there within `timeout_s`.
    """
    return Server(address, timeout_s=timeout_s, keys=keys)


class Server(Connection):
    """A daemon. Close it, or use it as a context manager. Closing ends a daemon that `launch` started."""

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        process: ChildProcess | None = None,
        log_file: Path | None = None,
        keys: KeysSource | None = None,
    ) -> None:
        super().__init__(address, timeout_s=timeout_s, keys=keys)
        #: Process of the daemon; None unless `launch` started it.
        self.process = process
        #: Log file of the daemon; None unless `launch` started it.
        self.log_file = log_file

    def __repr__(self) -> str:
        return f"Server({self.address!r})"

    def _repr_html_(self) -> str:
        try:
            version = self.version()
            scenes = self.scenes()
        except errors.TensormassError as error:
            return notebook.table(repr(self), [["no answer", str(error)]])
        rows = [["version", version.version], ["backend", f"{version.backend} ({version.device})"]]
        rows += [[f"scene {status.scene}", f"{notebook.state_name(status)}, step {status.step:,}"] for status in scenes]
        return notebook.table(repr(self), rows)

    def load(
        self,
        scene: SceneSource,
        *,
        lockstep: bool | None = None,
        name: str | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> SceneHandle:
        """Loads a scene and starts it.

        Args:
            scene: a `Scene`, the protobuf message, or the name of a scene file, a mesh file or a built-in scene
                (`builtin_scenes`).
            lockstep: True steps only on `SceneHandle.step`, False in real time; None keeps the scene's own choice.
            name: replaces the scene's own.
            progress: (part, fraction) -> None; called while the daemon loads, with a text for people and the share of
                the work that is done, 0 to 1. An exception from it ends the load and is raised here.

        Warns:
            FindingWarning: something is probably a mistake, such as a mesh in millimetres. `Scene.accept` silences one.

        Raises:
            InvalidArgumentError: the scene is refused; the message names the body, the element and the remedy.
            AlreadyExistsError: a scene of this name is loaded.
        """
        request = control_pb2.LoadSceneRequest(scene=_message_of(scene, lockstep, name))
        if progress is None:
            report = self.call("LoadScene", request, timeout_s=LOAD_TIMEOUT_S).report
        else:
            report = self._load_with_progress(request, progress)
        handle = SceneHandle(self, request.scene.name, report, request.scene)
        try:
            findings.warn_of(report.findings)
        except findings.FindingWarning:
            handle.unload()  # the caller takes findings as errors, and an error leaves nothing behind
            raise
        return handle

    def _load_with_progress(
        self, request: control_pb2.LoadSceneRequest, progress: Callable[[str, float], None]
    ) -> control_pb2.SceneReport:
        messages = self.call("LoadSceneWithProgress", request, timeout_s=LOAD_TIMEOUT_S)
        report = control_pb2.SceneReport()
        try:
            for message in messages:
                progress(message.part, message.fraction)
                report = message.report
        except grpc.RpcError as error:
            raise errors.from_rpc_error(error) from error
        finally:
            messages.cancel()  # has no effect after the end
        return report

    def inspect(self, scene: SceneSource) -> control_pb2.SceneReport:
        """Checks and compiles a scene without running it. Raises the errors and issues the warnings of `load`."""
        request = control_pb2.InspectSceneRequest(scene=_message_of(scene, None, None))
        report: control_pb2.SceneReport = self.call("InspectScene", request, timeout_s=LOAD_TIMEOUT_S).report
        findings.warn_of(report.findings)
        return report

    def scene(self, name: str) -> SceneHandle:
        """Returns a handle on a scene that is already loaded.

        Raises:
            NotFoundError: no scene of this name is loaded.
        """
        handle = SceneHandle(self, name, None)
        try:
            handle.status()
        except errors.NotFoundError as error:
            loaded = ", ".join(status.scene for status in self.scenes()) or "none"
            raise errors.NotFoundError(f"{error}; there are: {loaded}") from error
        return handle

    def scenes(self) -> list[stream_pb2.SceneStatus]:
        """The status of every loaded scene."""
        return list(self.call("ListScenes", control_pb2.ListScenesRequest()).scenes)


def _message_of(source: SceneSource, lockstep: bool | None, name: str | None) -> scene_pb2.Scene:
    scene = Scene.from_file(source) if isinstance(source, str | Path) else source
    message = scene.message if isinstance(scene, Scene) else scene
    if lockstep is None and name is None:
        return message
    changed = scene_pb2.Scene()
    changed.CopyFrom(message)
    if lockstep is not None:
        changed.stepping.lockstep = lockstep
    if name is not None:
        changed.name = name
    return changed
