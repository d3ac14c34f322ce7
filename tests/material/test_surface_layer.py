"""Density correction of the layer of cells below a liquid's surface."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.density_correction import DensityCorrection
from warp_lcp.material.surface_layer_kernels import (
    LEAST_AROUND,
    LEAST_IN_LAYER,
    filled_kernel,
    layer_kernel,
)

COUNTS = (8, 12)


def share(depth: np.ndarray) -> np.ndarray:
    """Return the share of a cell's kernel that a half space fills, by the center's depth [cells]."""
    d = np.clip(np.abs(depth), 0.0, 1.5)
    deep = np.where(d < 0.5, 0.5 + 0.75 * d - d**3 / 3.0, 1.0 - (1.5 - d) ** 3 / 6.0)
    return np.where(depth < 0.0, 1.0 - deep, deep)


def equations(density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return b and the lower bounds of x of inner cells, shape (ny, nx); b was 1, lower 0."""
    grid = StaggeredGrid((*COUNTS, 1), 1.0, 2, "cpu")
    base, kind = (grid.field(wp.int8) for _ in range(2))
    solid = np.full(grid.shape, wl.SOLID, dtype=np.int8)
    inner = (1, slice(1, -1), slice(1, -1))
    solid[inner] = wl.AIR
    base.assign(solid)
    solid[inner] = np.where(density > 0.0, wl.FLUID, wl.AIR)
    kind.assign(solid)
    rho, capacity, filled = grid.field(), grid.field(), grid.field(wp.uint8)
    host = np.zeros(grid.shape, dtype=np.float32)
    host[inner] = density
    rho.assign(host)
    capacity.fill_(1.0)
    filled.fill_(1)  # the ring is solid
    b, lower = grid.field(wp.float64), grid.field(wp.float64)
    b.fill_(1.0)
    grid.domain.launch(filled_kernel, [base, rho, capacity, filled])
    grid.domain.launch(layer_kernel, [grid.planes, kind, rho, capacity, filled, None, b, lower])
    return b.numpy()[inner], lower.numpy()[inner]


def test_the_two_shares_belong_together() -> None:
    """F(d - 1) of neighbors is F(d) of a cell."""
    depth = np.linspace(0.5, 1.0, 5001)
    at = np.abs(share(depth - 1.0) - LEAST_AROUND).argmin()
    assert share(depth)[at] == pytest.approx(LEAST_IN_LAYER, abs=0.005)


@pytest.mark.parametrize("level", [6.0, 6.2, 6.5, 6.77, 6.9])
def test_liquid_at_rest_is_left_alone(level: float) -> None:
    heights = np.arange(COUNTS[1])[:, None] + 0.5 + np.zeros(COUNTS[0])
    density = share(level - heights)
    b, lower = equations(density)
    layer = lower < 0.0
    assert layer[: int(level - 1.0)].all()
    assert not layer[density < LEAST_IN_LAYER - 0.005].any()
    assert b[layer].max() < 0.005
    assert (b[~layer] == 1.0).all()


def test_a_sparse_layer_lacks_material() -> None:
    density = np.zeros(COUNTS[::-1])
    density[:6], density[6], density[7] = 1.0, 0.8, 0.4
    b, lower = equations(density)
    assert np.isneginf(lower[:7]).all()
    assert (lower[7:] == 0.0).all()
    np.testing.assert_allclose(b[6], LEAST_IN_LAYER - 0.8, atol=1e-6)
    assert (b[:6] == 0.0).all()
    assert (b[7:] == 1.0).all()


def test_other_corrections_have_no_fields_for_it() -> None:
    class Walls:
        """A boundary without solids."""

        def __init__(self, grid: StaggeredGrid) -> None:
            self.base, self.open, self.capacity = grid.field(wp.int8), [], grid.field()

    grid = StaggeredGrid((*COUNTS, 1), 1.0, 2, "cpu")
    made = [
        DensityCorrection(
            grid,
            Walls(grid),  # type: ignore[arg-type]
            wl.ProjectedMultigrid(),
            particles_a_cell=4,
            max_density=1.02,
            even=True,
            fills_layer=fills,
        )
        for fills in (False, True)
    ]
    assert [one._filled is not None for one in made] == [False, True]
