"""Front of the deposit; percentiles selected on a device, against NumPy's partition."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_lcp.granular.runout import LEAST_DEPTH, DepositFront, ParticlePercentiles
from warp_lcp.granular.simulator import percentile_place
from warp_lcp.grid.staggered import StaggeredGrid

DEVICE = wp.get_device("cpu")


class PointParticles:
    """Particles at given points, shape (n, 3)."""

    def __init__(self, points: np.ndarray) -> None:
        self.count, self.position = (
            len(points),
            wp.array(points.astype(np.float32), dtype=wp.vec3, device=DEVICE),
        )


def particles(points: np.ndarray) -> Any:
    """Return particles at given points."""
    return PointParticles(points)


@pytest.mark.parametrize("seed", range(4))
def test_the_number_at_a_place_is_that_of_the_sorted_ones(seed: int) -> None:
    rng, front = np.random.default_rng(7800 + seed), ParticlePercentiles(DEVICE)
    for _ in range(4):
        n = int(rng.choice([1, 2, 99, 100, 101, 1500]))
        points = (rng.standard_normal((n, 3)) * 10.0 ** rng.integers(-30, 30, (n, 3))).astype(
            np.float32
        )
        points[rng.random((n, 3)) < 0.3] = rng.choice([0.0, 1.0, -1.0, 1e-42])  # many equal values
        for place in {percentile_place(n), 0, n - 1, int(rng.integers(0, n))}:
            front.find(particles(points), place)
            expected = np.sort(points[:, :2], axis=0)[place]
            assert front.read() == tuple(map(float, expected))


def test_no_particles_are_nowhere() -> None:
    front = ParticlePercentiles(DEVICE)
    front.find(particles(np.zeros((0, 3))), percentile_place(0))
    assert front.read() == (0.0, 0.0)


def front_of(depth: np.ndarray) -> float:
    """Return the front of columns of these depths [cells], on a grid with cells of 1 m."""
    front = DepositFront(grid := StaggeredGrid((len(depth), 1, 1), 1.0, 2))
    fraction = np.zeros(grid.shape, dtype=np.float32)
    fraction[1:-1, 1:-1, 1:-1] = depth
    front.find(wp.array(fraction, dtype=wp.float32, device=DEVICE))
    return front.read()


def reference(depth: np.ndarray) -> float:
    """Return the front of columns of these depths [cells], with NumPy."""
    last = int(depth.argmax())
    if depth[last] < LEAST_DEPTH:
        return 0.0
    shallow = np.flatnonzero(depth[last:] < LEAST_DEPTH)
    if not len(shallow):
        return float(len(depth))
    last += int(shallow[0]) - 1
    return float(last + 0.5 + (depth[last] - LEAST_DEPTH) / (depth[last] - depth[last + 1]))


def test_the_front_is_where_a_wedge_is_half_a_cell_deep() -> None:
    """Front of a wedge, wherever its toe lies in the grid; grains ahead of it do not count.

    Depths are in float32.
    """
    x = np.arange(40) + 0.5
    for toe in (20.0, 20.3, 20.8):
        depth = np.maximum(0.4 * (toe - x), 0.0)
        depth[30] = 0.3
        assert front_of(depth) == pytest.approx(toe - 1.25, abs=1e-5)
        depth[32] = 5.0  # a pile of its own
        assert front_of(depth) == pytest.approx(toe - 1.25, abs=1e-5)


def test_the_front_of_no_deposit_and_of_one_up_to_the_wall() -> None:
    assert front_of(np.full(5, 0.4)) == 0.0
    assert front_of(np.full(5, 2.0)) == 5.0


@pytest.mark.parametrize("counts", [(30, 12, 1), (24, 9, 5)])
def test_the_front_on_a_device_is_that_of_the_deepest_columns(counts: tuple[int, int, int]) -> None:
    rng, grid = np.random.default_rng(31), StaggeredGrid(counts, 0.5, 3 if counts[2] > 1 else 2)
    front = DepositFront(grid)
    for filled in (0.0, 0.02, 0.1, 0.2, 0.5, 1.0):
        fraction = np.zeros(grid.shape, dtype=np.float32)
        inside = rng.random(counts[::-1]) * (rng.random(counts[::-1]) < filled)
        inside *= np.linspace(1.5, 0.0, counts[0]) ** 2
        fraction[1:-1, 1:-1, 1:-1] = inside
        front.find(wp.array(fraction, dtype=wp.float32, device=DEVICE))
        expected = 0.5 * reference(inside.sum(axis=1).max(axis=0))
        assert front.read() == pytest.approx(expected, rel=1e-5)
