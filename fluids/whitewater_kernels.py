# mypy: ignore-errors
"""Kernels of whitewater: emission from liquid cells, motion of diffuse particles, their kinds.

Coordinates X are those of the stored grid in cells, X = x / dx + 1 - origin: cell (k, j, i) is the
unit cube from (i, j, k). Random numbers are hashes of the seed, the step and the cell's number in
the domain, so they depend neither on the order of threads nor on the part of the grid.
"""

import warp as wp

from warp_lcp.grid.advection import AIM
from warp_lcp.grid.cell_kernel import (
    F32,
    I8,
    I32,
    INTS,
    POINTS,
    cell_kernel,
    interpolated,
    list_kernel,
)
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.operators.grid_poisson import SOLID

MODULE = "fluids.whitewater"
CENTERS = wp.array3d(dtype=wp.vec4)
SPRAY, FOAM, BUBBLE = 0, 1, 2  # kinds of diffuse particles
NONE, CELLS, CUT = 0, 1, 2  # solids: none besides the domain's sides, of whole cells, cut cells
LEAVES = 0.6  # least cosine between velocity and normal at a crest [Ihmsen et al. 2012]
AIR = 4.0  # distance to the surface where none is stored, and the largest that is [cells]
SPREAD = 0.15  # largest random velocity of a new particle, relative to that of the liquid
LIFTED = 2.0  # largest height above the surface of a particle from a crest, in foam layers
STRIDE = 0.5  # longest stride of a particle among walls [cells]
STRIDES = 64  # most strides of a step
ROOM = 0.5  # distance that remains to walls after a way of one stride [cells]
BURIED = 2.0  # depth inside a solid from which a particle is removed [cells]

_SOLID = wp.constant(wp.int8(SOLID))
_LEAVES = wp.constant(LEAVES)
_AIR = wp.constant(AIR)
_SPREAD = wp.constant(SPREAD)
_LIFTED = wp.constant(LIFTED)
_STRIDE = wp.constant(STRIDE)
_STRIDES = wp.constant(STRIDES)
_BURIED = wp.constant(BURIED)
_ROOM = wp.constant(ROOM)
_MARGIN = wp.constant(MARGIN)
_AIM = wp.constant(AIM)
_NONE = wp.constant(NONE)
_CUT = wp.constant(CUT)
_SPRAY = wp.constant(SPRAY)
_FOAM = wp.constant(FOAM)
_BUBBLE = wp.constant(BUBBLE)
# 2^32 over the golden ratio, and the multipliers of lowbias32.
_GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
_FIRST = wp.constant(wp.uint32(0x7FEB352D))
_SECOND = wp.constant(wp.uint32(0x846CA68B))


@wp.struct
class LiquidFields:
    """Liquid and solids of a step.

    `planes` is 1 in 2-D, 2 in 3-D. `centers` has the velocity at cell centers [m/s], and `AIR`
    minus the distance to the surface [cells]: 0 is air, far from liquid. `base` are the cells of
    solids. What else is known of solids depends on `walls`: with `CELLS`, `room` is the number of
    cells to the nearest SOLID one, as of `clearance`; with `CUT`, `distance` is that to solids at
    the low corners of cells [cells]. `origin` is the number of cells (x, y, z) before the stored
    ones. Particles stay between `low` and `high` [m], which are far away at open sides.
    """

    planes: int
    walls: int
    dx: float
    origin: wp.vec3i
    low: wp.vec3
    high: wp.vec3
    centers: CENTERS
    base: I8
    room: I8
    distance: F32


@wp.struct
class EmissionSettings:
    """Numbers of the emission in a step.

    A cell is sampled with the probability `share`, and stands for a cube of side `spread` [cells].
    It draws at most `most` particles in a step, and writes the fraction `youngest` of them, rounded
    up. `reach` is the distance of compared points [cells] in `directions`, `count` of them.
    `trapped` and `crest` are particles of a full potential per sampled cell in the step, by volume
    and by area. The potentials rise over `trapped_air_range` [m/s], `crest_range` (dimensionless)
    and `energy_range` [m^2/s^2].
    """

    seed: int
    step: int
    count: int
    most: int
    youngest: float
    share: float
    spread: float
    reach: float
    trapped: float
    crest: float
    trapped_air_range: wp.vec2
    crest_range: wp.vec2
    energy_range: wp.vec2
    layer: float  # half the thickness of the foam [cells]
    lifetime: float  # [s]
    dt: float  # [s]
    directions: POINTS


@wp.struct
class MotionSettings:
    """Numbers of the motion in a step: accelerations [m/s^2], rates [1/s], lengths [m]."""

    dt: float
    layer: float
    gravity: wp.vec3
    buoyancy: wp.vec3  # acceleration of a bubble at rest
    bubble_rate: float  # drag of the liquid on a bubble
    air_rate: float  # drag of the air on spray


@wp.func
def hashed(state: wp.uint32, value: wp.uint32):
    """Return a hash of a state and a number (lowbias32 by C. Wellons)."""
    x = state * _GOLDEN + value
    x = x ^ (x >> wp.uint32(16))
    x = x * _FIRST
    x = x ^ (x >> wp.uint32(15))
    x = x * _SECOND
    return x ^ (x >> wp.uint32(16))


@wp.func
def uniform(state: wp.uint32, stream: int):
    """Return a random number in [0, 1) of a stream, a multiple of 2^-24."""
    return float(hashed(state, wp.uint32(stream)) >> wp.uint32(8)) * 5.9604644775390625e-8


@wp.func
def cell_hash(F: LiquidFields, E: EmissionSettings, k: int, j: int, i: int):
    """Return the hash of a cell in a step, by its number in the domain."""
    h = hashed(wp.uint32(E.seed), wp.uint32(E.step))
    h = hashed(h, wp.uint32(i + F.origin[0]))
    h = hashed(h, wp.uint32(j + F.origin[1]))
    return hashed(h, wp.uint32(k + F.origin[2]))


@wp.func
def clamped_ramp(value: float, limits: wp.vec2):
    """Return Phi = (min(I, tau_max) - min(I, tau_min)) / (tau_max - tau_min)."""
    return (wp.min(value, limits[1]) - wp.min(value, limits[0])) / (limits[1] - limits[0])


@wp.func
def liquid_at(F: LiquidFields, X: wp.vec3):
    """Return velocity [m/s] and distance to the surface [cells] at a point.

    Linear between cell centers, which lie at i + 1/2. In 2-D the weight of the plane k = 2 is 0:
    code without branches is a third faster.
    """
    cx = wp.clamp(X[0] - 0.5, 0.0, float(F.centers.shape[2]) - 1.001)
    cy = wp.clamp(X[1] - 0.5, 0.0, float(F.centers.shape[1]) - 1.001)
    cz = wp.clamp(wp.where(F.planes == 2, X[2] - 0.5, 1.0), 0.0, float(F.centers.shape[0]) - 1.001)
    i = int(cx)
    j = int(cy)
    k = int(cz)
    fx = cx - float(i)
    fy = cy - float(j)
    fz = cz - float(k)
    gx = 1.0 - fx
    gy = 1.0 - fy
    gz = 1.0 - fz
    value = F.centers[k, j, i] * (gx * gy * gz) + F.centers[k, j, i + 1] * (fx * gy * gz)
    value += F.centers[k, j + 1, i] * (gx * fy * gz) + F.centers[k, j + 1, i + 1] * (fx * fy * gz)
    k += 1
    value += F.centers[k, j, i] * (gx * gy * fz) + F.centers[k, j, i + 1] * (fx * gy * fz)
    value += F.centers[k, j + 1, i] * (gx * fy * fz) + F.centers[k, j + 1, i + 1] * (fx * fy * fz)
    return wp.vec3(value[0], value[1], value[2]), _AIR - value[3]


@wp.func
def is_stored(F: LiquidFields, X: wp.vec3):
    """Return whether a point lies in a stored cell of the domain, without the ring."""
    low = wp.min(X[0], X[1]) - 1.0
    high = wp.min(float(F.base.shape[2] - 1) - X[0], float(F.base.shape[1] - 1) - X[1])
    if F.planes == 2:
        low = wp.min(low, X[2] - 1.0)
        high = wp.min(high, float(F.base.shape[0] - 1) - X[2])
    return low >= 0.0 and high > 0.0


@wp.func
def is_solid(F: LiquidFields, X: wp.vec3):
    """Return whether the cell of a stored point is SOLID."""
    k = wp.where(F.planes == 2, int(X[2]), 1)
    return F.base[k, int(X[1]), int(X[0])] == _SOLID


@wp.func
def sample_point(h: wp.uint32, stream: int, side: float, k: int, j: int, i: int):
    """Return a random point in a cube about a cell's center, of a side in cells.

    From three streams of random numbers.
    """
    return wp.vec3(
        float(i) + 0.5 + side * (uniform(h, stream) - 0.5),
        float(j) + 0.5 + side * (uniform(h, stream + 1) - 0.5),
        float(k) + 0.5 + side * (uniform(h, stream + 2) - 0.5),
    )


@wp.func
def emission(F: LiquidFields, E: EmissionSettings, X: wp.vec3):
    """Return the expected numbers of new particles of a cell, sampled at one point of it.

    With points x + R r_m in directions r_m over the circle or sphere of radius R = `reach`, and
    H_m the filled share at each of them:

        v_ta = 2 mean_m(H_m max(0, -(v_m - v) . r_m))   approach of liquid over R [m/s],
        f = mean_m(H_m), n = -sum_m((H_m - f) r_m)      filled share, normal,
        R kappa = 2 (1 - 2 f); 2-D: 2 sin(pi/2 (1 - 2 f)).

    A crest counts 2 f of its area. So a sheet of thickness t < R counts in proportion to its
    volume, f = t / (2 R), and not to its area, which grows as cells resolve thinner sheets.

    v_ta is Ihmsen's sum for liquid that meets head-on. Rigid rotation and liquid that separates
    give 0. R kappa is exact for balls and discs of radius 1 / kappa whose surface contains the
    point: f is (1 - R kappa / 2) / 2, in 2-D arccos(R kappa / 2) / pi. Directions that end in
    solids or outside of the stored domain are left out of f and n; a crest needs half of them.

    trapped = Phi_k Phi_ta (rate V dt) in the liquid, crest = Phi_k Phi_wc (rate A dt) at its
    surface, where the velocity leaves along the normal. A = delta(phi) dx^(d - 1), with the hat
    function of two cells' width as delta.

    Returns:
        trapped, crest, the normal, the velocity of the liquid [m/s].
    """
    trapped = float(0.0)
    crest = float(0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    v, phi = liquid_at(F, X)
    if phi < 1.0:
        phi_k = clamped_ramp(0.5 * wp.dot(v, v), E.energy_range)
        if phi_k > 0.0:
            approach = float(0.0)
            filled = float(0.0)
            seen = float(0.0)
            toward = wp.vec3(0.0, 0.0, 0.0)  # sum of H_m r_m
            around = wp.vec3(0.0, 0.0, 0.0)  # sum of r_m
            for m in range(E.count):
                r = E.directions[m]
                Y = X + E.reach * r
                if is_stored(F, Y):
                    if not is_solid(F, Y):
                        v_m, phi_m = liquid_at(F, Y)
                        share = wp.clamp(0.5 - phi_m, 0.0, 1.0)
                        seen += 1.0
                        filled += share
                        toward += share * r
                        around += r
                        if share > 0.0:
                            change = wp.dot(v_m - v, r)
                            approach += share * wp.max(-change, 0.0)
            if phi < 0.0:
                v_ta = 2.0 * approach / float(E.count)
                trapped = E.trapped * phi_k * clamped_ramp(v_ta, E.trapped_air_range)
            area = 1.0 - wp.abs(phi)
            if area > 0.0 and seen >= 0.5 * float(E.count):
                f = filled / seen
                n = f * around - toward
                size = wp.length(n)
                if size > 1.0e-6:
                    normal = n / size
                    r_kappa = 2.0 * (1.0 - 2.0 * f)
                    if F.planes == 1:
                        r_kappa = 2.0 * wp.sin(1.5707963 * (1.0 - 2.0 * f))
                    if wp.dot(v, normal) >= _LEAVES * wp.length(v):
                        bulk = 2.0 * f
                        crest = E.crest * area * bulk * phi_k * clamped_ramp(r_kappa, E.crest_range)
    return trapped, crest, normal, v


@cell_kernel(MODULE)
def center_kernel(k, j, i, planes: int, u: F32, v: F32, w: F32, phi: F32, centers: CENTERS):
    """Store the mean velocity of a cell's faces and its distance to the surface together.

    A particle then reads 8 vectors, not 32 numbers at four sets of places.
    """
    z = float(0.0)
    if planes == 2:
        z = 0.5 * (w[k, j, i] + w[wp.min(k + 1, w.shape[0] - 1), j, i])
    centers[k, j, i] = wp.vec4(
        0.5 * (u[k, j, i] + u[k, j, wp.min(i + 1, u.shape[2] - 1)]),
        0.5 * (v[k, j, i] + v[k, wp.min(j + 1, v.shape[1] - 1), i]),
        z,
        _AIR - wp.clamp(phi[k, j, i], -_AIR, _AIR),
    )


@wp.func
def drawn_count(E: EmissionSettings, h: wp.uint32, mean: float):
    """Return a random integer of a given mean, at most `most`."""
    count = E.most
    if mean < float(E.most):  # larger numbers may not be integers of 32 bits
        count = int(mean + uniform(h, 3))
    return count


@wp.func
def unwritten_count(E: EmissionSettings, drawn: int):
    """Return how many of a cell's new particles are too many: the oldest, which are first."""
    return wp.min(int((1.0 - E.youngest) * float(drawn)), drawn)


@cell_kernel(MODULE)
def count_kernel(k, j, i, F: LiquidFields, E: EmissionSettings, ends: I32):
    """Draw the number of new particles of each sampled cell, with the mean of `emission`."""
    inside = i > 0 and j > 0 and k > 0 and i < F.base.shape[2] - 1 and j < F.base.shape[1] - 1
    if inside and k < F.base.shape[0] - 1:
        if F.base[k, j, i] != _SOLID:
            if _AIR - F.centers[k, j, i][3] < 1.5:
                h = cell_hash(F, E, k, j, i)
                if uniform(h, 4) < E.share:
                    X = sample_point(h, 0, 1.0, k, j, i)
                    trapped, crest, _normal, _v = emission(F, E, X)
                    if trapped + crest > 0.0:
                        drawn = drawn_count(E, h, trapped + crest)
                        ends[k, j, i] = drawn - unwritten_count(E, drawn)


@cell_kernel(MODULE)
def emit_kernel(
    k,
    j,
    i,
    F: LiquidFields,
    E: EmissionSettings,
    ends: I32,
    old: int,
    position: POINTS,
    velocity: POINTS,
    state: POINTS,
):
    """Write the new particles of each cell behind the `old` ones.

    `ends` are the inclusive sums of the cells' numbers, in the order of cells. Particles from
    trapped air begin anywhere in the cube that the cell stands for, those from a crest above the
    surface in it. Both begin at a random time of the step: of n particles of a cell the one with
    the number q has the age -dt (q + r) / n at its start, 0 <= r < 1.
    """
    last = ends[k, j, i]
    place = (k * ends.shape[1] + j) * ends.shape[2] + i
    first = int(0)
    if place > 0:
        if i > 0:
            first = ends[k, j, i - 1]
        elif j > 0:
            first = ends[k, j - 1, ends.shape[2] - 1]
        else:
            first = ends[k - 1, ends.shape[1] - 1, ends.shape[2] - 1]
    if last > first:
        h = cell_hash(F, E, k, j, i)
        X = sample_point(h, 0, 1.0, k, j, i)
        trapped = float(1.0)
        crest = float(0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        v, depth = liquid_at(F, X)
        if depth > -1.0:  # deeper cells have no crest
            trapped, crest, normal, _v = emission(F, E, X)
        # `ends` decides how many are written, whatever the rounding of the mean in this kernel.
        drawn = last - first
        if E.youngest < 1.0:
            trapped, crest, normal, _v = emission(F, E, X)
            drawn = wp.max(drawn_count(E, h, trapped + crest), drawn)
        unwritten = drawn - (last - first)
        for q in range(unwritten, drawn):
            slot = old + first + q - unwritten
            own = hashed(h, wp.uint32(16 + q))
            Y = sample_point(own, 0, E.spread, k, j, i)
            if uniform(own, 3) * (trapped + crest) >= trapped:
                height = E.layer * (1.0 + (_LIFTED - 1.0) * uniform(own, 4))
                _there, phi = liquid_at(F, Y)
                Y = Y + (height - phi) * normal
            beside = wp.vec3(
                2.0 * uniform(own, 5) - 1.0,
                2.0 * uniform(own, 6) - 1.0,
                2.0 * uniform(own, 7) - 1.0,
            )
            if F.planes == 1:
                beside[2] = 0.0
            x = F.dx * (
                Y + wp.vec3(float(F.origin[0]), float(F.origin[1]), float(F.origin[2]))
            ) - wp.vec3(F.dx, F.dx, F.dx)
            if F.planes == 1:
                x[2] = 0.0
            position[slot] = x
            velocity[slot] = v + _SPREAD * wp.length(v) * beside
            age = -E.dt * (float(q) + uniform(own, 8)) / float(drawn)
            life = E.lifetime * (0.5 + uniform(own, 9))
            state[slot] = wp.vec3(age, life, float(_FOAM))


@wp.func
def solid_distance(F: LiquidFields, X: wp.vec3):
    """Return the distance to solids at a stored point [cells], linear between corners."""
    return interpolated(F.distance, F.planes, X[0], X[1], X[2])


@wp.func
def stored_point(F: LiquidFields, x: wp.vec3):
    """Return the coordinates in the stored grid of a point [m]."""
    return x * (1.0 / F.dx) + wp.vec3(
        1.0 - float(F.origin[0]), 1.0 - float(F.origin[1]), 1.0 - float(F.origin[2])
    )


@wp.func
def stay_inside(F: LiquidFields, x: wp.vec3, v: wp.vec3):
    """Put a particle back into the domain, and stop it there.

    Returns:
        Position [m], velocity [m/s], and whether a side stopped it.
    """
    y = wp.min(wp.max(x, F.low), F.high)
    a = wp.where(y[0] == x[0], 1.0, 0.0)
    b = wp.where(y[1] == x[1], 1.0, 0.0)
    c = wp.where(y[2] == x[2], 1.0, 0.0)
    return y, wp.vec3(a * v[0], b * v[1], c * v[2]), wp.where(a * b * c == 0.0, 1, 0)


@wp.func
def enter_no_solid_cell(F: LiquidFields, x: wp.vec3, v: wp.vec3, stride: float):
    """Move a particle along one axis after the other, but not into SOLID cells.

    Returns:
        Position [m], velocity [m/s], and whether a cell stopped it.
    """
    hit = int(0)
    for axis in range(3):
        e = wp.vec3(0.0, 0.0, 0.0)
        e[axis] = v[axis]
        y = x + stride * e
        Y = stored_point(F, wp.min(wp.max(y, F.low), F.high))
        barred = False
        if is_stored(F, Y):
            barred = is_solid(F, Y)
        if barred:
            v = v - e
            hit = 1
        else:
            x = y
    return x, v, hit


@wp.func
def keep_distance(F: LiquidFields, x: wp.vec3, v: wp.vec3):
    """Put a particle that is too near to a solid back along the normal.

    As near as the liquid's particles come. The velocity loses its part into the solid.

    Returns:
        Position [m], velocity [m/s], whether a solid stopped it, and the depth in it [cells].
    """
    hit = int(0)
    depth = float(0.0)
    Y = stored_point(F, x)
    if is_stored(F, Y):
        room = solid_distance(F, Y)
        depth = -room
        if room < _MARGIN:
            g = wp.vec3(0.0, 0.0, 0.0)
            for axis in range(3):
                e = wp.vec3(0.0, 0.0, 0.0)
                e[axis] = 0.5
                if axis <= F.planes:
                    g[axis] = solid_distance(F, Y + e) - solid_distance(F, Y - e)
            size = wp.length(g)
            if size > 1.0e-6:
                normal = g / size
                x = x + ((_AIM - room) * F.dx) * normal
                v = v - wp.min(wp.dot(v, normal), 0.0) * normal
                hit = 1
    return x, v, hit, depth


@wp.func
def free_way(F: LiquidFields, x: wp.vec3, X: wp.vec3):
    """Return the length of ways from a stored point that meet no solid and no side [cells].

    Whole cells: the nearest SOLID one is `room` cells further along some axis, and the point as far
    from the sides of its own cell. The ring beyond closed sides is SOLID.
    """
    free = float(0.0)
    if F.walls == _CUT:
        beside = wp.min(x - F.low, F.high - x)
        free = wp.min(solid_distance(F, X), wp.min(beside) / F.dx) - _ROOM
    else:
        k = wp.where(F.planes == 2, int(X[2]), 1)
        j = int(X[1])
        i = int(X[0])
        a = X[0] - float(i)
        b = X[1] - float(j)
        inner = wp.min(wp.min(a, 1.0 - a), wp.min(b, 1.0 - b))
        if F.planes == 2:
            c = X[2] - float(k)
            inner = wp.min(inner, wp.min(c, 1.0 - c))
        free = float(F.room[k, j, i]) - 1.0 + inner - _MARGIN
    return free


@wp.func
def move_among_walls(F: LiquidFields, x: wp.vec3, v: wp.vec3, dt: float, way: float):
    """Move a particle by strides of at most half a cell; solids and sides stop it.

    Returns:
        Position [m], velocity [m/s], how often a wall stopped it, and its depth in solids [cells].
    """
    depth = float(0.0)
    stopped = int(0)
    parts = wp.clamp(int(way / _STRIDE) + 1, 1, _STRIDES)
    stride = dt / float(parts)
    for _part in range(parts):
        if F.walls == _CUT:
            x, v, hit, depth = keep_distance(F, x + stride * v, v)
        else:
            x, v, hit = enter_no_solid_cell(F, x, v, stride)
        x, v, met = stay_inside(F, x, v)
        stopped += hit + met
    return x, v, stopped, depth


@list_kernel(MODULE)
def advance_kernel(
    i,
    F: LiquidFields,
    M: MotionSettings,
    position: POINTS,
    velocity: POINTS,
    state: POINTS,
    marks: INTS,
):
    """Move each particle by a step according to its kind; mark those that are to go.

    The kind follows from the distance to the surface: bubbles deeper than `layer`, spray higher,
    foam between. With the step h, or the rest of it for a new particle:

        spray   v <- (v + h g) / (1 + h c_air)
        bubble  v <- (v + h b + h c u(x)) / (1 + h c)     drift b / c against gravity
        foam    v <- u(x + h/2 u(x))                      midpoint rule

    then x <- x + dt v, in strides where a solid may be on the way. Before its birth a new particle
    goes with the liquid: its place was drawn in the liquid of the step's start. The domain's sides
    are planes normal to the axes, so that one stride suffices there. Drags are implicit, stable for
    any h. `state` is the age, the rest of the life [s] and the kind. Foam, and spray that a wall
    stops, lose life.
    """
    x = position[i]
    v = velocity[i]
    age = state[i][0]
    life = state[i][1]
    h = M.dt + wp.min(age, 0.0)
    X = stored_point(F, x)
    kind = int(_SPRAY)
    u = wp.vec3(0.0, 0.0, 0.0)
    free = float(0.0)
    if is_stored(F, X):
        u, height = liquid_at(F, X)
        if height * F.dx < -M.layer:
            kind = _BUBBLE
        elif height * F.dx <= M.layer:
            kind = _FOAM
        if F.walls != _NONE:
            free = free_way(F, x, X)
    if kind == _SPRAY:
        v = (v + h * M.gravity) * (1.0 / (1.0 + h * M.air_rate))
    else:
        if kind == _BUBBLE:
            c = h * M.bubble_rate
            v = (v + h * M.buoyancy + c * u) * (1.0 / (1.0 + c))
        else:
            v, _height = liquid_at(F, X + (0.5 * h / F.dx) * u)
    finite = wp.length_sq(x) + wp.length_sq(v) < 1.0e36  # False for what is not a number
    depth = float(0.0)
    stopped = int(0)
    if F.walls == _NONE:
        x, v, stopped = stay_inside(F, x + M.dt * v, v)
    else:
        way = M.dt * wp.length(v) / F.dx
        if way < free:
            x = x + M.dt * v
        else:
            x, v, stopped, depth = move_among_walls(F, x, v, M.dt, way)
    if kind == _FOAM or stopped > 0:
        life -= h
    marks[i] = 0
    if life <= 0.0 or depth > _BURIED or not finite:
        marks[i] = 1
    position[i] = x
    velocity[i] = v
    state[i] = wp.vec3(age + M.dt, life, float(kind))


@list_kernel(MODULE)
def tally_kernel(i, state: POINTS, counts: INTS):
    """Count the particles of each kind; integers, so that the order does not matter."""
    wp.atomic_add(counts, int(state[i][2]), 1)
