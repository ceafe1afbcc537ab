"""Refuses phrases that readers had to read three times: in comments, documents, messages and names of tests.

    python tests/tidy/writing.py [--long] [PATH ...]

Prints one line a finding (`file:line: 'phrase'; what to write instead`) and ends with 1 if there is any. A path is a
file or a folder. Without a path, every file of the repository is read. `--long` also lists long sentences, as advice.

`prose` finds what people read in a file: comments, docstrings, paragraphs, strings of several words and names of tests.
The rest is code, which is not checked.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import io
import itertools
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path, PurePosixPath

MAX_WORDS = 25

SLASHES = {".h", ".cc", ".cpp", ".cu", ".cuh", ".ts", ".js", ".mjs", ".rs", ".proto", ".css", ".in"}
HASHES = {".sh", ".cmake", ".yaml", ".yml", ".toml", "Makefile", "Dockerfile", "CMakeLists.txt", "run"}
NOT_PROSE = "tests/tidy/"  # spells out what it refuses


class Kind(Enum):
    COMMENT = 1  # or a docstring
    PARAGRAPH = 2
    PIECE = 3  # a heading, list item or table row: the rules about first words do not hold there
    TEXT = 4  # a message or the name of a test: neither do they here, and its sentences are not counted


@dataclass(frozen=True)
class Prose:
    """What people read: its text, and the line of the file on which each of its lines stands."""

    text: str
    lines: tuple[int, ...]
    kind: Kind = Kind.COMMENT


@dataclass(frozen=True)
class Phrase:
    pattern: re.Pattern[str]
    instead: str


def _phrase(pattern: str, instead: str, flags: re.RegexFlag = re.IGNORECASE) -> Phrase:
    """Compiles a pattern in which a space stands for any white space, so that it also matches across lines."""
    return Phrase(re.compile(pattern.replace(" ", r"\s+"), flags), instead)


_BE = "(?:is|are|was|were)"
_COMPARISON = (
    r"(?:longer|shorter|more|less|fewer|worse|better|slower|faster|larger|smaller|greater|bigger|higher|lower|closer|farther"
    r"|further|likelier|easier|harder|cheaper|earlier|later|stiffer|softer|one)\b"
)

# First words of a comment, docstring or paragraph. A question may begin with "What is" and "Where".
OPENINGS = (
    _phrase(r"[Oo]f\b", "name the subject first", re.NOFLAG),
    _phrase(rf"What {_BE}\b(?![^.]*\?)", "name the subject first", re.NOFLAG),
    _phrase(r"Where\b(?![^.]*\?)", "name the subject first", re.NOFLAG),
    _phrase(r"Beside\b", "name the subject first", re.NOFLAG),
)

# First words of a comment or docstring.
PRONOUNS = (
    _phrase(r"(?:It|Its|They|Them|Their|He|She)\b", "name the thing instead of a pronoun", re.NOFLAG),
    _phrase(
        rf"(?:This|That|These|Those) (?:{_BE}|does|do|has|have|can|must|may|will|makes|keeps|takes|gives)\b",
        "name the thing instead of a pronoun",
        re.NOFLAG,
    ),
)

PHRASES = (
    _phrase(rf"(?<!\bthere\s)\b{_BE} none\b", "say what it is not, or 'there is no ...'"),
    _phrase(rf"(?<!\bthere\s)\b{_BE} no (?!{_COMPARISON})", "is not a ..., has no ..., there is no ..."),
    _phrase(rf"\b{_BE} to be\b", "must be"),
    _phrase(r"\binside[- ]out\b", "inverted"),
    _phrase(r"\b(?:the|its|their|each|a) begin\b(?!\()|\bbegin of\b", "start"),
    _phrase(r"\bnear memory\b", "shared memory, L1 or registers"),
    _phrase(r"\bput(?:s|ting)? (?:\w+ ){0,4}aside\b", "saves as a checkpoint"),
    _phrase(r"\bof which\b", "two sentences"),
    _phrase(r"\bkept states?\b", "checkpoint"),
    _phrase(
        r"\b(?:memory|history|histories) of (?:a|the|its|their|each|every) (?:law|material)s?\b",
        "viscoelastic internal variables",
    ),
    _phrase(r"\bscenes? as (?:it is|they are)\b", "the unmodified scene, baseline"),
    _phrase(r"\bstations?\b", "concurrent scenes"),
    _phrase(r"(?<!\bload\s)\bimbalances?\b", "residual"),
    _phrase(r"\b(?:held|driven) (?:node|vertice|row|point|degree|surface|face|end|side)s?\b", "fixed, prescribed"),
    _phrase(r"\b(?:the|its|their|whose|all|own) supports\b", "boundary conditions, fixed nodes"),
    _phrase(r"\bcareful\b", "fallback settings"),
    _phrase(r"\b(?:made|makes?|making) positive\b|\bpositive stiffness\b", "projected to positive definite"),
    _phrase(r"\bshares of moduli\b", "selective reduced integration weights"),
    _phrase(r"\b(?:last|next|each|every|one) look\b", "check"),
    _phrase(r"\bTM_CHECK\b", "TM_RETURN_IF_ERROR", re.NOFLAG),
    _phrase(r"\bTM_TRY\b", "TM_ASSIGN_OR_RETURN", re.NOFLAG),
)


def writing(path: PurePosixPath, text: str) -> list[str]:
    """Every banned phrase in what people read in a file."""
    problems = []
    for part in prose(path, text):
        found = [(match, phrase) for phrase in PHRASES for match in phrase.pattern.finditer(part.text)]
        openings = {Kind.COMMENT: OPENINGS + PRONOUNS, Kind.PARAGRAPH: OPENINGS}.get(part.kind, ())
        found += [(match, phrase) for phrase in openings if (match := phrase.pattern.match(part.text))]
        rows = [row.strip() for row in part.text.split("\n")]
        problems += [
            f"{path}:{part.lines[at]}: '{after[:40]}...' stands twice"
            for at, (row, after) in enumerate(itertools.pairwise(rows), start=1)
            if row == after and len(row.split()) > 4
        ]
        for match, phrase in sorted(found, key=lambda pair: pair[0].start()):
            words = " ".join(match.group().split())
            problems.append(f"{path}:{_line(part, match.start())}: '{words}'; {phrase.instead}")
    return problems


def long_sentences(path: PurePosixPath, text: str) -> list[str]:
    """Sentences of more than MAX_WORDS words."""
    problems = []
    for part in prose(path, text):
        if part.kind is Kind.TEXT:
            continue
        for match in re.finditer(r".+?(?:[.;:?!](?=\s|$)|$)", part.text, re.DOTALL):
            if (count := len(match.group().split())) > MAX_WORDS:
                start = match.start() + len(match.group()) - len(match.group().lstrip())
                problems.append(f"{path}:{_line(part, start)}: a sentence of {count} words")
    return problems


def prose(path: PurePosixPath, text: str) -> Iterator[Prose]:
    """What people read in a file; nothing of a kind of file that is not listed here."""
    if str(path).startswith(NOT_PROSE):
        return iter(())
    kind = path.suffix or path.name
    if kind == ".md":
        return _paragraphs(text)
    if kind == ".html":
        comments = _blocks((at, 0, note) for at, note in _matches(r"<!--(.*?)-->", text))
        return itertools.chain(comments, _texts(_matches(r">([^<]+)<", text)))
    if kind == ".py":
        return _python(text)
    if kind in SLASHES:
        notes, strings = _slash_comments(text, kind)
        return itertools.chain(_blocks(notes), _texts(strings), _test_names(text))
    if kind in HASHES or path.name in HASHES:
        notes = list(_hash_comments(text))
        return itertools.chain(_blocks(notes), _texts(_rows_without(notes, text)))
    return iter(())


def _line(part: Prose, offset: int) -> int:
    return part.lines[min(part.text.count("\n", 0, offset), len(part.lines) - 1)]


def _matches(pattern: str, text: str) -> Iterator[tuple[int, str]]:
    for match in re.finditer(pattern, text, re.DOTALL):
        yield text.count("\n", 0, match.start()) + 1, match.group(1)


def _without_code(text: str) -> str:
    """Replaces `code`, --options and the addresses of links, which are not prose."""
    text = re.sub(r"``[^`]+``|`[^`]+`|(?<![\w-])--\w[\w-]*", "CODE", text)
    return re.sub(r"\]\([^)\s]*(?: \"[^\"]*\")?\)", "]", text)


def _prose(text: str, lines: Iterable[int], kind: Kind = Kind.COMMENT) -> Prose:
    return Prose(_without_code(text), tuple(lines), kind)


def _texts(found: Iterable[tuple[int, str]]) -> Iterator[Prose]:
    """Texts of several words. A single word is a name, which programs read."""
    for line, text in found:
        if " " in text.strip():
            yield _prose(text, range(line, line + text.count("\n") + 1), Kind.TEXT)


def _test_names(text: str) -> Iterator[Prose]:
    """The names of a GoogleTest, as words."""
    for line, name in _matches(r"(?m:^)(?:TYPED_)?TEST(?:_F|_P)?\(\s*(\w+\s*,\s*\w+)\)", text):
        yield _prose(re.sub(r"(?<=[a-z0-9])(?=[A-Z])|,\s*", " ", name), [line], Kind.TEXT)


# A comment as the readers below find it: line, column (0 if a line of its own), text.
Comment = tuple[int, int, str]


def _blocks(comments: Iterable[Comment]) -> Iterator[Prose]:
    """Joins comments on consecutive lines. One behind code begins a block; what continues it stands in its column."""
    texts: list[str] = []
    lines: list[int] = []
    column = 0
    for line, behind_code, text in comments:
        whole = text.strip("\n").split("\n")
        continues = bool(lines) and line == lines[-1] + 1 and behind_code <= 0 and -behind_code == column
        if not continues and texts:
            yield _prose("\n".join(texts), lines)
            texts, lines = [], []
        if not texts:
            column = abs(behind_code)
        texts += [part.strip(" \t*/!#<") for part in whole]
        lines += range(line, line + len(whole))
    if texts:
        yield _prose("\n".join(texts), lines)


def _comment(text: str, start: int, content: str) -> Comment:
    """A comment's column is negative where it has its line to itself."""
    line_start = text.rfind("\n", 0, start) + 1
    alone = not text[line_start:start].strip()
    column = start - line_start + 1
    return text.count("\n", 0, start) + 1, -column if alone else column, content


_SLASH = re.compile(
    r'R"(?P<mark>[^(\s]*)\(.*?\)(?P=mark)"'  # C++ raw string
    r'|"(?:\\.|[^"\\\n])*"'
    r"|(?<![0-9A-Fa-f])'(?:\\[^'\n]+|[^'\\\n])'"  # a character, not 1'000 or Rust's 'a
    r"|//(?P<line>[^\n]*)|/\*(?P<block>.*?)\*/",
    re.DOTALL,
)
_SCRIPT = re.compile(
    r'"(?:\\.|[^"\\\n])*"'
    r"|'(?:\\.|[^'\\\n])*'"
    r"|`(?:\\.|[^`\\])*`"
    r"|(?<![:\w])//(?P<line>[^\n]*)|/\*(?P<block>.*?)\*/",
    re.DOTALL,
)


def _slash_comments(text: str, kind: str) -> tuple[list[Comment], list[tuple[int, str]]]:
    """The comments, and the strings with their lines."""
    pattern = _SCRIPT if kind in {".ts", ".js", ".mjs", ".css"} else _SLASH
    comments = []
    strings = []
    for match in pattern.finditer(text):
        content = match.group("line") if match.group("line") is not None else match.group("block")
        if content is not None:
            comments.append(_comment(text, match.start(), content))
        else:
            strings.append((text.count("\n", 0, match.start()) + 1, match.group()[1:-1]))
    return comments, strings


def _hash_comments(text: str) -> Iterator[Comment]:
    """Comments of a shell script, Makefile, YAML, TOML or CMake list: a # at the start of a word, outside quotes."""
    offset = 0
    for row in text.split("\n"):
        for match in re.finditer(r"(?:(?<=\s)|^)#+(?!!)", row):
            before = row[: match.start()]
            if before.count('"') % 2 == 0 and before.count("'") % 2 == 0:
                yield _comment(text, offset + match.start(), row[match.end() :])
                break
        offset += len(row) + 1


def _rows_without(comments: Iterable[Comment], text: str) -> Iterator[tuple[int, str]]:
    """The rows of a file without their comments: keys, values and messages."""
    notes = {line: note for line, _, note in comments}
    for line, row in enumerate(text.split("\n"), start=1):
        yield line, row.removesuffix(notes[line]) if line in notes else row


def _python(text: str) -> Iterator[Prose]:
    comments = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            alone = not token.line[: token.start[1]].strip()
            column = token.start[1] + 1
            comments.append((token.start[0], -column if alone else column, token.string))
    yield from _blocks(comments)
    docstrings = set()
    for node in ast.walk(ast.parse(text)):  # a body comes before what stands in it
        match node:
            # A docstring, or the string that describes the attribute above it.
            case ast.Expr(value=ast.Constant(value=str(content), lineno=first) as constant):
                docstrings.add(constant)
                rows = [row.strip() for row in content.split("\n")]
                yield _prose("\n".join(rows), range(first, first + len(rows)))
            case ast.Constant(value=str(content), lineno=first) if node not in docstrings:
                yield from _texts([(first, content)])
            case ast.FunctionDef(name=name, lineno=first) if name.startswith("test_"):
                yield from _texts([(first, name.replace("_", " "))])


def _paragraphs(text: str) -> Iterator[Prose]:
    """The paragraphs, list items, headings and table rows of a Markdown file, without its code blocks."""
    texts: list[str] = []
    lines: list[int] = []
    kind = Kind.PARAGRAPH
    fenced = False
    for number, row in enumerate([*text.split("\n"), ""], start=1):
        stripped = row.strip()
        fence = stripped.startswith(("```", "~~~"))
        starts = re.match(r"#+ |[-*+] |\d+\. |\||>", stripped)
        if (fence or fenced or not stripped or starts) and texts:
            yield _prose("\n".join(texts), lines, kind)
            texts, lines = [], []
        fenced ^= fence
        if fence or fenced or not stripped:
            continue
        if not texts:
            kind = Kind.PIECE if starts else Kind.PARAGRAPH
        texts.append(stripped)
        lines.append(number)


def _files(given: list[Path]) -> Iterator[Path]:
    """The repository's files below the current folder that lie under one of the given paths."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    wanted = [path.resolve() for path in given or [Path()]]
    for path in sorted({Path(name) for name in names.split("\0") if name}):
        full = path.resolve()
        if path.is_file() and any(full == folder or folder in full.parents for folder in wanted):
            yield path


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description="List phrases that this project does not write.")
    parser.add_argument("paths", nargs="*", type=Path, metavar="PATH", help="files or folders (default: all)")
    parser.add_argument("--long", action="store_true", help=f"also list sentences of more than {MAX_WORDS} words")
    options = parser.parse_args()
    for path in options.paths:
        if not path.exists():
            parser.error(f"{path} does not exist")
    problems = []
    for path in _files(options.paths):
        if b"\0" not in (content := path.read_bytes()):
            problems += writing(PurePosixPath(path), content.decode())
            if options.long:
                problems += long_sentences(PurePosixPath(path), content.decode())
    with contextlib.suppress(BrokenPipeError):  # `| head`
        print("\n".join(problems) or "nothing found", flush=True)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
