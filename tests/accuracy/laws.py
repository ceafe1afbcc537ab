"""The laws, implemented a second time and in other forms: as stress tensors for the reference solvers, in principal
stretches for pulling, and by components for shearing. The server derives its own from the energies in scene.proto.

F: deformation gradient; J = det F; P: first Piola-Kirchhoff stress; C = FᵀF; λ, μ: Lamé's constants; K: bulk modulus.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass.v1 import scene_pb2

Floats = npt.NDArray[np.float64]

IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Law:
    """One law with its parameters.

    message: the law in the protocol.
    stress: F [..., 3, 3] to P [Pa].
    volumetric: F to the part of P that the bulk modulus contributes [Pa], for selective quadrature.
    pull: principal stretches along (x, y, z) to nominal stresses [Pa].
    shear: γ to P11, P12, P21, P22, P33 of F = I + γ e_x ⊗ e_y [Pa].
    directed: anisotropic; `pull` then assumes fibres along x.
    """

    message: scene_pb2.Law
    stress: Callable[[Floats], Floats]
    volumetric: Callable[[Floats], Floats]
    pull: Callable[[Floats], Floats]
    shear: Callable[[float], Floats]
    directed: bool = False
    # *ELASTIC or *HYPERELASTIC cards of CalculiX; empty if CalculiX does not have the law.
    calculix: str = ""


def lame(young_modulus_pa: float, poisson_ratio: float) -> tuple[float, float]:
    """λ and μ [Pa]."""
    mu = young_modulus_pa / (2 * (1 + poisson_ratio))
    return 2 * mu * poisson_ratio / (1 - 2 * poisson_ratio), mu


def _bulk(young_modulus_pa: float, poisson_ratio: float) -> float:
    return young_modulus_pa / (3 * (1 - 2 * poisson_ratio))


def _isotropic(young_modulus_pa: float, poisson_ratio: float) -> scene_pb2.IsotropicElastic:
    return scene_pb2.IsotropicElastic(young_modulus_pa=young_modulus_pa, poisson_ratio=poisson_ratio)


def _trace(a: Floats) -> Floats:
    return np.einsum("...ii", a)[..., None, None]


def _transpose(a: Floats) -> Floats:
    return np.swapaxes(a, -1, -2)


def _det(f: Floats) -> Floats:
    return np.linalg.det(f)[..., None, None]


def _inverse_transpose(f: Floats) -> Floats:
    return _transpose(np.linalg.inv(f).astype(np.float64, copy=False))


def _by_volume(bulk_modulus_pa: float) -> Callable[[Floats], Floats]:
    """P of the energy W = K/2 (J − 1)²."""
    return lambda f: bulk_modulus_pa * (_det(f) - 1) * _det(f) * _inverse_transpose(f)


def _shear_by_principal_stress(principal: Callable[[float], Floats]) -> Callable[[float], Floats]:
    """Law.shear from the principal Cauchy stresses under the stretches (s, 1/s, 1)."""

    def shear(g: float) -> Floats:
        stretch = (g + np.sqrt(g**2 + 4)) / 2
        first, second, third = principal(stretch)
        # The larger principal direction of F Fᵀ is (stretch, 1, 0).
        cos2, sin2 = np.array([stretch**2, 1]) / (stretch**2 + 1)
        s11, s22, s12 = (
            first * cos2 + second * sin2,
            first * sin2 + second * cos2,
            (first - second) * np.sqrt(cos2 * sin2),
        )
        return np.array([s11 - g * s12, s12, s12 - g * s22, s22, third])  # P = σ F^-T

    return shear


def hooke(young_modulus_pa: float, poisson_ratio: float) -> Law:
    lam, mu = lame(young_modulus_pa, poisson_ratio)

    def stress(f: Floats) -> Floats:
        strain = (f + _transpose(f)) / 2 - IDENTITY
        return lam * _trace(strain) * IDENTITY + 2 * mu * strain

    return Law(
        scene_pb2.Law(hooke=_isotropic(young_modulus_pa, poisson_ratio)),
        stress,
        lambda f: _bulk(young_modulus_pa, poisson_ratio) * (_trace(f) - 3) * IDENTITY,
        lambda s: lam * (s.sum() - 3) + 2 * mu * (s - 1),
        lambda g: mu * g * np.array([0, 1, 1, 0, 0]),
    )


def st_venant_kirchhoff(young_modulus_pa: float, poisson_ratio: float) -> Law:
    lam, mu = lame(young_modulus_pa, poisson_ratio)

    def stress(f: Floats) -> Floats:
        strain = (_transpose(f) @ f - IDENTITY) / 2
        return f @ (lam * _trace(strain) * IDENTITY + 2 * mu * strain)

    def pull(s: Floats) -> Floats:
        strain = (s**2 - 1) / 2
        return s * (lam * strain.sum() + 2 * mu * strain)

    def shear(g: float) -> Floats:
        pressure = lam * g**2 / 2
        across = pressure + mu * g**2
        return np.array([pressure + mu * g**2, mu * g + g * across, mu * g, across, pressure])

    return Law(
        scene_pb2.Law(st_venant_kirchhoff=_isotropic(young_modulus_pa, poisson_ratio)),
        stress,
        lambda f: _bulk(young_modulus_pa, poisson_ratio) * f * (_trace(_transpose(f) @ f) - 3) / 2,
        pull,
        shear,
        calculix=f"*ELASTIC\n{young_modulus_pa:g}, {poisson_ratio:g}\n",
    )


def corotational(young_modulus_pa: float, poisson_ratio: float) -> Law:
    lam, mu = lame(young_modulus_pa, poisson_ratio)

    def stress(f: Floats) -> Floats:
        u, s, v = np.linalg.svd(f)
        rotation = u @ v
        return 2 * mu * (f - rotation) + lam * (s.sum(axis=-1) - 3)[..., None, None] * rotation

    def volumetric(f: Floats) -> Floats:
        u, s, v = np.linalg.svd(f)
        return _bulk(young_modulus_pa, poisson_ratio) * (s.sum(axis=-1) - 3)[..., None, None] * (u @ v)

    def shear(g: float) -> Floats:
        root = np.sqrt(4 + g**2)  # F = R S with R the rotation by atan(γ/2), tr S = root + 1
        cos, sin, spread = 2 / root, g / root, lam * (root - 2)
        diagonal = 2 * mu * (1 - cos) + spread * cos
        return np.array([diagonal, 2 * mu * (g - sin) + spread * sin, (2 * mu - spread) * sin, diagonal, spread])

    return Law(
        scene_pb2.Law(corotational=_isotropic(young_modulus_pa, poisson_ratio)),
        stress,
        volumetric,
        lambda s: lam * (s.sum() - 3) + 2 * mu * (s - 1),
        shear,
    )


def neo_hookean(young_modulus_pa: float, poisson_ratio: float) -> Law:
    lam, mu = lame(young_modulus_pa, poisson_ratio)

    def stress(f: Floats) -> Floats:
        return mu * f + (lam * np.log(_det(f)) - mu) * _inverse_transpose(f)

    return Law(
        scene_pb2.Law(neo_hookean=_isotropic(young_modulus_pa, poisson_ratio)),
        stress,
        lambda f: _bulk(young_modulus_pa, poisson_ratio) * np.log(_det(f)) * _inverse_transpose(f),
        lambda s: mu * (s - 1 / s) + lam * np.log(s.prod()) / s,
        lambda g: mu * g * np.array([0, 1, 1, 0, 0]),
    )


def stable_neo_hookean(young_modulus_pa: float, poisson_ratio: float) -> Law:
    """W = μ'/2 (I_C − 3) + λ'/2 (J − α)² − μ'/2 ln(I_C + 1), μ' = 4/3 μ, λ' = λ + 5/6 μ, α = 1 + 3μ'/4λ'
    (Smith, de Goes, Kim 2018, equation 14, and their conversion to Hooke's moduli).
    """
    hooke_lam, hooke_mu = lame(young_modulus_pa, poisson_ratio)
    mu, lam = 4 / 3 * hooke_mu, hooke_lam + 5 / 6 * hooke_mu
    alpha = 1 + 3 * mu / (4 * lam)

    def stress(f: Floats) -> Floats:
        square = np.einsum("...ij,...ij", f, f)[..., None, None]
        j = _det(f)
        return mu * (1 - 1 / (square + 1)) * f + lam * (j - alpha) * j * _inverse_transpose(f)

    def pull(s: Floats) -> Floats:
        j = s.prod()
        return mu * s * (1 - 1 / ((s**2).sum() + 1)) + lam * (j - alpha) * j / s

    def shear(g: float) -> Floats:
        same, other = mu * (1 - 1 / (4 + g**2)), lam * (1 - alpha)
        return np.array([same + other, same * g, -other * g, same + other, same + other])

    message = scene_pb2.Law(stable_neo_hookean=_isotropic(young_modulus_pa, poisson_ratio))
    return Law(message, stress, _by_volume(_bulk(young_modulus_pa, poisson_ratio)), pull, shear)


def mooney_rivlin(c10_pa: float, c01_pa: float, bulk_modulus_pa: float) -> Law:
    def stress(f: Floats) -> Floats:
        c = _transpose(f) @ f
        i1, j = _trace(c), _det(f)
        i2 = (i1**2 - _trace(c @ c)) / 2
        dual = _inverse_transpose(f)
        first = 2 * j ** (-2 / 3) * (f - i1 / 3 * dual)
        second = 2 * j ** (-4 / 3) * (i1 * f - f @ c - 2 / 3 * i2 * dual)
        return c10_pa * first + c01_pa * second + bulk_modulus_pa * (j - 1) * j * dual

    def pull(s: Floats) -> Floats:
        j = s.prod()
        b = j ** (-1 / 3) * s  # distortional stretches; τ_i = b_i ∂W/∂b_i less its mean, + K (J − 1) J
        kirchhoff = 2 * c10_pa * b**2 - 2 * c01_pa / b**2
        return (kirchhoff - kirchhoff.mean() + bulk_modulus_pa * (j - 1) * j) / s

    def shear(g: float) -> Floats:
        normal = -2 / 3 * g**2 * (c10_pa + 2 * c01_pa)
        along = 2 * (c10_pa + c01_pa) * g
        back = 2 * g * (c10_pa * (1 + g**2 / 3) + c01_pa * (1 + 2 / 3 * g**2))
        return np.array([normal, along, back, normal, 2 / 3 * g**2 * (c01_pa - c10_pa)])

    message = scene_pb2.Law(
        mooney_rivlin=scene_pb2.MooneyRivlin(c10_pa=c10_pa, c01_pa=c01_pa, bulk_modulus_pa=bulk_modulus_pa)
    )
    return Law(
        message,
        stress,
        _by_volume(bulk_modulus_pa),
        pull,
        shear,
        # CalculiX uses C10 (Ī1 − 3) + C01 (Ī2 − 3) + 1/D1 (J − 1)², which is the same energy with D1 = 2/K.
        calculix=f"*HYPERELASTIC, MOONEY-RIVLIN\n{c10_pa:g}, {c01_pa:g}, {2 / bulk_modulus_pa:.7g}\n",
    )


def ogden(mu_pa: float, alpha: float, bulk_modulus_pa: float) -> Law:
    def pull(s: Floats) -> Floats:
        j = s.prod(axis=-1)[..., None]
        powers = mu_pa * (j ** (-1 / 3) * s) ** alpha
        return (powers - powers.mean(axis=-1)[..., None] + bulk_modulus_pa * (j - 1) * j) / s

    def stress(f: Floats) -> Floats:
        u, s, v = np.linalg.svd(f)
        return (u * pull(s)[..., None, :]) @ v

    def principal(stretch: float) -> Floats:
        powers = mu_pa * np.array([stretch**alpha, stretch**-alpha, 1])
        return powers - powers.mean()

    message = scene_pb2.Law(ogden=scene_pb2.Ogden(mu_pa=mu_pa, alpha=alpha, bulk_modulus_pa=bulk_modulus_pa))
    return Law(message, stress, _by_volume(bulk_modulus_pa), pull, _shear_by_principal_stress(principal))


def hencky(young_modulus_pa: float, poisson_ratio: float) -> Law:
    lam, mu = lame(young_modulus_pa, poisson_ratio)

    def pull(s: Floats) -> Floats:
        strain = np.log(s)
        return (2 * mu * strain + lam * strain.sum(axis=-1)[..., None]) / s

    def stress(f: Floats) -> Floats:
        u, s, v = np.linalg.svd(f)
        return (u * pull(s)[..., None, :]) @ v

    return Law(
        scene_pb2.Law(hencky=_isotropic(young_modulus_pa, poisson_ratio)),
        stress,
        lambda f: _bulk(young_modulus_pa, poisson_ratio) * np.log(_det(f)) * _inverse_transpose(f),
        pull,
        _shear_by_principal_stress(lambda stretch: 2 * mu * np.log(stretch) * np.array([1, -1, 0])),
    )


def transversely_isotropic(
    young_modulus_pa: float, poisson_ratio: float, fibre_modulus_pa: float, direction: tuple[float, float, float]
) -> Law:
    matrix = st_venant_kirchhoff(young_modulus_pa, poisson_ratio)
    a = np.array(direction) / np.linalg.norm(direction)

    def stress(f: Floats) -> Floats:
        along = f @ a
        strain = ((along**2).sum(axis=-1) - 1) / 2
        return matrix.stress(f) + fibre_modulus_pa * (strain[..., None] * along)[..., :, None] * a

    def pull(s: Floats) -> Floats:
        return matrix.pull(s) + np.array([fibre_modulus_pa * s[0] * (s[0] ** 2 - 1) / 2, 0, 0])

    def shear(g: float) -> Floats:
        tension = fibre_modulus_pa * (g * a[0] * a[1] + g**2 * a[1] ** 2 / 2)
        x = a[0] + g * a[1]
        return matrix.shear(g) + tension * np.array([x * a[0], x * a[1], a[1] * a[0], a[1] ** 2, 0])

    message = scene_pb2.Law(
        transversely_isotropic=scene_pb2.TransverselyIsotropic(
            young_modulus_pa=young_modulus_pa,
            poisson_ratio=poisson_ratio,
            fibre_modulus_pa=fibre_modulus_pa,
            fibre_direction=scene_pb2.Vector3(x=a[0], y=a[1], z=a[2]),
        )
    )
    return Law(message, stress, matrix.volumetric, pull, shear, directed=True)


# Soft tissue: 5 kPa. Laws with these two constants describe the same tissue at small strain.
LAWS: dict[str, Law] = {
    "hooke": hooke(5000, 0.35),
    "st_venant_kirchhoff": st_venant_kirchhoff(5000, 0.35),
    "corotational": corotational(5000, 0.35),
    "neo_hookean": neo_hookean(5000, 0.35),
    "stable_neo_hookean": stable_neo_hookean(5000, 0.35),
    "mooney_rivlin": mooney_rivlin(600, 300, 8000),
    "ogden": ogden(300, 12, 8000),
    "transversely_isotropic": transversely_isotropic(5000, 0.35, 8000, (1, 0, 0)),
    "hencky": hencky(5000, 0.35),
}
