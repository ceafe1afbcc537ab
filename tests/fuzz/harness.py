"""Runs a decoder on an input, and keeps the input if the decoder fails in another way than it may."""

from __future__ import annotations

import contextlib
import hashlib
import signal
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from fuzz.targets import Target

MAX_S = 20.0
"""A decoder that takes longer for an input hangs."""

INPUTS = Path(__file__).parent / "inputs"


class DecoderError(Exception):
    """A decoder failed. The text says how, and where the input is."""


@contextlib.contextmanager
def _within(seconds: float) -> Iterator[None]:
    def late(number: int, at: FrameType | None) -> None:
        raise TimeoutError(f"it takes longer than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def run(name: str, target: Target, data: bytes, keep_in: Path = INPUTS) -> None:
    """Raises DecoderError, and writes the input to `keep_in`, if the decoder fails in a way that it may not."""
    try:
        with _within(MAX_S):
            target.run(data)
    except target.allowed as error:
        if str(error):
            return
        problem: BaseException = AssertionError("an error without a text")
    except BaseException as error:
        problem = error
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
    else:
        return
    path = keep_in / name / f"{hashlib.sha256(data).hexdigest()[:12]}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    raise DecoderError(f"{name}: {type(problem).__name__}: {problem}; the input is {path}") from problem
