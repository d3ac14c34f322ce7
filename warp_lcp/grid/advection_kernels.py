# mypy: ignore-errors
"""The kernel that moves particles, and the one that measures how far solids are."""

import functools
import typing

import warp as wp

from warp_lcp.grid.runge_kutta import runge_kutta
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rows import RowPass

MAX_CLEARANCE = 6  # cells; a particle that moves further in a step takes the careful way, which is always right


@functools.cache
def advect_pass(endless: int) -> RowPass:
    """Return the pass for a domain whose axis n has no end where bit n is set."""
    return runge_kutta("warp_lcp.grid.advection", "advect", {"room": wp.int8}, endless)


@wp.kernel(enable_backward=False, module="warp_lcp.grid.clearance")
@typing.no_type_check
def clearance_kernel(cells: wp.array3d(dtype=wp.int8), planes: int, distance: int, room: wp.array3d(dtype=wp.int8)):
    """Pass `distance` = 0 marks SOLID cells 0 and others MAX_CLEARANCE; pass d marks those around cells of d - 1 with d.

    In place without a race: a cell that another thread marks in this launch was more than d - 1 and becomes d, no source either way.
    """
    k, j, i = wp.tid()
    if distance == 0:
        room[k, j, i] = wp.where(cells[k, j, i] == wp.int8(SOLID), wp.int8(0), wp.int8(MAX_CLEARANCE))
    elif int(room[k, j, i]) > distance:
        near = int(0)
        for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, room.shape[0])):
            for b in range(wp.max(j - 1, 0), wp.min(j + 2, room.shape[1])):
                for a in range(wp.max(i - 1, 0), wp.min(i + 2, room.shape[2])):
                    if int(room[c, b, a]) == distance - 1:
                        near = 1
        if near > 0:
            room[k, j, i] = wp.int8(distance)
