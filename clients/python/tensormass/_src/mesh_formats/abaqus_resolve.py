"""Members of the sets of Abaqus and CalculiX, in the numbers of the result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tensormass._src.mesh_formats.abaqus_model import Scope
from tensormass._src.mesh_formats.abaqus_sets import MAX_NUMBER, Members
from tensormass._src.mesh_formats.raw import FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import shown

# Sets that name each other.
_MAX_DEPTH = 50


def resolved(raw: Raw, scopes: Sequence[Scope]) -> None:
    """Adds all sets to the result."""
    resolver = _Resolver(raw, scopes)
    instances = [scope for scope in scopes if scope.parts[0].name]
    for of_nodes in (True, False):
        target = raw.node_sets if of_nodes else raw.cell_sets
        root = resolver.names(scopes[0], of_nodes)
        for key, spelling in root.items():
            target[spelling] = resolver.members(scopes[0], key, of_nodes, 0)
        own: dict[str, list[tuple[Scope, str]]] = {}
        for scope in instances:
            for key, spelling in resolver.names(scope, of_nodes).items():
                own.setdefault(key, []).append((scope, spelling))
        for key, found in own.items():
            parts = [resolver.members(scope, key, of_nodes, 0) for scope, _ in found]
            if key not in root:
                target[found[0][1]] = np.unique(np.concatenate(parts))
            if len(found) > 1 or key in root:
                for (scope, spelling), members in zip(found, parts, strict=True):
                    target[f"{scope.name}.{spelling}"] = members
    raw.notes += resolver.notes


class _Resolver:
    def __init__(self, raw: Raw, scopes: Sequence[Scope]) -> None:
        self._raw = raw
        self._root = scopes[0]
        self._by_name = {scope.name.upper(): scope for scope in scopes if scope.name}
        self.notes: list[str] = []
        self._memory: dict[tuple[int, str, bool], Ints] = {}

    def names(self, scope: Scope, of_nodes: bool) -> dict[str, str]:
        """Returns the sets of a scope: name in capitals and as written."""
        found: dict[str, str] = {}
        for space in scope.parts:
            for key, (spelling, _) in (space.sets.of_nodes if of_nodes else space.sets.of_elements).items():
                found.setdefault(key, spelling)
        return found

    def members(self, scope: Scope, key: str, of_nodes: bool, depth: int) -> Ints:
        """Returns indices of a set's nodes or elements in the result."""
        memory = (id(scope), key, of_nodes)
        if memory in self._memory:
            return self._memory[memory]
        found: list[Ints] = [np.empty(0, np.int64)]
        for space in scope.parts:
            sets = space.sets.of_nodes if of_nodes else space.sets.of_elements
            if key not in sets:
                continue
            name, parts = sets[key]
            if depth > _MAX_DEPTH:
                where = next(part.where for part in parts if part.where)
                raise FormatError(f"{where}: the set {shown(name)} contains itself; name its members")
            for part in parts:
                found.append(self._of(scope, name, part, of_nodes, depth))
        result: Ints = np.unique(np.concatenate(found))
        self._memory[memory] = result
        return result

    def _of(self, scope: Scope, name: str, part: Members, of_nodes: bool, depth: int) -> Ints:
        if part.instance:
            if part.instance.upper() not in self._by_name:
                raise FormatError(f"{part.where}: there is no instance {shown(part.instance)}")
            scope = self._by_name[part.instance.upper()]
        found: list[Ints] = [self._numbers(scope, name, part.numbers, of_nodes)]
        if part.ranges:
            numbers = scope.node_numbers if of_nodes else scope.element_numbers
            for first, last, step in part.ranges:
                inside = (numbers >= first) & (numbers <= last) & ((numbers - first) % step == 0)
                found.append(np.flatnonzero(inside) + (scope.first_node if of_nodes else scope.first_element))
        for member, where in part.names:
            found.append(self._named(scope, name, member, where, of_nodes, depth))
        if part.elements:
            elements = self._named(scope, name, part.elements, part.where, False, depth)
            found.append(self._nodes_of(elements))
        return np.concatenate(found)

    def _named(self, scope: Scope, name: str, member: str, where: str, of_nodes: bool, depth: int) -> Ints:
        key = member.upper()
        for candidate in dict.fromkeys((id(scope), id(self._root))):
            chosen = scope if candidate == id(scope) else self._root
            if key in self.names(chosen, of_nodes):
                return self.members(chosen, key, of_nodes, depth + 1)
        instance, dot, rest = key.rpartition(".")
        if dot and instance in self._by_name:
            chosen = self._by_name[instance]
            if rest.isdigit():
                return self._numbers(chosen, name, np.array([min(int(rest), MAX_NUMBER)]), of_nodes)
            if rest in self.names(chosen, of_nodes):
                return self.members(chosen, rest, of_nodes, depth + 1)
        if of_nodes and key in self.names(scope, False):
            return self._nodes_of(self.members(scope, key, False, depth + 1))
        raise FormatError(f"{where}: the set {shown(name)} names {shown(member)}, which is not a set; define it")

    def _numbers(self, scope: Scope, name: str, numbers: Ints, of_nodes: bool) -> Ints:
        known = scope.node_numbers if of_nodes else scope.element_numbers
        order = np.argsort(known, kind="stable")
        at = np.minimum(np.searchsorted(known[order], numbers), max(len(known) - 1, 0))
        exists = known[order][at] == numbers if len(known) else np.zeros(len(numbers), bool)
        if (missing := int((~exists).sum())) > 0:
            what = "nodes" if of_nodes else "elements"
            self.notes.append(f"the set {name!r} names {missing} {what} that do not exist; they are skipped")
        return order[at[exists]] + (scope.first_node if of_nodes else scope.first_element)

    def _nodes_of(self, elements: Ints) -> Ints:
        chosen = [np.empty(0, np.int64)]
        for block in self._raw.blocks:
            assert isinstance(block.rows, slice)
            first = block.rows.start
            rows = elements[(elements >= first) & (elements < first + len(block.nodes))] - first
            chosen.append(block.nodes[rows].reshape(-1))
        return np.unique(np.concatenate(chosen))
