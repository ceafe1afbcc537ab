"""Built-in scenes, by the names of their files in scenes/.

organ.py makes the meshes of an organ when a scene first uses it, which takes seconds, and again when their source
changes. They are kept in the checkout's build/scenes or in the user's cache.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tensormass._shared.cache import cache_folder
from tensormass._src import mesh_files
from tensormass._src.isosurface import Implicit
from tensormass._src.meshes import TriangleSurface
from tensormass._src.organ import ORGANS

_PACKAGE = Path(__file__).resolve().parent
_TEMPLATES = _PACKAGE.parent / "scenes"
_SOURCES = (
    "organ.py",
    "isosurface.py",
    "interface.py",
    "meshes.py",
    "mesh_geometry.py",
    "mesh_files.py",
    "mesh_writing.py",
    "shapes.py",
)


def builtin_scenes() -> list[str]:
    """Returns the names of the built-in scenes."""
    return sorted(path.stem for path in _TEMPLATES.glob("*.yaml"))


def builtin_scene(name: str) -> tuple[Path, Path] | None:
    """Returns file and mesh folder of a built-in scene, None if there is no such scene. Makes missing meshes."""
    if name not in builtin_scenes():
        return None
    scene_file = _TEMPLATES / f"{name}.yaml"
    organs = [organ for organ in ORGANS if f"{organ}.msh" in scene_file.read_text()]
    if not organs:
        return scene_file, _TEMPLATES
    folder = cache_folder()
    sources = hashlib.sha256(b"".join((_PACKAGE / source).read_bytes() for source in _SOURCES)).hexdigest()
    missing = [organ for organ in organs if not _is_made(organ, folder, sources)]
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
        # Made in a temporary folder and then moved, so that a second process never reads half a file.
        with tempfile.TemporaryDirectory(dir=folder) as made:
            _make_organs(Path(made), missing)
            for organ in missing:
                *files, stamp = _files(organ)
                (Path(made) / stamp).write_text(sources)
                for file in [*files, stamp]:
                    os.replace(Path(made) / file, folder / file)
    return scene_file, folder


def _files(organ: str) -> tuple[str, ...]:
    """Returns the names of an organ's files. The last one says of what the others were made."""
    return f"{organ}.msh", f"{organ}_skin.ply", f"{organ}_made_from.txt"


def _is_made(organ: str, folder: Path, sources: str) -> bool:
    *files, stamp = (folder / file for file in _files(organ))
    return stamp.is_file() and stamp.read_text() == sources and all(file.is_file() for file in files)


def _make_organs(folder: Path, names: Sequence[str]) -> None:
    skins: dict[Implicit, TriangleSurface] = {}  # organs that differ only in their cells look the same
    for name in names:
        organ = ORGANS[name]
        mesh_files.write_mesh(folder / f"{name}.msh", organ.volume(graded=organ.focus is not None))
        if organ.inside not in skins:
            skins[organ.inside] = organ.skin()
        skin = skins[organ.inside]
        mesh_files.write_surface(folder / f"{name}_skin.ply", skin)
