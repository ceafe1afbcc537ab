"""Built-in scenes, by the names of their files in scenes/.

organ.py makes the meshes of organs when a scene first uses them, which takes seconds, and again when their source
changes. They are kept in the checkout's build/scenes or in the user's cache.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from tensormass._src import mesh_files
from tensormass._src.extras import require
from tensormass._src.isosurface import Implicit
from tensormass._src.meshes import TriangleSurface
from tensormass._src.organ import ORGANS
from tensormass._src.processes import BUILD_BIN

_PACKAGE = Path(__file__).resolve().parent
_TEMPLATES = _PACKAGE.parent / "scenes"
_SOURCES = ("organ.py", "isosurface.py", "interface.py", "meshes.py", "mesh_geometry.py", "mesh_files.py", "shapes.py")


def builtin_scenes() -> list[str]:
    """Returns the names of the built-in scenes."""
    return sorted(path.stem for path in _TEMPLATES.glob("*.yaml"))


def builtin_scene(name: str) -> tuple[Path, Path] | None:
    """Returns file and mesh folder of a built-in scene, None if there is no such scene. Makes missing meshes."""
    if name not in builtin_scenes():
        return None
    scene_file = _TEMPLATES / f"{name}.yaml"
    if not any(f"{organ}.msh" in scene_file.read_text() for organ in ORGANS):
        return scene_file, _TEMPLATES
    require("meshes", f"the built-in scene {name!r}")
    folder = cache_folder()
    files = [folder / file for organ in ORGANS for file in (f"{organ}.msh", f"{organ}_skin.ply")]
    stamp = folder / "made_from.txt"
    sources = hashlib.sha256(b"".join((_PACKAGE / source).read_bytes() for source in _SOURCES)).hexdigest()
    if not (stamp.is_file() and stamp.read_text() == sources and all(file.is_file() for file in files)):
        folder.mkdir(parents=True, exist_ok=True)
        # Made in a temporary folder and then moved, so that a second process never reads half a file.
        with tempfile.TemporaryDirectory(dir=folder) as made:
            _make_organs(Path(made))
            (Path(made) / stamp.name).write_text(sources)
            for file in [*files, stamp]:
                os.replace(Path(made) / file.name, file)
    return scene_file, folder


def _make_organs(folder: Path) -> None:
    skins: dict[Implicit, TriangleSurface] = {}  # organs that differ only in their cells look the same
    for name, organ in ORGANS.items():
        mesh_files.write_mesh(folder / f"{name}.msh", organ.volume(graded=organ.focus is not None))
        if organ.inside not in skins:
            skins[organ.inside] = organ.skin()
        skin = skins[organ.inside]
        mesh_files.write_surface(folder / f"{name}_skin.ply", skin)


def cache_folder() -> Path:
    """Returns the folder of meshes that are made on demand."""
    build = BUILD_BIN.parent
    if build.is_dir() and os.access(build, os.W_OK):
        return build / "scenes"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tensormass" / "scenes"
