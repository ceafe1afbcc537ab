"""Parts of a mesh that hang together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

#: Smaller parts than this share of the largest one are crumbs of a segmentation or a mesher, and are dropped.
MIN_PART = 0.01


def components(node_count: int, blocks: Sequence[npt.NDArray[np.integer]]) -> npt.NDArray[np.int64]:
    """Labels each node with the smallest node index of its component. Merges labels and halves the chains of labels
    until nothing changes."""
    label = np.arange(node_count, dtype=np.int64)
    while True:
        new = label.copy()
        for elements in blocks:
            lowest = label[elements].min(axis=1)
            for corner in range(elements.shape[1]):
                np.minimum.at(new, label[elements[:, corner]], lowest)
        new = new[new]
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new
