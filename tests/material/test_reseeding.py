"""Reseeding: moved particles, conservation, and unchanged regions."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from grid_fields import particles_of_cells
from small_liquids import advance, box, create, dam, scene
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import Window
from warp_lcp.material import reseeding_kernels as kernels
from warp_lcp.material.reseeding import Reseeding
from warp_lcp.scene.table import SceneError

CELLS = 12


def pool(dimension: int, solid: list[dict[str, Any]] | None = None) -> Any:
    """Return a simulation of a box, for its grid and boundary."""
    size = [1.0] * dimension
    return create(
        scene(size=size, resolution=CELLS, liquid=[box([0.0] * dimension, size)], solid=solid or [])
    )


def uneven(
    simulation: Any, *, bubble: bool = False, top: float = 0.75, seed: int = 12
) -> Particles:
    """Return random particles below `top`, on average as many as at rest.

    Each has a velocity of its own.
    """
    grid, random = simulation.grid, np.random.default_rng(seed)
    size = np.array([1.0, top, 1.0 if grid.dimension == 3 else 0.0])
    points = (
        random.uniform(0.001, 0.999, (int(2**grid.dimension * CELLS**grid.dimension * top), 3))
        * size
    )
    points = points[simulation.boundary.admits(points)]
    if bubble:
        points = points[(np.abs(points[:, :2] * CELLS - [6.0, 4.0]) > [2.0, 2.0]).any(axis=1)]
    velocity = random.standard_normal(points.shape).astype(np.float32)
    return Particles(grid, points.astype(np.float32), velocity, affine=True)


def reseeding(simulation: Any, least: int, most: int) -> Reseeding:
    """Return a reseeding that checks its arguments."""
    return Reseeding(
        simulation.grid,
        simulation.boundary,
        least=least,
        most=most,
        particles_a_cell=2**simulation.grid.dimension,
        every=1,
    )


def test_no_particle_is_drawn_from_beyond_an_open_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search for neighbors beside an open side.

    The ring there is open as cells are, and its neighbors would lie outside the memory.
    """
    simulation = dam(
        3,
        particles={"reseed": {"every": 1}},
        domain={"size": [1.0, 0.5, 0.25], "resolution": 16, "open": ["top", "right"]},
    )
    launch, sought = Window.launch, []

    def noted(window: Window, kernel: Any, inputs: list[Any], **more: Any) -> None:
        if kernel is kernels.find_kernel:
            sought.append(window)
        launch(window, kernel, inputs, **more)

    monkeypatch.setattr(Window, "launch", noted)
    simulation.rearrangement.reseeding.apply(simulation.particles, simulation.grid.everywhere, 0)  # type: ignore[union-attr]
    (window,) = sought
    assert (window.low, window.high) == (simulation.grid.domain.low, simulation.grid.domain.high)


@pytest.mark.parametrize(("dimension", "least", "most"), [(2, 3, 6), (3, 5, 12)])
def test_cells_deep_in_the_liquid_hold_enough(dimension: int, least: int, most: int) -> None:
    simulation = pool(dimension)
    grid, particles = simulation.grid, uneven(simulation)
    deep = (
        (slice(2, -2), slice(2, 7), slice(2, -2))
        if dimension == 3
        else (slice(None), slice(2, 7), slice(2, -2))
    )
    before = particles_of_cells(grid, particles)
    assert (before[deep] < least).sum() > 5
    reseed = reseeding(simulation, least, most)
    for step in range(4):
        moved = reseed.apply(particles, grid.everywhere, step)
    after = particles_of_cells(grid, particles)
    # a thin region around one stays thin
    assert (after[deep] < least).sum() <= 0.15 * (before[deep] < least).sum()
    assert after.sum() == before.sum() == particles.count
    assert moved <= 2


@pytest.mark.parametrize("dimension", [2, 3])
def test_each_keeps_its_velocity_and_goes_to_a_neighboring_cell(dimension: int) -> None:
    """Velocities stay, and particles move to a neighboring cell at most.

    So momentum and energy are the same to the last bit; positions show which particles moved.
    """
    simulation = pool(dimension)
    grid, particles = simulation.grid, uneven(simulation)
    particles.sort()
    before = {name: array.numpy().copy() for name, array in particles.arrays().items()}
    moved = reseeding(simulation, 3 * dimension - 3, 6 * dimension).apply(
        particles, grid.everywhere, 7
    )
    after = {name: array.numpy() for name, array in particles.arrays().items()}
    for name in before.keys() - {"position"}:
        assert np.array_equal(before[name], after[name])
    changed = (before["position"] != after["position"]).any(axis=1)
    assert moved == changed.sum() > 10
    cells = [particles.cells_of(p["position"]) for p in (before, after)]
    assert np.abs(cells[1] - cells[0])[changed].max() == 1
    assert (cells[1] != cells[0]).any(axis=1)[changed].all()


def test_the_surface_bubbles_and_walls_are_left_alone() -> None:
    """Surface, bubbles and walls: unchanged.

    A bubble of four cells is air; a cell at the surface has half of its surroundings empty.
    """
    ball = {"shape": "sphere", "center": [0.1, 0.1], "radius": 0.13}
    simulation = pool(2, [ball])
    grid, particles = simulation.grid, uneven(simulation, bubble=True)
    before = particles_of_cells(grid, particles)[0]
    assert reseeding(simulation, 3, 6).apply(particles, grid.everywhere, 0) > 0
    after = particles_of_cells(grid, particles)[0]
    assert (after[2:6, 4:8] == 0).all()
    assert (after[9:] == 0).all()
    touched = np.zeros(after.shape, dtype=bool)
    touched[0], touched[:, 0], touched[:, -1] = True, True, True
    assert (after[touched] <= before[touched]).all()  # they may give particles away
    assert simulation.boundary.admits(particles.position.numpy()).all()


def test_nothing_is_drawn_from_cells_that_hold_no_more_than_at_rest() -> None:
    simulation = pool(2)
    particles = uneven(simulation)
    before = particles_of_cells(simulation.grid, particles)
    reseeding(simulation, 4, 4).apply(particles, simulation.grid.everywhere, 0)
    after = particles_of_cells(simulation.grid, particles)
    assert (after[before > 4] >= 4).all()
    assert (after[before <= 4] <= 4).all()
    assert (after[before <= 4] >= before[before <= 4]).all()


def test_runs_are_repeatable() -> None:
    found = []
    for _ in range(2):
        simulation = dam(
            particles={"reseed": {"every": 1, "min": 4, "max": 4}}, density_correction={}
        )
        rows = advance(simulation, 0.6)
        assert sum(row["reseeded"] for row in rows) > 0
        found.append(
            {name: array.numpy().copy() for name, array in simulation.particles.arrays().items()}
        )
    for name, array in found[0].items():
        assert np.array_equal(array, found[1][name])


def test_only_a_scene_with_the_setting_has_reseeding() -> None:
    assert dam().rearrangement.reseeding is None
    assert "reseeded" not in dam().columns()
    simulation = dam(particles={"reseed": {"every": 4}})
    rows = advance(simulation, 0.3)
    assert [row["reseeded"] is not None for row in rows] == [
        step % 4 == 0 for step in range(len(rows))
    ]


@pytest.mark.parametrize(("least", "most"), [(0, 8), (5, 8), (2, 3)])
def test_a_cell_of_particles_at_rest_is_within_the_bounds(least: int, most: int) -> None:
    """The bounds are 1 <= least <= 4 <= most; without particles there is nothing to copy."""
    with pytest.raises(ValueError, match=f"least = {least}, most = {most}: must be at least 1"):
        reseeding(pool(2), least, most)
    reseeding(pool(2), 1, 4)


@pytest.mark.parametrize(("reseed", "key"), [({"min": 5}, "min"), ({"max": 3}, "max")])
def test_bounds_that_exclude_rest_are_refused(reseed: dict[str, int], key: str) -> None:
    with pytest.raises(
        (SceneError, ValidationError),
        match=f"particles.*reseed.*{key}|at (most|least) the 4 particles",
    ):
        dam(particles={"reseed": reseed})
    with pytest.raises(ValueError, match="4 between them"):
        reseeding(pool(2), *((5, 8) if key == "min" else (2, 3)))
