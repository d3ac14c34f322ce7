# mypy: ignore-errors
"""Kernels of what thin solids hold apart: faces that they cross, and transfers and densities of what is on one side of them."""

import warp as wp

from warp_lcp.grid.cell_kernel import (
    F32,
    I8,
    I16,
    I32,
    INTS,
    POINTS,
    U8,
    cell_below,
    cell_kernel,
    list_kernel,
)
from warp_lcp.grid.thin_walls_kernels import GROUPS, MISS, SHAPES, away, hit, into_group
from warp_lcp.operators.grid_poisson import AIR, SOLID

MODULE = "warp_lcp.grid.barriers"
CENTERS = 3  # the `axis` of a field at cell centers
# cells from a cell's center to a solid that may be between a particle in the cell and a face it
# touches, or a kernel's end
REACH = 2.8
# the least weight of a face that a particle's own cell has, as in `warp_lcp.grid.transfer`
EDGE = 1.0e-5
TINY_WEIGHT = 1.0e-9
# cells: points within it of a surface lie on it, and in the solid; particles keep a larger distance
SURFACE = 1.0e-6
FREE = 2.5  # cells from solids that cut cells, beyond which a particle's way is not theirs

_AIR, _SOLID = wp.constant(wp.int8(AIR)), wp.constant(wp.int8(SOLID))
_MISS = wp.constant(wp.float64(MISS))
TURNS, SHIFTS = wp.array(dtype=wp.mat33), wp.array(dtype=wp.vec3)


VEC8 = wp.types.vector(length=8, dtype=wp.float32)


@wp.struct
class Barrier:
    """Thin solids and the grid that they stand in."""

    shapes: SHAPES
    groups: GROUPS
    near: U8  # whether one is within REACH of a cell's center
    planes: int
    dx: float
    origin: wp.vec3i  # cells of a larger grid before the first one of this


@wp.struct
class Components:
    """A field of faces a component; w is null in 2-D."""

    u: F32
    v: F32
    w: F32


@wp.struct
class Marks:
    """Marks of faces."""

    u: I8
    v: I8
    w: I8


@wp.func
def place_of(B: Barrier, axis: int, k: int, j: int, i: int):
    """Return the center [m] of a lower face or, with CENTERS, of a cell; z = 0 in 2-D."""
    x = (float(i + B.origin[0]) - wp.where(axis == 0, 1.0, 0.5)) * B.dx
    y = (float(j + B.origin[1]) - wp.where(axis == 1, 1.0, 0.5)) * B.dx
    z = float(0.0)
    if B.planes == 2:
        z = (float(k + B.origin[2]) - wp.where(axis == 2, 1.0, 0.5)) * B.dx
    return wp.vec3(x, y, z)


@wp.func
def wall_between(B: Barrier, x: wp.vec3, y: wp.vec3):
    """Return the number of the first solid on the way from x to y, or that one of them lies in, 0: none; and where on the way it is."""
    t = _MISS
    found = int(0)
    for g in range(B.groups.shape[0]):
        group = B.groups[g]
        a = into_group(group.turn, group.shift, wp.vec3d(x))
        b = into_group(group.turn, group.shift, wp.vec3d(y))
        for s in range(group.first, group.end):
            at, _n = hit(B.shapes[s], a, b)
            if at < t:
                t = at
                found = B.shapes[s].solid
            elif found == 0:
                on = wp.float64(SURFACE * B.dx)
                d, _m = away(B.shapes[s], b, on)
                e, _m = away(B.shapes[s], a, on)
                if wp.min(d, e) < on:
                    found = B.shapes[s].solid
                    t = wp.where(e < on, wp.float64(0.0), wp.float64(1.0))
    return found, float(t)


@wp.func
def sees(B: Barrier, x: wp.vec3, y: wp.vec3):
    """Return whether no solid stands between two points."""
    found, _t = wall_between(B, x, y)
    return found == 0


@wp.func
def nearest_wall(B: Barrier, x: wp.vec3, reach: float):
    """Return the solid nearest to a point, 0 if none is within `reach` [m], the direction away from it and the distance [m]."""
    least = wp.float64(reach)
    found = int(0)
    normal = wp.vec3()
    for g in range(B.groups.shape[0]):
        group = B.groups[g]
        p = into_group(group.turn, group.shift, wp.vec3d(x))
        for s in range(group.first, group.end):
            d, n = away(B.shapes[s], p, least)
            if d < least:
                least = d
                found = B.shapes[s].solid
                normal = wp.vec3(group.turn * n)
    if B.planes == 1:
        normal = wp.normalize(wp.vec3(normal[0], normal[1], 0.0))
    return found, normal, float(least)


@cell_kernel(MODULE)
def near_kernel(k, j, i, B: Barrier, near: U8):
    """Mark the cells that a thin solid is near."""
    found, _n, _d = nearest_wall(B, place_of(B, CENTERS, k, j, i), REACH * B.dx)
    near[k, j, i] = wp.where(found > 0, wp.uint8(1), wp.uint8(0))


@cell_kernel(MODULE)
def apart_kernel(k, j, i, B: Barrier, axis: int, apart: U8):
    """Set bit d where a solid stands between a place of a field and the one before it along axis d."""
    bits = int(0)
    if B.near[k, j, i] != wp.uint8(0):
        x = place_of(B, axis, k, j, i)
        for d in range(B.planes + 1):
            y = place_of(
                B,
                axis,
                k - wp.where(d == 2, 1, 0),
                j - wp.where(d == 1, 1, 0),
                i - wp.where(d == 0, 1, 0),
            )
            if not sees(B, x, y):
                bits = bits | (1 << d)
    apart[k, j, i] = wp.uint8(bits)


@cell_kernel(MODULE)
def cross_kernel(
    k,
    j,
    i,
    B: Barrier,
    axis: int,
    apart: U8,
    open: F32,
    wall: I16,
    number: I16,
    below: F32,
    above: F32,
):
    """Close the lower faces between cells whose centers a solid stands between; the domain's stay its own.

    `below` and `above` are the distances to it from the centers of the cells below and above a
    face, in cells.
    """
    crossed = int(0)
    if (int(apart[k, j, i]) >> axis) & 1 != 0:
        if wall[k, j, i] != wp.int16(0):
            x = place_of(B, CENTERS, k, j, i)
            y = place_of(
                B,
                CENTERS,
                k - wp.where(axis == 2, 1, 0),
                j - wp.where(axis == 1, 1, 0),
                i - wp.where(axis == 0, 1, 0),
            )
            found, t = wall_between(B, x, y)
            crossed = found
            above[k, j, i] = wp.min(t, 1.0)
            # which rounding may let miss an end that lies on the surface
            _found, t = wall_between(B, y, x)
            below[k, j, i] = wp.min(t, 1.0)
            if open[k, j, i] > 0.0:
                wall[k, j, i] = wp.int16(crossed)
            open[k, j, i] = 0.0
    number[k, j, i] = wp.int16(crossed)


@cell_kernel(MODULE)
def solid_kernel(k, j, i, B: Barrier, ax: F32, ay: F32, az: F32, base: I8):
    """A cell whose faces are all closed is SOLID."""
    if B.near[k, j, i] != wp.uint8(0) and base[k, j, i] == _AIR:
        open = ax[k, j, i] + ax[k, j, i + 1] + ay[k, j, i] + ay[k, j + 1, i]
        if B.planes == 2:
            open += az[k, j, i] + az[k + 1, j, i]
        if open == 0.0:
            base[k, j, i] = _SOLID


@cell_kernel(MODULE)
def calm_kernel(k, j, i, near: U8, base: I8, calm: I8):
    """Copy the base of cells; SOLID where a thin solid is near."""
    calm[k, j, i] = wp.where(near[k, j, i] != wp.uint8(0), _SOLID, base[k, j, i])


@cell_kernel(MODULE, ordered=True)
def whole_kernel(k, j, i, axis: int, number: I16, below: F32, above: F32, index: I32):
    """Give the open cell nearer to a solid that crosses its face to that solid."""
    if number[k, j, i] > wp.int16(0):
        c, b, a = cell_below(axis, k, j, i)
        if above[k, j, i] <= below[k, j, i]:
            c = k
            b = j
            a = i
        if index[c, b, a] < 0:
            index[c, b, a] = int(number[k, j, i])


@wp.func
def beside(B: Barrier, x: wp.vec3, y: wp.vec3, way: wp.vec3):
    """Return whether a way from x to y beside the straight one is free, by `way` aside."""
    free = bool(False)
    if sees(B, x, x + way):
        if sees(B, x + way, y + way):
            free = sees(B, y + way, y)
    return free


@cell_kernel(MODULE, ordered=True)
def gap_kernel(k, j, i, B: Barrier, axis: int, open: F32, number: I16, gaps: INTS):
    """Count the crossed faces of each solid that have a gap: a free way beside their centers, where the next face is closed as well."""
    if number[k, j, i] > wp.int16(0):
        y = place_of(B, CENTERS, k, j, i)
        c, b, a = cell_below(axis, k, j, i)
        x = place_of(B, CENTERS, c, b, a)
        found = int(0)
        for d in range(B.planes + 1):
            if d != axis:
                for n in range(4):
                    side = 2 * (n & 1) - 1
                    way = wp.vec3()
                    way[d] = B.dx * float(side) * wp.where(n < 2, 0.2, 0.4)
                    if beside(B, x, y, way):
                        if (
                            open[
                                k + wp.where(d == 2, side, 0),
                                j + wp.where(d == 1, side, 0),
                                i + wp.where(d == 0, side, 0),
                            ]
                            == 0.0
                        ):
                            found = 1
        if found > 0:
            wp.atomic_add(gaps, int(number[k, j, i]), 1)


@wp.func
def spline(d: float):
    """Return the quadratic B-spline at a distance in cells."""
    a = wp.abs(d)
    outer = wp.max(1.5 - a, 0.0)
    return wp.where(a < 0.5, 0.75 - a * a, 0.5 * outer * outer)


@cell_kernel(MODULE)
def share_kernel(k, j, i, B: Barrier, parts: int, share: F32):
    """Find the share of a cell's kernel that its center sees, by points of equal distance: `parts` a cell and axis."""
    result = float(1.0)
    if B.near[k, j, i] != wp.uint8(0):
        x = place_of(B, CENTERS, k, j, i)
        seen = float(0.0)
        all = float(0.0)
        step = 1.0 / float(parts)
        layers = wp.where(B.planes == 2, 3 * parts, 1)
        for c in range(layers):
            z = float(0.0)
            if B.planes == 2:
                z = (float(c) + 0.5) * step - 1.5
            for b in range(3 * parts):
                y = (float(b) + 0.5) * step - 1.5
                for a in range(3 * parts):
                    way = wp.vec3((float(a) + 0.5) * step - 1.5, y, z)
                    w = spline(way[0]) * spline(y)
                    if B.planes == 2:
                        w *= spline(z)
                    all += w
                    if sees(B, x, x + B.dx * way):
                        seen += w
        result = seen / all
    share[k, j, i] = result


@cell_kernel(MODULE)
def capacity_kernel(k, j, i, share: F32, capacity: F32):
    """Reduce the open share of a cell's kernel to what its center sees of it."""
    capacity[k, j, i] = capacity[k, j, i] * share[k, j, i]


@cell_kernel(MODULE)
def density_kernel(k, j, i, B: Barrier, each: float, offsets: INTS, position: POINTS, density: F32):
    """Add up the particles around a cell that its center sees."""
    if B.near[k, j, i] != wp.uint8(0):
        center = place_of(B, CENTERS, k, j, i)
        total = float(0.0)
        for c in range(wp.max(k - B.planes + 1, 0), wp.min(k + B.planes, density.shape[0])):
            for b in range(wp.max(j - 1, 0), wp.min(j + 2, density.shape[1])):
                row = (c * density.shape[1] + b) * density.shape[2]
                for p in range(
                    offsets[row + wp.max(i - 1, 0)], offsets[row + wp.min(i + 2, density.shape[2])]
                ):
                    way = (position[p] - center) / B.dx
                    w = spline(way[0]) * spline(way[1])
                    if B.planes == 2:
                        w *= spline(way[2])
                    if w > 0.0:
                        if sees(B, center, position[p]):
                            total += w
        density[k, j, i] = each * total


@wp.func
def tent(B: Barrier, axis: int, way: wp.vec3):
    """Return the weight of a face at a distance [cells] from a particle; its cell's own faces have some."""
    w = float(1.0)
    for d in range(B.planes + 1):
        part = 1.0 - wp.abs(way[d])
        if d == axis and part > -EDGE:
            part = wp.max(part, EDGE)
        w *= wp.max(part, 0.0)
    return w


@cell_kernel(MODULE)
def gather_kernel(
    k,
    j,
    i,
    B: Barrier,
    axis: int,
    offsets: INTS,
    position: POINTS,
    velocity: POINTS,
    gradient: POINTS,
    field: F32,
    weight: F32,
):
    """Average the velocities of the particles around a face that it sees."""
    if B.near[k, j, i] != wp.uint8(0):
        face = place_of(B, axis, k, j, i)
        momentum = float(0.0)
        sum = float(0.0)
        low = wp.vec3i(wp.max(i - 1, 0), wp.max(j - 1, 0), wp.max(k - B.planes + 1, 0))
        for c in range(low[2], wp.min(k + B.planes, field.shape[0])):
            for b in range(low[1], wp.min(j + 2, field.shape[1])):
                row = (c * field.shape[1] + b) * field.shape[2]
                for p in range(offsets[row + low[0]], offsets[row + wp.min(i + 2, field.shape[2])]):
                    way = face - position[p]
                    w = tent(B, axis, way / B.dx)
                    if w > 0.0:
                        if sees(B, position[p], face):
                            v = velocity[p][axis]
                            if gradient:
                                v += wp.dot(gradient[p], way)
                            momentum += w * v
                            sum += w
        weight[k, j, i] = sum
        field[k, j, i] = wp.where(sum > TINY_WEIGHT, momentum / wp.max(sum, TINY_WEIGHT), 0.0)


@wp.func
def seen(B: Barrier, axis: int, x: wp.vec3, field: F32):
    """Return what a point sees of the faces of a component around it, their gradient [1/m], and the weight of those that it sees.

    Those that it does not see have the mean of the others.
    """
    g = x / B.dx + wp.vec3(
        1.0 - float(B.origin[0]), 1.0 - float(B.origin[1]), 1.0 - float(B.origin[2])
    )
    for d in range(3):
        if d != axis:
            g[d] = g[d] - 0.5
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(1)
    if B.planes == 2:
        k = int(wp.floor(g[2]))
    f = g - wp.vec3(float(i), float(j), float(k))
    values = VEC8()
    there = VEC8()
    sum = float(0.0)
    total = float(0.0)
    corners = 4 * B.planes
    for n in range(corners):
        a = n & 1
        b = (n >> 1) & 1
        c = n >> 2
        w = wp.where(a == 1, f[0], 1.0 - f[0]) * wp.where(b == 1, f[1], 1.0 - f[1])
        if B.planes == 2:
            w *= wp.where(c == 1, f[2], 1.0 - f[2])
        if sees(B, x, place_of(B, axis, k + c, j + b, i + a)):
            v = field[k + c, j + b, i + a]
            values[n] = v
            there[n] = 1.0
            sum += wp.max(w, 1.0e-6)
            total += wp.max(w, 1.0e-6) * v
    mean = total / wp.max(sum, 1.0e-30)
    value = float(0.0)
    slope = wp.vec3()
    for n in range(corners):
        a = n & 1
        b = (n >> 1) & 1
        c = n >> 2
        v = values[n]
        if there[n] == 0.0:
            v = mean
        wx = wp.where(a == 1, f[0], 1.0 - f[0])
        wy = wp.where(b == 1, f[1], 1.0 - f[1])
        wz = float(1.0)
        if B.planes == 2:
            wz = wp.where(c == 1, f[2], 1.0 - f[2])
        value += wx * wy * wz * v
        slope[0] += wp.where(a == 1, 1.0, -1.0) * wy * wz * v
        slope[1] += wp.where(b == 1, 1.0, -1.0) * wx * wz * v
        if B.planes == 2:
            slope[2] += wp.where(c == 1, 1.0, -1.0) * wx * wy * v
    return value, slope / B.dx, sum


@wp.func
def cell_at(B: Barrier, x: wp.vec3, shape: wp.vec3i):
    """Return the stored cell (k, j, i) of a point [m]; the nearest one of the grid of a point outside."""
    i = wp.clamp(int(wp.floor(x[0] / B.dx)) + 1 - B.origin[0], 0, shape[2] - 1)
    j = wp.clamp(int(wp.floor(x[1] / B.dx)) + 1 - B.origin[1], 0, shape[1] - 1)
    k = int(1)
    if B.planes == 2:
        k = wp.clamp(int(wp.floor(x[2] / B.dx)) + 1 - B.origin[2], 0, shape[0] - 1)
    return k, j, i


@wp.func
def shape_of(field: U8):
    """Return the shape of a field."""
    return wp.vec3i(field.shape[0], field.shape[1], field.shape[2])


@list_kernel(MODULE)
def interpolate_kernel(
    i,
    B: Barrier,
    axis: int,
    field: F32,
    saved: F32,
    flip: float,
    before: POINTS,
    position: POINTS,
    velocity: POINTS,
    gradient: POINTS,
):
    """Give particles near thin solids what they see of the velocity of faces, see `warp_lcp.grid.transfer`."""
    x = position[i]
    c, b, a = cell_at(B, x, shape_of(B.near))
    if B.near[c, b, a] != wp.uint8(0):
        value, slope, sum = seen(B, axis, x, field)
        v = velocity[i]
        if sum > 0.0:
            if flip > 0.0:
                old, _slope, _sum = seen(B, axis, x, saved)
                value += flip * (before[i][axis] - old)
            v[axis] = value
            velocity[i] = v
            if gradient:
                gradient[i] = slope


@wp.func
def velocity_at(B: Barrier, u: F32, v: F32, w: F32, x: wp.vec3):
    """Return what a point sees of the velocity [m/s]; 0 along an axis of which it sees no face."""
    a, _a, _sa = seen(B, 0, x, u)
    b, _b, _sb = seen(B, 1, x, v)
    c = float(0.0)
    if B.planes == 2:
        c, _c, _sc = seen(B, 2, x, w)
    return wp.vec3(a, b, c)


@list_kernel(MODULE)
def carry_kernel(
    i,
    B: Barrier,
    distance: F32,
    u: F32,
    v: F32,
    w: F32,
    dt: float,
    low: wp.vec3,
    high: wp.vec3,
    least: wp.vec3,
    most: wp.vec3,
    start: POINTS,
    position: POINTS,
):
    """Move particles that start near thin solids, and far from others, by the velocity that they see.

    That of half their way, if this lies between `low` and `high`, where velocities are known.
    They may not leave the room between `least` and `most`.
    """
    x = start[i]
    c, b, a = cell_at(B, x, shape_of(B.near))
    if B.near[c, b, a] != wp.uint8(0):
        if distance[c, b, a] > FREE:
            first = velocity_at(B, u, v, w, x)
            y = x + 0.5 * dt * first
            inside = bool(True)
            for d in range(B.planes + 1):
                if y[d] < low[d] or y[d] > high[d]:
                    inside = False
            way = first
            if inside:
                if sees(B, x, y):
                    way = velocity_at(B, u, v, w, y)
            y = x + dt * way
            for d in range(B.planes + 1):
                y[d] = wp.clamp(y[d], least[d], most[d])
            position[i] = y


@wp.func
def mean_around(B: Barrier, axis: int, other: int, k: int, j: int, i: int, field: F32, known: I8):
    """Return the mean of the known faces of another component around a face that it sees, 0 if there are none."""
    x = place_of(B, axis, k, j, i)
    total = float(0.0)
    count = float(0.0)
    for n in range(4):
        below = n & 1
        above = n >> 1
        c = k - wp.where(axis == 2, below, 0) + wp.where(other == 2, above, 0)
        b = j - wp.where(axis == 1, below, 0) + wp.where(other == 1, above, 0)
        a = i - wp.where(axis == 0, below, 0) + wp.where(other == 0, above, 0)
        if known[c, b, a] > wp.int8(0):
            if sees(B, x, place_of(B, other, c, b, a)):
                total += field[c, b, a]
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
    U: Components,
    K: Marks,
    turn: TURNS,
    shift: SHIFTS,
    kind: I8,
    contact: U8,
    fluid: int,
    released: int,
    result: F32,
):
    """Write what crossed faces become: without the velocity into the wall that they are beside, or any relative to it along its normal.

    They lie on one side of the wall, and only what is there sees them.
    """
    if number[k, j, i] > wp.int16(0):
        own = U.u[k, j, i]
        mark = K.u[k, j, i]
        if axis == 1:
            own = U.v[k, j, i]
            mark = K.v[k, j, i]
        if axis == 2:
            own = U.w[k, j, i]
            mark = K.w[k, j, i]
        x = place_of(B, axis, k, j, i)
        solid, n, _d = nearest_wall(B, x, 1.5 * B.dx)
        value = own
        if solid > 0:
            moving = turn[solid] * x + shift[solid]
            if mark <= wp.int8(0):
                value = moving[axis]
            else:
                c = k - wp.where(axis == 2, 1, 0)
                b = j - wp.where(axis == 1, 1, 0)
                a = i - wp.where(axis == 0, 1, 0)
                if sees(B, x, place_of(B, CENTERS, k, j, i)):
                    c = k
                    b = j
                    a = i
                held = int(kind[c, b, a]) == fluid and int(contact[c, b, a]) != released
                speed = wp.vec3()
                if axis != 0:
                    speed[0] = mean_around(B, axis, 0, k, j, i, U.u, K.u)
                if axis != 1:
                    speed[1] = mean_around(B, axis, 1, k, j, i, U.v, K.v)
                if axis != 2 and B.planes == 2:
                    speed[2] = mean_around(B, axis, 2, k, j, i, U.w, K.w)
                speed[axis] = own
                relative = wp.dot(n, speed - moving)
                if held or relative < 0.0:
                    value = own - relative * n[axis]
        result[k, j, i] = value


@cell_kernel(MODULE)
def take_kernel(k, j, i, number: I16, result: F32, field: F32, known: I8):
    """Take the results of `constrain_kernel`; the faces are of no more use to those that solids cut."""
    if number[k, j, i] > wp.int16(0):
        field[k, j, i] = result[k, j, i]
        known[k, j, i] = wp.int8(0)


@cell_kernel(MODULE)
def forget_kernel(k, j, i, number: I16, velocity: F32):
    """Forget the velocity of solids on faces that they cross no more."""
    if number[k, j, i] > wp.int16(0):
        velocity[k, j, i] = 0.0


@cell_kernel(MODULE)
def wall_velocity_kernel(
    k, j, i, B: Barrier, axis: int, number: I16, turn: TURNS, shift: SHIFTS, velocity: F32
):
    """Fill the velocity of the solids on the faces that they cross."""
    solid = int(number[k, j, i])
    if solid > 0:
        v = turn[solid] * place_of(B, axis, k, j, i) + shift[solid]
        velocity[k, j, i] = v[axis]


@cell_kernel(MODULE)
def fill_layer_kernel(k, j, i, layer: int, fill: int, apart: U8, known: I8, field: F32):
    """Fill faces marked `fill` from neighbors known up to `layer` that no solid stands between, and mark them layer + 1."""
    if int(known[k, j, i]) == fill:
        total = float(0.0)
        count = float(0.0)
        for n in range(6):
            d = n >> 1
            side = 2 * (n & 1) - 1
            c = k + wp.where(d == 2, side, 0)
            b = j + wp.where(d == 1, side, 0)
            a = i + wp.where(d == 0, side, 0)
            if (
                c >= 0
                and b >= 0
                and a >= 0
                and c < known.shape[0]
                and b < known.shape[1]
                and a < known.shape[2]
            ):
                mark = int(known[c, b, a])
                if mark > 0 and mark <= layer:
                    bits = int(apart[wp.max(c, k), wp.max(b, j), wp.max(a, i)])
                    if (bits >> d) & 1 == 0:
                        total += field[c, b, a]
                        count += 1.0
        if count > 0.0:
            field[k, j, i] = total / count
            known[k, j, i] = wp.int8(layer + 1)
