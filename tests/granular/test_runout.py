"""Percentiles selected on a device, against NumPy's partition."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_lcp.granular.runout import ParticlePercentiles
from warp_lcp.granular.simulator import percentile_place

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
