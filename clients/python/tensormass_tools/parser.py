"""The parser of a command line that may hold a secret."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

_NUMBER = re.compile(r"-\.?\d")


class Parser(argparse.ArgumentParser):
    """Takes options by their full names, and refuses one that it does not know before it reads what follows.

    argparse takes `--token` as short for `--token-file` and repeats what it cannot use. The value may be a secret, and
    the refusal may end in a log, so the refusal says the option's name alone.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(*args, **{**kwargs, "allow_abbrev": False})

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]  # noqa: ANN401
        given = list(sys.argv[1:] if args is None else args)
        known = set(self._names())
        for argument in given[: given.index("--")] if "--" in given else given:
            if not argument.startswith("-") or argument == "-" or _NUMBER.match(argument):
                continue
            name = argument.partition("=")[0] if argument.startswith("--") else argument[:2]
            if name not in known:
                self.error(f"{name}: no option has this name; --help lists those of a command")
        return super().parse_args(given, namespace)

    def _names(self) -> Iterator[str]:
        """Returns the names of all options, those of subcommands too."""
        for action in self._actions:
            yield from action.option_strings
            for choice in (action.choices or {}).values() if isinstance(action.choices, dict) else ():
                if isinstance(choice, Parser):
                    yield from choice._names()
