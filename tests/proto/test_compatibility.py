"""The protocol keeps what it has released, and each way to break it is refused."""

from __future__ import annotations

from pathlib import Path

import compatibility
import pytest

HEAD = 'syntax = "proto3";\npackage test.v1;\n'
SCHEMA = """
message Scene {
  reserved 9;
  reserved "old";
  string name = 1;
  optional double dt_s = 2;
  repeated Tool tools = 3;
  enum State { STATE_UNSPECIFIED = 0; STATE_RUNNING = 1; }
  State state = 4;
}
message Tool {
  oneof kind { Probe probe = 1; Hook hook = 2; }
  double speed = 3;
  map<string, double> joints = 4;
}
message Probe { double radius_m = 1; }
message Hook {}
message Spare {}
enum Shape { reserved 7; reserved "SHAPE_OLD"; SHAPE_UNSPECIFIED = 0; SHAPE_WEDGE = 1; }
service Control {
  rpc Load(Scene) returns (Tool);
  rpc Follow(Scene) returns (stream Tool);
}
"""
# Old text, new text, and the line that tells what breaks.
BREAKING = {
    "field removed": ("  string name = 1;\n", "", "test.v1.Scene.name: field removed"),
    "field removed, name not reserved": ("string name = 1;", "reserved 1;", "test.v1.Scene.name: field removed"),
    "field removed, number not reserved": ("string name = 1;", 'reserved "name";', "test.v1.Scene.name: field removed"),
    "field renumbered": ("string name = 1;", "string name = 5;", "test.v1.Scene.name: was 1, is 5"),
    "field renamed": ("string name = 1;", "string title = 1;", "test.v1.Scene.name: field 1 is now named title"),
    "field retyped": ("string name = 1;", "bytes name = 1;", "test.v1.Scene.name: was 'string', is 'bytes'"),
    "message type changed": (
        "repeated Tool tools",
        "repeated Probe tools",
        "test.v1.Scene.tools: was 'repeated test.v1.Tool', is 'repeated test.v1.Probe'",
    ),
    "no longer repeated": ("repeated Tool", "Tool", "Scene.tools: was 'repeated test.v1.Tool', is 'test.v1.Tool'"),
    "presence lost": ("optional double", "double", "test.v1.Scene.dt_s: was 'optional double', is 'double'"),
    "map value retyped": (
        "map<string, double>",
        "map<string, float>",
        "test.v1.Tool.JointsEntry.value: was 'double', is 'float'",
    ),
    "moved into a oneof": (
        "Hook hook = 2; }\n  double speed = 3;",
        "Hook hook = 2; double speed = 3; }",
        "test.v1.Tool.speed: was 'double', is 'oneof kind double'",
    ),
    "moved out of a oneof": (
        "Hook hook = 2; }",
        "} Hook hook = 2;",
        "test.v1.Tool.hook: was 'oneof kind test.v1.Hook', is 'test.v1.Hook'",
    ),
    "oneof member removed": (" Hook hook = 2;", "", "test.v1.Tool.hook: field removed"),
    "reserved number given away": ("  reserved 9;\n", "  bool again = 9;\n", "test.v1.Scene: 9 is no longer reserved"),
    "reserved name given away": ('  reserved "old";\n', "", "test.v1.Scene: old is no longer reserved"),
    "message removed": ("message Spare {}\n", "", "test.v1.Spare: message removed"),
    "enum removed": ("enum Shape", "enum Other", "test.v1.Shape: enum removed"),
    "enum value removed": (" SHAPE_WEDGE = 1;", "", "test.v1.Shape.SHAPE_WEDGE: value removed"),
    "enum value renumbered": ("SHAPE_WEDGE = 1", "SHAPE_WEDGE = 2", "test.v1.Shape.SHAPE_WEDGE: was 1, is 2"),
    "enum value renamed": ("SHAPE_WEDGE", "SHAPE_PRISM", "Shape.SHAPE_WEDGE: value 1 is now named SHAPE_PRISM"),
    "nested enum value removed": (" STATE_RUNNING = 1;", "", "test.v1.Scene.State.STATE_RUNNING: value removed"),
    "reserved value given away": (" reserved 7;", "", "test.v1.Shape: 7 is no longer reserved"),
    "reserved value name given away": (' reserved "SHAPE_OLD";', "", "Shape: SHAPE_OLD is no longer reserved"),
    "service removed": ("service Control", "service Other", "test.v1.Control: service removed"),
    "call removed": ("  rpc Load(Scene) returns (Tool);\n", "", "test.v1.Control.Load: call removed"),
    "request changed": ("Load(Scene)", "Load(Probe)", "Load: input_type was .test.v1.Scene, is .test.v1.Probe"),
    "response changed": (
        "Load(Scene) returns (Tool)",
        "Load(Scene) returns (Hook)",
        "Load: output_type was .test.v1.Tool",
    ),
    "stream ended": ("(stream Tool)", "(Tool)", "Follow: server_streaming was True, is False"),
    "request streamed": ("Load(Scene)", "Load(stream Scene)", "Load: client_streaming was False, is True"),
}
ALLOWED = {
    "nothing": ("", ""),
    "field added": ("string name = 1;", "string name = 1; bool loud = 5;"),
    "oneof member added": ("Hook hook = 2;", "Hook hook = 2; Probe second = 5;"),
    "field removed and reserved": ("string name = 1;", 'reserved 1; reserved "name";'),
    "value removed and reserved": ("SHAPE_WEDGE = 1;", 'reserved 1; reserved "SHAPE_WEDGE";'),
    "value added": ("SHAPE_WEDGE = 1;", "SHAPE_WEDGE = 1; SHAPE_BALL = 2;"),
    "call added": ("  rpc Load(", "  rpc Unload(Scene) returns (Tool);\n  rpc Load("),
    "message added": ("message Hook {}", "message Hook {} message Knife {}"),
}


def write(folder: Path, text: str) -> Path:
    folder.mkdir()
    (folder / "a.proto").write_text(HEAD + text)
    return folder


def changes(tmp_path: Path, old: str, new: str) -> list[str]:
    assert old in SCHEMA, "the case no longer applies to the schema"
    released = compatibility.compiled(write(tmp_path / "released", SCHEMA))
    present = compatibility.compiled(write(tmp_path / "present", SCHEMA.replace(old, new, 1) if old else SCHEMA))
    return compatibility.breaking_changes(released, present)


def test_the_protocol_keeps_what_was_released() -> None:
    released, present = compatibility.compiled(compatibility.RELEASED), compatibility.compiled(compatibility.PRESENT)
    assert sum(len(message.field) for _, message in compatibility._messages(released)) > 200
    problems = compatibility.breaking_changes(released, present)
    assert not problems, "\n".join(problems)


def test_every_file_of_the_protocol_has_a_released_baseline() -> None:
    present, released = (
        {path.relative_to(folder) for path in folder.rglob("*.proto")}
        for folder in (compatibility.PRESENT, compatibility.RELEASED)
    )
    assert present == released, "record a new file with `python tests/proto/compatibility.py --release`"


@pytest.mark.parametrize("case", BREAKING)
def test_a_breaking_change_is_refused(case: str, tmp_path: Path) -> None:
    old, new, message = BREAKING[case]
    problems = changes(tmp_path, old, new)
    assert len(problems) == 1, problems
    assert message in problems[0]


@pytest.mark.parametrize("case", ALLOWED)
def test_a_compatible_change_is_allowed(case: str, tmp_path: Path) -> None:
    assert changes(tmp_path, *ALLOWED[case]) == []


def test_a_release_records_the_schema_without_comments(tmp_path: Path) -> None:
    source = write(tmp_path / "source", "// Of a scene.\n" + SCHEMA + "/* two\nlines */\n")
    target = write(tmp_path / "target", "message Gone {}")
    (target / "gone.proto").write_text(HEAD + "message AlsoGone {}")
    compatibility.release(source, target)
    assert [path.name for path in target.iterdir()] == ["a.proto"]
    assert "Of a scene" not in (target / "a.proto").read_text()
    assert compatibility.compiled(target) == compatibility.compiled(source)


def test_a_schema_that_does_not_compile_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(compatibility.SchemaError):
        compatibility.compiled(write(tmp_path / "broken", "message {"))
    with pytest.raises(compatibility.SchemaError):
        compatibility.compiled(tmp_path / "nothing")
