"""Semi-Lagrangian advection of fields."""

import numpy as np
import pytest
import warp as wp

from grid_fields import uniform_velocity
from warp_lcp.grid.advection import CENTERS, carry_field
from warp_lcp.grid.staggered import StaggeredGrid

CELLS = 32


def coordinates(grid: StaggeredGrid, axis: int) -> list[np.ndarray]:
    """Return x, y, z [m] of a component's faces or of cell centers.

    They are in the stored shape.
    """
    K, J, I = np.meshgrid(*(np.arange(n) - 1.0 for n in grid.shape), indexing="ij")
    return [(c + (0.0 if a == axis else 0.5)) * grid.spacing for a, c in enumerate((I, J, K))]


def carried(
    grid: StaggeredGrid,
    velocity: list[wp.array],
    dt: float,
    values: np.ndarray,
    axis: int,
    level: np.ndarray | None = None,
):
    """Return a field after a step."""
    levels = np.ones(grid.shape) if level is None else level
    field, out = (
        wp.array(v.astype(np.float32), device="cpu") for v in (values, np.full(grid.shape, -7.0))
    )
    carry_field(
        grid,
        grid.everywhere,
        velocity,
        dt / grid.spacing,
        field,
        out,
        axis=axis,
        level=wp.array(levels.astype(np.float32), device="cpu"),
        least=0.5,
    )
    return out.numpy()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("axis", [0, 1, CENTERS])
def test_a_linear_field_goes_with_the_flow(dimension, axis):
    """Linear field in a uniform flow.

    f = a . x becomes a . (x - u dt): the sign of the way back, and the places of faces and centers.
    """
    counts = (12, 10, 8 if dimension == 3 else 1)
    grid = StaggeredGrid(counts, 0.1, dimension, "cpu")
    x = coordinates(grid, axis)
    slope, speed, dt = (1.3, -0.7, 0.4 * (dimension == 3)), (0.9, 0.5, -0.6), 0.15
    values = sum(a * c for a, c in zip(slope, x, strict=True))
    out = carried(grid, uniform_velocity(grid, speed[:dimension]), dt, values, axis)
    exact = values - dt * sum(a * u for a, u in zip(slope, speed[:dimension], strict=False))
    k = slice(3, -3) if dimension == 3 else slice(1, 2)
    inner = (k, slice(4, -4), slice(4, -4))
    assert np.allclose(out[inner], exact[inner], atol=2e-6)


def test_waves_keep_their_height_and_their_place():
    """Height and place of waves.

    A wave of 16 cells moves by two wavelengths in 80 steps; linear interpolation would leave 23 %
    of it.
    """
    grid = StaggeredGrid((96, 4, 1), 1.0, 2, "cpu")
    x = coordinates(grid, 1)[0]
    inside = (x > 12.0) & (x < 60.0)
    values = np.where(inside, np.sin(np.pi * x / 8.0), 0.0).astype(np.float32)
    velocity = uniform_velocity(grid, (0.4, 0.0))
    for _ in range(80):
        values = carried(grid, velocity, 1.0, values, 1)
    middle = (x[1, 2] > 52.0) & (x[1, 2] < 84.0)
    exact = np.sin(np.pi * (x[1, 2] - 32.0) / 8.0)[middle]
    found = values[1, 2][middle]
    assert found @ exact / (exact @ exact) == pytest.approx(0.872, abs=0.02)
    assert np.abs(found - exact).max() < 0.2


def test_third_order_around_a_turn():
    """Third order around a turn.

    Starting points of a rigid rotation are exact to the third order in the step.
    """
    errors = []
    for steps in (1, 2):
        grid = StaggeredGrid((CELLS, CELLS, 1), 1.0 / CELLS, 2, "cpu")
        faces = grid.faces()
        for axis, field in enumerate(faces):
            x, y, _ = coordinates(grid, axis)
            field.assign((-(y - 0.5) if axis == 0 else x - 0.5).astype(np.float32))
        x, y, _ = coordinates(grid, CENTERS)
        values, angle = x.copy(), 1.0
        for _ in range(steps):
            values = carried(grid, faces, angle / steps, values, CENTERS)
        exact = 0.5 + np.cos(angle) * (x - 0.5) + np.sin(angle) * (y - 0.5)
        near = np.hypot(x - 0.5, y - 0.5) < 0.25
        errors.append(np.abs(values - exact)[1][near[1]].max())
    assert errors[0] < 0.012
    assert 6.0 < errors[0] / errors[1] < 10.5


def test_new_extrema_do_not_appear():
    """No new extrema: a step function stays between its values."""
    grid = StaggeredGrid((CELLS, CELLS, 1), 1.0, 2, "cpu")
    x, y, _ = coordinates(grid, 0)
    values = ((x > 10.0) & (y > 12.0)).astype(np.float32)
    for _ in range(7):
        values = carried(grid, uniform_velocity(grid, (0.37, 0.61)), 1.0, values, 0)
    inside = values[1, 12:-1, 12:-1]  # what comes from the domain, and not from the ring
    assert inside.min() >= 0.0 and inside.max() <= 1.0
    assert 0.0 < values[1, 18, 14] < 1.0


def test_places_without_the_level_are_left_alone():
    """Places without the level remain unchanged.

    Faces keep their velocity, centers get 0; a face has the mean level of its two cells.
    """
    grid = StaggeredGrid((8, 8, 1), 1.0, 2, "cpu")
    level = np.zeros(grid.shape)
    level[:, :, 5:] = 0.9
    x = coordinates(grid, 0)[0]
    out = carried(grid, uniform_velocity(grid, (0.5, 0.0)), 1.0, x, 0, level)
    # face 5 lies at the mean of 0 and 0.9
    assert np.array_equal(out[1, 1:9, 1:6], x.astype(np.float32)[1, 1:9, 1:6])
    assert np.allclose(out[1, 1:9, 6:9], x[1, 1:9, 6:9] - 0.5)
    out = carried(grid, uniform_velocity(grid, (0.5, 0.0)), 1.0, x, CENTERS, level)
    assert not out[1, 1:9, 1:5].any() and out[1, 1:9, 6:9].all()
