"""The folder of what is made on demand and kept."""

from __future__ import annotations

import os
from pathlib import Path

from tensormass._shared.processes import BUILD_BIN


def cache_folder() -> Path:
    """Returns the folder of meshes that are made on demand."""
    build = BUILD_BIN.parent
    if build.is_dir() and os.access(build, os.W_OK):
        return build / "scenes"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tensormass" / "scenes"
