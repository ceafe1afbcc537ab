"""Conversion between the constants of isotropic elasticity: Lamé's λ and μ, Young's modulus E and Poisson's ratio ν."""

from __future__ import annotations

import math

from tensormass._shared.errors import InvalidArgumentError


def young_poisson(lambda_pa: float, mu_pa: float) -> tuple[float, float]:
    """Returns Young's modulus [Pa] and Poisson's ratio of a material with Lamé's constants.

        E = μ (3λ + 2μ) / (λ + μ)        ν = λ / (2 (λ + μ))

    Args:
        lambda_pa: λ [Pa], above -2/3 μ, because the bulk modulus λ + 2/3 μ is positive.
        mu_pa: μ, the shear modulus [Pa], positive.

    Raises:
        InvalidArgumentError: constants that no stable material has.
    """
    if not 0 < mu_pa < math.inf:
        raise InvalidArgumentError(f"mu_pa: expected a positive number, got {mu_pa!r}")
    if not -2 / 3 * mu_pa < lambda_pa < math.inf:
        raise InvalidArgumentError(
            f"lambda_pa: expected a number above -2/3 mu_pa = {-2 / 3 * mu_pa:g}, got {lambda_pa!r}"
        )
    total = lambda_pa + mu_pa
    return mu_pa * (3 * lambda_pa + 2 * mu_pa) / total, lambda_pa / (2 * total)


def lame(young_modulus_pa: float, poisson_ratio: float) -> tuple[float, float]:
    """Returns Lamé's λ and μ [Pa] of a material. See `young_poisson`.

    Args:
        young_modulus_pa: E [Pa], positive.
        poisson_ratio: ν, above -1 and below 0.5.

    Raises:
        InvalidArgumentError: constants that no stable material has.
    """
    if not 0 < young_modulus_pa < math.inf:
        raise InvalidArgumentError(f"young_modulus_pa: expected a positive number, got {young_modulus_pa!r}")
    if not -1 < poisson_ratio < 0.5:
        raise InvalidArgumentError(f"poisson_ratio: expected a number above -1 and below 0.5, got {poisson_ratio!r}")
    mu_pa = young_modulus_pa / (2 * (1 + poisson_ratio))
    return 2 * mu_pa * poisson_ratio / (1 - 2 * poisson_ratio), mu_pa
