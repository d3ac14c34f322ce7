"""Kernels of the pressure problem on whole cells.

`index` is -1 in open cells and the number of the wall (0: the domain, 1 + s: solid s) in the others. A face with a wall on one side is
closed, and the wall's own velocity passes it.
"""

import typing

import warp as wp

from warp_lcp.grid.staggered import CellRange
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

TOUCHES_NOTHING = 0  # no solid face
HELD = 1  # a wall cell whose liquid stays on its walls
RELEASED = 2  # a wall cell whose liquid is leaving

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))

options: dict[str, typing.Any] = {"enable_backward": False, "module": "fluids.pressure"}


@wp.func
@typing.no_type_check
def wall_velocity(wall: int, axis: int, walls: wp.array(dtype=wp.vec3)):
    """Return one component of a wall's velocity; walls without velocities stand still."""
    if walls:
        return walls[wall][axis]
    return 0.0


@wp.func
@typing.no_type_check
def flux(
    field: wp.array3d(dtype=wp.float32),
    index: wp.array3d(dtype=wp.int32),
    walls: wp.array(dtype=wp.vec3),
    axis: int,
    k: int,
    j: int,
    i: int,
):
    """Return what passes the lower face of a cell along an axis [m/s]; at least one of its two cells is open."""
    below = index[k - wp.where(axis == 2, 1, 0), j - wp.where(axis == 1, 1, 0), i - wp.where(axis == 0, 1, 0)]
    wall = wp.max(below, index[k, j, i])
    if wall >= 0:
        return wp.float64(wall_velocity(wall, axis, walls))
    return wp.float64(field[k, j, i])


@wp.func
@typing.no_type_check
def outflow(
    u: wp.array3d(dtype=wp.float32),
    v: wp.array3d(dtype=wp.float32),
    w: wp.array3d(dtype=wp.float32),
    index: wp.array3d(dtype=wp.int32),
    walls: wp.array(dtype=wp.vec3),
    k: int,
    j: int,
    i: int,
    planes: int,
):
    """Return the sum of s_f u_f over the faces of an open cell, s_f = +-1 outward [m/s]."""
    y = flux(u, index, walls, 0, k, j, i + 1) - flux(u, index, walls, 0, k, j, i)
    y += flux(v, index, walls, 1, k, j + 1, i) - flux(v, index, walls, 1, k, j, i)
    if planes == 2:
        y += flux(w, index, walls, 2, k + 1, j, i) - flux(w, index, walls, 2, k, j, i)
    return y


@wp.func
@typing.no_type_check
def neighbor(index: wp.array3d(dtype=wp.int32), k: int, j: int, i: int, n: int):
    """Return the index of neighbor n = 0..5 (-x +x -y +y -z +z) of a cell."""
    side = 2 * (n & 1) - 1
    axis = n >> 1
    return index[k + wp.where(axis == 2, side, 0), j + wp.where(axis == 1, side, 0), i + wp.where(axis == 0, side, 0)]


@wp.kernel(**options)
@typing.no_type_check
def base_kernel(cells: CellRange, index: wp.array3d(dtype=wp.int32), base: wp.array3d(dtype=wp.int8)):
    """Cells without liquid: SOLID where there is a wall, AIR elsewhere."""
    plane, row, chunk = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    first = cells.i + chunk * cells.grain
    for i in range(first, wp.min(first + cells.grain, cells.end)):
        base[k, j, i] = wp.where(index[k, j, i] >= 0, _SOLID, _AIR)


@wp.kernel(**options)
@typing.no_type_check
def mark_kernel(key: wp.array(dtype=wp.int32), kind: wp.array(dtype=wp.int8)):
    """A cell that holds a particle is FLUID."""
    cell = key[wp.tid()]
    if kind[cell] == _AIR:
        kind[cell] = _FLUID


@wp.kernel(**options)
@typing.no_type_check
def prepare_kernel(
    cells: CellRange,
    u: wp.array3d(dtype=wp.float32),
    v: wp.array3d(dtype=wp.float32),
    w: wp.array3d(dtype=wp.float32),
    kind: wp.array3d(dtype=wp.int8),
    index: wp.array3d(dtype=wp.int32),
    separating: wp.array(dtype=wp.uint8),
    walls: wp.array(dtype=wp.vec3),
    planes: int,
    last: wp.array3d(dtype=wp.float64),
    ratio: wp.float64,
    b: wp.array3d(dtype=wp.float64),
    lower: wp.array3d(dtype=wp.float64),
    start: wp.array3d(dtype=wp.float64),
):
    """Right-hand side b, lower bound and first guess of every cell."""
    plane, row, chunk = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    first = cells.i + chunk * cells.grain
    for i in range(first, wp.min(first + cells.grain, cells.end)):
        y = wp.float64(0.0)
        x = wp.float64(0.0)
        bound = -wp.float64(wp.inf)
        if kind[k, j, i] == _FLUID:
            y = outflow(u, v, w, index, walls, k, j, i, planes)
            x = last[k, j, i] * ratio
            for n in range(2 * planes + 2):
                wall = neighbor(index, k, j, i, n)
                if wall >= 0:
                    if separating[wall] != wp.uint8(0):  # nested: `and` would read both operands
                        bound = wp.float64(0.0)
        b[k, j, i] = y
        lower[k, j, i] = bound
        start[k, j, i] = wp.max(x, bound)


@wp.kernel(**options)
@typing.no_type_check
def count_kernel(cells: CellRange, kind: wp.array3d(dtype=wp.int8), sums: wp.array3d(dtype=wp.float64)):
    """Count the FLUID cells of a row."""
    plane, row = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    n = int(0)
    for i in range(cells.i, cells.end):
        n += wp.where(kind[k, j, i] == _FLUID, 1, 0)
    sums[k, j, 0] = wp.float64(n)


@wp.kernel(**options)
@typing.no_type_check
def subtract_gradient_kernel(
    cells: CellRange,
    axis: int,
    x: wp.array3d(dtype=wp.float64),
    kind: wp.array3d(dtype=wp.int8),
    field: wp.array3d(dtype=wp.float32),
    known: wp.array3d(dtype=wp.int8),
):
    """Project the open faces that touch FLUID and mark them 1; other faces become 0, or -1 inside solids."""
    plane, row, chunk = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    first = cells.i + chunk * cells.grain
    c = wp.max(k - wp.where(axis == 2, 1, 0), 0)  # the ring's own lower faces have no cell below: they count as inside the wall
    b = wp.max(j - wp.where(axis == 1, 1, 0), 0)
    for i in range(first, wp.min(first + cells.grain, cells.end)):
        a = wp.max(i - wp.where(axis == 0, 1, 0), 0)
        here = kind[k, j, i]
        below = kind[c, b, a]
        mark = int(0)
        if here == _SOLID and below == _SOLID:
            mark = -1
        elif here != _SOLID and below != _SOLID and (here == _FLUID or below == _FLUID):
            mark = 1
            field[k, j, i] = field[k, j, i] - float(x[k, j, i] - x[c, b, a])
        known[k, j, i] = wp.int8(mark)


@wp.kernel(**options)
@typing.no_type_check
def contact_kernel(
    cells: CellRange,
    u: wp.array3d(dtype=wp.float32),
    v: wp.array3d(dtype=wp.float32),
    w: wp.array3d(dtype=wp.float32),
    kind: wp.array3d(dtype=wp.int8),
    index: wp.array3d(dtype=wp.int32),
    walls: wp.array(dtype=wp.vec3),
    planes: int,
    x: wp.array3d(dtype=wp.float64),
    lower: wp.array3d(dtype=wp.float64),
    threshold: wp.float64,
    contact: wp.array3d(dtype=wp.uint8),
    sums: wp.array3d(dtype=wp.float64),
):
    """Find the released cells; a row's sums are [0] their number and [1] the largest |outflow| of the other FLUID cells [m/s]."""
    plane, row = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    released = int(0)
    worst = wp.float64(0.0)
    for i in range(cells.i, cells.end):
        state = int(TOUCHES_NOTHING)
        if kind[k, j, i] == _FLUID:
            y = outflow(u, v, w, index, walls, k, j, i, planes)
            for n in range(2 * planes + 2):
                if neighbor(index, k, j, i, n) >= 0:
                    state = HELD
            if lower[k, j, i] == wp.float64(0.0) and x[k, j, i] <= wp.float64(0.0) and y > threshold:
                state = RELEASED
                released += 1
            else:
                worst = wp.max(worst, wp.abs(y))
        contact[k, j, i] = wp.uint8(state)
    sums[k, j, 0] = wp.float64(released)
    sums[k, j, 1] = worst
