# mypy: ignore-errors
"""Kernels for log values of sand: yield ratio, dissipation, wall contact."""

import functools
from pathlib import Path

import warp as wp

from warp_lcp.granular.stress_layout import CONSTANTS
from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_below, cell_kernel
from warp_lcp.grid.extrapolate import BLOCKED
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.operators.grid_poisson import SOLID

RATIO_YIELDS = 0.99  # ratio to the bound from which a cell counts as yielding
KERNELS = KernelFile(
    Path(__file__).parent / "headers/stress.h", CONSTANTS | {"RATIO_YIELDS": RATIO_YIELDS}
)


@functools.cache
def report_pass(dimension: int, rate: bool = False, cut: int = 0) -> StencilKernel:
    """Return the kernel for 2 or 3 dimensions.

    `rate`: friction depends on the shear rate. `cut`: 1 if solids cut cells, 2 if some of them
    move.
    """
    kind = ("", "_cut", "_cut_moving")[cut]
    module = f"granular.report_{dimension}d{'_rate' * rate}{kind}"
    return KERNELS.kernel(
        "granular.report.report",
        module=module,
        constants={"DIM": dimension, "RATE": rate, "CUT": cut},
    )


@cell_kernel("granular.report")
def solved_velocity_kernel(
    k, j, i, axis: int, base: I8, inverse: F32, found: F64, velocity: F32, known: I8
):
    """Set the velocity of a face that stresses act on, and mark it as known."""
    c, b, a = cell_below(axis, k, j, i)
    mark = wp.int8(0)
    if inverse[k, j, i] > 0.0:
        velocity[k, j, i] = wp.float32(found[k, j, i])
        mark = wp.int8(1)
    elif base[k, j, i] == wp.int8(SOLID) and base[c, b, a] == wp.int8(SOLID):
        mark = wp.int8(BLOCKED)
    known[k, j, i] = mark


@cell_kernel("granular.report")
def contact_kernel(
    k,
    j,
    i,
    held: wp.uint8,
    released: wp.uint8,
    flags: U8,
    now: wp.array4d(dtype=wp.float32),
    out: U8,
):
    """Mark a cell of sand by whether it has pressure."""
    mark = wp.uint8(0)
    if flags[k, j, i] != wp.uint8(0):
        mark = released
        if now[0, k, j, i] > 0.0:
            mark = held
    out[k, j, i] = mark
