"""Checks the fields of a scene file against the schema, so that a mistake is named by its place and remedy."""

from __future__ import annotations

import math
import sys
from typing import Any, cast

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from tensormass._shared.enums import enum_number
from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._shared.units import in_si, unit_of

_MAX_UINT32 = 2**32 - 1


def checked_fields(content: object, descriptor: Descriptor, where: str, path: str) -> dict[str, Any]:
    """Checks fields against the schema and returns them with the numbers of enums.

    Refuses unknown, empty and wrongly nested fields, which the parser would pass over or explain poorly.

    Args:
        where: file, for messages.
        path: of `content` in the scene; empty for the scene itself.
    """
    at = f"{where}: {path or 'scene'}"
    if not isinstance(content, dict):
        raise InvalidArgumentError(f"{at}: expected a mapping of {descriptor.name}'s fields, found {content!r}")
    fields = descriptor.fields_by_name
    checked: dict[str, Any] = {}
    for key, value in content.items():
        field = fields.get(key) if isinstance(key, str) else None
        if field is None:
            inside = _path_within(descriptor, str(key))
            remedy = f"did you mean {inside!r}?" if inside else suggestion(str(key), fields)
            raise InvalidArgumentError(f"{at}: {descriptor.name} has no field {key!r}; {remedy}")
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
            _check_value(field, item, f"{where}: {place}", place)
            items.append(
                enum_number(field.enum_type, item, f"{where}: {place}") if field.enum_type is not None else item
            )
        checked[key] = items if field.is_repeated else items[0]
    return checked


def _path_within(descriptor: Descriptor, name: str, levels: int = 2) -> str | None:
    """Returns the path of the first nested field of this name, as `law.hooke.young_modulus_pa` in a body, or None.

    Skips packed arrays, because scene files do not contain them.
    """
    for field in descriptor.fields:
        if (inner := field.message_type) is None:
            continue
        found = inner.fields_by_name.get(name)
        if found is not None and found.type != FieldDescriptor.TYPE_BYTES:
            return f"{field.name}.{name}"
        if levels > 1 and (path := _path_within(inner, name, levels - 1)) is not None:
            return f"{field.name}.{path}"
    return None


def _check_value(field: FieldDescriptor, value: object, where: str, path: str) -> None:
    """Refuses a value that the field cannot hold. The protobuf parser would say so in nested texts of its own.

    Args:
        where: file and path, for messages.
        path: of the field in the scene; its names give the unit.
    """
    if isinstance(value, dict | list | None):
        raise InvalidArgumentError(f"{where}: expected one value, found {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidArgumentError(f"{where}: expected a finite number, found {value!r}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        beyond = f"above {sys.float_info.max:.2g}" if value > 0 else f"below {-sys.float_info.max:.2g}"
        raise InvalidArgumentError(f"{where}: expected a finite number, found one {beyond}")
    if field.enum_type is not None:
        return  # `enum_number` refuses unknown values
    if field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES):
        if not isinstance(value, str):
            raise InvalidArgumentError(f"{where}: expected text, found {_as_written(value)}; write it in quotes")
    elif field.type == FieldDescriptor.TYPE_BOOL:
        if not isinstance(value, bool):
            raise InvalidArgumentError(f"{where}: expected true or false, found {_as_written(value)}")
    else:
        _check_number(field, value, where, path)


def _check_number(field: FieldDescriptor, value: object, where: str, path: str) -> None:
    """Texts that are numbers are accepted, because YAML reads `1e-2` as a text."""
    whole = field.cpp_type == FieldDescriptor.CPPTYPE_UINT32
    unit = next(filter(None, map(unit_of, reversed(path.split(".")[-2:]))), None)
    expected = "a whole number" if whole else f"a number in {unit}" if unit else "a number"
    # The parser would take `yes` and `on` for 1.
    if isinstance(value, bool):
        raise InvalidArgumentError(f"{where}: expected a number, found {_as_written(value)}")
    try:
        number = float(cast(float, value))
    except (TypeError, ValueError):
        si = in_si(value, unit) if unit and isinstance(value, str) else None
        remedy = f"; write {si:.12g}" if si is not None else ""
        raise InvalidArgumentError(f"{where}: expected {expected}, found {_as_written(value)}{remedy}") from None
    if whole and not number.is_integer():
        raise InvalidArgumentError(f"{where}: expected {expected}, found {_as_written(value)}")
    if whole and not 0 <= number <= _MAX_UINT32:
        raise InvalidArgumentError(f"{where}: expected {expected} of 0 to {_MAX_UINT32}, found {_as_written(value)}")


def _as_written(value: object) -> str:
    """Writes a value about as a scene file has it."""
    return str(value).lower() if isinstance(value, bool) else str(value) if isinstance(value, int) else repr(value)
