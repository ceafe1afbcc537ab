"""The nodes of a region, selected as the daemon selects them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._src.meshes import BoolArray, FloatArray
from tensormass._src.packing import middle_ends
from tensormass.v1 import scene_pb2


class Regions:
    """Selects nodes of one body by regions.

    Args:
        body: its sets may be named by regions.
        positions: [node_count, 3] m at rest, after scale and translation, with the nodes that `element_order` adds.
    """

    def __init__(self, body: scene_pb2.Body, positions: FloatArray) -> None:
        self._positions = positions
        quadratic = body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC
        self._ends = middle_ends(body) if quadratic else np.empty((0, 2), np.int64)
        self._sets: dict[str, BoolArray] = {}
        for index, named in enumerate(body.sets):
            where = f"body {body.name!r}: sets[{index}]"
            masks = [self.mask(region, where) for region in named.regions]
            self._sets[named.name] = self._with_middles(np.logical_or.reduce(masks))

    def mask(self, region: scene_pb2.Region, where: str) -> BoolArray:
        """Returns the nodes of a region as a mask [node_count].

        Raises:
            InvalidArgumentError: an unknown set or node, or a region without nodes; the message names `where`.
        """
        mask = self._with_middles(self._selected(region, where))
        if not mask.any():
            raise InvalidArgumentError(f"{where}: no node of the body lies in the region")
        return mask

    def _selected(self, region: scene_pb2.Region, where: str) -> BoolArray:
        kind = region.WhichOneof("kind")
        if kind == "box":
            low, high = _vector(region.box.min_m), _vector(region.box.max_m)
            return np.all((self._positions >= low) & (self._positions <= high), axis=1)
        if kind == "sphere":
            distance = np.linalg.norm(self._positions - _vector(region.sphere.center_m), axis=1)
            return distance <= region.sphere.radius_m
        if kind == "nodes":
            indices = np.array(region.nodes.indices, dtype=np.int64)
            if indices.size and indices.max() >= len(self._positions):
                raise InvalidArgumentError(
                    f"{where}: node {indices.max()} does not exist; the body has {len(self._positions)}"
                )
            mask = np.zeros(len(self._positions), np.bool_)
            mask[indices] = True
            return mask
        if kind == "set":
            if region.set not in self._sets:
                raise InvalidArgumentError(
                    f"{where}: the body has no set {region.set!r}; {suggestion(region.set, self._sets)}"
                )
            return self._sets[region.set]
        raise InvalidArgumentError(f"{where}: give box, sphere, nodes or set")

    def _with_middles(self, mask: BoolArray) -> BoolArray:
        """Adds the nodes in the middle of edges that have both ends in the mask."""
        out = mask.copy()
        first = len(mask) - len(self._ends)
        out[first:] |= mask[self._ends].all(axis=1)
        return out


def _vector(of: scene_pb2.Vector3) -> npt.NDArray[np.float64]:
    return np.array([of.x, of.y, of.z])
