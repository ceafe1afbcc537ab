"""Edits of a scene file's fields."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor

#: The value of a knob.
Value = str | float | int


def with_numbers(fields: Mapping[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    """Copies fields and turns texts into numbers where the schema has numbers.

    To YAML `1e-2` and `"4"` are texts, which protobuf accepts as numbers. The copy shares nothing, unlike YAML's
    aliases, so that each body can be edited alone.
    """

    def read(value: Any, field: FieldDescriptor) -> Any:  # noqa: ANN401
        if isinstance(value, list):
            return [read(item, field) for item in value]
        if field.message_type is not None:
            return with_numbers(value, field.message_type)
        if not isinstance(value, str) or field.cpp_type not in _NUMBERS:
            return value
        number = float(value)
        if not math.isfinite(number):
            return value  # protobuf accepts it only as a text
        return number if field.cpp_type == FieldDescriptor.CPPTYPE_DOUBLE else int(number)

    return {name: read(value, descriptor.fields_by_name[name]) for name, value in fields.items()}


_NUMBERS = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_UINT32)


def solver_setter(name: str) -> Callable[[dict[str, Any], Value], None]:
    return lambda fields, value: fields.setdefault("solver", {}).update({name: value})


def set_integrator(fields: dict[str, Any], value: Value) -> None:
    """Sets the time scheme. Equilibrium in place of a dynamic step may end above its tolerance, like that."""
    solver = fields.setdefault("solver", {})
    solver["integrator"] = value
    if value == "quasi_static":
        solver["allow_unconverged"] = True
    else:
        solver.pop("allow_unconverged", None)


def set_dt(fields: dict[str, Any], value: Value) -> None:
    stepping = fields.setdefault("stepping", {})
    if "rate_hz" in stepping:  # keeps the speed against the clock
        stepping["rate_hz"] *= stepping.get("dt_s", 1 / 60) / float(value)
    stepping["dt_s"] = value


def each_body(fields: dict[str, Any], edit: Callable[[dict[str, Any]], None]) -> None:
    for body in fields["bodies"]:
        edit(body)


def set_contact_method(fields: dict[str, Any], value: Value) -> None:
    for tool in fields["tools"]:
        tool["contact_method"] = value
