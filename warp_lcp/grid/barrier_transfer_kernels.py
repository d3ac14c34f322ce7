# mypy: ignore-errors
"""Particle kernels near thin solids: density, velocity transfer, advection."""

import warp as wp

from warp_lcp.grid.barrier_geometry import (
    CENTERS,
    CERTAIN,
    Barrier,
    place_of,
    room_at,
    sees,
    sight_of,
)
from warp_lcp.grid.cell_kernel import (
    F32,
    INTS,
    POINTS,
    U8,
    cell_kernel,
    list_kernel,
    of_axis,
    spline,
)

MODULE = "warp_lcp.grid.barriers.transfer"
# Least weight of a face of a particle's own cell, as in `warp_lcp.grid.transfer`.
EDGE = 1.0e-5
TINY_WEIGHT = 1.0e-9
FREE = 2.5  # cells from other solids beyond which these do not affect a particle's path

# Cells: more than the distance between a particle and a face, or a cell, to which it contributes.
TENT = 1.8
KERNEL = 2.65

VEC8 = wp.types.vector(length=8, dtype=wp.float32)


@cell_kernel(MODULE)
def density_kernel(k, j, i, B: Barrier, each: float, offsets: INTS, position: POINTS, density: F32):
    """Add up the particles around a cell that its center sees.

    With d = (x_p - x) / dx for a particle at x_p and the center x [m], and the quadratic B-spline
    B:

        density = each * sum_p B(d_x) B(d_y) B(d_z),

    in 2-D without the factor of z. `each` is the share of one particle of the density at rest.
    """
    if B.near[k, j, i] != wp.uint8(0):
        center = place_of(B, CENTERS, k, j, i)
        # Lines shorter than this [cells] are free; tests take most of the time.
        certain = room_at(B, center, KERNEL * B.dx) / B.dx - CERTAIN
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
                        free = wp.length(way) < certain
                        if not free:
                            free = sees(B, center, position[p])
                        if free:
                            total += w
        density[k, j, i] = each * total


@wp.func
def tent(planes: int, axis: int, way: wp.vec3):
    """Return the tent weight of a face at a distance `way` [cells] from a particle.

    The weight of faces of the particle's own cell is positive.
    """
    w = float(1.0)
    for d in range(planes + 1):
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
    """Average the velocities of the particles that a face sees around it.

    With tent weights w_p, the particles' velocities v_p [m/s] and the gradients c_p [1/s] of the
    component (APIC; 0 without `gradient`), at the face's center x [m]:

        u = sum_p w_p (v_p + c_p . (x - x_p)) / sum_p w_p.

    u is 0 where the sum of the weights is at most TINY_WEIGHT.
    """
    if B.near[k, j, i] != wp.uint8(0):
        face = place_of(B, axis, k, j, i)
        seen_at = sight_of(B, axis, k, j, i)
        certain = room_at(B, seen_at, TENT * B.dx) - CERTAIN * B.dx
        momentum = float(0.0)
        sum = float(0.0)
        low = wp.vec3i(wp.max(i - 1, 0), wp.max(j - 1, 0), wp.max(k - B.planes + 1, 0))
        for c in range(low[2], wp.min(k + B.planes, field.shape[0])):
            for b in range(low[1], wp.min(j + 2, field.shape[1])):
                row = (c * field.shape[1] + b) * field.shape[2]
                for p in range(offsets[row + low[0]], offsets[row + wp.min(i + 2, field.shape[2])]):
                    way = face - position[p]
                    w = tent(B.planes, axis, way / B.dx)
                    if w > 0.0:
                        free = wp.length(seen_at - position[p]) < certain
                        if not free:
                            free = sees(B, position[p], seen_at)
                        if free:
                            v = velocity[p][axis]
                            if gradient:
                                v += wp.dot(gradient[p], way)
                            momentum += w * v
                            sum += w
        weight[k, j, i] = sum
        field[k, j, i] = wp.where(sum > TINY_WEIGHT, momentum / wp.max(sum, TINY_WEIGHT), 0.0)


@wp.func
def seen(B: Barrier, axis: int, x: wp.vec3, room: float, n: int, one: F32, two: F32, three: F32):
    """Interpolate a component, field n of three, from the faces that a point sees.

    Returns the value, its gradient [1/m] and the weight of the visible faces. Faces that the point
    does not see get the mean of the others. `room` is the point's distance from solids [m]. The
    field is selected here so that kernels call this function in one place: each call is inlined,
    with its lines of sight, and many copies take more registers than a thread has.
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
    if B.planes == 1:
        f[2] = 0.0
    # Lines shorter than this [cells] are free; tests take most of the time.
    certain = room / B.dx - CERTAIN
    values = VEC8()
    there = VEC8()
    sum = float(0.0)
    total = float(0.0)
    corners = 4 * B.planes
    for m in range(corners):
        a = m & 1
        b = (m >> 1) & 1
        c = m >> 2
        w = wp.where(a == 1, f[0], 1.0 - f[0]) * wp.where(b == 1, f[1], 1.0 - f[1])
        if B.planes == 2:
            w *= wp.where(c == 1, f[2], 1.0 - f[2])
        free = wp.length(wp.vec3(float(a), float(b), float(c)) - f) < certain
        if not free:
            free = sees(B, x, sight_of(B, axis, k + c, j + b, i + a))
        if free:
            v = of_axis(n, one, two, three, k + c, j + b, i + a)
            values[m] = v
            there[m] = 1.0
            sum += wp.max(w, 1.0e-6)
            total += wp.max(w, 1.0e-6) * v
    mean = total / wp.max(sum, 1.0e-30)
    value = float(0.0)
    slope = wp.vec3()
    for m in range(corners):
        a = m & 1
        b = (m >> 1) & 1
        c = m >> 2
        v = values[m]
        if there[m] == 0.0:
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
    """Return the stored cell (k, j, i) of a point [m].

    For a point outside the grid it is the nearest cell.
    """
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
    """Interpolate the velocity at particles from the faces that they see.

    Only particles near thin solids are considered.

    See `warp_lcp.grid.transfer`.

    With multilinear weights w_i of the faces around a particle, and the field u_saved before the
    step, the component v [m/s] and its gradient c [1/s] are

        v = sum_i w_i u_i + flip (v_before - sum_i w_i u_saved,i),   c = sum_i grad(w_i) u_i.

    Faces that the particle does not see have the mean of the others. A particle that sees no face
    keeps its component and gradient.
    """
    x = position[i]
    c, b, a = cell_at(B, x, shape_of(B.near))
    if B.near[c, b, a] != wp.uint8(0):
        room = room_at(B, x, TENT * B.dx)
        value = float(0.0)
        slope = wp.vec3()
        sum = float(0.0)
        fields = wp.where(flip > 0.0, 2, 1)
        for n in range(fields):
            if n == 0 or sum > 0.0:
                here, way, weight = seen(B, axis, x, room, n, field, saved, saved)
                if n == 0:
                    value = here
                    slope = way
                    sum = weight
                else:
                    value += flip * (before[i][axis] - here)
        v = velocity[i]
        if sum > 0.0:
            v[axis] = value
            velocity[i] = v
            if gradient:
                gradient[i] = slope


@wp.func
def velocity_at(B: Barrier, u: F32, v: F32, w: F32, x: wp.vec3):
    """Interpolate the velocity [m/s] from the faces that a point sees.

    The component along an axis is 0 if no face of that axis is visible.
    """
    room = room_at(B, x, TENT * B.dx)
    result = wp.vec3()
    for axis in range(B.planes + 1):
        value, _slope, _sum = seen(B, axis, x, room, axis, u, v, w)
        result[axis] = value
    return result


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
    """Advect particles that start near thin solids by the velocity that they see.

    Particles far from these solids are left out. The velocity is that of the midpoint of their
    path, if the midpoint is between `low` and `high`, the corners of the domain. Particles stop at
    `least` and `most`: these corners or, where sides let particles pass, infinity.

    The midpoint rule, with x [m], v [m/s] and dt [s]:

        x <- x + dt v(y),   y = x + (dt / 2) v(x).

    y = x if the midpoint lies outside of the domain, or if the particle does not see it. Particles
    within FREE cells of other solids are left out, too.
    """
    x = start[i]
    c, b, a = cell_at(B, x, shape_of(B.near))
    if B.near[c, b, a] != wp.uint8(0):
        if distance[c, b, a] > FREE:
            # At the start, and at the midpoint if it lies inside and is visible.
            way = wp.vec3()
            y = x
            inside = bool(True)
            looks = int(2)  # a variable, so that the loop is not unrolled
            for n in range(looks):
                if n == 1:
                    y = x + 0.5 * dt * way
                    for d in range(B.planes + 1):
                        if y[d] < low[d] or y[d] > high[d]:
                            inside = False
                    if inside:
                        inside = sees(B, x, y)
                if inside:
                    way = velocity_at(B, u, v, w, y)
            y = x + dt * way
            position[i] = wp.max(wp.min(y, most), least)
