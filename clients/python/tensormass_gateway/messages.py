"""The text messages of the WebSocket: gateway.proto in protobuf's JSON mapping, with the message's name as `type`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from google.protobuf import json_format
from google.protobuf.message import Message

from tensormass.v1 import gateway_pb2
from tensormass_gateway.requests import PARSE_ERRORS, ProtocolError

_ALL = gateway_pb2.GatewayMessage()
_TYPES = {type(getattr(_ALL, field.name)): field.name for field in _ALL.DESCRIPTOR.fields}
_MAX_WHOLE = 2**53


def to_json(message: Message) -> dict[str, Any]:
    """Returns a message of the gateway as it is sent: its type, and all fields, those with a default value too."""
    fields = json_format.MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    return {"type": _TYPES[type(message)], **{name: _whole(value) for name, value in fields.items()}}


def result_to_json(result: gateway_pb2.CommandResult, *, loaded: bool) -> dict[str, Any]:
    """Returns the result of a command as it is sent.

    Args:
        loaded: there are findings, or none was found. Each has those fields alone that have a value.
    """
    fields = to_json(result)
    findings = [json_format.MessageToDict(one, preserving_proto_field_name=True) for one in result.findings]
    del fields["findings"]
    return {**fields, "findings": findings} if loaded else fields


def read(request: Mapping[str, Any]) -> gateway_pb2.ViewerMessage:
    """Reads a message of a viewer whose fields are checked. Passes over those that it does not know.

    The mapping takes more than the gateway does, such as texts for numbers, and does not say what is wrong in a
    viewer's words. Each message is therefore checked before.

    Raises:
        ProtocolError: a type or a field that the mapping does not take.
    """
    kind, message = request["type"], gateway_pb2.ViewerMessage()
    if kind not in message.DESCRIPTOR.fields_by_name:
        raise ProtocolError("a message's type or fields are unknown")
    fields = {name: value for name, value in request.items() if name != "type"}
    try:
        json_format.ParseDict(fields, getattr(message, kind), ignore_unknown_fields=True)
    except PARSE_ERRORS as error:
        raise ProtocolError("a message's type or fields are unknown") from error
    return message


def _whole(value: object) -> object:
    """Returns a whole number as int, because JSON of a page has 7 and not 7.0."""
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) <= _MAX_WHOLE else value
