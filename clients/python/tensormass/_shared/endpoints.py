"""Data endpoints as a client reaches them."""

from __future__ import annotations

import re

from tensormass.v1 import control_pb2

# Matches a wildcard address. A daemon binds it; a client must connect to one interface.
_WILDCARD = re.compile(r"(?P<scheme>\w+(?:://|/))(?:0\.0\.0\.0|\[::\]|\*)(?P<port>:\d+)")
# Matches the host of a gRPC target that ends in host:port. An IPv6 host keeps its brackets.
_HOST = re.compile(r"(\[[^]]*\]|[^/:]+)(?::\d+)?$")


def reached_endpoint(endpoint: str, control: str) -> str:
    """Returns a data endpoint (tcp://host:port, tcp/host:port) as the client that reached `control` (host:port)
    connects.

    A daemon that listens on every interface does not know which of them leads to the client. The client knows: it uses
    the host at which it reached the control plane. Every other endpoint is returned unchanged.
    """
    wildcard, host = _WILDCARD.fullmatch(endpoint), _HOST.search(control)
    return f"{wildcard['scheme']}{host[1]}{wildcard['port']}" if wildcard and host else endpoint


def reached_endpoints(version: control_pb2.GetVersionResponse, control: str) -> control_pb2.GetVersionResponse:
    """Returns a copy of a daemon's answer with each endpoint replaced by `reached_endpoint`."""
    reached = control_pb2.GetVersionResponse()
    reached.CopyFrom(version)
    reached.zeromq_publish_endpoint = reached_endpoint(version.zeromq_publish_endpoint, control)
    reached.zeromq_pose_endpoint = reached_endpoint(version.zeromq_pose_endpoint, control)
    reached.zenoh_locator = reached_endpoint(version.zenoh_locator, control)
    return reached
