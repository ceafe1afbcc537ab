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

from tensormass._shared import strict_yaml
from tensormass._shared.errors import InvalidArgumentError, NotFoundError, naming
from tensormass._shared.files import read_bytes
from tensormass._shared.scene_fields import checked_fields
from tensormass._src import demo, mesh_files, textures
from tensormass._src.packing import add_what_the_mesh_carries, pack_mesh, pack_triangles
from tensormass.v1 import scene_pb2

_YAML_ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file: fields by name, before meshes are read.

    Change the fields, then make a scene of them: `tm.Scene(message=file.message())`.
    """

    #: Fields of the message `Scene` by their names in scene.proto, as the file has them: units are those of the names.
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
        if not Path(path).exists() and str(path) in demo.builtin_scenes():
            return SceneFile.read_builtin(str(path))
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
        return SceneFile.parse(text, path.parent, str(path))

    @staticmethod
    def read_builtin(name: str) -> SceneFile:
        """Reads a built-in scene, and never another file. Makes its meshes first if they are missing, which takes
        seconds.

        Raises:
            NotFoundError: there is no built-in scene of this name.
        """
        found = demo.builtin_scene(name)
        if found is None:
            raise NotFoundError(f"there is no built-in scene {name!r}, only {', '.join(demo.builtin_scenes())}")
        path, directory = found
        return replace(SceneFile.parse(path.read_text("utf-8"), directory, str(path)), builtin=name)

    @staticmethod
    def parse(text: str, directory: Path, where: str) -> SceneFile:
        """Parses the text of a scene file.

        Args:
            directory: to which mesh files are relative.
            where: name of the file in messages.

        Raises:
            InvalidArgumentError: not YAML, or not a mapping of fields.
        """
        content = strict_yaml.load(text, where)
        if not isinstance(content, dict):
            raise InvalidArgumentError(f"{where}: a scene is a mapping of fields, starting with `name: ...`")
        return SceneFile(content, directory, where)

    @staticmethod
    def is_mesh(path: str | Path) -> bool:
        """Tells whether a name, by its ending, is a bare mesh (`Scene.from_file` takes both) and not a scene file."""
        suffix = Path(path).suffix.lower()
        return suffix != "" and suffix not in _YAML_ENDINGS

    def message(self) -> scene_pb2.Scene:
        """Checks the fields, reads the meshes and makes the message.

        Raises:
            NotFoundError: a mesh or a picture that a field names does not exist.
            InvalidArgumentError: a mistake; the message names the file and the path of the field.
        """
        message = scene_pb2.Scene()
        fields = checked_fields(self.fields, cast(Descriptor, message.DESCRIPTOR), self.where, "")
        try:
            json_format.ParseDict(fields, message, max_recursion_depth=20)
        except json_format.ParseError as error:
            raise InvalidArgumentError(f"{self.where}: {error}") from error
        _resolve_files(message, self)
        return message


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
