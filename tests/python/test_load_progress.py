"""How far a load is, from a real daemon. Without build/bin/tensormassd these are skipped."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import tensormass as tm
from tensormass._shared import processes

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

BLOCK = """
name: block
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 5, cells_y: 5, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
"""


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server


def test_a_load_says_how_far_it_is(server: tm.Server) -> None:
    heard: list[tuple[str, float]] = []
    handle = server.load(tm.Scene.from_yaml(BLOCK), progress=lambda part, fraction: heard.append((part, fraction)))
    fractions = [fraction for _, fraction in heard]
    assert fractions == sorted(fractions)
    assert (fractions[0], heard[-1]) == (0.0, ("", 1.0))
    assert all(part for part, _ in heard[:-1])
    assert handle.report is not None
    assert handle.report.bodies[0].name == "tissue"
    handle.unload()


def test_an_exception_of_the_callback_ends_the_load(server: tm.Server) -> None:
    def give_up(part: str, fraction: float) -> None:
        raise KeyboardInterrupt

    scene = tm.Scene.from_yaml(BLOCK)
    with pytest.raises(KeyboardInterrupt):
        server.load(scene, name="given-up", progress=give_up)
    server.load(scene, name="next").unload()


def test_a_refusal_has_the_same_text_with_a_callback(server: tm.Server) -> None:
    scene = tm.Scene.from_yaml(BLOCK)
    scene.message.bodies[0].density_kg_per_m3 = -1
    for progress in (None, lambda part, fraction: None):
        with pytest.raises(tm.InvalidArgumentError, match="body 'tissue'"):
            server.load(scene, progress=progress)
