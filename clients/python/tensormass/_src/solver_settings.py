"""Settings of the solver, the time step and the guard, checked against the schema."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, cast

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.scene_fields import checked_fields

Integrator = Literal["implicit_euler", "bdf2", "implicit_midpoint", "quasi_static"]
Precision = Literal["float", "double"]
OnFault = Literal["go_on", "stop"]


def set_fields(message: Message, where: str, fields: Mapping[str, Any]) -> None:
    """Sets the fields of a message that are not None. Refuses all of them if one is wrong.

    Args:
        where: method and message, for messages.
        fields: numbers, or short names of enums, by the names of the message's fields.

    Raises:
        InvalidArgumentError: a value that the field cannot hold; the message names the argument.
    """
    descriptor = cast(Descriptor, message.DESCRIPTOR)
    given = {name: value for name, value in fields.items() if value is not None}
    for name, value in given.items():
        # Scene files accept numbers as text, because YAML reads `1e-2` as a text.
        if isinstance(value, str) and descriptor.fields_by_name[name].enum_type is None:
            raise InvalidArgumentError(f"{where}: {name}: expected a number, found {value!r}")
    for name, value in checked_fields(given, descriptor, where, "").items():
        whole = isinstance(getattr(message, name), int)
        setattr(message, name, int(value) if whole else float(value))
