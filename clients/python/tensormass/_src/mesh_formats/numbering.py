"""Numbers of nodes in files, and their indices from 0."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tensormass._src.mesh_formats.raw import FormatError, Ints


class Numbering:
    """Finds the index of a node's number.

    Args:
        numbers: of the nodes in the file's order.
        place: returns `FILE:LINE` of the node with an index.
    """

    def __init__(self, numbers: Ints, place: Callable[[int], str]) -> None:
        self._first = int(numbers[0]) if len(numbers) else 0
        self._count = len(numbers)
        self._sorted: Ints | None = None
        if not len(numbers) or bool((np.diff(numbers) == 1).all()):
            return
        self._order = np.argsort(numbers, kind="stable")
        ordered = numbers[self._order]
        self._sorted = ordered
        twice = np.flatnonzero(np.diff(ordered) == 0)
        if twice.size:
            node = int(self._order[twice[0] + 1])
            raise FormatError(f"{place(node)}: node {numbers[node]} is defined a second time; number nodes anew")

    def indices(self, numbers: Ints, place: Callable[[int], str]) -> Ints:
        """Returns indices of numbers [n, k]. `place` returns `FILE:LINE: element` of a row, for the message."""
        if self._sorted is None:
            if numbers.size and numbers.min() >= self._first and numbers.max() < self._first + self._count:
                return numbers - self._first if self._first else numbers
            found = numbers - self._first
            wrong = (found < 0) | (found >= self._count)
        else:
            at = np.minimum(np.searchsorted(self._sorted, numbers), self._count - 1)
            found = self._order[at]
            wrong = self._sorted[at] != numbers
        if wrong.any():
            row = int(np.flatnonzero(wrong.reshape(len(numbers), -1).any(axis=1))[0])
            node = int(numbers[row][wrong[row]].reshape(-1)[0])
            raise FormatError(f"{place(row)} uses node {node}, which is not defined; the file is cut off or damaged")
        return found.astype(np.int32)
