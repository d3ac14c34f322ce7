"""Particles carried by the grid's velocity among walls that are given by their distance.

The Runge-Kutta step is that of `warp_lcp.grid.advection`. A particle whose distance to walls exceeds its way needs no care. The others go
in strides that the distance allows, but of half a cell at least, so that one that rests on a wall gets on; whoever ends a stride too
near a wall or inside it is put back along the normal. On a plane that takes just the normal part from the way. The rest of the way loses
its part into the wall, and between two walls all but the part along their edge. A stride that would end on another side of a wall is
halved, so that plates of more than a cell are not tunnelled at any speed.

Positions are measured by the distance that is interpolated between nodes, which defines where solids are, and by that to the domain's
walls.
"""

import warp as wp

from warp_lcp.grid.distance_advection_kernels import PUSH, PUSH_OUT, advect_pass
from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.runge_kutta import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid

__all__ = ["MARGIN", "PUSH", "advect_with_distance", "push_out"]


def advect_with_distance(
    grid: StaggeredGrid,
    fields: list[wp.array],
    distance: wp.array,
    dt: float,
    position: wp.array,
    stopped: wp.array,
    *,
    open_sides: int = 0,
    endless: int = 0,
) -> None:
    """Move particles through the grid's velocity for a time step; nobody ends within MARGIN cells of a wall who did not start there.

    Where no way back out of a wall is found within a cell, a particle stays where its last stride was open. A move goes at most 1024
    cells, and 32 along walls.

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        distance: to solids at the low corners of the cells, float32 in cells, > 0 in the open; in the stored shape. In 2-D the plane
            k = 1 is used. The domain's walls need not be in it.
        dt: time step [s].
        position: [m], shape (n,) (updated).
        stopped: int32, shape (1,): raised by the number of particles that met a wall.
        open_sides: of `warp_lcp.grid.sides.side_bits`: they stop nobody. Who crosses them ends on them or beyond.
        endless: has bit n set if axis n has no end, see `warp_lcp.grid.advection.advect`; its sides are open, and alike.
    """
    u, v, w = [*fields, None][:3]
    given = {"u": u, "v": v, "w": w, "distance": distance, "stopped": stopped, "h": dt * (1.0 / grid.spacing)}
    launch(advect_pass(endless), len(position), grid, position=position, open_sides=open_sides, **given)


def push_out(grid: StaggeredGrid, distance: wp.array, position: wp.array, moved: wp.array, left: wp.array, *, open_sides: int = 0) -> None:
    """Put particles that walls have run over, or come too near, back into the open along the gradient of the distance.

    Args:
        grid: the grid.
        distance: to solids in cells, as for `advect_with_distance`.
        position: [m], shape (n,) (updated): moved by at most PUSH cells.
        moved: int32, shape (1,): raised by the number of particles that were put outside.
        left: int32, shape (1,): raised by the number of those for which no way out was found; they stay where they were.
        open_sides: of `warp_lcp.grid.sides.side_bits`: particles beyond stay there.
    """
    launch(PUSH_OUT, len(position), grid, position=position, distance=distance, open_sides=open_sides, moved=moved, left=left)
