"""Makes the README the front page: it gets the table of contents, which a code host would print as text."""

from __future__ import annotations

import shutil
from pathlib import Path

from sphinx.application import Sphinx

# Caption and pages of each part of the sidebar, as Sphinx's toctree takes them. Sphinx refuses a page that is in none.
CONTENTS = {
    "Use": [
        "docs/viewer",
        "Python SDK and command <clients/python/README>",
        "docs/choosing",
        "docs/organs",
        "examples/README",
        "clients/haptic/README",
        "docs/haptics",
        "docs/findings",
        "docs/metrics",
        "docs/protocol",
        "docs/security",
        "docs/operation",
    ],
    "Reference": ["docs/site/python", "docs/site/haptic"],
    "How good it is": [
        "docs/performance",
        "docs/accuracy",
        "docs/stability",
        "docs/comparison",
        "Results of accuracy <tests/accuracy/results/README>",
        "Results of speed <tests/bench/results/README>",
        "Results of stability <tests/stability/results/README>",
    ],
    "Change it": ["CONTRIBUTING", "docs/architecture", "docs/extending", "SECURITY", "CHANGELOG"],
    "Why it is so": ["docs/decisions/README"],
}


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", add_contents)
    app.connect("build-finished", copy_front_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    if page == app.config.root_doc:
        source[0] += "".join(toctree(entries, caption) for caption, entries in CONTENTS.items())
    elif page == "docs/decisions/README":
        names = sorted(path.stem for path in (Path(app.srcdir) / page).parent.glob("*.md") if path.stem != "README")
        source[0] += toctree(names)


def toctree(entries: list[str], caption: str = "") -> str:
    option = f":caption: {caption}\n" if caption else ""
    return f"\n\n```{{toctree}}\n:hidden:\n{option}\n" + "\n".join(entries) + "\n```\n"


def copy_front_page(app: Sphinx, error: Exception | None) -> None:
    """A folder's address opens its index.html, and so do people."""
    if error is None and app.builder.name == "html":
        shutil.copy(Path(app.outdir) / f"{app.config.root_doc}.html", Path(app.outdir) / "index.html")
