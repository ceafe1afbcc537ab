"""Named settings of built-in scenes: the best of what `tensormass trade` measured, kept in presets.yaml.

`PROMISES` says what each name promises, docs/accuracy.md what each preset reaches.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from tensormass import InvalidArgumentError, Scene, SceneFile
from tensormass._shared.cache import cache_folder
from tensormass_tools.trade.knobs import Knobs, Setting

FILE = Path(__file__).resolve().parent / "presets.yaml"
#: Meaning of each name; `tests/accuracy/trade.py` chooses the settings accordingly. No preset changes the law, and none
#: is less accurate than the unmodified scene, in displacement or in the tool's force.
PROMISES = {
    "fast": "the fastest that is no less accurate than the unmodified scene",
    "balanced": "the most accurate that is no slower than the unmodified scene",
    "accurate": "the most accurate that takes at most twice the time",
}

#: What `tensormass run` makes of a built-in scene on a backend without --preset. The files fit two cores.
FOR_BACKEND: dict[str, dict[str, Setting]] = {
    "cuda": {
        "demo": {"resolution": 2.1, "dt_s": 1 / 960},
        **{name: {"resolution": 2.0, "dt_s": 1 / 960} for name in ("retract", "grasp", "table")},
    },
}


def all_presets() -> dict[str, dict[str, Setting]]:
    """Returns all presets, [scene][preset]."""
    presets: dict[str, dict[str, Setting]] = yaml.safe_load(FILE.read_text("utf-8")) if FILE.exists() else {}
    return presets


def read_scene(path: str | Path, preset: str | None) -> Scene:
    """Reads a scene like `Scene.from_file` and applies a preset, which only built-in scenes have.

    Raises:
        InvalidArgumentError: also if no such preset was measured for the scene.
    """
    if preset is None:
        return Scene.from_file(path)
    presets = all_presets()
    file = SceneFile.read(path)
    if file.builtin not in presets:
        raise InvalidArgumentError(
            f"--preset {preset}: presets were measured for {', '.join(presets) or 'no scene'}, not for {path}; "
            f"`tensormass trade {path}` finds the settings of your own scene"
        )
    of_scene = presets[file.builtin]
    if preset not in of_scene:
        raise InvalidArgumentError(f"--preset {preset}: {file.builtin} has {', '.join(of_scene)}")
    return _with_setting(file, of_scene[preset])


def read_for_backend(path: str | Path, backend: str) -> Scene | None:
    """Reads a built-in scene as it fits a backend, "cpu" or "cuda"; None if nothing was found for it.

    Raises:
        NotFoundError: the path names neither a file nor a built-in scene.
    """
    if SceneFile.is_mesh(path):
        return None
    file = SceneFile.read(path)
    setting = FOR_BACKEND.get(backend, {}).get(file.builtin or "")
    return None if setting is None else _with_setting(file, setting)


def _with_setting(file: SceneFile, setting: Setting) -> Scene:
    """Applies a setting. Organs that it meshes again go into the cache."""
    return Scene(message=Knobs(file, cache_folder() / "presets").apply(setting).message())
