# mypy: ignore-errors
"""Surface tension near thin solids: curvature and jump of the surface on one side."""

import warp as wp

from warp_lcp.fluids.surface_tension_kernels import BAND as SHARE
from warp_lcp.fluids.surface_tension_kernels import distance_of
from warp_lcp.grid.barrier_fields import has_neighbors, stand_in
from warp_lcp.grid.cell_kernel import F32, I8, U8, cell_kernel, neighbor_offset
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

MODULE = "fluids.surface_tension_barriers"
STEEP = wp.constant(1.0e-4)  # least square of a slope that defines a direction
BAND = wp.constant(SHARE)
_AIR, _FLUID, _SOLID = (wp.constant(wp.int8(kind)) for kind in (AIR, FLUID, SOLID))


@cell_kernel(MODULE)
def curvature_kernel(
    k,
    j,
    i,
    near: U8,
    apart: U8,
    planes: int,
    once: F32,
    twice: F32,
    linear: float,
    cubic: float,
    limit: float,
    bend: F32,
):
    """Compute the curvature again near thin solids, see `headers/pressure.h`.

    Cells beyond a thin solid are replaced by cells on the near side.
    """
    if near[k, j, i] != wp.uint8(0) and has_neighbors(near, planes, k, j, i):
        share = 2.0 * once[k, j, i] - twice[k, j, i]
        value = float(0.0)
        if share >= BAND and share <= 1.0 - BAND:
            here = distance_of(k, j, i, once, twice, linear, cubic)
            slope = wp.vec3()
            second = wp.mat33()
            for n in range(wp.where(planes == 2, 27, 9)):
                offset = neighbor_offset(n, planes)
                to = stand_in(apart, k, j, i, offset)
                d = distance_of(k + to[0], j + to[1], i + to[2], once, twice, linear, cubic)
                way = wp.vec3(float(offset[2]), float(offset[1]), float(offset[0]))
                steps = wp.abs(offset[2]) + wp.abs(offset[1]) + wp.abs(offset[0])
                if steps == 1:
                    slope += 0.5 * d * way
                    second += (d - here) * wp.outer(way, way)
                if steps == 2:
                    w = 0.25 * d
                    for a in range(3):
                        for b in range(3):
                            if a != b:
                                second[a, b] = second[a, b] + w * way[a] * way[b]
            steep = wp.dot(slope, slope)
            if steep > STEEP:
                along = wp.dot(slope, second * slope)
                sum = steep * wp.trace(second) - along
                value = wp.clamp(sum / (steep * wp.sqrt(steep)), -limit, limit)
        bend[k, j, i] = value


@cell_kernel(MODULE)
def jump_kernel(
    k, j, i, near: U8, apart: U8, planes: int, scale: float, kind: I8, bend: F32, jump: F32
):
    """Set the jump again in cells beside the surface, from the cell's own curvature."""
    # jump = scale * curvature [m/s] if a neighbor that no thin solid separates from this cell has
    # the other type, FLUID or AIR; else 0. Bit d of `apart` marks a thin solid between a cell and
    # the one before it along axis d. The curvature is in 1 / cells, and
    # scale = kick_dt sigma / (rho dx^2) [m/s].
    if near[k, j, i] != wp.uint8(0) and has_neighbors(near, planes, k, j, i):
        own = kind[k, j, i]
        value = float(0.0)
        if own != _SOLID:
            other = wp.where(own == _FLUID, _AIR, _FLUID)
            for n in range(2 * (planes + 1)):
                d = n >> 1
                side = 2 * (n & 1) - 1
                c = k + wp.where(d == 2, side, 0)
                b = j + wp.where(d == 1, side, 0)
                a = i + wp.where(d == 0, side, 0)
                bits = int(apart[wp.max(c, k), wp.max(b, j), wp.max(a, i)])
                if kind[c, b, a] == other and (bits >> d) & 1 == 0:
                    value = scale * bend[k, j, i]
        jump[k, j, i] = value
