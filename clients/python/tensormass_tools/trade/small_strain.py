"""Which laws are equal for small strains, and by which constants."""

from __future__ import annotations

import numpy as np

from tensormass import LAWS
from tensormass.v1 import scene_pb2

#: Laws with Young's modulus and Poisson's ratio as constants. They are equal for small strains.
ISOTROPIC_LAWS = tuple(name for name in LAWS if isinstance(getattr(scene_pb2.Law(), name), scene_pb2.IsotropicElastic))


def small_strain(law: scene_pb2.Law) -> tuple[float, float] | None:
    """Returns Young's modulus [Pa] and Poisson's ratio for small strains; None for a law that is not isotropic, or
    whose Poisson's ratio other laws do not accept."""
    kind = law.WhichOneof("kind")
    if kind in ISOTROPIC_LAWS:
        own = getattr(law, kind)
        return own.young_modulus_pa, own.poisson_ratio
    if kind == "mooney_rivlin":
        shear, bulk = 2 * (law.mooney_rivlin.c10_pa + law.mooney_rivlin.c01_pa), law.mooney_rivlin.bulk_modulus_pa
    elif kind == "ogden":
        shear, bulk = law.ogden.mu_pa * law.ogden.alpha / 2, law.ogden.bulk_modulus_pa
    else:
        return None
    poisson = (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))
    return (2 * shear * (1 + poisson), poisson) if np.isfinite(poisson) and poisson <= 0.4999 else None
