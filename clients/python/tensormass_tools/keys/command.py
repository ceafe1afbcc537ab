"""The arguments of `tensormass keys`, and what it prints."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from tensormass._shared.client_keys import date_of
from tensormass._shared.extras import require
from tensormass_tools.output import print_json
from tensormass_tools.parser import Parser

ROLES = ("operator", "hand", "viewer", "recorder", "metrics")


def add_arguments(parser: argparse.ArgumentParser, json_option: argparse.ArgumentParser) -> None:
    """Adds the subcommands."""
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    folder = Parser(add_help=False)
    folder.add_argument("--keys", type=Path, default=Path("keys"), metavar="FOLDER", help="default: %(default)s")
    valid = Parser(add_help=False)
    valid.add_argument("--days", type=float, default=365, help="how long the keys are valid (default: %(default)s)")
    host = "a name or address under which clients reach the daemon, besides those of this machine (repeatable)"

    sub = commands.add_parser("init", parents=[valid, json_option], help="make a folder of keys, for a daemon")
    sub.add_argument("keys", type=Path, nargs="?", default=Path("keys"), metavar="FOLDER", help="default: keys")
    sub.add_argument("--host", action="append", default=[], help=host)
    sub.set_defaults(keys_command=_init)

    sub = commands.add_parser("add", parents=[folder, valid, json_option], help="make the keys of a client")
    sub.add_argument("name")
    sub.add_argument("--role", required=True, choices=ROLES, help="what the client may do (docs/security.md)")
    sub.add_argument("--of", metavar="SCENE/TOOL", help="scene and tool of a hand")
    sub.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: FOLDER/clients/NAME.json")
    sub.add_argument(
        "--page",
        action="append",
        default=[],
        metavar="HOST",
        help="for a gateway: a name or address under which browsers reach it (repeatable)",
    )
    sub.set_defaults(keys_command=_add)

    sub = commands.add_parser("remove", parents=[folder, json_option], help="end a client's keys at once")
    sub.add_argument("name")
    sub.set_defaults(keys_command=_remove)

    sub = commands.add_parser("list", parents=[folder, json_option], help="clients, their roles, and when keys expire")
    sub.set_defaults(keys_command=_list)

    sub = commands.add_parser(
        "renew", parents=[folder, valid, json_option], help="make new keys in place of a client's or the daemon's"
    )
    sub.add_argument("name", nargs="?", help="the client; without it the daemon, which must then be restarted")
    sub.add_argument("--host", action="append", default=[], help=host)
    sub.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: FOLDER/clients/NAME.json")
    sub.set_defaults(keys_command=_renew)


def run(args: argparse.Namespace) -> int:
    require("keys", "tensormass keys")
    return int(args.keys_command(args))


def _init(args: argparse.Namespace) -> int:
    from tensormass_tools.keys.folder import KeyFolder

    KeyFolder(args.keys).init(args.host, args.days)
    if args.json:
        print_json({"keys": str(args.keys)})
    else:
        print(
            f"made {args.keys}\n"
            f"a client:  tensormass keys add NAME --role operator --keys {args.keys}\n"
            f"a daemon:  tensormassd --keys {args.keys}\n"
            f"Whoever reads {args.keys / 'authority.json'} can make keys: a daemon does not need it."
        )
    return 0


def _add(args: argparse.Namespace) -> int:
    from tensormass_tools.keys.folder import KeyFolder

    keys = KeyFolder(args.keys).add(
        args.name, args.role, of=args.of, days=args.days, output=args.output, pages=args.page
    )
    if args.json:
        print_json({"client": args.name, "id": keys.id, "role": keys.role, "file": str(keys.path)})
    else:
        print(f"wrote {keys.path}: keys of {args.name}, {args.role}, until {date_of(keys.expires_s)}")
    return 0


def _remove(args: argparse.Namespace) -> int:
    from tensormass_tools.keys.folder import KeyFolder

    KeyFolder(args.keys).remove(args.name)
    print_json({"removed": args.name}) if args.json else print(f"removed {args.name}; a daemon cuts it within 5 s")
    return 0


def _list(args: argparse.Namespace) -> int:
    from tensormass_tools.keys.folder import KeyFolder

    entries = KeyFolder(args.keys).entries()
    if args.json:
        print_json(
            [
                {"client": one.name, "role": one.role, "scene": one.scene, "tool": one.tool, "expires_s": one.expires_s}
                for one in entries
            ]
        )
        return 0
    for one in entries:
        of = f" of {one.scene}/{one.tool}" if one.role == "hand" else ""
        state = "expired" if time.time() >= one.expires_s else "until"
        print(f"{one.name}  {one.role}{of}  {state} {date_of(one.expires_s)}")
    if not entries:
        print("no client has keys")
    return 0


def _renew(args: argparse.Namespace) -> int:
    from tensormass_tools.keys.folder import KeyFolder

    path = KeyFolder(args.keys).renew(args.name, args.days, args.host, args.output)
    if args.json:
        print_json({"renewed": args.name or "daemon", "file": str(path)})
    elif args.name is None:
        print(f"wrote {path}; restart the daemon")
    else:
        print(f"wrote {path}; the keys before have ended")
    return 0
