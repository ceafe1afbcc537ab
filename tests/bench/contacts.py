"""What each kind of contact costs: the steps of `demo-abdomen` as it is, and without one kind after the other.

    python tests/bench/contacts.py [--backend cuda] [--commit HASH] >> tests/bench/results/contacts.jsonl

The scenes follow the scripted hand in lockstep, in turns of 64 steps, so that a slower moment of the machine slows all
of them. The steps of a turn are made in one call, and the times are those of all steps. A scene without any link runs
the fused solve of the GPU.
"""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Callable, Iterator
from typing import Any

from one_backend import print_rows

import tensormass as tm
from tensormass.v1 import scene_pb2
from tensormass_tools.hand import HandScript, script_of

_SCENE = "demo-abdomen"
_TURN = 64


def _drop_self_contact(scene: scene_pb2.Scene) -> None:
    for contact in [contact for contact in scene.body_contacts if contact.other in ("", contact.body)]:
        scene.body_contacts.remove(contact)


def _drop_body_contacts(scene: scene_pb2.Scene) -> None:
    del scene.body_contacts[:]


def _drop_attachments(scene: scene_pb2.Scene) -> None:
    del scene.attachments[:]


def _drop_links(scene: scene_pb2.Scene) -> None:
    _drop_body_contacts(scene)
    _drop_attachments(scene)


def _drop_obstacles(scene: scene_pb2.Scene) -> None:
    for tool in [tool for tool in scene.tools if tool.fixed]:
        scene.tools.remove(tool)


def _drop_probe(scene: scene_pb2.Scene) -> None:
    for tool in [tool for tool in scene.tools if not tool.fixed]:
        scene.tools.remove(tool)


def _drop_all(scene: scene_pb2.Scene) -> None:
    _drop_links(scene)
    del scene.tools[:]


_VARIANTS: dict[str, Callable[[scene_pb2.Scene], None]] = {
    "all": lambda _: None,
    "without self-contact": _drop_self_contact,
    "without contact of bodies": _drop_body_contacts,
    "without attachments": _drop_attachments,
    "without links": _drop_links,
    "without obstacles": _drop_obstacles,
    "without the probe": _drop_probe,
    "without any contact": _drop_all,
}


def _measure(server: tm.Server) -> dict[str, dict[str, float]]:
    path = script_of(_SCENE)
    assert path is not None
    script = HandScript.read(path)
    iterations: dict[str, list[int]] = {name: [] for name in _VARIANTS}
    with contextlib.ExitStack() as stack:
        handles: dict[str, tm.SceneHandle] = {}
        for name, drop in _VARIANTS.items():
            scene = tm.Scene.from_file(_SCENE)
            drop(scene.message)
            handles[name] = stack.enter_context(server.load(scene, name=name.replace(" ", "_"), lockstep=True))
        dt_s = 1 / 60
        for turn in range(max(1, round(float(script.times_s[-1]) / dt_s / _TURN))):
            for name, handle in handles.items():
                if any(tool.name == script.tool for tool in handle.topology().tools):
                    poses = [script.at((turn * _TURN + step) * dt_s) for step in range(_TURN)]
                    status = handle.follow(script.tool, poses)
                else:
                    status = handle.step(_TURN)
                iterations[name].append(status.cg_iterations)
        times = {name: handle.step_times() for name, handle in handles.items()}
    return {
        name: {
            "steps": of.count,
            "step_ms_median": round(1e3 * of.p50_s, 4),
            "step_ms_p99": round(1e3 * of.p99_s, 4),
            "cg_iterations": statistics.median(iterations[name]),
        }
        for name, of in times.items()
    }


def _rows(server: tm.Server, _: str) -> Iterator[dict[str, Any]]:
    for name, row in _measure(server).items():
        yield {"case": f"contact: {name}", **row}


def main() -> None:
    print_rows(__file__, __doc__, _rows)


if __name__ == "__main__":
    main()
