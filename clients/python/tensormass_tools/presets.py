"""Named settings of built-in scenes: the best of what `tensormass trade` measured, kept in presets.yaml.

What a name promises is in `PROMISES`; what each preset reaches is in docs/accuracy.md.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from tensormass._src.demo import cache_folder
from tensormass._src.errors import InvalidArgumentError
from tensormass._src.scene import Scene
from tensormass._src.scene_file import SceneFile
from tensormass_tools.trade.knobs import Knobs, Setting

FILE = Path(__file__).resolve().parent / "presets.yaml"
#: What each name stands for, of the settings measured; `tests/accuracy/trade.py` chooses them so. None of them changes
#: the law, and none is less accurate than the scene as it is, neither in displacement nor in the tool's force.
PROMISES = {
    "fast": "the fastest that is no less accurate than the scene as it is",
    "balanced": "the most accurate that is no slower than the scene as it is",
    "accurate": "the most accurate that takes at most twice the time",
}


def all_presets() -> dict[str, dict[str, Setting]]:
    """[scene][preset]."""
    presets: dict[str, dict[str, Setting]] = yaml.safe_load(FILE.read_text("utf-8")) if FILE.exists() else {}
    return presets


def read_scene(path: str | Path, preset: str | None) -> Scene:
    """As `Scene.from_file`; with a preset, a built-in scene that has one of that name.

    Raises:
        InvalidArgumentError: also where a preset was measured for no such scene.
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
    return Scene(message=Knobs(file, cache_folder() / "presets").apply(of_scene[preset]).message())
