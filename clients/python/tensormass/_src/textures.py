"""Pictures on the skins of bodies, for viewers."""

from __future__ import annotations

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.meshes import TriangleSurface


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
