# mypy: ignore-errors
"""Kernels of what is told of a step: how near each cell is to yielding, what friction takes, and what holds sand to walls."""

import functools

import warp as wp

from warp_lcp.granular.yield_set import sand_pass, xyz
from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_below, cell_kernel
from warp_lcp.grid.extrapolate import BLOCKED
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rows import RowPass

RATIO_YIELDS = 0.99  # of the bound, from which a cell counts as yielded


@functools.cache
def report_pass(dimension: int, rate: bool = False, cut: bool = False) -> RowPass:
    """Return the pass for 2 or 3 dimensions; friction grows with the rate of shear; solids cut cells."""
    vectors = xyz("share", "mass", "inverse", edge=[wp.float64] * 3, u=[wp.float64] * 3)
    fields = {"flags": wp.uint8, **dict.fromkeys(("now", "drive", "stiff", "ratio", "openings"), wp.float32), **vectors}
    found = {"sums": ("cells", "yielded", "taken"), "largest": ("most",)}
    module = f"report_{dimension}d{'_rate' * rate}{'_cut' * cut}"
    whole, words = {"numbers": wp.float32}, {"RATE": rate, "CUT": cut, "RATIO_YIELDS": RATIO_YIELDS}
    return sand_pass(module, "report", dimension, wp.float64, fields, whole=whole, **found, **words)


@cell_kernel("granular.report")
def take_kernel(k, j, i, axis: int, base: I8, inverse: F32, found: F64, velocity: F32, known: I8):
    """Give a face that stresses act on the velocity that they leave, and find what is known of it."""
    c, b, a = cell_below(axis, k, j, i)
    mark = wp.int8(0)
    if inverse[k, j, i] > 0.0:
        velocity[k, j, i] = wp.float32(found[k, j, i])
        mark = wp.int8(1)
    elif base[k, j, i] == wp.int8(SOLID) and base[c, b, a] == wp.int8(SOLID):
        mark = wp.int8(BLOCKED)
    known[k, j, i] = mark


@cell_kernel("granular.report")
def contact_kernel(k, j, i, held: wp.uint8, released: wp.uint8, flags: U8, now: wp.array4d(dtype=wp.float32), out: U8):
    """Mark a cell of sand by whether it has pressure."""
    mark = wp.uint8(0)
    if flags[k, j, i] != wp.uint8(0):
        mark = released
        if now[0, k, j, i] > 0.0:
            mark = held
    out[k, j, i] = mark
