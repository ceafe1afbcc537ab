"""Suggestions for misspelt words, and names in the protocol's alphabet."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def suggestion(word: str, known: Iterable[str]) -> str:
    """Returns `did you mean 'x'?` if a known word is close, else `known: x, y`."""
    known = list(known)
    # A missing unit: `mu` for `mu_pa`.
    close = [name for name in known if word and name.startswith(f"{word}_")] or difflib.get_close_matches(
        word, known, n=1
    )
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known) or 'none'}"


def as_name(text: str) -> str:
    """Returns `text` with all but A-Z, a-z, 0-9, _ and - replaced, as names of scenes, bodies and sets need it."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in text)[:64]
