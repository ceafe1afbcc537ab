"""Packages that only some calls need. pyproject.toml lists them as extras, so that the SDK alone stays light."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

from tensormass._shared.errors import NotFoundError

#: [extra of pyproject.toml]: its packages, [name in messages]: name of its module.
EXTRAS = {
    "desktop": {"pyvista": "pyvista"},
    "keys": {"cryptography": "cryptography"},
    "meshes": {"lz4": "lz4"},
    "modes": {"scikit-fem": "skfem", "SciPy": "scipy"},
    "organs": {"scikit-image": "skimage", "SciPy": "scipy", "pytetwild": "pytetwild"},
    "plot": {"matplotlib": "matplotlib"},
    "record": {"mcap": "mcap", "mcap-protobuf-support": "mcap_protobuf", "zstandard": "zstandard"},
    "tetrahedra": {"pytetwild": "pytetwild"},
    "viewer": {"aiohttp": "aiohttp", "meshopt": "meshopt"},
}


def require(extra: str, what: str) -> None:
    """Checks that the packages of an extra are installed. `what` needs them, and opens the message.

    Raises:
        NotFoundError: one is missing; the message says how to install it.
    """
    packages = EXTRAS[extra]
    if any(importlib.util.find_spec(module) is None for module in packages.values()):
        raise NotFoundError(f"{what} needs {_listed(packages)}; install with: pip install 'tensormass[{extra}]'")


def _listed(packages: Iterable[str]) -> str:
    *first, last = packages
    return f"{', '.join(first)} and {last}" if first else last
