"""Open sides of the domain: beyond them lies open air instead of a wall, and what crosses them has left."""

import typing
from collections.abc import Iterable

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel
from warp_lcp.grid.runge_kutta import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid

SIDES = ("left", "right", "bottom", "top", "back", "front")  # at low x, high x, low y, high y, low z, high z; bit n is side n
GONE = 0.75 * MARGIN  # cells from an open side at which a particle has left: nearer than particles keep from walls


def side_bits(names: Iterable[str]) -> int:
    """Return a number that has bit n set for the n-th of `SIDES`.

    Raises:
        ValueError: there is no such side.
    """
    bits = 0
    for name in names:
        if name not in SIDES:
            raise ValueError(f"{name!r} is no side: choose from {', '.join(SIDES)}")
        bits |= 1 << SIDES.index(name)
    return bits


def open_ring(shape: tuple[int, int, int], bits: int) -> np.ndarray:
    """Return which cells of the ring lie beyond open sides only, bool in the stored shape; a corner beyond a wall as well does not.

    Args:
        shape: (nz + 2, ny + 2, nx + 2).
        bits: of `side_bits`.
    """
    outside, closed = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for number in range(len(SIDES)):
        axis, high = number >> 1, number & 1
        layer = [slice(None)] * 3
        layer[2 - axis] = slice(-1, None) if high else slice(0, 1)
        outside[tuple(layer)] = True
        if not bits >> number & 1:
            closed[tuple(layer)] = True
    return outside & ~closed


@cell_kernel("warp_lcp.grid.sides")
@typing.no_type_check
def continue_kernel(k, j, i, bits: int, nx: int, ny: int, nz: int, field: F32):
    """Copy a field from the cells beside open sides to those beyond."""
    c = wp.clamp(k, 1, nz)
    b = wp.clamp(j, 1, ny)
    a = wp.clamp(i, 1, nx)
    beyond = int(0)
    if i != a:
        beyond = beyond | wp.where(i < a, 1, 2)
    if j != b:
        beyond = beyond | wp.where(j < b, 4, 8)
    if k != c:
        beyond = beyond | wp.where(k < c, 16, 32)
    if beyond != 0 and (beyond & bits) == beyond:
        field[k, j, i] = field[c, b, a]


def continue_beyond(grid: StaggeredGrid, bits: int, field: wp.array) -> None:
    """Copy a float32 field from the cells beside open sides to those beyond; nothing happens without an open side."""
    if bits:
        grid.everywhere.launch(continue_kernel, [bits, *grid.counts, field])


@wp.kernel(enable_backward=False, module="warp_lcp.grid.sides")
@typing.no_type_check
def gone_kernel(bits: int, axes: int, low: float, high: wp.vec3, position: wp.array(dtype=wp.vec3), marks: wp.array(dtype=wp.int32)):
    """Mark particles that have reached an open side, of all others 0."""
    p = wp.tid()
    gone = int(0)
    for axis in range(axes):
        x = position[p][axis]
        if (bits >> (2 * axis)) & 1 == 1:
            if x < low:
                gone = 1
        if (bits >> (2 * axis + 1)) & 1 == 1:
            if x > high[axis]:
                gone = 1
    marks[p] = gone


def mark_gone(grid: StaggeredGrid, bits: int, position: wp.array, marks: wp.array) -> None:
    """Mark the particles that have reached an open side.

    Args:
        grid: the grid.
        bits: of `side_bits`.
        position: [m], shape (n,).
        marks: int32, shape (n,) (written): 1 for those that have left, else 0.
    """
    high = [(count - GONE) * grid.spacing for count in grid.counts]
    inputs = [bits, grid.dimension, GONE * grid.spacing, wp.vec3(*high), position, marks]
    wp.launch(gone_kernel, len(position), inputs, device=grid.device)
