"""`tensormass export`: a scene with its meshes as one message, for clients without the SDK.

The daemon has no built-in scenes and reads no files. The SDK reads scene files, makes the meshes of organs, and packs
them into the message `Scene`; this command writes that message.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from google.protobuf import json_format

from tensormass import InvalidArgumentError
from tensormass._shared.files import replacing
from tensormass.v1 import control_pb2
from tensormass_tools import presets
from tensormass_tools.output import check_writable, print_json

_ENDINGS = (".pb", ".json")


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """The options of `tensormass export`."""
    parser.add_argument("scene", help=scene_help)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=".pb: the message Scene as protobuf bytes; .json: the message LoadSceneRequest as JSON, for grpcurl",
    )
    parser.add_argument("--name", help="name that replaces the scene's own")
    parser.add_argument("--preset", choices=tuple(presets.PROMISES), help="a measured setting of a built-in scene")


def run(args: argparse.Namespace) -> int:
    """Writes the file; 0 if that was possible."""
    output: Path = args.output
    if output.suffix not in _ENDINGS:
        raise InvalidArgumentError(f"--output {output}: must end in {' or '.join(_ENDINGS)}")
    check_writable("--output", output)
    message = presets.read_scene(args.scene, args.preset).message
    if args.name is not None:
        message.name = args.name
    if output.suffix == ".pb":
        content = message.SerializeToString()
    else:
        request = control_pb2.LoadSceneRequest(scene=message)
        content = json_format.MessageToJson(request, preserving_proto_field_name=True).encode()
    try:
        with replacing(output) as aside:
            aside.write_bytes(content)
    except OSError as error:
        raise InvalidArgumentError(f"--output {output}: cannot be written: {error.strerror}") from error
    if args.json:
        print_json({"output": str(output), "bytes": len(content)})
    else:
        print(f"wrote {output}, {len(content):,} bytes")
    return 0
