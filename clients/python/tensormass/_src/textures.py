"""Pictures on the skins of bodies, for viewers."""

from __future__ import annotations

from pathlib import Path

from tensormass._src.errors import InvalidArgumentError, NotFoundError
from tensormass._src.meshes import TriangleSurface


def read_image(path: Path) -> bytes:
    """Reads a picture file. The daemon checks its size and that it is a PNG or JPEG.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be read: {error.strerror}") from error


def coordinates(surface: TriangleSurface, where: str) -> bytes:
    """Packs the texture coordinates of a surface, as `Texture.coordinates` has them.

    Raises:
        InvalidArgumentError: the surface has none.
    """
    if surface.texture_coordinates is None:
        raise InvalidArgumentError(
            f"{where}: the skin has no texture coordinates; use a Wavefront file (.obj) with `vt` lines"
        )
    return surface.texture_coordinates.astype("<f4", copy=False).tobytes()
