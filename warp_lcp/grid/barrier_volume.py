# mypy: ignore-errors
"""Filled share of cells beside thin solids, for the volume of the liquid."""

import warp as wp

from warp_lcp.grid.barrier_fields import has_neighbors
from warp_lcp.grid.barrier_geometry import CENTERS, INSIDE, Barrier, place_of, room_at, sees_from
from warp_lcp.grid.cell_kernel import F32, I8, U8, cell_kernel, neighbor_offset
from warp_lcp.grid.level_set_kernels import slope_beside

MODULE = "warp_lcp.grid.barrier_volume"
# Sample points per cell. They are n (a, b, c) modulo 1 with the powers a, b, c of the inverse of
# the root of x^4 = x + 1. Along each axis they lie nearly evenly, so that a plane along the axes
# cuts off its share to about a hundredth.
POINTS_2D, POINTS_3D = wp.constant(256), wp.constant(256)
FIRST, SECOND, THIRD = 0.8191725134, 0.6710436067, 0.5497004779
# 1 / cells over which the surface at a sample point is smoothed, as in the cells elsewhere.
SHARP = wp.constant(4.0)


@wp.func
def phi_at(apart: U8, planes: int, phi: F32, known: I8, k: int, j: int, i: int, way: wp.vec3):
    """Return phi at a shift [cells] from a cell's center, with slopes of the cell's own side."""
    here = phi[k, j, i]
    result = here
    for d in range(planes + 1):
        dk = wp.where(d == 2, 1, 0)
        dj = wp.where(d == 1, 1, 0)
        di = wp.where(d == 0, 1, 0)
        low = ((int(apart[k, j, i]) >> d) & 1) == 0 and known[k - dk, j - dj, i - di] == wp.int8(1)
        high = (int(apart[k + dk, j + dj, i + di]) >> d) & 1 == 0
        high = high and known[k + dk, j + dj, i + di] == wp.int8(1)
        lower = phi[k - dk, j - dj, i - di]
        upper = phi[k + dk, j + dj, i + di]
        result += way[d] * slope_beside(here, lower, upper, low, high)
    return result


@wp.func
def open_at(nodes: F32, planes: int, k: int, j: int, i: int, x: wp.vec3):
    """Return the distance [cells] to thick solids at a place in a cell, 0 to 1 along each axis."""
    total = float(0.0)
    for n in range(wp.where(planes == 2, 8, 4)):
        a = n & 1
        b = (n >> 1) & 1
        c = n >> 2
        w = wp.where(a == 1, x[0], 1.0 - x[0]) * wp.where(b == 1, x[1], 1.0 - x[1])
        if planes == 2:
            w *= wp.where(c == 1, x[2], 1.0 - x[2])
        total += w * nodes[k + c, j + b, i + a]
    return total


@cell_kernel(MODULE)
def filled_kernel(
    k, j, i, B: Barrier, apart: U8, phi: F32, known: I8, nodes: F32, has_nodes: bool, filled: F32
):
    """Find the share of a cell that liquid fills, -1 where no thin solid is between its neighbors.

    Each sample point outside of solids belongs to the nearest center, among those of the cell and
    its neighbors, that it sees. It is filled where phi, linear about that center, is negative. A
    part of a cell that lies beyond a thin solid so is filled as the cells on its own side are.
    Points that see no center are empty.

    With phi and the distance d from thick solids, both in cells, at the sample points:

        filled = mean of clip(1/2 - SHARP phi, 0, 1) clip(1/2 + SHARP d, 0, 1).

    The second factor is 1 without thick solids (`has_nodes`). The cell's own center is tested
    first: no center is nearer to its points.
    """
    share = float(-1.0)
    x = place_of(B, CENTERS, k, j, i)
    reach = 1.8 * B.dx
    if B.near[k, j, i] != wp.uint8(0) and has_neighbors(B.near, B.planes, k, j, i):
        room = room_at(B, x, reach)
        if room < reach:
            least = float(1.0)
            for n in range(wp.where(B.planes == 2, 27, 9)):
                offset = neighbor_offset(n, B.planes)
                least = wp.min(least, phi[k + offset[0], j + offset[1], i + offset[2]])
            total = float(0.0)
            count = wp.where(B.planes == 2, POINTS_3D, POINTS_2D)
            if least >= 0.0:
                count = 0
            own = known[k, j, i] == wp.int8(1) and B.near[k, j, i] != wp.uint8(INSIDE)
            for n in range(count):
                t = float(n) + 0.5
                at = wp.vec3(t * FIRST, t * SECOND, t * THIRD)
                at = wp.vec3(at[0] - wp.floor(at[0]), at[1] - wp.floor(at[1]), 0.5)
                if B.planes == 2:
                    at[2] = t * THIRD - wp.floor(t * THIRD)
                way = at - wp.vec3(0.5, 0.5, 0.5)
                point = x + B.dx * way
                wet = float(0.0)
                if own and sees_from(B, x, point, room):
                    wet = 0.5 - SHARP * phi_at(apart, B.planes, phi, known, k, j, i, way)
                else:
                    nearest = float(9.0)
                    for m in range(wp.where(B.planes == 2, 27, 9)):
                        offset = neighbor_offset(m, B.planes)
                        to = way - wp.vec3(float(offset[2]), float(offset[1]), float(offset[0]))
                        c = k + offset[0]
                        b = j + offset[1]
                        a = i + offset[2]
                        if (
                            m != wp.where(B.planes == 2, 13, 4)
                            and wp.length(to) < nearest
                            and known[c, b, a] == wp.int8(1)
                            and B.near[c, b, a] != wp.uint8(INSIDE)
                            and has_neighbors(B.near, B.planes, c, b, a)
                        ):
                            if sees_from(B, point, point - B.dx * to, 0.0):
                                nearest = wp.length(to)
                                wet = 0.5 - SHARP * phi_at(apart, B.planes, phi, known, c, b, a, to)
                wet = wp.clamp(wet, 0.0, 1.0)
                if has_nodes:
                    wet *= wp.clamp(0.5 + SHARP * open_at(nodes, B.planes, k, j, i, at), 0.0, 1.0)
                total += wet
            share = total / float(wp.max(count, 1))
    filled[k, j, i] = share
