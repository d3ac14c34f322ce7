# mypy: ignore-errors
"""Least density of the layer of cells below a liquid's surface, for the density correction.

A cell deep inside, all of whose neighbors are more than half full, has the density at rest. The
layer above it has not, even at rest, and the correction lets it become sparse. The surface then
lies too high. A half space fills the share

    F(d) = 1/2 + 3 d / 4 - d^3 / 3,   |d| < 1/2;   F(d) = 1 - (3/2 - d)^3 / 6,   1/2 < d < 3/2,

of the quadratic B-spline of a cell whose center is d cells below its surface. A cell whose
neighbors all hold at least F(d - 1) is at least d cells deep and holds at least F(d). With
F(-0.27) = `LEAST_AROUND` that is F(0.73) = `LEAST_IN_LAYER`: liquid at rest is left as it is.
"""

import warp as wp

from warp_lcp.grid.barrier_fields import FAR
from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_kernel
from warp_lcp.operators.grid_poisson import FLUID, SOLID

MODULE = "warp_lcp.material.surface_layer"
LEAST_AROUND = wp.constant(0.3)  # share that all neighbors of a cell of the layer hold
LEAST_IN_LAYER = wp.constant(0.92)  # share that a cell of the layer holds

_FLUID, _SOLID = wp.constant(wp.int8(FLUID)), wp.constant(wp.int8(SOLID))


@cell_kernel(MODULE)
def filled_kernel(k, j, i, base: I8, density: F32, capacity: F32, filled: U8):
    """Mark cells that hold at least `LEAST_AROUND` of what they can hold, and solids, by 1."""
    enough = density[k, j, i] >= LEAST_AROUND * capacity[k, j, i]
    filled[k, j, i] = wp.where(enough or base[k, j, i] == _SOLID, wp.uint8(1), wp.uint8(0))


@cell_kernel(MODULE)
def layer_kernel(
    k,
    j,
    i,
    planes: int,
    kind: I8,
    density: F32,
    capacity: F32,
    filled: U8,
    own_side: U8,
    b: F64,
    lower: F64,
):
    """Set the equation of cells of the layer: they hold at least `LEAST_IN_LAYER`.

    The cell's lack is b = max(LEAST_IN_LAYER capacity - density, 0), unless it is too full; x may
    have either sign (`lower`). Cells deep inside, which have an equation already, keep it. Beside
    thin solids `own_side` says whether the neighbors on the cell's own side are filled.
    """
    if kind[k, j, i] == _FLUID and lower[k, j, i] == wp.float64(0.0):
        around = bool(True)
        for n in range(wp.where(planes == 2, 27, 9)):
            dk = wp.where(planes == 2, n // 9 - 1, 0)
            if filled[k + dk, j + (n // 3) % 3 - 1, i + n % 3 - 1] == wp.uint8(0):
                around = False
        if own_side:
            if own_side[k, j, i] != wp.uint8(FAR):
                around = own_side[k, j, i] != wp.uint8(0)
        if around:
            lack = LEAST_IN_LAYER * capacity[k, j, i] - density[k, j, i]
            lower[k, j, i] = -wp.float64(wp.inf)
            if b[k, j, i] > wp.float64(0.0):
                b[k, j, i] = wp.float64(wp.max(lack, 0.0))
