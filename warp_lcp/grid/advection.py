"""Particles carried by the grid's velocity, never into a SOLID cell.

Third-order Runge-Kutta with the weights 2/9, 3/9, 4/9 at 0, 1/2, 3/4 of the step [Ralston 1962]. Every stage walks from cell to cell: a
particle that meets a closed face stops short of it and slides on along it. With solids of whole cells no distance is needed, and none
would do: pushing particles out along a distance strands them in SOLID cells.
"""

import typing

import warp as wp

from warp_lcp.grid.particles import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid, cell_index, inside
from warp_lcp.operators.grid_poisson import SOLID


@wp.func
@typing.no_type_check
def sample(field: wp.array3d(dtype=wp.float32), x: wp.vec3, axis: int, planes: int):
    """Interpolate one component at grid coordinates inside the domain."""
    y = x - wp.vec3(0.5, 0.5, 0.5)
    y[axis] = y[axis] + 0.5
    i = int(y[0])
    j = int(y[1])
    fx = y[0] - float(i)
    fy = y[1] - float(j)
    k = int(1)
    fz = float(0.0)
    if planes == 2:
        k = int(y[2])
        fz = y[2] - float(k)
    low = wp.lerp(wp.lerp(field[k, j, i], field[k, j, i + 1], fx), wp.lerp(field[k, j + 1, i], field[k, j + 1, i + 1], fx), fy)
    if planes == 1:
        return low
    c = k + 1
    high = wp.lerp(wp.lerp(field[c, j, i], field[c, j, i + 1], fx), wp.lerp(field[c, j + 1, i], field[c, j + 1, i + 1], fx), fy)
    return wp.lerp(low, high, fz)


@wp.func
@typing.no_type_check
def is_solid(cells: wp.array3d(dtype=wp.int8), cell: wp.vec3i, axis: int, side: int):
    """Return whether the neighbor of a cell on one side along an axis is SOLID."""
    c = cell
    c[axis] = c[axis] + side
    return cells[c[2], c[1], c[0]] == wp.int8(SOLID)


@wp.func
@typing.no_type_check
def stays(coordinate: float, cell: int):
    """Return whether a coordinate lies in a cell and keeps off its faces."""
    f = coordinate - float(cell)
    return f >= MARGIN and f <= 1.0 - MARGIN


@wp.func
@typing.no_type_check
def walk(start: wp.vec3, displacement: wp.vec3, cells: wp.array3d(dtype=wp.int8), planes: int):
    """Move a point by a displacement, both in cells, through open cells only; return where it ends and how many faces stopped it."""
    counts = wp.vec3i(cells.shape[2] - 2, cells.shape[1] - 2, cells.shape[0] - 2)
    cell = wp.vec3i(cell_index(start[0], counts[0]), cell_index(start[1], counts[1]), 1)
    if planes == 2:
        cell[2] = cell_index(start[2], counts[2])
    x = start + displacement
    if stays(x[0], cell[0]) and stays(x[1], cell[1]) and (planes == 1 or stays(x[2], cell[2])):
        return x, 0  # most particles
    x = start
    rest = displacement
    stopped = int(0)
    # along each axis the walk goes one way only, so it crosses no more faces than this
    for _n in range(counts[0] + counts[1] + counts[2]):
        axis = int(-1)
        t = float(1.0)
        for a in range(planes + 1):
            face = float(cell[a])
            if rest[a] > 0.0:
                face += 1.0
            gap = face - x[a]
            if wp.abs(rest[a]) > wp.abs(gap):  # few particles cross a face, so few divide
                s = wp.max(gap / rest[a], 0.0)
                if s < t:
                    t = s
                    axis = a
        if axis < 0:
            break
        side = wp.where(rest[axis] > 0.0, 1, -1)
        x = x + t * rest
        rest = (1.0 - t) * rest
        x[axis] = float(cell[axis]) + wp.where(side > 0, 1.0, 0.0)
        if is_solid(cells, cell, axis, side):
            x[axis] = x[axis] - float(side) * MARGIN
            rest[axis] = 0.0
            stopped += 1
        else:
            cell[axis] = cell[axis] + side
    x = x + rest
    for a in range(planes + 1):  # whoever moves along a closed face keeps off it too
        low = float(cell[a])
        if x[a] < low + MARGIN:  # nested: `and` would read both operands, here every time
            if is_solid(cells, cell, a, -1):
                x[a] = low + MARGIN
        if x[a] > low + 1.0 - MARGIN:
            if is_solid(cells, cell, a, 1):
                x[a] = low + 1.0 - MARGIN
    return x, stopped


@wp.func
@typing.no_type_check
def velocity_at(
    u: wp.array3d(dtype=wp.float32), v: wp.array3d(dtype=wp.float32), w: wp.array3d(dtype=wp.float32), at: wp.vec3, planes: int
):
    """Interpolate the velocity at grid coordinates; points outside the domain and NaN are brought inside."""
    x = wp.vec3(inside(at[0], u.shape[2] - 2), inside(at[1], u.shape[1] - 2), inside(at[2], u.shape[0] - 2))
    r = wp.vec3(sample(u, x, 0, planes), sample(v, x, 1, planes), 0.0)
    if planes == 2:
        r[2] = sample(w, x, 2, planes)
    return r


@wp.kernel(enable_backward=False, module="warp_lcp.grid.advection")
@typing.no_type_check
def advect_kernel(
    u: wp.array3d(dtype=wp.float32),
    v: wp.array3d(dtype=wp.float32),
    w: wp.array3d(dtype=wp.float32),
    cells: wp.array3d(dtype=wp.int8),
    planes: int,
    dx: float,
    inverse_dx: float,
    dt: float,
    position: wp.array(dtype=wp.vec3),
    stopped: wp.array(dtype=wp.int32),
):
    """One Runge-Kutta step of each particle; dt in s."""
    p = wp.tid()
    h = dt * inverse_dx
    x = position[p] * inverse_dx + wp.vec3(1.0, 1.0, 1.0)
    k1 = velocity_at(u, v, w, x, planes)
    x2, _hits2 = walk(x, 0.5 * h * k1, cells, planes)
    k2 = velocity_at(u, v, w, x2, planes)
    x3, _hits3 = walk(x, 0.75 * h * k2, cells, planes)
    k3 = velocity_at(u, v, w, x3, planes)
    y, hits = walk(x, h * (2.0 * k1 + 3.0 * k2 + 4.0 * k3) / 9.0, cells, planes)
    y = (y - wp.vec3(1.0, 1.0, 1.0)) * dx
    if planes == 1:
        y[2] = 0.0
    position[p] = y
    if hits > 0:
        wp.atomic_add(stopped, 0, 1)


def advect(grid: StaggeredGrid, fields: list[wp.array], cells: wp.array, dt: float, position: wp.array, stopped: wp.array) -> None:
    """Move particles through the grid's velocity for a time step.

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        cells: int8 of AIR, FLUID, SOLID, in the stored shape; the ring is SOLID. Every particle lies in a cell that is not SOLID.
        dt: time step [s].
        position: [m], shape (n,) (updated).
        stopped: int32, shape (1,): raised by the number of particles that a closed face stopped.
    """
    u, v, w = [*fields, None][:3]
    inputs = [u, v, w, cells, grid.planes, grid.spacing, 1.0 / grid.spacing, dt, position, stopped]
    wp.launch(advect_kernel, len(position), inputs, device=grid.device)
