# mypy: ignore-errors
"""Kernels of airborne bodies of material: find them, sum their momenta, move them.

Sums are int64 in fixed point. Integers have the same sum in any order, so that a GPU gives the same
bits on every run.
"""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, U8, interpolated, list_kernel
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.kernels import KernelFile
from warp_lcp.material.boundary_kernels import TOUCHES
from warp_lcp.operators.grid_poisson import SOLID

COLUMNS = 18  # columns of a body's sums, see `add_up`
LEAVES = 17  # column: number of particles that come near a wall or an open side
# Most strides of a path, one cell each: the longest move of a particle in a step.
MOST_STRIDES = 1024

_TOUCHES = wp.constant(wp.uint8(TOUCHES))
_SOLID = wp.constant(wp.int8(SOLID))


Integers, Bytes = wp.array(dtype=wp.int32), wp.array(dtype=wp.uint8)
Kinds = I8
Motions = wp.array2d(dtype=wp.vec3)
Vectors, Field = wp.array(dtype=wp.vec3), F32


@wp.struct
class FragmentFields:
    """The particles of bodies, and sums over each body, for kernels."""

    planes: int
    straight: int  # whether particles go straight on
    inverse_dx: float  # [1/m]
    origin: wp.vec3i  # cells of a larger grid before the first one of this
    who: Integers  # the particles of all bodies
    body: Integers  # body of each particle
    sums: wp.array2d(dtype=wp.int64)


KERNELS = KernelFile(
    Path(__file__).parent / "headers/particle_models.h",
    {"SOLID": SOLID, "TOUCHES": TOUCHES, "TINY_WEIGHT": TINY_WEIGHT},
)
UNITE = KERNELS["warp_lcp.material.ballistic_fragments.unite"]
ALONE = KERNELS["warp_lcp.material.ballistic_fragments.alone"]
NUMBER = KERNELS["warp_lcp.material.ballistic_fragments.number"]
HOLD = KERNELS["warp_lcp.material.ballistic_fragments.hold"]


@wp.func
def root_of(parent: Integers, cell: int):
    """Follow parents to the root of a cell's tree."""
    c = cell
    while parent[c] != c:
        c = parent[c]
    return c


@wp.func
def put(sums: wp.array2d(dtype=wp.int64), body: int, column: int, quanta: wp.float64, value: float):
    """Add a value to a sum."""
    wp.atomic_add(sums, body, column, wp.int64(wp.rint(wp.float64(value) * quanta)))


@wp.func
def add_up(
    flight: FragmentFields, rate: float, q: wp.float64, velocity: Vectors, n: int, x: wp.vec3
):
    """Add the n-th particle at x [cells] to its body's sums, in cells and steps.

    `rate` is cells a step in one m/s, and q of the sums' units are one cell or cell a step or
    product of two of them. [0] particles; [1:4] x; [4:7] v; [7:10] x cross v; [10:16] xx, yy, zz,
    xy, xz, yz; [16] v v.
    """
    b = flight.body[n]
    v = velocity[flight.who[n]] * rate
    turn = wp.cross(x, v)
    wp.atomic_add(flight.sums, b, 0, wp.int64(1))
    for d in range(3):
        put(flight.sums, b, 1 + d, q, x[d])
        put(flight.sums, b, 4 + d, q, v[d])
        put(flight.sums, b, 7 + d, q, turn[d])
        put(flight.sums, b, 10 + d, q, x[d] * x[d])
    put(flight.sums, b, 13, q, x[0] * x[1])
    put(flight.sums, b, 14, q, x[0] * x[2])
    put(flight.sums, b, 15, q, x[1] * x[2])
    put(flight.sums, b, 16, q, wp.dot(v, v))


@list_kernel("warp_lcp.material.ballistic_fragments")
def board_kernel(
    i,
    key: Integers,
    parent: Integers,
    number: Integers,
    who: Integers,
    body: Integers,
    count: Integers,
):
    """List the particles of bodies; count[1] becomes their number.

    All other particles cost only this test.
    """
    b = number[root_of(parent, key[i])]
    if b >= 0:
        n = wp.atomic_add(count, 1, 1)
        who[n] = i
        body[n] = b


@list_kernel("warp_lcp.material.ballistic_fragments")
def lift_kernel(
    i,
    who: Integers,
    flight: FragmentFields,
    rate: float,
    quanta: wp.float64,
    velocity: Vectors,
    position: Vectors,
    start: Vectors,
):
    """Store the places of particles, and sum them up."""
    x = position[who[i]]
    start[i] = x
    add_up(flight, rate, quanta, velocity, i, x * flight.inverse_dx)


@wp.func
def velocity_at(u: Field, v: Field, w: Field, planes: int, origin: wp.vec3i, x: wp.vec3):
    """Return the velocity of the grid at x [cells], from the faces."""
    a = x[0] + 1.0 - float(origin[0])
    b = x[1] + 1.0 - float(origin[1])
    c = x[2] + 1.0 - float(origin[2])
    at = wp.vec3(
        interpolated(u, planes, a, b - 0.5, c - 0.5),
        interpolated(v, planes, a - 0.5, b, c - 0.5),
        0.0,
    )
    if planes == 2:
        at[2] = interpolated(w, planes, a - 0.5, b - 0.5, c)
    return at


@wp.func
def turned(angle: wp.vec3, a: wp.vec3):
    """Return a vector turned about an axis whose length is the angle [radians]."""
    size = wp.length(angle)
    if size == 0.0:
        return a
    n = angle / size
    return (
        wp.cos(size) * a + wp.sin(size) * wp.cross(n, a) + (1.0 - wp.cos(size)) * wp.dot(n, a) * n
    )


@wp.func
def is_near(base: Kinds, touch: U8, planes: int, origin: wp.vec3i, x: wp.vec3):
    """Return whether x [cells] is in a cell beside a wall, or near the grid's end."""
    i = int(wp.floor(x[0])) + 1 - origin[0]
    j = int(wp.floor(x[1])) + 1 - origin[1]
    k = int(1)
    if planes == 2:
        k = int(wp.floor(x[2])) + 1 - origin[2]
    near = bool(True)
    if (
        i > 0
        and j > 0
        and k > 0
        and i + 1 < base.shape[2]
        and j + 1 < base.shape[1]
        and k + 1 < base.shape[0]
    ):
        near = base[k, j, i] == _SOLID or (touch[k, j, i] & _TOUCHES) != wp.uint8(0)
    return near


@list_kernel("warp_lcp.material.ballistic_fragments")
def fly_kernel(
    i,
    who: Integers,
    flight: FragmentFields,
    h: float,
    velocity: Vectors,
    u: Field,
    v: Field,
    w: Field,
    motion: Motions,
    base: Kinds,
    touch: U8,
    start: Vectors,
    end: Vectors,
    x: Vectors,
    near: Bytes,
):
    """Advect particles in the frame of their body to x [cells].

    This is one third-order Runge-Kutta step. Its stages are at positions that move by the velocity
    minus the body's mean velocity. The particles' part of the body's rigid rotation turns with the
    body. A motion is the body's [0] velocity, [1] spin, [2] center.
    """
    p = who[i]
    b = flight.body[i]
    x0 = start[i] * flight.inverse_dx
    mean = motion[b, 0]
    spin = motion[b, 1]
    k1 = velocity_at(u, v, w, flight.planes, flight.origin, x0)
    way = h * k1
    if flight.straight == 0:
        k2 = velocity_at(u, v, w, flight.planes, flight.origin, x0 + 0.5 * h * (k1 - mean))
        k3 = velocity_at(u, v, w, flight.planes, flight.origin, x0 + 0.75 * h * (k2 - mean))
        way = h / 9.0 * (2.0 * k1 + 3.0 * k2 + 4.0 * k3)
    x1 = x0 + way
    end[i] = start[i] + way / flight.inverse_dx
    rigid = wp.cross(spin, start[i] - motion[b, 2])
    velocity[p] = velocity[p] + turned(spin * (h / flight.inverse_dx), rigid) - rigid
    longest = wp.max(wp.max(wp.abs(way[0]), wp.abs(way[1])), wp.abs(way[2]))
    strides = wp.clamp(int(wp.ceil(longest)), 1, MOST_STRIDES)
    met = wp.uint8(0)
    for stride in range(strides):
        if is_near(
            base, touch, flight.planes, flight.origin, x1 - (float(stride) / float(strides)) * way
        ):
            met = wp.uint8(1)
    x[i] = x1
    near[i] = met


@list_kernel("warp_lcp.material.ballistic_fragments")
def arrive_kernel(
    i,
    who: Integers,
    flight: FragmentFields,
    rate: float,
    quanta: wp.float64,
    velocity: Vectors,
    x: Vectors,
    near: Bytes,
):
    """Sum up the particles at their new places [cells].

    Count those that came near a wall or an open side.
    """
    add_up(flight, rate, quanta, velocity, i, x[i])
    if near[i] != wp.uint8(0):
        wp.atomic_add(flight.sums, flight.body[i], LEAVES, wp.int64(1))


@list_kernel("warp_lcp.material.ballistic_fragments")
def land_kernel(
    i,
    who: Integers,
    flight: FragmentFields,
    velocity: Vectors,
    gradient_u: Vectors,
    gradient_v: Vectors,
    gradient_w: Vectors,
    motion: Motions,
    end: Vectors,
    position: Vectors,
):
    """Set the particles' places and velocities: a scaled velocity plus a rigid motion.

    Bodies with a negative share stay unchanged. A motion is [0] the shift, [1] the velocity, [2]
    the spin, [3] the center, [4] the share, three times.
    """
    p = who[i]
    b = flight.body[i]
    s = motion[b, 4][0]
    if s >= 0.0:
        x = end[i] + motion[b, 0]
        w = motion[b, 2]
        position[p] = x
        velocity[p] = s * velocity[p] + motion[b, 1] + wp.cross(w, x - motion[b, 3])
        if gradient_u:
            gradient_u[p] = s * gradient_u[p] + wp.vec3(0.0, -w[2], w[1])
            gradient_v[p] = s * gradient_v[p] + wp.vec3(w[2], 0.0, -w[0])
            if flight.planes == 2:
                gradient_w[p] = s * gradient_w[p] + wp.vec3(-w[1], w[0], 0.0)
