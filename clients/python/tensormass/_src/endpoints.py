"""Data endpoints as a client reaches them."""

from __future__ import annotations

import re

from tensormass.v1 import control_pb2

# An address of every interface: a daemon binds it, a client has to connect to one of them.
_WILDCARD = re.compile(r"(?P<scheme>\w+(?:://|/))(?:0\.0\.0\.0|\[::\]|\*)(?P<port>:\d+)")
# The host of a gRPC target that ends in host:port; an IPv6 one keeps its brackets.
_HOST = re.compile(r"(\[[^]]*\]|[^/:]+)(?::\d+)?$")


def reached_endpoint(endpoint: str, control: str) -> str:
    """A data endpoint (tcp://host:port, tcp/host:port) as a client connects to it that reached the daemon at `control`.

    A daemon that listens on every interface does not know which of them leads to the client; the client does: it goes
    to the host at which it reached the control plane (host:port). Every other endpoint stays as it is.
    """
    wildcard, host = _WILDCARD.fullmatch(endpoint), _HOST.search(control)
    return f"{wildcard['scheme']}{host[1]}{wildcard['port']}" if wildcard and host else endpoint


def reached_endpoints(version: control_pb2.GetVersionResponse, control: str) -> control_pb2.GetVersionResponse:
    """A daemon's answer with each of its endpoints as `reached_endpoint` says."""
    reached = control_pb2.GetVersionResponse()
    reached.CopyFrom(version)
    reached.zeromq_publish_endpoint = reached_endpoint(version.zeromq_publish_endpoint, control)
    reached.zeromq_pose_endpoint = reached_endpoint(version.zeromq_pose_endpoint, control)
    reached.zenoh_locator = reached_endpoint(version.zenoh_locator, control)
    return reached
