# mypy: ignore-errors
"""Kernels for the coupling matrix U of rigid bodies and liquid cells."""

import warp as wp

from warp_lcp.fluids.wall_kernels import WallKernelFields, face_center, moving_on
from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.operators.grid_poisson import FLUID

_FLUID = wp.constant(wp.int8(FLUID))
_I32 = wp.array(dtype=wp.int32)
_F64 = wp.array(dtype=wp.float64)


@wp.struct
class CoupledBodies:
    """Indices and centers of mass of the rigid bodies, and the layout of the fields."""

    walls: WallKernelFields
    bodies: int
    body: _I32  # body of each wall number; -1 for a wall that is no body
    center: wp.array(dtype=wp.vec3d)  # center of mass of each body [m]
    low: wp.vec3i  # first (k, j, i) of the stored fields of the problem
    rows: int  # rows per plane of these fields
    row: int  # length of a row of these fields


@wp.func
def body_on_face(S: CoupledBodies, axis: int, k: int, j: int, i: int):
    """Return the body that covers a face, -1 without one, and the covered share."""
    free, solid, part = moving_on(S.walls, axis, k, j, i)
    share = (wp.float64(1.0) - wp.float64(free)) * wp.float64(part)
    body = S.body[solid]
    if share == wp.float64(0.0):
        body = -1
    return body, share


@wp.func
def beside_a_wall(S: CoupledBodies, k: int, j: int, i: int):
    """Return whether a face of a cell is not fully open."""
    a = wp.min(
        wp.min(S.walls.open_x[k, j, i], S.walls.open_x[k, j, i + 1]),
        wp.min(S.walls.open_y[k, j, i], S.walls.open_y[k, j + 1, i]),
    )
    if S.walls.planes == 2:
        a = wp.min(a, wp.min(S.walls.open_z[k, j, i], S.walls.open_z[k + 1, j, i]))
    return a < 1.0


@wp.func
def side(S: CoupledBodies, n: int, k: int, j: int, i: int):
    """Return body and share on side n = 2 axis + (0: low, 1: high) of a cell."""
    axis = n >> 1
    high = n & 1
    return body_on_face(
        S,
        axis,
        k + wp.where(axis == 2, high, 0),
        j + wp.where(axis == 1, high, 0),
        i + wp.where(axis == 0, high, 0),
    )


@wp.func
def next_body(S: CoupledBodies, last: int, k: int, j: int, i: int):
    """Return the next body number after `last` beside a cell.

    Returns the number of bodies if there is no further one.
    """
    least = int(S.bodies)
    for n in range(2 * (S.walls.planes + 1)):
        body, _share = side(S, n, k, j, i)
        if body > last and body < least:
            least = body
    return least


@cell_kernel("fluids.coupling")
def enter_kernel(
    k,
    j,
    first,
    end,
    S: CoupledBodies,
    kind: I8,
    counts: _I32,
    offsets: _I32,
    index: _I32,
    block: _I32,
    values: _F64,
):
    """Count the entries of U in a row of cells, or write them if `values` is given.

    An entry belongs to a FLUID cell and a body beside it: the outflow of the cell due to unit
    motions of the body, (vx, vy, wz) in 2-D or (vx, vy, vz, wx, wy, wz) in 3-D, see
    `fluids.coupling`.
    """
    # U = sum over the cell's sides of s a (n, r x n), with s = +1 on high and -1 on low sides, a
    # the share of the face that the body covers, n the axis of the face, and r the arm from the
    # body's center of mass to the face's center [m]. The first run counts entries, so that rows of
    # cells know where they write.
    row = k * kind.shape[1] + j
    begin = int(0)
    if values:
        begin = offsets[row]
    e = int(begin)
    for i in range(first, end):
        if kind[k, j, i] == _FLUID:
            if beside_a_wall(S, k, j, i):
                last = int(-1)
                for _ in range(S.bodies):
                    least = next_body(S, last, k, j, i)
                    if least == S.bodies:
                        break
                    last = least
                    if values and e < index.shape[0]:
                        move = wp.vec3d()
                        turn = wp.vec3d()
                        for n in range(2 * (S.walls.planes + 1)):
                            body, share = side(S, n, k, j, i)
                            if body == least:
                                axis = n >> 1
                                high = n & 1
                                c = k + wp.where(axis == 2, high, 0)
                                b = j + wp.where(axis == 1, high, 0)
                                a = i + wp.where(axis == 0, high, 0)
                                r = face_center(S.walls, axis, c, b, a) - S.center[least]
                                if S.walls.planes == 1:
                                    r[2] = wp.float64(0.0)
                                normal = wp.vec3d()
                                normal[axis] = share * wp.float64(2 * high - 1)
                                move += normal
                                turn += wp.cross(r, normal)
                        index[e] = ((k - S.low[0]) * S.rows + j - S.low[1]) * S.row + i - S.low[2]
                        block[e] = least
                        at = e * wp.where(S.walls.planes == 1, 3, 6)
                        values[at] = move[0]
                        values[at + 1] = move[1]
                        if S.walls.planes == 1:
                            values[at + 2] = turn[2]
                        else:
                            values[at + 2] = move[2]
                            values[at + 3] = turn[0]
                            values[at + 4] = turn[1]
                            values[at + 5] = turn[2]
                    e += 1
    counts[row] = e - begin


@forward_kernel(module="fluids.coupling")
def offsets_kernel(first: int, counts: _I32, offsets: _I32, capacity: int, total: _I32):
    """Compute exclusive prefix sums of counts, from row `first` on.

    The offset of row `first` is known. `total` gets the number of entries, limited by the capacity,
    and the unlimited number. One thread.
    """
    before = offsets[first]
    for row in range(first, counts.shape[0]):
        offsets[row] = before
        before += counts[row]
    total[0] = wp.min(before, capacity)
    total[1] = before


@cell_kernel("fluids.coupling")
def enclosed_kernel(k, j, i, open: F32, solid: F32, known: I8, velocity: F32):
    """Set closed faces without extrapolated velocity to the solid's velocity [m/s]."""
    if known[k, j, i] <= wp.int8(0) and open[k, j, i] == 0.0:
        velocity[k, j, i] = solid[k, j, i]
