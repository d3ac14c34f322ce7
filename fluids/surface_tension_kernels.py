# mypy: ignore-errors
"""Kernels of surface tension: extension into walls, curvature, push, energy."""

import functools
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.fluids.pressure import CONSTANTS, THETA_MIN
from warp_lcp.grid.cell_kernel import F32 as FIELD
from warp_lcp.grid.cell_kernel import I8 as MARKS
from warp_lcp.grid.cell_kernel import INTS, POINTS, cell_kernel, list_kernel
from warp_lcp.kernels import KernelFile, StencilKernel

MODULE = "fluids.surface_tension"
FLOATS = wp.array(dtype=wp.float32)
TAIL = wp.constant(1e-6)  # Fractions nearer to 0 or 1 than this have no distance in the profile.
# A surface farther from a wall's cell than this cuts no kernel that the extension reads [cells].
FARAWAY = wp.constant(4.0)
# Offsets from the wall, and largest distance along it, at which the curvature is read [cells].
FURTHER, MOST = wp.constant(2.0), wp.constant(3.0)
# Distance from the surface beyond which parallel surfaces meet a wall at the same angle [cells].
NEAR = wp.constant(2.0)
BAND = 0.02  # fractions nearer to 0 or 1 than this are too far from the surface
HALF = 0.3  # range of the fraction on either side of 1/2 within which the area is integrated
FARTHEST = 1.5  # largest distance of a cell beside the surface from the smooth surface [cells]
KERNELS = KernelFile(
    Path(__file__).parent / "headers/pressure.h",
    CONSTANTS | {"BAND": BAND, "FARTHEST": FARTHEST, "THETA_MIN": THETA_MIN, "HALF": HALF},
)
CURVATURE = KERNELS["fluids.surface_tension.curvature"]
JUMP = KERNELS["fluids.surface_tension.jump"]


@dataclass(frozen=True)
class SurfaceTensionKernels:
    """Kernels of the surface tension.

    Attributes:
        push: acts on the velocity.
        energy: sums the surface's energy.
    """

    push: StencilKernel
    energy: StencilKernel


@functools.cache
def push_pass(cut: bool) -> SurfaceTensionKernels:
    """Return the kernels with or without open fractions.

    `cut` is True if faces have open fractions.
    """
    kernel = functools.partial(
        KERNELS.kernel,
        module=MODULE + "_cut" * cut,
        constants={"CUT": cut, "MOVING": False, "GHOST": True},
    )
    return SurfaceTensionKernels(
        push=kernel("fluids.surface_tension.push"),
        energy=kernel("fluids.surface_tension.surface_energy"),
    )


@wp.func
def filled(s: float):
    """Return the fraction of a cell's kernel within a half space.

    The half space ends s cells from the cell's center, see `warp_lcp.grid.level_set`.
    """
    t = wp.min(1.5 - wp.abs(s), 1.0)
    share = t * t * t / 6.0
    if wp.abs(s) < 0.5:
        share = 0.5 - 0.75 * wp.abs(s) + wp.abs(s) * s * s / 3.0
    share = wp.where(wp.abs(s) >= 1.5, 0.0, share)
    return wp.where(s > 0.0, 1.0 - share, share)


@wp.func
def walled(part: float):
    """Return mean distance and variance of the part of a kernel that a wall takes.

    The part of a cell's kernel in the wall is everything c or more from the center [cells], since
    the kernel is (3/2 - t)^2 / 2 there, and 3/4 - t^2 up to t = 1/2.
    """
    u = wp.pow(wp.min(6.0 * part, 1.0), 1.0 / 3.0)  # 3/2 - c
    place = 1.5 - 0.75 * u
    variance = 0.0375 * u * u
    if part > 1.0 / 6.0:
        c = float(0.0)
        for _step in range(4):  # Newton's method for 1/2 - 3/4 c + c^3 / 3 = part
            c -= (0.5 - 0.75 * c + c * c * c / 3.0 - part) / (c * c - 0.75)
        c = wp.max(c, 0.0)
        place = (0.203125 - 0.375 * c * c + 0.25 * c * c * c * c) / part
        variance = wp.max(
            (0.125 - 0.25 * c * c * c + 0.2 * c * c * c * c * c) / part - place * place, 0.0
        )
    return wp.vec2(place, variance)


# The equation for d [cells] is G(-d) - part Phi((m cos - d) / sigma) = capacity open_share. G is
# `filled`, Phi the normal distribution, m and v are the mean distance and the variance of the
# wall's part (`walled`), and sigma^2 = v cos^2 + sin^2 / 4: the variance of the kernel along the
# wall is 1/4.
@wp.func
def whole_share(open_share: float, capacity: float, cosine: float):
    """Return the filled fraction of a whole kernel, from that of its open part.

    Particles represent only the open part, whose centroid is off the cell's center. A surface
    inclined to the wall therefore seems to lie lower there, by 0.15 cells times the cosine beside a
    whole cell's wall. Inside the wall the surface is extended as in `continue_kernel`. With d its
    distance from the center the whole fraction is G(-d). The wall's part is that of a normal
    distribution, and the difference is the open part. The distance d is found by bisection.
    """
    part = wp.min(1.0 - capacity, 0.5)
    beyond = walled(part)
    spread = 1.41421356 * wp.sqrt(beyond[1] * cosine * cosine + 0.25 * (1.0 - cosine * cosine))
    low = float(-1.5)
    high = float(1.5)
    for _step in range(12):  # bisection for the distance
        d = 0.5 * (low + high)
        wall = 0.5 + 0.5 * wp.erf((beyond[0] * cosine - d) / spread)
        if filled(-d) - part * wall > capacity * open_share:
            low = d
        else:
            high = d
    return filled(-0.5 * (low + high))


@cell_kernel(MODULE)
def share_kernel(k, j, i, phi: FIELD, blocked: MARKS, capacity: FIELD, cosine: float, share: FIELD):
    """Compute the filled fraction of the kernel of each open cell.

    With `capacity`, the open fractions beside walls, phi belongs to the open part only.
    """
    value = float(0.0)
    if blocked[k, j, i] == wp.int8(0):
        value = filled(-phi[k, j, i])
        if capacity:
            if capacity[k, j, i] < 0.999 and value > TAIL and value < 1.0 - TAIL:
                value = whole_share(value, capacity[k, j, i], cosine)
    share[k, j, i] = value


@wp.func
def distance_of(k: int, j: int, i: int, once: FIELD, twice: FIELD, linear: float, cubic: float):
    """Return the distance to the smooth surface [cells], see smooth_share.h."""
    within = wp.clamp(0.5 - 2.0 * once[k, j, i] + twice[k, j, i], -0.45, 0.45)
    return within * (linear + cubic * within * within)


@wp.func
def away_from(cell: int, ny: int, nx: int, p: wp.vec3):
    """Return the direction from a cell's center to a point [cells].

    The cell is a flat index on a grid of ny rows of nx cells.
    """
    k = cell // (ny * nx)
    j = (cell - k * ny * nx) // nx
    away = p - wp.vec3(float(cell - k * ny * nx - j * nx), float(j), float(k))
    return away / wp.max(wp.length(away), 1e-6)


@list_kernel(MODULE)
def lean_kernel(
    i,
    cells: INTS,
    points: POINTS,
    way: FLOATS,
    raised: FLOATS,
    planes: int,
    part: float,
    cosine: float,
    linear: float,
    cubic: float,
    once: FIELD,
    twice: FIELD,
    bend: FIELD,
    lean: FLOATS,
):
    """Compute the slope of the distance to the surface along the way into a wall.

    The slope is the fall of the distance d per cell of the way from the point to the wall's cell,
    such that the surface meets the wall at the contact angle. Where the surface meets the wall the
    slope is the cosine of that angle. At d from there, on the wall, parallel surfaces meet it at
    other angles, of cosine (1 - kappa d). Here kappa is the surface's curvature [1/cells] across
    the contact line: `part` of the whole curvature. It is read at the nearest point of the surface,
    two cells away from the wall: beside the wall it is not accurate before the slope is known.

    The middle of the way lies `raised` cells in front of a wall that cuts cells, if its ends were
    moved into the open. From the middle, the center of a circle of radius 1/kappa, cosine / kappa
    behind the wall, is at a distance of raised + cosine / kappa. This sum replaces the cosine.
    """
    p = points[i]
    away = away_from(cells[i], bend.shape[1], bend.shape[2], p)
    a = wp.clamp(int(wp.floor(p[0] + 0.5)), 1, bend.shape[2] - 2)
    b = wp.clamp(int(wp.floor(p[1] + 0.5)), 1, bend.shape[1] - 2)
    c = wp.clamp(int(wp.floor(p[2] + 0.5)), 1, bend.shape[0] - 2)
    d = distance_of(c, b, a, once, twice, linear, cubic)
    x = 0.5 * (
        distance_of(c, b, a + 1, once, twice, linear, cubic)
        - distance_of(c, b, a - 1, once, twice, linear, cubic)
    )
    y = 0.5 * (
        distance_of(c, b + 1, a, once, twice, linear, cubic)
        - distance_of(c, b - 1, a, once, twice, linear, cubic)
    )
    z = float(0.0)
    if planes == 2:
        z = 0.5 * (
            distance_of(c + 1, b, a, once, twice, linear, cubic)
            - distance_of(c - 1, b, a, once, twice, linear, cubic)
        )
    slope = wp.vec3(x, y, z)
    steep = wp.max(wp.dot(slope, slope), 0.1)
    q = FURTHER * away - slope * (d / steep)
    cell = wp.vec3(float(a), float(b), float(c))
    # Correct to the point itself, which lies between cells if the wall's cell is cut.
    d += wp.dot(slope, p - cell)
    q = cell + q * wp.min(MOST / wp.max(wp.length(q), 1e-6), 1.0)
    a = wp.clamp(int(wp.floor(q[0])), 1, bend.shape[2] - 2)
    b = wp.clamp(int(wp.floor(q[1])), 1, bend.shape[1] - 2)
    c = wp.clamp(int(wp.floor(q[2])), 1, bend.shape[0] - 2)
    total = float(0.0)
    weight = float(0.0)
    for dk in range(planes):
        for dj in range(2):
            for di in range(2):
                value = bend[c + dk, b + dj, a + di]
                w = wp.where(di == 0, 1.0 - (q[0] - float(a)), q[0] - float(a))
                w *= wp.where(dj == 0, 1.0 - (q[1] - float(b)), q[1] - float(b))
                if planes == 2:
                    w *= wp.where(dk == 0, 1.0 - (q[2] - float(c)), q[2] - float(c))
                if value != 0.0 and w > 0.0:
                    total += w * value
                    weight += w
    fall = cosine
    if weight > 0.25:
        kappa = part * total / weight
        fall = (cosine + kappa * raised[i]) * (
            1.0 - kappa * wp.clamp(d - 0.5 * way[i] * cosine, -NEAR, NEAR)
        )
    lean[cells[i]] = fall


@wp.func
def distance_for(share: float):
    """Return the distance [cells] at which `filled` equals a fraction, by bisection."""
    low = float(-1.5)
    high = float(1.5)
    for _step in range(16):
        d = 0.5 * (low + high)
        if filled(-d) > share:
            low = d
        else:
            high = d
    return 0.5 * (low + high)


@wp.func
def open_mean(p: wp.vec3, planes: int, blocked: MARKS, share: FIELD):
    """Interpolate the fraction from the open cells around a point.

    Also returns the sum of the weights of these cells, 0 without open cells.
    """
    a = int(wp.floor(p[0]))
    b = int(wp.floor(p[1]))
    c = int(wp.floor(p[2]))
    total = float(0.0)
    weight = float(0.0)
    for dk in range(planes):
        for dj in range(2):
            for di in range(2):
                w = wp.where(di == 0, 1.0 - (p[0] - float(a)), p[0] - float(a))
                w *= wp.where(dj == 0, 1.0 - (p[1] - float(b)), p[1] - float(b))
                if planes == 2:
                    w *= wp.where(dk == 0, 1.0 - (p[2] - float(c)), p[2] - float(c))
                if w > 1e-3:
                    if blocked[c + dk, b + dj, a + di] == wp.int8(0):
                        total += w * share[c + dk, b + dj, a + di]
                        weight += w
    if weight > 0.0:
        total = total / weight
    return total, weight


@list_kernel(MODULE)
def begin_kernel(
    i,
    cells: INTS,
    points: POINTS,
    way: FLOATS,
    lean: FLOATS,
    cosine: float,
    planes: int,
    blocked: MARKS,
    share: FIELD,
    flat: FLOATS,
):
    """Extend the fraction of cells' kernels into a wall's cell.

    A kernel is 3 cells wide. In front of a wetted wall the kernel may hold no liquid where that of
    the wall's cell does, which the surface reaches first. There the distance to the surface follows
    from the surrounding cells: it grows by the angle's cosine away from the wall and by its sine
    along the wall. The same holds for air at a wall that the liquid does not wet. Elsewhere this is
    the extension of `continue_kernel`.
    """
    # Distances in cells. In front of the wall the surface is at d = G^-1(value) from the point,
    # with G of `filled`; the distance in the wall's cell is d - way lean, and the fraction there is
    # G(-(d - way lean)). Without a surface at the point, |d| is the least of
    # sign (G^-1(share) + n cos) + a sin over the cells around it that hold the surface, but at
    # least 3/2: n and a are the offsets of the point from the cell, away from the wall and along
    # it, and sign is +1 for a wall that the liquid wets, else -1.
    p = points[i]
    away = away_from(cells[i], share.shape[1], share.shape[2], p)
    a = int(wp.floor(p[0]))
    b = int(wp.floor(p[1]))
    c = int(wp.floor(p[2]))
    value, weight = open_mean(p, planes, blocked, share)
    if weight > 0.0:
        fall = way[i] * lean[cells[i]]
        if value > TAIL and value < 1.0 - TAIL:
            value = filled(fall - distance_for(value))
        else:
            # Empty in front of a wetted wall, or full in front of one that is not wetted.
            if (value - 0.5) * cosine < 0.0:
                sign = wp.where(cosine > 0.0, 1.0, -1.0)
                sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
                least = float(4.0)
                for z in range(
                    wp.where(planes == 2, wp.max(c - 2, 0), c),
                    wp.where(planes == 2, wp.min(c + 4, share.shape[0]), c + 1),
                ):
                    for y in range(wp.max(b - 2, 0), wp.min(b + 4, share.shape[1])):
                        for x in range(wp.max(a - 2, 0), wp.min(a + 4, share.shape[2])):
                            near = share[z, y, x]
                            if blocked[z, y, x] == wp.int8(0) and near > TAIL and near < 1.0 - TAIL:
                                e = p - wp.vec3(float(x), float(y), float(z))
                                n = wp.dot(e, away)
                                along = wp.length(e - n * away)
                                least = wp.min(
                                    least, sign * (distance_for(near) + n * cosine) + along * sine
                                )
                if least < FARAWAY:
                    value = filled(fall - sign * wp.max(least, 1.5))
        flat[cells[i]] = value


@list_kernel(MODULE)
def continue_kernel(
    i,
    cells: INTS,
    points: POINTS,
    way: FLOATS,
    lean: FLOATS,
    cosine: float,
    spread: float,
    planes: int,
    blocked: MARKS,
    share: FIELD,
    flat: FLOATS,
):
    """Extend the smoothed fraction into a wall's cell from a mirror point.

    The point lies `way` cells away in the open, and the fraction is interpolated from the open
    cells around it. Along the way the distance to the surface falls by `lean` per cell, if the
    cosine is not 0. The profile, a normal distribution of standard deviation `spread` [cells],
    converts fractions to distances and back. Each thread reads open cells and writes a wall cell:
    there are no races.
    """
    p = points[i]
    value, weight = open_mean(p, planes, blocked, share)
    if weight > 0.0:
        if cosine != 0.0 and value > TAIL and value < 1.0 - TAIL:
            place = spread * 1.41421356 * wp.erfinv(2.0 * value - 1.0) + way[i] * lean[cells[i]]
            value = 0.5 + 0.5 * wp.erf(place / (1.41421356 * spread))
        flat[cells[i]] = value


@list_kernel(MODULE)
def calm_kernel(i, factor: float, deepest: float, key: INTS, phi: FLOATS, gradient: POINTS):
    """Scale the velocity gradients of particles in cells near the surface."""
    if phi[key[i]] > deepest:
        gradient[i] = factor * gradient[i]
