"""Settings of the documentation site. `make docs` builds it from the pages that the repository has anyway.

The repository's root is the source folder, so that links between pages are the same here and on a code host.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

SITE = Path(__file__).resolve().parent
ROOT = SITE.parents[1]
sys.path[:0] = [str(SITE), str(ROOT / "clients" / "python")]

project = "Tensormass"
version = release = tomllib.loads((ROOT / "clients/python/pyproject.toml").read_text("utf-8"))["project"]["version"]
project_copyright = "the Tensormass authors"
html_title = f"Tensormass {release}"

extensions = [
    "breathe",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "docstrings",
    "front_page",
    "public_names",
    "repository_files",
]

root_doc = "README"
include_patterns = [
    "*.md",
    "docs/*.md",
    "docs/decisions/*.md",
    "docs/site/*.rst",
    "clients/*/README.md",
    "examples/README.md",
    "tests/*/results/README.md",
]
exclude_patterns = [".*", "build*", "dist", "**/node_modules"]

# The slugs of code hosts, for the anchors of headings.
myst_heading_anchors = 4

# A name between single backticks is code in docstrings, as it is in Markdown.
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
# NumPy's own name for "anything that becomes an array" prints as half a page of types.
autodoc_type_aliases = {"npt.ArrayLike": "ArrayLike"}

# `make docs` runs Doxygen before Sphinx.
breathe_projects = {"haptic": str(ROOT / "build" / "docs" / "doxygen")}
breathe_default_project = "haptic"
breathe_default_members = ("members", "undoc-members")

html_theme = "furo"
# Colours that tell an added line from a removed one.
pygments_style = "tango"
pygments_dark_style = "monokai"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"sidebar_hide_name": False}
