"""Lamé's constants to Young's modulus and Poisson's ratio, and back."""

from __future__ import annotations

import pytest

import tensormass as tm


def test_known_materials() -> None:
    assert tm.young_poisson(1.0, 1.0) == (2.5, 0.25)
    assert tm.young_poisson(0.0, 3.0) == (6.0, 0.0)
    assert tm.lame(2.5, 0.25) == (1.0, 1.0)


@pytest.mark.parametrize(("young", "poisson"), [(4000, 0.45), (1e9, 0.0), (2e5, -0.9), (10, 0.4999)])
def test_both_directions_are_inverse(young: float, poisson: float) -> None:
    assert tm.young_poisson(*tm.lame(young, poisson)) == pytest.approx((young, poisson), rel=1e-11)


def test_they_are_the_constants_of_a_pulled_bar() -> None:
    """A bar pulled by ε is stressed by E ε along it and shrinks by ν ε across, where λ and μ leave no side stress."""
    lambda_pa, mu_pa, strain = 700.0, 300.0, 0.01
    young, poisson = tm.young_poisson(lambda_pa, mu_pa)
    volume = strain * (1 - 2 * poisson)
    assert lambda_pa * volume + 2 * mu_pa * strain == pytest.approx(young * strain)
    assert lambda_pa * volume - 2 * mu_pa * poisson * strain == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("lambda_pa", "mu_pa", "message"),
    [
        (1.0, 0.0, "mu_pa: expected a positive number, got 0.0"),
        (1.0, float("nan"), "mu_pa"),
        (1.0, float("inf"), "mu_pa"),
        (-2.0, 3.0, "lambda_pa: expected a number above -2/3 mu_pa = -2, got -2.0"),
        (float("nan"), 1.0, "lambda_pa"),
        (float("inf"), 1.0, "lambda_pa"),
    ],
)
def test_unstable_lame_constants_are_refused(lambda_pa: float, mu_pa: float, message: str) -> None:
    with pytest.raises(tm.InvalidArgumentError, match=message):
        tm.young_poisson(lambda_pa, mu_pa)


@pytest.mark.parametrize(("young", "poisson"), [(0, 0.3), (float("nan"), 0.3), (1, 0.5), (1, -1), (1, float("nan"))])
def test_constants_without_finite_lame_constants_are_refused(young: float, poisson: float) -> None:
    with pytest.raises(tm.InvalidArgumentError, match="young_modulus_pa" if poisson == 0.3 else "poisson_ratio"):
        tm.lame(young, poisson)


def test_a_body_takes_lame_constants() -> None:
    mesh = tm.grid([1, 1, 1], [1, 1, 1])
    scene = tm.Scene.from_mesh(mesh, law="neo_hookean", lame_pa=(1.0, 1.0))
    own = scene.body("body").law.neo_hookean
    assert (own.young_modulus_pa, own.poisson_ratio) == (2.5, 0.25)
    with pytest.raises(tm.InvalidArgumentError, match=r"body.lame_pa: given with young_modulus_pa or poisson_ratio"):
        tm.Scene.from_mesh(mesh, young_modulus_pa=1, lame_pa=(1, 1))
    with pytest.raises(tm.InvalidArgumentError, match=r"body.lame_pa: mu_pa: expected a positive number"):
        tm.Scene.from_mesh(mesh, lame_pa=(1, -1))
    with pytest.raises(tm.InvalidArgumentError, match=r"ogden has no constant 'young_modulus_pa'"):
        tm.Scene.from_mesh(mesh, law="ogden", lame_pa=(1, 1))
