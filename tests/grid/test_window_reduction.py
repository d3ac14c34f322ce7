"""Sums and maxima over windows, against NumPy.

The emulation of CUDA runs their other form.
"""

import numpy as np
import pytest
import warp as wp

from warp_lcp.fluids.pressure import COUNT
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.material.density_correction import CROWD
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID


@pytest.mark.parametrize("counts", [(7, 5, 1), (40, 3, 1), (9, 11, 37), (33, 2, 4)])
def test_windows_are_added_up(counts: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(sum(counts))
    grid = StaggeredGrid(counts, 0.1, 2 if counts[2] == 1 else 3)
    base = rng.choice(np.array([AIR, FLUID, SOLID], dtype=np.int8), grid.shape)
    density, capacity = (rng.uniform(0.0, 2.0, grid.shape).astype(np.float32) for _ in range(2))
    fields = {"base": base, "density": density, "capacity": capacity}
    arrays = {name: wp.array(field, device=grid.device) for name, field in fields.items()}
    crowd, all, count = (
        WindowReduction(CROWD, grid),
        WindowReduction(CROWD, grid, grid.domain),
        WindowReduction(COUNT, grid),
    )
    for _ in range(6):
        corners = np.sort(rng.integers(1, np.array(counts) + 1, (2, 3)), axis=0)
        window = grid.window(corners[0], corners[1], grow=1).common(grid.domain)
        assert window is not None
        box = tuple(map(slice, window.low, window.high))
        crowd.launch(window, **arrays, most=1.2)
        all.launch(window, **arrays, most=1.2)
        count.launch(window, kind=arrays["base"])
        has = (base[box] != SOLID) & (density[box] > 0.0)
        over = np.where(has, density[box] - np.float32(1.2) * capacity[box], 0.0)
        expected = [
            over[over > 0.0].sum(),
            density[box][has].sum(),
            1.0 + np.where(has, density[box] - capacity[box], -1.0).max(),
        ]
        assert crowd.read() == pytest.approx(expected, rel=1e-6)
        assert all.read() == pytest.approx(expected, rel=1e-6)
        assert count.read() == [(base[box] == FLUID).sum()]
