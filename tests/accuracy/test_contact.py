"""The other solution of contact against Hertz's formula, and the meshes and tables of contact_parts."""

from __future__ import annotations

import numpy as np
import pytest

from . import contact_parts, contact_reference, numpy_fem, references
from .contact_reference import COARSER, DEEP_PRESS, HALF_BALL
from .half_ball import half_ball
from .laws import hooke
from .meshes import boundary_faces
from .sphere_contact import HERTZ


@pytest.mark.parametrize("shape", sorted(contact_parts.HERTZ_SERIES))
def test_the_half_ball_is_one_body(shape: str) -> None:
    mesh = half_ball(shape, 2, 5, 0.1, 1.0)
    volume = numpy_fem.consistent_forces(mesh, lambda x: np.ones((*x.shape[:-1], 1))).sum()
    assert volume == pytest.approx(2 * np.pi / 3, rel=0.15)
    for face in boundary_faces(mesh):  # an inner face without a twin would be a boundary face
        on_top = (np.abs(mesh.nodes[face, 2]) < 1e-12).all()
        assert on_top or (np.linalg.norm(mesh.nodes[face], axis=1) > 0.85).all()


def test_multipliers_agree_with_hertz_and_do_not_depend_on_the_augmentation() -> None:
    a = HERTZ.contact_radius_m
    law = hooke(HERTZ.young_modulus_pa, HERTZ.poisson_ratio)
    tissue = contact_reference.half_ball_section(law, 6, 14, HERTZ.inner * a, HERTZ.outer * a)
    soft, stiff = (
        contact_reference.press(tissue, HERTZ.radius_m, [HERTZ.depth_m], times * HERTZ.young_modulus_pa / a)[0]
        for times in (20, 60)
    )
    assert soft == pytest.approx(stiff, rel=1e-4)
    assert soft == pytest.approx(HERTZ.force_n, rel=0.02)


@pytest.mark.parametrize("name", [DEEP_PRESS, HALF_BALL])
def test_a_stored_force_hardly_changes_on_a_coarser_mesh(name: str) -> None:
    answers = references.numbers("contact")
    assert answers[name + COARSER] == pytest.approx(answers[name], rel=0.01)


def test_the_page_shows_every_table() -> None:
    page = contact_parts.PAGE.read_text()
    for name, lines in contact_parts.tables().items():
        assert "\n".join(lines) in page, name
