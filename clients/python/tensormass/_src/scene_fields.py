"""Checks the fields of a scene file against the schema, so that a mistake is named by its place and remedy."""

from __future__ import annotations

import math
import sys
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from tensormass._src.enums import enum_number
from tensormass._src.errors import InvalidArgumentError
from tensormass._src.names import suggestion


def checked_fields(content: object, descriptor: Descriptor, where: str, path: str) -> dict[str, Any]:
    """The fields with the full names of enums. Refuses what the parser would pass over or explain poorly: unknown,
    empty and wrongly nested fields."""
    at = f"{where}: {path or 'scene'}"
    if not isinstance(content, dict):
        raise InvalidArgumentError(f"{at}: expected a mapping of {descriptor.name}'s fields, found {content!r}")
    fields = descriptor.fields_by_name
    checked: dict[str, Any] = {}
    for key, value in content.items():
        field = fields.get(key) if isinstance(key, str) else None
        if field is None:
            raise InvalidArgumentError(f"{at}: {descriptor.name} has no field {key!r}; {suggestion(str(key), fields)}")
        inner = f"{path}.{key}" if path else key
        if value is None:
            raise InvalidArgumentError(f"{where}: {inner}: has no value; give one or leave the field out")
        if not field.is_repeated:
            values = {inner: value}
        elif isinstance(value, list):
            values = {f"{inner}[{index}]": item for index, item in enumerate(value)}
        else:
            raise InvalidArgumentError(f"{where}: {inner}: expected a list, found {value!r}")
        items: list[Any] = []
        for place, item in values.items():
            if field.message_type is not None:
                items.append(checked_fields(item, field.message_type, where, place))
                continue
            _check_value(field, item, f"{where}: {place}")
            items.append(
                enum_number(field.enum_type, item, f"{where}: {place}") if field.enum_type is not None else item
            )
        checked[key] = items if field.is_repeated else items[0]
    return checked


def _check_value(field: FieldDescriptor, value: object, where: str) -> None:
    """Refuses what is no number or text that the field can hold, as far as the parser does not."""
    if isinstance(value, dict | list | None):
        raise InvalidArgumentError(f"{where}: expected one value, found {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidArgumentError(f"{where}: expected a finite number, found {value!r}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        beyond = f"above {sys.float_info.max:.2g}" if value > 0 else f"below {-sys.float_info.max:.2g}"
        raise InvalidArgumentError(f"{where}: expected a finite number, found one {beyond}")
    # `yes` and `on` too, which the parser takes for 1; what an enum knows is said with it.
    if isinstance(value, bool) and field.type not in (FieldDescriptor.TYPE_BOOL, FieldDescriptor.TYPE_ENUM):
        is_text = field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
        expected, remedy = ("text", "; write it in quotes") if is_text else ("a number", "")
        raise InvalidArgumentError(f"{where}: expected {expected}, found {str(value).lower()}{remedy}")
