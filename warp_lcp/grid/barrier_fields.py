# mypy: ignore-errors
"""Fields at cell centers on one side of thin solids: free paths and smoothing."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, U8, cell_kernel, neighbor_offset
from warp_lcp.grid.level_set_kernels import slope_beside

MODULE = "warp_lcp.grid.barrier_fields"
FAR = wp.constant(2)  # value of `surrounded_kernel` away from thin solids


@wp.func
def free_path(apart: U8, k: int, j: int, i: int, dk: int, dj: int, di: int):
    """Return whether no thin solid separates a cell from one of its neighbors.

    The neighbor is at most a cell away on each axis. Some path of steps along the axes must be
    free: the two cells are then on the same side of every solid that is longer than a cell.

    Bit d of `apart` is 1 where a thin solid separates a cell from its lower neighbor along axis d.
    A step along d is free if this bit of the upper one of its two cells is 0. All 6 orders of the
    axes are tried.
    """
    found = bool(False)
    for n in range(6):  # orders of the axes
        c = int(k)
        b = int(j)
        a = int(i)
        free = bool(True)
        for step in range(3):
            d = ((n >> 1) + wp.where((n & 1) == 1, 3 - step, step)) % 3
            to_c = c + wp.where(d == 2, dk, 0)
            to_b = b + wp.where(d == 1, dj, 0)
            to_a = a + wp.where(d == 0, di, 0)
            if to_c != c or to_b != b or to_a != a:
                bits = int(apart[wp.max(c, to_c), wp.max(b, to_b), wp.max(a, to_a)])
                if (bits >> d) & 1 == 1:
                    free = False
            c = to_c
            b = to_b
            a = to_a
        if free:
            found = True
    return found


@wp.func
def stand_in(apart: U8, k: int, j: int, i: int, way: wp.vec3i):
    """Return the step to the cell that replaces one at a step `way` (z, y, x).

    It is that cell if it is on the same side of thin solids. Otherwise the step is shortened by one
    of its axes, or by two, which mirrors the values beside the cell. If none of these is free,
    there is no step.
    """
    result = way
    free = free_path(apart, k, j, i, way[0], way[1], way[2])
    for without in range(1, 7):  # axes to leave out, one a bit: 1, 2, 4, and then 3, 5, 6
        if not free:
            bits = int(without)
            if without == 3:
                bits = 4
            if without == 4:
                bits = 3
            shorter = wp.vec3i(
                wp.where((bits & 4) != 0, 0, way[0]),
                wp.where((bits & 2) != 0, 0, way[1]),
                wp.where((bits & 1) != 0, 0, way[2]),
            )
            if free_path(apart, k, j, i, shorter[0], shorter[1], shorter[2]):
                free = True
                result = shorter
    if not free:
        result = wp.vec3i(0, 0, 0)
    return result


@wp.func
def has_neighbors(field: U8, planes: int, k: int, j: int, i: int):
    """Return whether all cells around a cell are stored."""
    result = i > 0 and j > 0 and i + 1 < field.shape[2] and j + 1 < field.shape[1]
    if planes == 2 and (k == 0 or k + 1 == field.shape[0]):
        result = False
    return result


@cell_kernel(MODULE)
def binomial_kernel(k, j, i, near: U8, apart: U8, planes: int, source: F32, out: F32):
    """Repeat a binomial pass (1, 2, 1)/4 near thin solids.

    Values from beyond the solids are left out.
    """
    if near[k, j, i] != wp.uint8(0) and has_neighbors(near, planes, k, j, i):
        total = float(0.0)
        for n in range(wp.where(planes == 2, 27, 9)):
            way = neighbor_offset(n, planes)
            w = wp.where(way[2] == 0, 0.5, 0.25) * wp.where(way[1] == 0, 0.5, 0.25)
            if planes == 2:
                w *= wp.where(way[0] == 0, 0.5, 0.25)
            step = stand_in(apart, k, j, i, way)
            total += w * source[k + step[0], j + step[1], i + step[2]]
        out[k, j, i] = total


@cell_kernel(MODULE)
def surrounded_kernel(k, j, i, near: U8, apart: U8, planes: int, inside: U8, around: U8):
    """Find the cells whose neighbors on their own side of thin solids are all inside.

    `inside` is 1 in cells inside the material and in solids. `around` is 1 if it is 1 in the cell
    and in all cells around it that no thin solid separates from it, 0 if it is not, and `FAR` away
    from thin solids.
    """
    result = wp.uint8(FAR)
    if near[k, j, i] != wp.uint8(0) and has_neighbors(near, planes, k, j, i):
        result = wp.uint8(1)
        for n in range(wp.where(planes == 2, 27, 9)):
            way = neighbor_offset(n, planes)
            if inside[k + way[0], j + way[1], i + way[2]] == wp.uint8(0):
                if free_path(apart, k, j, i, way[0], way[1], way[2]):
                    result = wp.uint8(0)
    around[k, j, i] = result


@cell_kernel(MODULE)
def shift_kernel(
    k,
    j,
    i,
    near: U8,
    apart: U8,
    planes: int,
    variance: float,
    limit: float,
    capacity: F32,
    phi: F32,
    known: I8,
    out: F32,
):
    """Shift phi back to a cell's center near thin solids.

    Only values on the cell's own side are used.

    See `warp_lcp.grid.level_set_kernels.wall_shift_kernel`.

    The equation, in cells, with the kernel's capacity c:

        phi <- phi - s . grad(phi),   s = variance grad(c) / max(c, 1e-3).

    Both vectors are limited to length 1. Beyond a solid c counts as that of the cell itself, and
    slopes of phi are one-sided.
    """
    one = wp.int8(1)
    if near[k, j, i] != wp.uint8(0) and has_neighbors(near, planes, k, j, i):
        here = phi[k, j, i]
        value = here
        c = capacity[k, j, i]
        if known[k, j, i] == one and c < 0.999 and wp.abs(here) < 0.98 * limit:
            grad = wp.vec3()
            s = wp.vec3()
            for d in range(planes + 1):
                dk = wp.where(d == 2, 1, 0)
                dj = wp.where(d == 1, 1, 0)
                di = wp.where(d == 0, 1, 0)
                low = ((int(apart[k, j, i]) >> d) & 1) == 0
                high = ((int(apart[k + dk, j + dj, i + di]) >> d) & 1) == 0
                below = c
                above = c
                if low:
                    below = capacity[k - dk, j - dj, i - di]
                if high:
                    above = capacity[k + dk, j + dj, i + di]
                s[d] = 0.5 * (above - below)
                low = low and known[k - dk, j - dj, i - di] == one
                high = high and known[k + dk, j + dj, i + di] == one
                lower = phi[k - dk, j - dj, i - di]
                upper = phi[k + dk, j + dj, i + di]
                grad[d] = slope_beside(here, lower, upper, low, high)
            grad = grad / wp.max(wp.length(grad), 1.0)
            s = s * (variance / wp.max(c, 1.0e-3))
            s = s / wp.max(wp.length(s), 1.0)
            value = wp.clamp(here - wp.dot(s, grad), -limit, limit)
        out[k, j, i] = value
