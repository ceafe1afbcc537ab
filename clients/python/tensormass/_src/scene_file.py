"""Scene files: YAML, one to one by field name with the protobuf `Scene`.

Mesh, skin and picture files are read here, because the daemon reads none: they become packed arrays in the message.
Positions are sent unchanged. `Mesh.scale` and `Mesh.translation_m` travel along, and the daemon applies them."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor

from tensormass._src import demo, mesh_files, strict_yaml, textures
from tensormass._src.errors import InvalidArgumentError, NotFoundError, naming
from tensormass._src.files import read_bytes
from tensormass._src.packing import add_what_the_mesh_carries, pack_mesh, pack_triangles
from tensormass._src.scene_fields import checked_fields
from tensormass.v1 import scene_pb2

_YAML_ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file: fields by name, before meshes are read."""

    fields: dict[str, Any]
    #: Folder to which mesh files are relative.
    directory: Path
    #: Name of the file in messages.
    where: str
    #: Name of the built-in scene; None for any other file.
    builtin: str | None = None

    @staticmethod
    def read(path: str | Path) -> SceneFile:
        """Reads a scene file or a built-in scene. Raises the errors of `Scene.from_file`."""
        directory: Path | None = None
        builtin: str | None = None
        if not Path(path).exists() and (found := demo.builtin_scene(str(path))) is not None:
            builtin = str(path)
            path, directory = found
        path = Path(path)
        try:
            text = path.read_text("utf-8")
        except FileNotFoundError:
            close = difflib.get_close_matches(str(path), demo.builtin_scenes(), n=1)
            meant = f"; did you mean {close[0]!r}?" if close else ""
            raise NotFoundError(
                f"{path}: no such file, nor a built-in scene ({', '.join(demo.builtin_scenes())}){meant}"
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidArgumentError(f"{path}: cannot be read: {error}") from error
        return replace(SceneFile.parse(text, directory or path.parent, str(path)), builtin=builtin)

    @staticmethod
    def parse(text: str, directory: Path, where: str) -> SceneFile:
        """Parses the text of a scene file. Raises the errors of `read`."""
        content = strict_yaml.load(text, where)
        if not isinstance(content, dict):
            raise InvalidArgumentError(f"{where}: a scene is a mapping of fields, starting with `name: ...`")
        return SceneFile(content, directory, where)

    def message(self) -> scene_pb2.Scene:
        """Checks the fields, reads the meshes and makes the message."""
        message = scene_pb2.Scene()
        fields = checked_fields(self.fields, cast(Descriptor, message.DESCRIPTOR), self.where, "")
        try:
            json_format.ParseDict(fields, message, max_recursion_depth=20)
        except json_format.ParseError as error:
            raise InvalidArgumentError(f"{self.where}: {error}") from error
        _resolve_files(message, self)
        return message


def is_mesh_file(path: str | Path) -> bool:
    """Tells whether a name, by its ending, is a bare mesh and not a scene."""
    suffix = Path(path).suffix.lower()
    return suffix != "" and suffix not in _YAML_ENDINGS


def _resolve_files(scene: scene_pb2.Scene, file: SceneFile) -> None:
    directory, where = file.directory, file.where
    trusted = file.builtin is not None  # this package has made their meshes
    for index, body in enumerate(scene.bodies):
        at = f"{where}: bodies[{index}]"
        with naming(f"{at}.mesh.file"):
            if body.mesh.WhichOneof("source") == "file":
                mesh = mesh_files.read_mesh(directory / body.mesh.file, trusted=trusted)
                body.mesh.packed.CopyFrom(pack_mesh(mesh))
                add_what_the_mesh_carries(body, mesh, f"{at}.sets")
        if body.skin.WhichOneof("source") == "file":
            with naming(f"{at}.skin.file"):
                skin = mesh_files.read_surface(directory / body.skin.file, trusted=trusted)
                body.skin.packed.CopyFrom(pack_triangles(skin))
            if body.HasField("texture") and not body.texture.coordinates:
                body.texture.coordinates = textures.coordinates(skin, f"{at}.texture")
        with naming(f"{at}.texture.file"):
            if body.texture.WhichOneof("source") == "file":
                body.texture.image = read_bytes(directory / body.texture.file)
    for index, tool in enumerate(scene.tools):
        if tool.mesh.surface.WhichOneof("source") != "file":
            continue
        with naming(f"{where}: tools[{index}].mesh.surface.file"):
            surface = mesh_files.read_surface(directory / tool.mesh.surface.file, trusted=trusted)
            tool.mesh.surface.packed.CopyFrom(pack_triangles(surface))
