"""Particles carried by the grid's velocity, never into a SOLID cell.

Third-order Runge-Kutta with the weights 2/9, 3/9, 4/9 at 0, 1/2, 3/4 of the step [Ralston 1962]. Every stage walks from cell to cell: a
particle that meets a closed face stops short of it and slides on along it. With solids of whole cells no distance is needed, and none
would do: pushing particles out along a distance strands them in SOLID cells. The number of cells to the nearest solid tells which
particles nothing can stop; only the others walk.
"""

import warp as wp

from warp_lcp.grid.advection_kernels import MAX_CLEARANCE, advect_pass, clearance_kernel
from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.runge_kutta import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid

__all__ = ["MARGIN", "MAX_CLEARANCE", "advect", "clearance"]


def clearance(grid: StaggeredGrid, cells: wp.array) -> wp.array:
    """Return how many cells away the nearest SOLID cell is, diagonals counting as 1: 0 in SOLID cells, at most MAX_CLEARANCE.

    Args:
        grid: the grid.
        cells: int8 of AIR, FLUID, SOLID, in the stored shape; the ring is SOLID, or AIR where particles may leave the domain.

    Returns:
        int8, in the stored shape.
    """
    room = grid.field(wp.int8)
    for distance in range(MAX_CLEARANCE):
        wp.launch(clearance_kernel, grid.shape, [cells, grid.planes, distance, room], device=grid.device)
    return room


def advect(
    grid: StaggeredGrid, fields: list[wp.array], room: wp.array, dt: float, position: wp.array, stopped: wp.array, endless: int = 0
) -> None:  # fmt: skip
    """Move particles through the grid's velocity for a time step.

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        room: of `clearance`. Every particle lies in a cell that is not SOLID.
        dt: time step [s].
        position: [m], shape (n,) (updated).
        stopped: int32, shape (1,): raised by the number of particles that a closed face stopped.
        endless: has bit n set if axis n has no end: velocities beyond its sides are those at the other, as the ring's are. Particles may
            end up there.
    """
    u, v, w = [*fields, None][:3]
    given = {"u": u, "v": v, "w": w, "room": room, "stopped": stopped, "h": dt * (1.0 / grid.spacing)}
    launch(advect_pass(endless), len(position), grid, position=position, **given)
