"""The protocol's enums by the short names that scene files use."""

from __future__ import annotations

from google.protobuf.descriptor import EnumDescriptor

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion


def enum_number(enum: EnumDescriptor, value: object, where: str) -> int:
    """Returns the number of a value, by its full or short name: SHAPE_HEXAHEDRON, hexahedron."""
    known = {short_name(enum, of.number): of.number for of in enum.values if of.number != 0}
    short = str(value).removeprefix(_enum_prefix(enum)).lower()
    if short not in known:
        said = short if isinstance(value, bool) else repr(value)
        raise InvalidArgumentError(f"{where}: unknown value {said}; {suggestion(short, known)}")
    return known[short]


def short_name(enum: EnumDescriptor, number: int) -> str:
    """Returns the short name that scene files use: SHAPE_HEXAHEDRON -> hexahedron."""
    return str(enum.values_by_number[number].name).removeprefix(_enum_prefix(enum)).lower()


def _enum_prefix(enum: EnumDescriptor) -> str:
    return "".join(f"_{c}" if c.isupper() else c.upper() for c in enum.name).removeprefix("_") + "_"
