"""Makes the first change of CONTRIBUTING.md in a clone of its own, and says how long each step took.

    python3 tests/setup/first_change.py [--keep] [--seconds S]

Runs what stands there and nothing else: the commands of its `sh` blocks and the changes of its `diff` blocks, in their
order. The command after the first change must fail, because only the test has changed, and the last one must pass. The
clone has the committed state of this checkout, and no build and no installed packages of its own. Debian's packages and
the caches of pip, npm and cargo are those of the machine.

Prints one line of JSON to stdout at the end; what the commands print goes to stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = "CONTRIBUTING.md"
HEADING = "## A first change"
DEFAULT_SECONDS = 3600.0


class FirstChangeError(Exception):
    """The page's steps do not end as it says; the message has the step."""


@dataclass(frozen=True)
class Block:
    """A fenced block of the page: `sh` to run, or `diff` to apply."""

    kind: str
    text: str


def blocks(page: str) -> list[Block]:
    """Reads the blocks of the section.

    Raises:
        FirstChangeError: the section does not hold two changes, each with a command before and after it.
    """
    section = page.partition(f"\n{HEADING}\n")[2].partition("\n## ")[0]
    found = [
        Block(kind, textwrap.dedent(indent + text))
        for indent, kind, text in re.findall(r"^( *)```(sh|diff)\n *(.*?)^ *```$", section, re.MULTILINE | re.DOTALL)
    ]
    if [block.kind for block in found] != ["sh", "diff", "sh", "diff", "sh"]:
        raise FirstChangeError(f"{PAGE}: '{HEADING}' must have a command, a change, a command, a change, a command")
    return found


def follow(steps: list[Block], clone: Path, limit_s: float) -> list[dict[str, object]]:
    """Makes the steps in a clone and returns a record of each.

    Raises:
        FirstChangeError: a step ended otherwise than the page says, or the time was up.
    """
    records: list[dict[str, object]] = []
    changes = 0
    ends = time.monotonic() + limit_s
    for number, block in enumerate(steps, start=1):
        start = time.monotonic()
        if block.kind == "diff":
            changes += 1
            applied = subprocess.run(["git", "apply", "-"], cwd=clone, input=block.text, text=True, check=False)
            if applied.returncode != 0:
                raise FirstChangeError(f"step {number}: the change of {PAGE} no longer fits the sources; renew it")
        else:
            failed = run(block.text, clone, ends - start) != 0
            if failed != (changes == 1):
                what = "failed" if failed else "passed, though its test should fail"
                raise FirstChangeError(f"step {number}: `{block.text.strip()}` {what}")
        what = block.text.strip() if block.kind == "sh" else f"change of {block.text.split()[1].removeprefix('a/')}"
        records.append({"step": number, "what": what, "seconds": round(time.monotonic() - start, 1)})
    return records


def run(command: str, folder: Path, limit_s: float) -> int:
    """Runs a command in a session of its own, so that nothing of it is left when the time is up."""
    process = subprocess.Popen(["bash", "-ec", command], cwd=folder, stdout=sys.stderr, start_new_session=True)
    try:
        return process.wait(timeout=max(limit_s, 0.0))
    except subprocess.TimeoutExpired:
        raise FirstChangeError(f"`{command.strip()}`: the time of --seconds was up") from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--keep", action="store_true", help="keep the clone and name it")
    parser.add_argument("--seconds", type=float, default=DEFAULT_SECONDS, help="longest time (default: %(default)g)")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="tensormass-first-change-"))
    clone = folder / "tensormass"
    start = time.monotonic()
    try:
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        cloned_s = time.monotonic() - start
        steps = follow(blocks((clone / PAGE).read_text("utf-8")), clone, options.seconds - cloned_s)
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=clone, check=True, capture_output=True, text=True
        ).stdout.strip()
    except FirstChangeError as error:
        print(f"first change: {error}", file=sys.stderr)
        return 1
    finally:
        if options.keep:
            print(f"first change: the clone is {clone}", file=sys.stderr)
        else:
            shutil.rmtree(folder)
    print(
        json.dumps(
            {
                "command": "python3 tests/setup/first_change.py",
                "commit": commit,
                "processors": os.cpu_count(),
                "system": platform.platform(),
                "clone_s": round(cloned_s, 1),
                "steps": steps,
                "seconds": round(time.monotonic() - start, 1),
            }
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
