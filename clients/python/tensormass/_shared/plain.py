"""Protobuf messages as plain values, ready for JSON."""

from __future__ import annotations

from typing import Any

from google.protobuf.message import Message


def to_plain(message: Message) -> dict[str, Any]:
    """Converts every field, by its name in the schema. Numbers stay numbers (protobuf's own JSON writes 64-bit ones as
    text), enums become names, absent messages are left out."""
    plain: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if field.enum_type is not None:
            plain[field.name] = field.enum_type.values_by_number[value].name
        elif field.message_type is not None:
            plain[field.name] = [to_plain(item) for item in value] if field.is_repeated else to_plain(value)
        else:
            plain[field.name] = list(value) if field.is_repeated else value
    return plain
