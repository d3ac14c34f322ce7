# mypy: ignore-errors
"""Velocity kernels beside thin solids: crossed faces and extrapolation."""

import warp as wp

from warp_lcp.grid.barrier_geometry import (
    CENTERS,
    SHIFTS,
    TURNS,
    Barrier,
    nearest_wall,
    place_of,
    sees,
    sight_of,
)
from warp_lcp.grid.cell_kernel import F32, I8, I16, U8, cell_kernel, next_to, of_axis

MODULE = "warp_lcp.grid.barriers.velocity"


@wp.struct
class FaceComponents:
    """Face fields of the components; w is null in 2-D."""

    u: F32
    v: F32
    w: F32


@wp.struct
class FaceMarks:
    """Marks of the faces of the components."""

    u: I8
    v: I8
    w: I8


@wp.func
def mean_around(
    B: Barrier, axis: int, other: int, k: int, j: int, i: int, U: FaceComponents, K: FaceMarks
):
    """Return the mean of another component over the known faces that a face sees.

    The mean is 0 if there are none.
    """
    x = place_of(B, axis, k, j, i)
    total = float(0.0)
    count = float(0.0)
    around = int(4)  # a variable, so that the loop is not unrolled
    for n in range(around):
        below = n & 1
        above = n >> 1
        c, b, a = next_to(axis, -below, k, j, i)
        c, b, a = next_to(other, above, c, b, a)
        if of_axis(other, K.u, K.v, K.w, c, b, a) > wp.int8(0):
            if sees(B, x, sight_of(B, other, c, b, a)):
                total += of_axis(other, U.u, U.v, U.w, c, b, a)
                count += 1.0
    return total / wp.max(count, 1.0)


@cell_kernel(MODULE)
def constrain_kernel(
    k,
    j,
    i,
    B: Barrier,
    axis: int,
    number: I16,
    open: F32,
    U: FaceComponents,
    K: FaceMarks,
    turn: TURNS,
    shift: SHIFTS,
    kind: I8,
    contact: U8,
    fluid: int,
    released: int,
    result: F32,
):
    """Write the velocity of crossed faces, without the part through their wall.

    A face loses the relative velocity into its wall; where the wall holds the material it loses all
    relative velocity along the normal. A crossed face lies on one side of the wall, and only places
    on that side see it. A face that is open in part has been projected and keeps its velocity.

    With the velocity u of the material, the velocity u_s = turn x + shift of the solid at the
    face's center x, both in m/s, the wall's normal n towards the face and the face's axis a:

        u_a <- u_a - (n . (u - u_s)) n_a   if the wall holds the material or n . (u - u_s) < 0.

    The other components of u are means over the faces that this one sees. A face without a known
    velocity gets that of the solid.
    """
    if number[k, j, i] > wp.int16(0) and open[k, j, i] == 0.0:
        own = of_axis(axis, U.u, U.v, U.w, k, j, i)
        mark = of_axis(axis, K.u, K.v, K.w, k, j, i)
        x = place_of(B, axis, k, j, i)
        solid, n, _d = nearest_wall(B, x, 1.5 * B.dx)
        value = own
        if solid > 0:
            moving = turn[solid] * x + shift[solid]
            if mark <= wp.int8(0):
                value = moving[axis]
            else:
                c, b, a = next_to(axis, -1, k, j, i)
                if sees(B, x, place_of(B, CENTERS, k, j, i)):
                    c = k
                    b = j
                    a = i
                held = int(kind[c, b, a]) == fluid and int(contact[c, b, a]) != released
                speed = wp.vec3()
                for other in range(B.planes + 1):
                    if other != axis:
                        speed[other] = mean_around(B, axis, other, k, j, i, U, K)
                speed[axis] = own
                relative = wp.dot(n, speed - moving)
                if held or relative < 0.0:
                    value = own - relative * n[axis]
        result[k, j, i] = value


@cell_kernel(MODULE)
def copy_constrained_kernel(k, j, i, number: I16, open: F32, result: F32, field: F32, known: I8):
    """Copy the results of `constrain_kernel`, and mark those faces as unknown.

    Faces that solids cut must not use them any more.
    """
    if number[k, j, i] > wp.int16(0) and open[k, j, i] == 0.0:
        field[k, j, i] = result[k, j, i]
        known[k, j, i] = wp.int8(0)
