# mypy: ignore-errors
"""Kernels of the wall drag, see `fluids.wall_drag`."""

import warp as wp

from warp_lcp.fluids.wall_kernels import (
    WallKernelFields,
    closed_on,
    face_center,
    fields_on,
    put,
    standing_of,
)
from warp_lcp.grid.cell_kernel import F32, I8, INTS, U8, cell_kernel
from warp_lcp.material.boundary_kernels import HELD
from warp_lcp.operators.grid_poisson import FLUID

_FLUID, _HELD = wp.constant(wp.int8(FLUID)), wp.constant(wp.uint8(HELD))
HALF = wp.constant(0.5)


@wp.struct
class WallDragFields:
    """Fields that the wall drag reads; velocities are those after the projection."""

    walls: WallKernelFields
    kind: I8
    contact: U8
    # Distance to the free surface at cell centers [cells]; null if it lies on the cells' faces.
    phi: F32
    u: F32
    v: F32
    w: F32
    known_u: I8
    known_v: I8
    known_w: I8
    # Shear stress over rho u^2 of the domain and of each solid.
    coefficient: wp.array(dtype=wp.float32)
    turn: wp.array(dtype=wp.mat33)  # the velocity of a wall's point x is turn x + shift
    shift: wp.array(dtype=wp.vec3)


@wp.func
def open_share(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the open fraction of a face."""
    free = float(0.0)
    if S.index:
        _owner, own, _covered, _mover, _moved = closed_on(S, axis, k, j, i)
        free = 1.0 - own
    else:
        free, _wall = fields_on(S, axis, k, j, i)
    return free


@wp.func
def fill(D: WallDragFields, k: int, j: int, i: int):
    """Return the liquid fraction of a cell, from the free surface."""
    full = wp.where(D.kind[k, j, i] == _FLUID, 1.0, 0.0)
    if D.phi:
        full = wp.clamp(HALF - D.phi[k, j, i], 0.0, 1.0)
        full = wp.where(D.kind[k, j, i] == _FLUID, wp.max(full, HALF), wp.min(full, HALF))
    return full


@wp.func
def mean_of(field: F32, known: I8, axis: int, component: int, k: int, j: int, i: int):
    """Return the mean of a component on a face of another axis [m/s].

    It is the mean over the projected ones of its four faces around this face; 0 without any.
    """
    total = float(0.0)
    count = float(0.0)
    around = int(4)  # a variable, so that the loop is not unrolled
    for n in range(around):
        a = n & 1  # 0: the cell of the face; 1: the cell below
        b = n >> 1  # 0: its lower face; 1: its upper face
        z = k - wp.where(axis == 2, a, 0) + wp.where(component == 2, b, 0)
        y = j - wp.where(axis == 1, a, 0) + wp.where(component == 1, b, 0)
        x = i - wp.where(axis == 0, a, 0) + wp.where(component == 0, b, 0)
        if known[z, y, x] == wp.int8(1):
            total += field[z, y, x]
            count += 1.0
    return total / wp.max(count, 1.0)


@wp.func
def velocity_on(D: WallDragFields, axis: int, k: int, j: int, i: int):
    """Return the velocity vector on a face [m/s].

    The component of the face's own axis is stored there; the others are means over the surrounding
    faces.
    """
    q = wp.vec3()
    if axis == 0:
        q[0] = D.u[k, j, i]
    else:
        q[0] = mean_of(D.u, D.known_u, axis, 0, k, j, i)
    if axis == 1:
        q[1] = D.v[k, j, i]
    else:
        q[1] = mean_of(D.v, D.known_v, axis, 1, k, j, i)
    if D.walls.planes == 2:
        if axis == 2:
            q[2] = D.w[k, j, i]
        else:
            q[2] = mean_of(D.w, D.known_w, axis, 2, k, j, i)
    return q


@wp.func
def piece_of(S: WallKernelFields, n: int, along: int, k: int, j: int, i: int):
    """Return area [faces], normal and solid of a piece of wall in a cell.

    The area is the one that drags along an axis. The first 2 d pieces are the parts of each face
    that whole cells, or the domain, close. The last piece is that of solids that cut the cell: a
    plane with the vector area of all their parts, which cancel in a gap of one cell.
    """
    faces = 2 * (S.planes + 1)
    area = float(0.0)
    normal = wp.vec3()
    solid = int(0)
    if n < faces:
        axis = n >> 1
        high = n & 1
        if axis != along:
            owner, own, _covered, _mover, _moved = closed_on(
                S,
                axis,
                k + wp.where(axis == 2, high, 0),
                j + wp.where(axis == 1, high, 0),
                i + wp.where(axis == 0, high, 0),
            )
            if S.index or owner == 0:
                area = own
                solid = wp.max(owner, 0)
                normal[axis] = 1.0
    elif not S.index:
        most = float(0.0)
        for m in range(faces):
            axis = m >> 1
            high = m & 1
            owner, own, covered, mover, moved = closed_on(
                S,
                axis,
                k + wp.where(axis == 2, high, 0),
                j + wp.where(axis == 1, high, 0),
                i + wp.where(axis == 0, high, 0),
            )
            if owner == 0:
                own = float(0.0)
            normal[axis] = normal[axis] + float(2 * high - 1) * (own + covered + moved)
            if own > most:
                most = own
                solid = owner
            if covered > most:
                most = covered
                solid = standing_of(S, k, j, i)
            if moved > most:
                most = moved
                solid = mover
        area = wp.length(normal)
        normal = wp.normalize(normal)
    return area, normal, solid


@wp.func
def pull(
    D: WallDragFields, axis: int, q: wp.vec3, x: wp.vec3, area: float, normal: wp.vec3, solid: int
):
    """Return the pull of a piece of wall on a face, and the speed that it removes.

    The pull is area x coefficient x speed. The second value is the velocity change until the face
    rests relative to the wall [m/s].
    """
    relative = q - (D.turn[solid] * x + D.shift[solid])
    along = relative - wp.dot(relative, normal) * normal
    own = relative[axis]
    # At most all of the velocity, and no gain.
    lost = wp.clamp(along[axis], wp.min(own, 0.0), wp.max(own, 0.0))
    return wp.where(lost == 0.0, 0.0, area * D.coefficient[solid] * wp.length(along)), lost


@cell_kernel("fluids.wall_drag")
def drag_kernel(
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
    D: WallDragFields,
    axis: int,
    dt: float,
    mass: wp.float64,
    apply: int,
    field: F32,
    known: I8,
    losses: wp.array(dtype=wp.float64),
):
    """Apply the drag to the projected faces of a row beside walls.

    With the sums over all pieces of wall, the new velocity is u' = u - sum of rate lost / (1 + sum
    of rate), the implicit step of `fluids.wall_drag`. The sum has to be known before any piece's
    share of the impulse, so that pieces are visited twice if impulses are written.

    Only walls that hold the liquid count. With `values` null the pieces of wall are counted, else
    their impulses are written. Velocities change only if `apply` is set. `mass` is that of a full
    cell [kg]; `losses` gains the energy of each row [J].
    """
    row = k * field.shape[1] + j
    begin = int(0)
    if values:
        begin = offsets[row]
    e = int(begin)
    for i in range(first, end):
        c = k - wp.where(axis == 2, 1, 0)
        b = j - wp.where(axis == 1, 1, 0)
        a = i - wp.where(axis == 0, 1, 0)
        here = bool(False)
        below = bool(False)
        if known[k, j, i] == wp.int8(1):
            here = D.kind[k, j, i] == _FLUID and D.contact[k, j, i] == _HELD
            below = D.kind[c, b, a] == _FLUID and D.contact[c, b, a] == _HELD
        if here or below:
            free = open_share(S, axis, k, j, i)
            part = free * HALF * (fill(D, k, j, i) + fill(D, c, b, a))
            center = face_center(S, axis, k, j, i)
            x = wp.vec3(float(center[0]), float(center[1]), float(center[2]))
            q = velocity_on(D, axis, k, j, i)
            rates = float(0.0)
            pulls = float(0.0)
            now = float(0.0)
            last = int(e)
            sides = int(2)  # a variable, so that the loop is not unrolled
            # First the sum over all pieces, then the share of each one.
            for turn in range(wp.where(values, 2, 1)):
                for side in range(sides):
                    z = wp.where(side == 0, k, c)
                    y = wp.where(side == 0, j, b)
                    s = wp.where(side == 0, i, a)
                    if (side == 0 and here) or (side == 1 and below):
                        # The cell's other face: its upper or its lower one.
                        o = wp.where(side == 0, 1, 0)
                        other = open_share(
                            S,
                            axis,
                            z + wp.where(axis == 2, o, 0),
                            y + wp.where(axis == 1, o, 0),
                            s + wp.where(axis == 0, o, 0),
                        )
                        weight = (
                            dt / float(S.spacing) / wp.max(part, 1.0e-6) * free / (free + other)
                        )
                        for n in range(2 * (S.planes + 1) + 1):
                            area, normal, solid = piece_of(S, n, axis, z, y, s)
                            if area > 0.0 and D.coefficient[solid] > 0.0:
                                rate, lost = pull(D, axis, q, x, weight * area, normal, solid)
                                if turn == 0:
                                    rates += rate
                                    pulls += rate * lost
                                    e += 1
                                else:
                                    e -= 1  # backward from the last one
                                    force = wp.vec3d()
                                    force[axis] = mass * wp.float64(
                                        part * rate * (now - q[axis] + lost)
                                    )
                                    put(e, solid, force, center - references[solid], owners, values)
                if turn == 0:
                    last = e
                now = q[axis] - pulls / (1.0 + rates)
            e = last
            if apply == 1 or values:
                losses[row] = losses[row] + wp.float64(0.5) * mass * wp.float64(part) * wp.float64(
                    (q[axis] - now) * (q[axis] + now)
                )
                field[k, j, i] = now
    counts[row] = e - begin
