# mypy: ignore-errors
"""Kernels of cells and faces beside solids; they run when solids are placed."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, I32, U8, cell_below, cell_kernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.operators.grid_poisson import AIR, SOLID

TOUCHES_NOTHING = 0  # no solid face
HELD = 1  # a wall cell whose material stays at its walls
RELEASED = 2  # a wall cell whose material separates

TOUCHES = 1  # bits of `touch`: a face of the cell is not open,
LETS_GO = 2  # and one of those belongs to a wall that separates


_AIR = wp.constant(wp.int8(AIR))
_SOLID = wp.constant(wp.int8(SOLID))


options: dict[str, str] = {"module": "warp_lcp.material.boundary"}


@cell_kernel("warp_lcp.material.boundary")
def base_kernel(k, j, i, index: I32, base: I8):
    """Mark cells with a wall as SOLID, others as AIR."""
    base[k, j, i] = wp.where(index[k, j, i] >= 0, _SOLID, _AIR)


@wp.func
def touch_of(separates: wp.uint8):
    """Return the bits that a wall adds to the touch of cells beside it."""
    return wp.where(separates != wp.uint8(0), TOUCHES | LETS_GO, TOUCHES)


@cell_kernel("warp_lcp.material.boundary")
def touch_kernel(k, j, i, index: I32, separating: wp.array(dtype=wp.uint8), planes: int, touch: U8):
    """Find the walls on the faces of each cell."""
    # touch = bitwise or of `touch_of` over the walls in the 2 d neighbors; `index` is -1 in open
    # cells.
    flags = int(0)
    for n in range(2 * planes + 2):
        side = 2 * (n & 1) - 1
        axis = n >> 1
        wall = index[
            k + wp.where(axis == 2, side, 0),
            j + wp.where(axis == 1, side, 0),
            i + wp.where(axis == 0, side, 0),
        ]
        if wall >= 0:
            flags = flags | touch_of(separating[wall])
    touch[k, j, i] = wp.uint8(flags)


@cell_kernel("warp_lcp.material.boundary")
def touch_cut_kernel(
    k, j, i, planes: int, wx: I16, wy: I16, wz: I16, separating: wp.array(dtype=wp.uint8), touch: U8
):
    """Find the walls on the faces of each cell; -1 marks an open face."""
    # touch = bitwise or of `touch_of` over the walls that close a part of one of the 2 d faces.
    flags = int(0)
    for side in range(2):
        x = int(wx[k, j, i + side])
        if x >= 0:
            flags = flags | touch_of(separating[x])
        y = int(wy[k, j + side, i])
        if y >= 0:
            flags = flags | touch_of(separating[y])
        if planes == 2:
            z = int(wz[k + side, j, i])
            if z >= 0:
                flags = flags | touch_of(separating[z])
    touch[k, j, i] = wp.uint8(flags)


@cell_kernel("warp_lcp.material.boundary")
def wall_velocity_kernel(
    k,
    j,
    i,
    axis: int,
    planes: int,
    spacing: float,
    origin: wp.vec3i,
    index: I32,
    turn: wp.array(dtype=wp.mat33),
    shift: wp.array(dtype=wp.vec3),
    middle: wp.array(dtype=wp.vec3),
    length: wp.vec3,
    field: F32,
):
    """Set the velocity turn x + shift [m/s] of the wall on the faces that it closes.

    Other faces of the component get 0. Along periodic axes, of `length` [m] (0 along others), a
    face may belong to an image of the wall. Then x is the face's place at the wall itself, the one
    nearest to the wall's `middle` [m]. Without periodic axes `middle` is None.
    """
    c, b, a = cell_below(axis, k, j, i)
    wall = wp.max(index[k, j, i], index[c, b, a])
    u = float(0.0)
    if wall >= 0:
        x = (float(i + origin[0]) - wp.where(axis == 0, 1.0, 0.5)) * spacing
        y = (float(j + origin[1]) - wp.where(axis == 1, 1.0, 0.5)) * spacing
        z = float(0.0)
        if planes == 2:
            z = (float(k + origin[2]) - wp.where(axis == 2, 1.0, 0.5)) * spacing
        place = wp.vec3(x, y, z)
        if middle:
            for d in range(3):
                if length[d] > 0.0:
                    images = wp.round((place[d] - middle[wall][d]) / length[d])
                    place[d] = place[d] - images * length[d]
        v = turn[wall] * place + shift[wall]
        u = v[axis]
    field[k, j, i] = u


@forward_kernel(**options)
def larger_kernel(a: wp.array(dtype=wp.float32), b: wp.array(dtype=wp.float32)):
    """Set b to the larger of a and b."""
    i = wp.tid()
    b[i] = wp.max(a[i], b[i])
