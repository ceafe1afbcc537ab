"""Compares the protocol with the last released one and says what would break a client of that release.

    python tests/proto/compatibility.py             list what breaks
    python tests/proto/compatibility.py --release   record the present protocol as the released one

`released/` holds the protocol of the last release without comments. Frames and poses carry field numbers; scene files
and the gateway's JSON carry field names. So neither the number nor the name of a field may change, and a removed field
must leave both reserved. Additions are always allowed.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    EnumValueDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorSet,
    ServiceDescriptorProto,
)

ROOT = Path(__file__).resolve().parents[2]
PRESENT = ROOT / "proto"
RELEASED = Path(__file__).resolve().parent / "released"


class SchemaError(Exception):
    """The schema does not compile; protoc has printed why."""


def compiled(folder: Path) -> FileDescriptorSet:
    """The descriptors of every .proto file below a folder."""
    files = sorted(map(str, folder.rglob("*.proto")))
    with tempfile.TemporaryDirectory() as output:
        target = Path(output) / "schema"
        protoc = [sys.executable, "-m", "grpc_tools.protoc"]  # as a program it finds google/protobuf/*.proto itself
        if not files or subprocess.call([*protoc, f"--proto_path={folder}", f"--descriptor_set_out={target}", *files]):
            raise SchemaError(f"{folder} does not compile")
        return FileDescriptorSet.FromString(target.read_bytes())


def breaking_changes(released: FileDescriptorSet, present: FileDescriptorSet) -> list[str]:
    """One line for each change that a client or a scene file of the release does not survive."""
    problems: list[str] = []
    new_messages, new_enums, new_services = dict(_messages(present)), dict(_enums(present)), dict(_services(present))
    for name, message in _messages(released):
        if name not in new_messages:
            problems.append(f"{name}: message removed")
        else:
            problems += _message_changes(name, message, new_messages[name])
    for name, enum in _enums(released):
        if name not in new_enums:
            problems.append(f"{name}: enum removed")
        else:
            problems += _enum_changes(name, enum, new_enums[name])
    for name, service in _services(released):
        if name not in new_services:
            problems.append(f"{name}: service removed")
        else:
            problems += _service_changes(name, service, new_services[name])
    return problems


def _message_changes(name: str, old: DescriptorProto, new: DescriptorProto) -> Iterator[str]:
    reserved = {n for span in new.reserved_range for n in range(span.start, span.end)}
    yield from _number_changes(name, "field", _pairs(old.field), _pairs(new.field), reserved, set(new.reserved_name))
    yield from _unreserved(name, {n for span in old.reserved_range for n in range(span.start, span.end)} - reserved)
    yield from _unreserved(name, set(old.reserved_name) - set(new.reserved_name))
    fields = {field.number: field for field in new.field}
    for field in old.field:
        if field.number in fields:
            before, after = _kind(old, field), _kind(new, fields[field.number])
            if before != after:
                yield f"{name}.{field.name}: was '{before}', is '{after}'"


def _enum_changes(name: str, old: EnumDescriptorProto, new: EnumDescriptorProto) -> Iterator[str]:
    # An enum's reserved ranges include their end; a message's do not.
    reserved = {n for span in new.reserved_range for n in range(span.start, span.end + 1)}
    yield from _number_changes(name, "value", _pairs(old.value), _pairs(new.value), reserved, set(new.reserved_name))
    yield from _unreserved(name, {n for span in old.reserved_range for n in range(span.start, span.end + 1)} - reserved)
    yield from _unreserved(name, set(old.reserved_name) - set(new.reserved_name))


def _service_changes(name: str, old: ServiceDescriptorProto, new: ServiceDescriptorProto) -> Iterator[str]:
    methods = {method.name: method for method in new.method}
    for method in old.method:
        if method.name not in methods:
            yield f"{name}.{method.name}: call removed"
            continue
        now = methods[method.name]
        for what in ("input_type", "output_type", "client_streaming", "server_streaming"):
            if getattr(method, what) != getattr(now, what):
                yield f"{name}.{method.name}: {what} was {getattr(method, what)}, is {getattr(now, what)}"


def _number_changes(
    name: str, what: str, old: dict[int, str], new: dict[int, str], reserved: set[int], reserved_names: set[str]
) -> Iterator[str]:
    """Names that changed their number, numbers that changed their name, and removals that do not reserve both."""
    numbers = {label: number for number, label in new.items()}
    for number, label in old.items():
        if label in numbers:
            if numbers[label] != number:
                yield f"{name}.{label}: was {number}, is {numbers[label]}"
        elif number in new:
            yield f"{name}.{label}: {what} {number} is now named {new[number]}"
        elif number not in reserved or label not in reserved_names:
            yield f'{name}.{label}: {what} removed; write `reserved {number};` and `reserved "{label}";` in its place'


def _unreserved(name: str, gone: Iterable[int | str]) -> Iterator[str]:
    for label in gone:
        yield f"{name}: {label} is no longer reserved"


def _pairs(entries: Iterable[FieldDescriptorProto | EnumValueDescriptorProto]) -> dict[int, str]:
    return {entry.number: entry.name for entry in entries}


def _kind(message: DescriptorProto, field: FieldDescriptorProto) -> str:
    """What a reader of the bytes must know of a field besides its number: repetition, presence and type."""
    words = []
    if field.label == FieldDescriptorProto.LABEL_REPEATED:
        words.append("repeated")
    if field.proto3_optional:
        words.append("optional")
    elif field.HasField("oneof_index"):
        words.append(f"oneof {message.oneof_decl[field.oneof_index].name}")
    words.append(
        field.type_name.removeprefix(".") or FieldDescriptorProto.Type.Name(field.type)[len("TYPE_") :].lower()
    )
    return " ".join(words)


def _messages(schema: FileDescriptorSet) -> Iterator[tuple[str, DescriptorProto]]:
    def below(prefix: str, messages: Iterable[DescriptorProto]) -> Iterator[tuple[str, DescriptorProto]]:
        for message in messages:
            name = f"{prefix}.{message.name}"
            yield name, message
            yield from below(name, message.nested_type)

    for file in schema.file:
        yield from below(file.package, file.message_type)


def _enums(schema: FileDescriptorSet) -> Iterator[tuple[str, EnumDescriptorProto]]:
    for file in schema.file:
        for enum in file.enum_type:
            yield f"{file.package}.{enum.name}", enum
    for name, message in _messages(schema):
        for enum in message.enum_type:
            yield f"{name}.{enum.name}", enum


def _services(schema: FileDescriptorSet) -> Iterator[tuple[str, ServiceDescriptorProto]]:
    for file in schema.file:
        for service in file.service:
            yield f"{file.package}.{service.name}", service


def without_comments(text: str) -> str:
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)
    return "".join(f"{line.rstrip()}\n" for line in text.split("\n") if line.strip())


def release(source: Path, target: Path) -> None:
    """Replaces the recorded schema by a copy of the source."""
    for old in target.rglob("*.proto"):
        old.unlink()
    for path in source.rglob("*.proto"):
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(without_comments(path.read_text()))
    if compiled(target) != compiled(source):
        raise SchemaError(f"{target} differs from {source}, though only comments were taken out")


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Compare the protocol with the last released one.")
    parser.add_argument("--release", action="store_true", help="record the present protocol as the released one")
    if parser.parse_args().release:
        release(PRESENT, RELEASED)
        return 0
    problems = breaking_changes(compiled(RELEASED), compiled(PRESENT))
    print("\n".join(problems) or "nothing breaks")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
