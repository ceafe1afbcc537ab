"""Reads docstrings as this project writes them: an indented paragraph is code.

reStructuredText wants a `::` before it, which the docstrings do not have, because editors show them as they are.
"""

from __future__ import annotations

from sphinx.application import Sphinx


def setup(app: Sphinx) -> dict[str, bool]:
    # Before Napoleon, which indents what belongs to "Args:" and "Raises:".
    app.connect("autodoc-process-docstring", mark_code, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def mark_code(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Inserts `::` where an indented line follows an empty one and a line that is not indented."""
    marked: list[str] = []
    above = ""  # the last line that is not empty
    for line in lines:
        if line.startswith("    ") and marked and not marked[-1] and above and not above.startswith(" "):
            marked += ["::", ""]
        marked.append(line)
        above = line or above
    lines[:] = marked
