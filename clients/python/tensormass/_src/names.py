"""Words that a user wrote, looked up among the known ones."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def suggestion(word: str, known: Iterable[str]) -> str:
    """`did you mean 'x'?` if one is close, else `known: x, y`."""
    known = list(known)
    # A unit that was left out: `mu` for `mu_pa`.
    close = [name for name in known if word and name.startswith(f"{word}_")] or difflib.get_close_matches(
        word, known, n=1
    )
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known) or 'none'}"


def as_name(text: str) -> str:
    """`text` in the alphabet of scenes, bodies and sets."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in text)[:64]
