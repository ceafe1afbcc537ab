"""The gateway's options, and the same as command-line arguments."""

from __future__ import annotations

import argparse
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from tensormass_gateway.origins import origin_of

DEFAULT_VIEWER = Path(__file__).resolve().parents[2] / "web" / "dist"


@dataclass(frozen=True)
class GatewayOptions:
    """How a gateway listens and whom it lets in."""

    control: str = "127.0.0.1:50051"
    """The daemon's control address, host:port."""
    host: str = "127.0.0.1"
    port: int = 0
    """0: a free one."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    max_browsers: int = 16
    origins: tuple[str, ...] = ()
    """Origins let in beside those of the gateway's own pages."""
    allow_poses: bool = False
    viewer: Path = DEFAULT_VIEWER
    poll_interval_s: float = 1.0
    """How often the daemon is asked for its scenes, and how soon its return is noticed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The gateway's options, for `tensormass view` and `tensormass run`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s, loopback)")
    parser.add_argument("--port", type=int, default=0, help="port to listen on; 0: a free one (default)")
    parser.add_argument("--token", default=None, help="what a browser must know (default: random)")
    parser.add_argument("--max-browsers", type=int, default=16, help="browsers at once (default: %(default)s)")
    parser.add_argument(
        "--origin",
        action="append",
        type=_origin_argument,
        default=[],
        metavar="URL",
        help="let in pages of this origin too, such as http://viewer.example:8000: needed where a page's address is a "
        "name other than localhost and this machine's (repeatable)",
    )
    parser.add_argument("--allow-poses", action="store_true", help="let browsers move tools (default: they only look)")
    parser.add_argument("--viewer", type=Path, default=DEFAULT_VIEWER, help="folder of the built viewer")
    parser.add_argument(
        "--gateway-ready-file",
        type=Path,
        default=None,
        metavar="PATH",
        help="write {url, host, port, token, pid} as JSON when listening",
    )


def options_from(args: argparse.Namespace, control: str) -> GatewayOptions:
    """What `add_arguments` parsed, for the daemon at `control` (host:port)."""
    optional = {} if args.token is None else {"token": args.token}
    return GatewayOptions(
        control=control,
        host=args.host,
        port=args.port,
        max_browsers=args.max_browsers,
        origins=tuple(args.origin),
        allow_poses=args.allow_poses,
        viewer=args.viewer,
        **optional,
    )


def _origin_argument(text: str) -> str:
    try:
        return origin_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
