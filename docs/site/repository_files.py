"""Links of the pages to files that are not pages: sources and folders are shown on the site, data is downloaded.

MyST makes a download of every link to a file, and does not find folders. A code host shows both. Each source file
that a page links to gets a highlighted page of its own below files/, and each folder a list of its files.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any

from docutils import nodes
from pygments.lexers import get_lexer_for_filename
from pygments.util import ClassNotFound
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.highlighting import PygmentsBridge

SOURCES = {".cff", ".cpp", ".cuh", ".cu", ".h", ".mjs", ".proto", ".py", ".rs", ".sh", ".toml", ".ts", ".yaml", ".yml"}
FOLDER = "files"
#: Names of the files that git tracks, and what `file_pages` makes pages of.
tracked: list[str] = []
shown: set[PurePosixPath] = set()


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", find_tracked_files)
    # Before Sphinx collects the files to copy.
    app.connect("doctree-read", show_files, priority=100)
    app.connect("html-collect-pages", file_pages)
    return {"parallel_read_safe": False, "parallel_write_safe": True}


def find_tracked_files(app: Sphinx) -> None:
    """Lists what git tracks: a folder's page must not show what somebody built there."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=app.srcdir, check=True, capture_output=True, text=True)
    tracked[:] = sorted(name for name in listed.stdout.split("\0") if name)
    shown.clear()


def show_files(app: Sphinx, doctree: nodes.document) -> None:
    """Points links at the pages that `file_pages` makes."""
    page = app.env.docname
    for link in list(doctree.findall(addnodes.download_reference)):
        target = path_of(link["reftarget"], page)
        if target.suffix in SOURCES:
            point(app, link, target)
    for link in list(doctree.findall(addnodes.pending_xref)):
        if link.get("reftype") != "myst" or link.get("refdomain") is not None:
            continue
        target = path_of(link["reftarget"], page)
        if (Path(app.srcdir) / target).is_dir():
            shown.update(PurePosixPath(name) for name in files_of(target))
            point(app, link, target)


def path_of(target: str, page: str) -> PurePosixPath:
    """Returns the path of a link's target from the repository's root."""
    if target.startswith("/"):
        return PurePosixPath(target.lstrip("/"))
    return PurePosixPath(os.path.normpath(PurePosixPath(page).parent / target))


def point(app: Sphinx, link: nodes.Element, target: PurePosixPath) -> None:
    shown.add(target)
    address = app.builder.get_relative_uri(app.env.docname, f"{FOLDER}/{target}")
    link.replace_self(nodes.reference("", "", *link.children, internal=True, refuri=address))


def files_of(folder: PurePosixPath) -> list[str]:
    """Names the tracked files of a folder and of its folders."""
    return [name for name in tracked if name.startswith(f"{folder}/")]


def file_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    for target in sorted(shown):
        is_folder = (Path(app.srcdir) / target).is_dir()
        body = folder_body(app, target) if is_folder else source_body(app, target)
        title = escape(str(target))
        context = {"title": title, "body": f"<h1>{title}</h1>\n{body}", "parents": []}
        yield f"{FOLDER}/{target}", context, "page.html"


def source_body(app: Sphinx, target: PurePosixPath) -> str:
    code = (Path(app.srcdir) / target).read_text("utf-8")
    try:
        language = get_lexer_for_filename(target.name).aliases[0]
    except ClassNotFound:
        language = "text"
    highlighter: PygmentsBridge = app.builder.highlighter  # type: ignore[attr-defined]  # that of HTML builders
    return highlighter.highlight_block(code, language)


def folder_body(app: Sphinx, folder: PurePosixPath) -> str:
    rows = []
    for name in files_of(folder):
        address = app.builder.get_relative_uri(f"{FOLDER}/{folder}", f"{FOLDER}/{name}")
        rows.append(f'<li><a class="reference internal" href="{address}"><code>{escape(name)}</code></a></li>')
    return "<ul>\n" + "\n".join(rows) + "\n</ul>\n"
