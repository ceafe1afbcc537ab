"""Packages that only some calls need. pyproject.toml lists them as extras, so that the SDK alone stays light."""

from __future__ import annotations

import importlib.util

from tensormass._src.errors import NotFoundError

#: [extra of pyproject.toml]: its packages, [name in messages]: name of its module.
EXTRAS = {
    "desktop": {"pyvista": "pyvista"},
    "meshes": {"lz4": "lz4"},
    "modes": {"scikit-fem": "skfem", "SciPy": "scipy"},
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
        raise NotFoundError(f"{what} needs {' and '.join(packages)}; install with: pip install 'tensormass[{extra}]'")
