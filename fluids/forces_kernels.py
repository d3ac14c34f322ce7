# mypy: ignore-errors
"""Kernel for the impulses of the pressure on solids."""

import warp as wp

from warp_lcp.fluids.wall_kernels import (
    WallKernelFields,
    closed_on,
    crossing_on,
    face_center,
    put,
    reach_across,
    standing_of,
    wall_way,
)
from warp_lcp.grid.cell_kernel import F32, F64, INTS, U8, cell_kernel


@cell_kernel("fluids.forces")
def pressure_kernel(
    k,
    j,
    first,
    end,
    S: WallKernelFields,
    references: wp.array(dtype=wp.vec3d),
    counts: INTS,
    offsets: INTS,
    owners: INTS,
    values: wp.array2d(dtype=wp.float64),
    bodies: wp.array(dtype=wp.uint8),
    touch: U8,
    x: F64,
    u: F32,
    v: F32,
    w: F32,
    kick_x: float,
    kick_y: float,
    kick_z: float,
    scale: wp.float64,
):
    """Count the closed face parts of a row under pressure, or write the impulses.

    Impulses are written if `values` is given. An impulse is `scale` times the share of the face
    times x, extrapolated from the cell's center to the wall, see `fluids.forces`. The kick [m/s] is
    the velocity change by gravity.
    """
    row = k * x.shape[1] + j
    begin = int(0)
    if values:
        begin = offsets[row]
    e = int(begin)
    for i in range(first, end):
        if x[k, j, i] != wp.float64(0.0) and touch[k, j, i] != wp.uint8(0):
            rise = float(0.0)
            still = int(0)
            if not S.index:
                rise = wp.dot(wall_way(S, k, j, i), wp.vec3(kick_x, kick_y, kick_z))
                still = standing_of(S, k, j, i)
            for n in range(2 * (S.planes + 1)):
                axis = n >> 1
                high = n & 1
                side = 2 * high - 1
                c = k + wp.where(axis == 2, high, 0)
                b = j + wp.where(axis == 1, high, 0)
                a = i + wp.where(axis == 0, high, 0)
                owner, own, covered, mover, moved = closed_on(S, axis, c, b, a)
                if S.number_x:
                    crossed, _below, _above = crossing_on(S, axis, c, b, a)
                    if crossed > 0:  # `thin_pressure_kernel` has it
                        own = 0.0
                        covered = 0.0
                        moved = 0.0
                stopped = u[c, b, a]
                if axis == 1:
                    stopped = v[c, b, a]
                if axis == 2:
                    stopped = w[c, b, a]
                for part in range(3):
                    solid = wp.where(part == 0, owner, wp.where(part == 1, still, mover))
                    share = wp.where(part == 0, own, wp.where(part == 1, covered, moved))
                    if share > 0.0:
                        if values:
                            more = wp.where(bodies[solid] != wp.uint8(0), 0.0, rise)
                            if S.index or solid == 0:
                                more = 0.5 * float(side) * stopped
                            if S.number_x:
                                share *= reach_across(S, axis, k, j, i)
                            force = wp.vec3d()
                            force[axis] = (
                                scale
                                * (x[k, j, i] + wp.float64(more))
                                * wp.float64(share)
                                * wp.float64(side)
                            )
                            put(
                                e,
                                solid,
                                force,
                                face_center(S, axis, c, b, a) - references[solid],
                                owners,
                                values,
                            )
                        e += 1
    counts[row] = e - begin
