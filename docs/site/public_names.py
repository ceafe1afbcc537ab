"""Fails the build if a public name of `tensormass` is not described on the site.

autodoc leaves out members without a docstring or a `#:` comment, in silence.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from types import ModuleType

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

logger = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("env-check-consistency", refuse_missing)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def refuse_missing(app: Sphinx, env: BuildEnvironment) -> None:
    import tensormass

    described = set(env.domaindata["py"]["objects"])
    for name in public_names(tensormass):
        if name not in described:
            logger.warning(
                "docs/site/python.rst does not describe %s; give it a docstring, or a comment '#:' above an attribute, "
                "and a place on the page",
                name,
            )


def public_names(package: ModuleType) -> list[str]:
    """Names what a package exports, and the public attributes of its classes."""
    names = []
    for name in package.__all__:
        names.append(f"{package.__name__}.{name}")
        value = getattr(package, name)
        if inspect.isclass(value):
            names += [f"{package.__name__}.{name}.{member}" for member in members(value, package)]
    return names


def members(value: type, package: ModuleType) -> list[str]:
    """Names the public attributes of a class that it or a base in the package defines."""
    own = [base for base in value.__mro__ if base.__module__.split(".")[0] == package.__name__]
    found = {name for base in own for source in (vars(base), instance_attributes(base)) for name in source}
    found |= {name for base in own for name in inspect.get_annotations(base)}
    return sorted(name for name in found if not name.startswith("_"))


def instance_attributes(value: type) -> Iterator[str]:
    """Names what `__init__` of a class assigns to self."""
    if "__init__" not in vars(value) or hasattr(value, "__dataclass_fields__"):
        return
    tree = ast.parse(textwrap.dedent(inspect.getsource(vars(value)["__init__"])))
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Store()):
                yield name
