"""Fits a built-in scene to the machine of a daemon: measures its meshes from fine to coarse until one leaves room."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from tensormass import Scene, SceneFile, Server
from tensormass._shared import defaults
from tensormass._shared.cache import cache_folder
from tensormass.v1 import scene_pb2
from tensormass_tools import fits, hand, priority
from tensormass_tools.first_steps import measure
from tensormass_tools.fitting import Choice, Machine, Measured, choose, sentence
from tensormass_tools.trade.knobs import Knobs


@dataclass(frozen=True)
class Fitted:
    """A scene as it runs."""

    scene: Scene
    #: What was chosen and why; empty if nothing was measured.
    sentence: str = ""
    #: True if the daemon may and should have real-time priority.
    realtime: bool = False


def fit_scene(server: Server, backend: str, path: str | Path, as_it_is: Fitted, cpu_threads: int | None) -> Fitted:
    """Measures the first steps of a built-in scene in a daemon, and chooses mesh and threads.

    Args:
        backend: that of the daemon.
        path: the scene as the user named it. Files of users are not measured, because they are never changed.
        as_it_is: the scene that runs if nothing is changed.
        cpu_threads: threads that the user chose; None leaves them to the daemon.
    """
    if SceneFile.is_mesh(path):
        return as_it_is
    file = SceneFile.read(path)
    ladder = fits.ladder_of(file.builtin, backend)
    if not ladder:
        return as_it_is
    knobs = Knobs(file, cache_folder() / "fits")
    machine = Machine.of(backend, len(os.sched_getaffinity(0)), cpu_threads)

    def prioritize() -> bool:
        """Gives the daemon, with the threads of a scene that it has loaded, priority where that helps."""
        daemon = server.process
        return machine.may_have_priority() and daemon is not None and priority.raise_threads(daemon.process.pid)

    machine = replace(machine, realtime=prioritize())
    own_dt_s = defaults.dt_s(knobs.message)
    periods_s = [float(rung.setting.get("dt_s", own_dt_s)) for rung in ladder]
    script = hand.script_of(str(path))
    scripted = None if script is None else hand.HandScript.read(script)

    def scene_of(choice: Choice) -> scene_pb2.Scene:
        message = scene_pb2.Scene()
        of_rung = as_it_is.scene.message if choice.rung == 0 else knobs.apply(ladder[choice.rung].setting).message()
        message.CopyFrom(of_rung)
        if choice.threads is not None:
            message.solver.cpu_threads = choice.threads
        return message

    def measure_choice(choice: Choice) -> Measured | None:
        return measure(server, scene_of(choice), scripted, machine.share(), prioritize)

    fit = choose(ladder, periods_s, machine, measure_choice)
    if fit is None:
        return as_it_is
    scene = Scene(message=scene_of(fit.choice)) if fit.changed else as_it_is.scene
    return Fitted(scene, sentence(scene.name, ladder, fit), machine.realtime)
