"""Options of the gateway, and their command-line arguments."""

from __future__ import annotations

import argparse
import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from tensormass import InvalidArgumentError
from tensormass._shared.client_keys import ClientKeys, keys_of
from tensormass._shared.processes import BUNDLE
from tensormass._shared.secret_files import read_secret
from tensormass_gateway.origins import origin_of


def find_viewer() -> Path:
    """Returns the folder of the built viewer: in the installed wheel, else in the checkout, where it may be missing."""
    bundled = BUNDLE / "viewer"
    return bundled if bundled.is_dir() else Path(__file__).resolve().parents[2] / "web" / "dist"


DEFAULT_VIEWER = find_viewer()


@dataclass(frozen=True)
class GatewayOptions:
    """Options of a gateway: its address, and who may connect."""

    control: str = "127.0.0.1:50051"
    """Control address of the daemon, host:port."""
    host: str = "127.0.0.1"
    port: int = 0
    """0 takes a free port."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Token of those who look."""
    operator_token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Token of those who also control scenes."""
    metrics_token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Token of Prometheus, which reads `/metrics` and nothing else."""
    max_browsers: int = 16
    origins: tuple[str, ...] = ()
    """Origins that may connect in addition to the gateway's own pages."""
    keys: ClientKeys | None = None
    """Keys of the gateway, for a daemon with keys; None: the daemon asks for none."""
    page: ClientKeys | None = None
    """Keys with the certificate of the page, for HTTPS; None: the page is for this machine alone."""
    allow_poses: bool = False
    """Whether operators may move tools."""
    viewer: Path = DEFAULT_VIEWER
    poll_interval_s: float = 1.0
    """Period at which the daemon is asked for its scenes. A restarted daemon is found as soon."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the gateway's options, for `tensormass view` and `tensormass run`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s, loopback)")
    parser.add_argument("--port", type=int, default=0, help="port to listen on; 0: a free one (default)")
    for option, does in (("--token-file", "look"), ("--operator-token-file", "control scenes")):
        parser.add_argument(
            option,
            type=_token_argument,
            metavar="FILE",
            help=f"holds what a browser must know to {does}: 16 characters or more (default: random)",
        )
    parser.add_argument(
        "--metrics-token-file",
        type=_token_argument,
        metavar="FILE",
        help="holds what Prometheus must know to read /metrics (default: random; the two tokens above do, too)",
    )
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
    parser.add_argument(
        "--allow-poses", action="store_true", help="let operators move tools with the pointer (default: they do not)"
    )
    parser.add_argument("--viewer", type=Path, default=DEFAULT_VIEWER, help="folder of the built viewer")
    parser.add_argument(
        "--gateway-ready-file",
        type=Path,
        default=None,
        metavar="PATH",
        help="write {url, host, port, token, operator_token, pid} as JSON when listening",
    )


def options_from(args: argparse.Namespace, control: str, *, daemon_has_keys: bool = True) -> GatewayOptions:
    """Makes options of the arguments of `add_arguments`, for the daemon at `control` (host:port).

    Args:
        daemon_has_keys: whether --keys are for the daemon too, or for the page alone.
    """
    keys = keys_of(getattr(args, "keys", None))
    tokens = {
        "token": args.token_file,
        "operator_token": args.operator_token_file,
        "metrics_token": args.metrics_token_file,
    }
    return GatewayOptions(
        control=control,
        host=args.host,
        port=args.port,
        max_browsers=args.max_browsers,
        origins=tuple(args.origin),
        keys=keys if daemon_has_keys else None,
        page=keys if keys is not None and keys.page_certificate else None,
        allow_poses=args.allow_poses,
        viewer=args.viewer,
        **{name: token for name, token in tokens.items() if token is not None},
    )


def _token_argument(path: str) -> str:
    """Reads a token. The list of a machine's processes shows arguments to all of its users, so no argument is one."""
    # The name of a file that does not exist may be the token itself, given by mistake.
    name = path if os.path.lexists(path) else "the file"
    try:
        return read_secret(Path(path), name, missing="", exposed="").strip()
    except InvalidArgumentError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _origin_argument(text: str) -> str:
    try:
        return origin_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
