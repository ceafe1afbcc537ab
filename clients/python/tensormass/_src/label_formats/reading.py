"""Chooses the reader of a label map, by its name's ending."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from tensormass._src.label_formats.content import Labels
from tensormass._src.mesh_formats.raw import FormatError

#: [ending]: module of this folder that reads it.
READERS = {".nrrd": "nrrd", ".nhdr": "nrrd", ".nii": "nifti", ".nii.gz": "nifti"}
#: Endings of the names of label maps.
LABEL_ENDINGS = tuple(READERS)


def reader_of(path: Path) -> str | None:
    """Returns the name of the reader; None if the ending is not that of a label map."""
    name = path.name.lower()
    return next((reader for ending, reader in READERS.items() if name.endswith(ending)), None)


def read(path: Path) -> Labels:
    """Reads a label map.

    Raises:
        FormatError: an unknown format, or a file that cannot be read.
    """
    name = reader_of(path)
    if name is None:
        raise FormatError(f"{path}: files of this ending are not read as label maps; known are {', '.join(READERS)}")
    with np.errstate(all="ignore"):
        labels: Labels = importlib.import_module(f"tensormass._src.label_formats.{name}").read(path)
    return labels
