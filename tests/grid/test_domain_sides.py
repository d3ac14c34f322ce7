"""Open sides of the domain."""

import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.domain_sides import SIDES, continue_beyond, mark_gone, open_ring, side_bits
from warp_lcp.grid.staggered import StaggeredGrid


def test_corners_beyond_a_wall_stay_closed() -> None:
    ring = open_ring((3, 5, 6), side_bits(["top", "left"]))
    assert ring[1, -1, 1:-1].all()
    assert ring[1, 1:-1, 0].all()
    assert ring[1, -1, 0]
    assert not ring[1, -1, -1]
    assert not ring[[0, 2]].any()
    assert not ring[1, 1:-1, 1:-1].any()


@pytest.mark.parametrize("side", SIDES)
def test_fields_go_on_beyond_the_side_and_nowhere_else(side: str) -> None:
    grid = StaggeredGrid((3, 4, 5), 0.5, 3, "cpu")
    values = np.random.default_rng(23).random(grid.shape).astype(np.float32)
    field = wp.array(values, dtype=wp.float32, device="cpu")
    continue_beyond(grid, side_bits([side]), field)
    number = SIDES.index(side)
    ring, inner = [slice(1, -1)] * 3, [slice(1, -1)] * 3
    ring[2 - (number >> 1)], inner[2 - (number >> 1)] = (-1, -2) if number & 1 else (0, 1)
    expected = values.copy()
    expected[tuple(ring)] = values[tuple(inner)]
    np.testing.assert_array_equal(field.numpy(), expected)


@pytest.mark.every_case
@pytest.mark.parametrize("beyond", [0.1, 0.0, -0.01])
@pytest.mark.parametrize("side", SIDES)
def test_particles_on_the_side_or_beyond_are_gone(side: str, beyond: float) -> None:
    grid = StaggeredGrid((3, 4, 5), 0.5, 3, "cpu")
    number = SIDES.index(side)
    points = np.full((6, 3), 0.75, dtype=np.float32)
    for other in range(6):
        points[other, other >> 1] = grid.counts[other >> 1] * 0.5 + beyond if other & 1 else -beyond
    marks = wp.full(6, 7, dtype=wp.int32, device="cpu")
    mark_gone(grid, side_bits([side]), wp.array(points, dtype=wp.vec3, device="cpu"), marks)
    np.testing.assert_array_equal(marks.numpy(), (np.arange(6) == number) & (beyond >= 0.0))


def test_unknown_sides_are_refused() -> None:
    with pytest.raises(ValueError, match="choose from left"):
        side_bits(["up"])
