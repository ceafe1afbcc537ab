"""Command lines: options have one name, and refusals repeat no secret."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import pytest

from tensormass_tools.cli import _parser, main
from tensormass_tools.parser import Parser

SECRET = "s3cret-of-an-operator"


def every_parser(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action.choices.values():
                yield from every_parser(choice)


def refusal(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as usage:
        main(arguments)
    assert usage.value.code == 2
    return capsys.readouterr().err


def test_no_command_takes_an_abbreviation() -> None:
    parsers = list(every_parser(_parser()))
    assert len(parsers) > 20
    assert [parser.prog for parser in parsers if parser.allow_abbrev or not isinstance(parser, Parser)] == []


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["view", "--token", SECRET], "--token"),
        (["view", f"--token={SECRET}"], "--token"),
        (["run", "--operator-token", SECRET], "--operator-token"),
        (["run", "beam", f"--operator-token={SECRET}"], "--operator-token"),
        (["--token", SECRET, "view"], "--token"),
        (["keys", "--password", SECRET, "list"], "--password"),
        (["view", f"-t{SECRET}"], "-t"),
    ],
)
def test_refusals_name_an_unknown_option_and_keep_its_value(
    arguments: list[str], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refusal(arguments, capsys)
    assert f"error: {name}: no option has this name" in told
    assert SECRET not in told


def test_a_token_in_place_of_its_file_is_not_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    told = refusal(["view", "--token-file", SECRET], capsys)
    assert "argument --token-file: the file: cannot be read" in told
    assert SECRET not in told


def test_other_arguments_are_read_as_before() -> None:
    parser = Parser()
    parser.add_argument("--offset", type=float)
    parser.add_argument("rest", nargs="*")
    assert parser.parse_args(["--offset", "-3.5"]).offset == -3.5
    assert parser.parse_args(["--offset=-.5", "--", "--unknown", "-"]).rest == ["--unknown", "-"]
