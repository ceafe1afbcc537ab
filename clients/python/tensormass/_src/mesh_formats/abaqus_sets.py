"""Sets of Abaqus and CalculiX: repeated, of other sets, of instances, generated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tensormass._src.mesh_formats.abaqus_deck import Keyword
from tensormass._src.mesh_formats.raw import FormatError, Ints
from tensormass._src.mesh_formats.text import shown

# Numbers of nodes and elements. A set may name larger ones, which do not exist.
MAX_NUMBER = (1 << 62) - 1


@dataclass
class Members:
    """What one keyword adds to a set."""

    numbers: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    #: Rows of first, last, step.
    ranges: list[tuple[int, int, int]] = field(default_factory=list)
    #: Names of sets, `INSTANCE.SET` or `INSTANCE.NUMBER`, with their places.
    names: list[tuple[str, str]] = field(default_factory=list)
    #: Name of an instance whose numbers these are; empty: those of the set's own space.
    instance: str = ""
    #: A set of nodes that takes the nodes of this set of elements.
    elements: str = ""
    where: str = ""


@dataclass
class Sets:
    """Sets of one space: by name in capitals, the name as it is written first and what its keywords add."""

    of_nodes: dict[str, tuple[str, list[Members]]] = field(default_factory=dict)
    of_elements: dict[str, tuple[str, list[Members]]] = field(default_factory=dict)

    def add(self, name: str, numbers: Ints, *, of_nodes: bool) -> None:
        self._members(name, of_nodes).append(Members(numbers))

    def _members(self, name: str, of_nodes: bool) -> list[Members]:
        sets = self.of_nodes if of_nodes else self.of_elements
        return sets.setdefault(name.upper(), (name, []))[1]

    def take(self, keyword: Keyword, name: str, *, of_nodes: bool) -> None:
        """Takes *NSET or *ELSET; a repeated name adds to the set."""
        given = keyword.parameters
        members = Members(instance=given.get("INSTANCE", ""), where=keyword.where)
        self._members(name, of_nodes).append(members)
        if of_nodes and given.get("ELSET"):
            members.elements = given["ELSET"]
        elif "GENERATE" in given:
            for at, fields in keyword.fields():
                try:
                    first, last, step = (int(word) for word in ([*fields, "1"] if len(fields) == 2 else fields))
                except ValueError:
                    first = last = step = 0
                if step < 1 or max(abs(first), abs(last), step) > MAX_NUMBER:
                    raise FormatError(
                        f"{keyword.text.where(at)}: *{keyword.name}: expected `first, last, step`, found "
                        f"{shown(','.join(fields))}"
                    )
                members.ranges.append((first, last, step))
        elif keyword.has_words():
            numbers: list[int] = []
            for at, fields in keyword.fields():
                for word in fields:
                    if word.isdigit():
                        numbers.append(min(int(word), MAX_NUMBER))
                    elif word:
                        members.names.append((word, keyword.text.where(at)))
            members.numbers = np.array(numbers, np.int64)
        else:
            members.numbers = keyword.numbers(np.int64)[0]
