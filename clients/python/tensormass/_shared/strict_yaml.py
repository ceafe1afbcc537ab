"""A YAML loader that refuses what PyYAML would take in silence."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import yaml

from tensormass._shared.errors import InvalidArgumentError


def load(text: str, where: str) -> Any:  # noqa: ANN401
    """Returns the content of a YAML text. Runs nothing in it.

    Args:
        where: file, for messages.

    Raises:
        InvalidArgumentError: not valid YAML; the message has line and column.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        place = f"line {before.count(chr(10)) + 1}, column {len(before) - before.rfind(chr(10))}"
        raise InvalidArgumentError(
            f"{where}: not valid YAML: character {text[error.position]!r} is not allowed, in {place}"
        ) from error
    except yaml.MarkedYAMLError as error:
        at = error.problem_mark or error.context_mark
        what = ", ".join(filter(None, (error.context, error.problem)))
        place = f", in line {at.line + 1}, column {at.column + 1}" if at is not None else ""
        raise InvalidArgumentError(f"{where}: not valid YAML: {what}{place}") from error
    except RecursionError:
        raise InvalidArgumentError(f"{where}: not valid YAML: nested too deep") from None


class _StrictLoader(yaml.SafeLoader):
    """Refuses equal keys (PyYAML silently keeps the last one) and names the place of values such as `2001-99-99`, which
    look like a type but cannot be one."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:  # noqa: ANN401
        try:
            return super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, ValueError) as error:
            if not isinstance(node, yaml.ScalarNode):
                raise
            text = node.value if len(node.value) <= 40 else f"{node.value[:40]}..."
            what = f"{text!r} cannot be read as {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        # A node that is a mapping only by its tag, such as `!!map x`, is refused below.
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a field's name is a plain word", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} stands twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)
