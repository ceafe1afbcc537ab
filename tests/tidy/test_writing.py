"""The check of writing catches each phrase where people read it, and nothing in code or in plain English."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest
import writing

ANYWHERE = [
    "a force that is none",
    "the rows are none of these",
    "a value that is no number",
    "what was no\nsphere",
    "the mass is to be positive",
    "elements turned inside out",
    "an inside-out element",
    "the begin of a step",
    "from its begin",
    "near memory",
    "this puts aside the state",
    "this puts the state aside",
    "twelve rows, of which two are fixed",
    "the kept state",
    "the history of a law",
    "the scene as it is",
    "eight stations",
    "the imbalance of forces",
    "driven nodes",
    "the supports",
    "the careful settings",
    "made positive",
    "positive stiffness",
    "shares of moduli",
    "at the last look",
    "TM_CHECK returns",
    "TM_TRY returns",
]
FIRST = ["Of padding: negative.", "of padding", "What is left of it.", "Where it is.", "Beside the tool."]
PRONOUN = ["It fails.", "Its energy.", "They move.", "This is the energy."]
PLAIN = [
    "Fails where there is none.",
    "There is no GPU here, and it is no longer needed.",
    "A setting that is no slower.",
    "The first of the rows begins where the tool is.",
    "Parts begin and end at a node.",
    "The load imbalance of warps.",
    "This function supports both precisions.",
    "Returns `what is none` and `TM_TRY`.",
    "A workstation holds a history of frames.",
    "Offset of the tool",
]


def found(path: str, text: str) -> list[str]:
    return writing.writing(PurePosixPath(path), text)


def comment(text: str, mark: str) -> str:
    return "\n".join(f"{mark} {line}" for line in text.split("\n")) + "\n"


@pytest.mark.parametrize("text", ANYWHERE)
def test_a_phrase_is_refused(text: str) -> None:
    assert len(found("docs/a.md", f"The page.\n\nHere {text}.\n")) == 1
    assert len(found("server/a.h", "int a;\n" + comment(f"Here {text}.", "///"))) == 1
    assert len(found("a.py", comment(f"Here {text}.", "#"))) == 1


@pytest.mark.parametrize("text", FIRST + PRONOUN)
def test_first_words_are_refused(text: str) -> None:
    for path, mark in [("a.h", "///"), ("a.ts", "//"), ("a.proto", "//"), ("a.py", "#"), ("Makefile", "#")]:
        assert len(found(path, comment(text, mark))) == 1, path
        assert found(path, comment(f"Reads the rows.\n{text}", mark)) == [], f"{path}: not the start of the comment"
    assert len(found("a.py", f'def f():\n    """{text}"""\n')) == 1
    assert len(found("a.css", f"/* {text} */\n")) == 1
    assert len(found("a.h", f"int a;  ///< {text}\nint b;  ///< Mass.\n")) == 1


@pytest.mark.parametrize("text", FIRST)
def test_first_words_of_a_paragraph_are_refused(text: str) -> None:
    assert len(found("a.md", f"# Title\n\n{text}\n")) == 1
    assert found("a.md", f"# {text}\n\n- {text}\n\n| {text} | b |\n") == []


@pytest.mark.parametrize("text", PRONOUN)
def test_a_paragraph_may_begin_with_a_pronoun(text: str) -> None:
    assert found("a.md", f"`make run` starts the daemon.\n\n{text}\n") == []


@pytest.mark.parametrize("text", PLAIN)
def test_plain_text_passes(text: str) -> None:
    assert found("a.md", text) == []
    assert found("a.cpp", comment(text, "//")) == []
    assert found("a.py", comment(text, "#")) == []


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("a.cpp", 'say("// Of rows");\nR"(// Of rows)";\nint begin = 1\'000;\nint begin = of_which;\n'),
        ("a.ts", "say(`// Of rows`);\nconst page = 'http://of.rows/ Of rows';\n"),
        ("a.rs", "fn f<'a>(x: &'a str) { say(\"// Of rows\") }\n"),
        ("a.py", 'say("# Of rows")\nload("--stations", "stations")\nmode = "careful"\n'),
        ("a.sh", 'echo "a # Of rows"\n'),
        ("a.md", "```\nit is none\n```\n\n[a](is-none-inside-out.md)\n"),
        ("a.json", '"it is none"\n'),
    ],
)
def test_code_is_not_read(path: str, text: str) -> None:
    assert found(path, text) == []


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("a.cpp", 'int a;\nsay("of {} rows, which is none of them", a);\n'),
        ("a.cpp", 'int a;\nauto text = R"(the supports)";\n'),
        ("a.cpp", "int a;\nTEST(Rows, FindTheCarefulSettings) {}\n"),
        ("a.cpp", "int a;\nTYPED_TEST(Rows, AreTurnedInsideOut) {}\n"),
        ("a.ts", "const a = 1;\nit('refuses what is none', check);\n"),
        ("a.ts", "const a = 1;\nsay(`${a} is no stream`);\n"),
        ("a.py", 'a = 1\nsay("stations", f"{a} is none")\n'),
        ("a.py", "a = 1\ndef test_rates_that_are_none() -> None: ...\n"),
        ("a.sh", 'a=1\necho "$a is none"\n'),
        ("a.yaml", "a: 1\ndescription: a beam whose end is none # the beam\n"),
        ("Makefile", "a = 1\nrun: ## Start what is none\n"),
        ("a.html", "<p>\n<b>it is none</b>\n"),
    ],
)
def test_messages_and_names_of_tests_are_read(path: str, text: str) -> None:
    (problem,) = found(path, text)
    assert problem.startswith(f"{path}:2: ")


def test_places_are_named() -> None:
    assert found("a.h", "int a;\n// Rows, and\n// what is\n// none.\n") == [
        "a.h:3: 'is none'; say what it is not, or 'there is no ...'"
    ]
    assert found("a.py", '"""Rows.\n\nOne is inside out.\n"""\n') == ["a.py:3: 'inside out'; inverted"]
    assert found("a.md", "a\n\n```\nb\n```\n\nc\nnear memory\n") == [
        "a.md:8: 'near memory'; shared memory, L1 or registers"
    ]
    assert found("a.html", "<p>rows</p>\n<!-- is none -->\n")[0].startswith("a.html:2:")


def test_a_comment_behind_code_goes_on_in_its_column() -> None:
    assert found("a.h", "int a;  // The mass\n        // where rows are.\n") == []
    assert len(found("a.h", "int a;  // The mass\n// Where rows are.\n")) == 1


def test_a_line_that_stands_twice_is_refused() -> None:
    twice = "Ends the viewers and returns the report of each."
    assert found("a.py", f'def f():\n    """{twice}\n    {twice}"""\n') == [
        "a.py:3: 'Ends the viewers and returns the report ...' stands twice"
    ]
    assert found("a.h", "// ------\n// ------\n// x | y\n// x | y\n") == []


def test_long_sentences_are_advice() -> None:
    long = "word " * (writing.MAX_WORDS + 1)
    assert writing.long_sentences(PurePosixPath("a.md"), f"Short one. {long.strip()}.\n") == [
        f"a.md:1: a sentence of {writing.MAX_WORDS + 1} words"
    ]
    assert found("a.md", long) == []
    assert writing.long_sentences(PurePosixPath("a.py"), f"say('{long}')\n") == []


def test_the_command_lists_findings(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    (tmp_path / "server").mkdir()
    (tmp_path / "server/a.h").write_text("// Of rows.\n")
    (tmp_path / "b.md").write_text("It is none.\n")

    def run(*arguments: str) -> tuple[int, str]:
        command = [sys.executable, writing.__file__, *arguments]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        return result.returncode, result.stdout + result.stderr

    assert run("server") == (1, "server/a.h:1: 'Of'; name the subject first\n")
    assert len(run()[1].splitlines()) == 2
    (tmp_path / "server/a.h").write_text("// Rows.\n")
    assert run("server") == (0, "nothing found\n")
    assert run("nowhere")[0] == 2
