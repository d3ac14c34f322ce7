# mypy: ignore-errors
"""Kernels of the packing: face masses, edge weights, free volume, stiffness."""

import warp as wp

from warp_lcp.granular.stress_layout import FIRM, HOLDS, NEARLY, PARTLY, SHEARS_HERE
from warp_lcp.grid.cell_kernel import F32, F64, I8, I32, U8, cell_below, cell_kernel, list_kernel
from warp_lcp.kernels.layout import make_struct
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

_FLUID = wp.constant(wp.int8(FLUID))
_AIR = wp.constant(wp.int8(AIR))
_SOLID = wp.constant(wp.int8(SOLID))

LEAST_FRACTION = 0.02  # of a cell or face, below which it counts as empty
LEAST_MASS = 0.1  # least mass of a face, relative to a full one: less would make the problem stiff
DENSE = 0.5  # fraction from which a cell has shear stress
# Fraction from which a cell beside air counts as full: other partly filled cells have no pressure,
# and so no friction.
SURFACE = 0.3
# Fraction from which a cell counts as full: less than 1 by the sampling noise, since gaps due to
# noise would close as if sand fell.
FULL = 0.95
# Reduction of FULL where a wall takes nearly all of a cell: half the distance of two particles.
WALL_NOISE = 0.25
FIRM_FRACTION = 0.9  # fraction from which a cell has cohesion
# Open fraction of a cell below which it has no stress: its faces are slits, and only huge pressures
# could move sand through them.
LEAST_OPEN = 5e-4
LANES = 16  # cells per SIMD vector
ROUNDING = 1e-6  # a fraction that differs from 1 by less counts as 1

_F32X = wp.array4d(dtype=wp.float32)
Faces = make_struct("Faces", dict.fromkeys("xyz", F32))  # components of a vector, or shears


@cell_kernel("granular.packing")
def fraction_kernel(k, j, i, base: I8, capacity: F32, splatted: F32, fraction: F32):
    """Compute the fraction of a cell from the particles' density.

    A value above 1 is mass, but never causes a velocity, see `contents_kernel`.
    """
    phi = float(0.0)
    if base[k, j, i] != _SOLID:
        phi = splatted[k, j, i] / wp.max(capacity[k, j, i], 0.1)
        if wp.abs(phi - 1.0) <= ROUNDING:
            phi = 1.0
    fraction[k, j, i] = phi


@cell_kernel("granular.packing")
def contents_kernel(
    k,
    j,
    i,
    base: I8,
    capacity: F32,
    fraction: F32,
    planes: int,
    rate: float,
    volume: F32,
    kind: I8,
    flags: U8,
    drive: F32,
):
    """Mark cells with sand, and compute their free volume.

    drive = max(FULL - saturation, 0) dx / dt [m/s]. The free fraction of a cell is limited by the
    mean around it: a gap beside a surplus in the neighbors is sampling noise, not room.

    The drive is never negative: excess density is corrected by moving particles apart (density
    correction). A correction by the stresses would be a velocity, which friction opposes (the walls
    of a silo would pull its sand down), and which grows as the time step shrinks. Where solids cut
    cells, `volume` is the open part of each cell.
    """
    solid = base[k, j, i] == _SOLID
    phi = fraction[k, j, i]
    mark = int(0)
    full = phi
    if not solid and phi > LEAST_FRACTION:
        mark = HOLDS
        if phi > DENSE:
            mark = mark | SHEARS_HERE
        if phi > FIRM_FRACTION:
            mark = mark | FIRM
        if phi >= SURFACE:
            air = bool(False)
            for axis in range(planes + 1):
                for side in range(2):
                    step = 2 * side - 1
                    n = k + wp.where(axis == 2, step, 0)
                    m = j + wp.where(axis == 1, step, 0)
                    l = i + wp.where(axis == 0, step, 0)
                    if base[n, m, l] != _SOLID and fraction[n, m, l] < SURFACE:
                        air = True
            if air:
                full = wp.max(phi, 1.0)
    open = float(1.0)
    if volume:
        open = volume[k, j, i]
        if mark != 0:
            least = float(1.0)
            for c in range(-planes + 1, planes):
                for b in range(-1, 2):
                    for a in range(-1, 2):
                        least = wp.min(least, volume[k + c, j + b, i + a])
            if least < 1.0:
                mark = mark | PARTLY
    bears = mark
    if open < LEAST_OPEN:
        bears = 0
    flags[k, j, i] = wp.uint8(bears)
    free = FULL - WALL_NOISE * (1.0 - open) - full
    if mark != 0 and free > 0.0:
        free = wp.min(free, _free_around(base, capacity, fraction, planes, k, j, i))
    drive[k, j, i] = wp.max(free, 0.0) * rate * open
    if solid:
        kind[k, j, i] = _SOLID
    elif mark != 0:
        kind[k, j, i] = _FLUID
    else:
        kind[k, j, i] = _AIR


@wp.func
def _free_around(base: I8, capacity: F32, fraction: F32, planes: int, k: int, j: int, i: int):
    """Return the free volume fraction after a 1-2-1 filter.

    The weights are (1, 2, 1)/4 along each axis.
    """
    free = float(0.0)
    for c in range(1 - planes, planes):
        for b in range(-1, 2):
            for a in range(-1, 2):
                if base[k + c, j + b, i + a] != _SOLID:
                    weight = wp.max(capacity[k + c, j + b, i + a], 0.1) / float(
                        (1 + wp.abs(a)) * (1 + wp.abs(b)) * (1 + wp.abs(c))
                    )
                    free += weight * (FULL - fraction[k + c, j + b, i + a])
    return free / wp.max(capacity[k, j, i], 0.1)


@cell_kernel("granular.packing")
def face_kernel(
    k,
    j,
    i,
    axis: int,
    base: I8,
    fraction: F32,
    velocity: F32,
    solid: F32,
    openings: _F32X,
    start: F32,
    mass: F32,
    inverse: F32,
):
    """Compute the mass of a face, its inverse, and the velocity before the stresses.

    Masses are in units of a full face. A face beside a solid cannot move: its inverse is 0. Its
    mass is the fraction of the open cell if the solid moves (it sweeps sand along), and its
    velocity the solid's. A face without mass has 0 in all three.

    A cell that is filled less than the surface has no pressure. A face between it and one with
    pressure gets the whole load, not half. Otherwise half of the load would be lost: the pressure
    and thus the friction below would be too small by the weight of that cell, and the uppermost row
    would slide off slopes on which it should rest. Of a face that a solid cuts the open part has
    mass, with a lower limit.
    """
    # mean = (phi_above + phi_below) / 2, plus half of the lesser phi where only that one is below
    # SURFACE. mass = max(mean, LEAST_MASS) in units of a full face, but 0 if
    # mean <= LEAST_FRACTION. inverse = 1 / mass; with cut cells 1 / max(open fraction *
    # mass, LEAST_MASS). Velocities are in m/s.
    c, b, a = cell_below(axis, k, j, i)
    m = float(0.0)
    light = float(0.0)
    u = float(0.0)
    if base[k, j, i] == _SOLID or base[c, b, a] == _SOLID:
        if solid:
            u = solid[k, j, i]
            m = fraction[k, j, i] + fraction[c, b, a]  # one of them is 0, or both
    else:
        mean = 0.5 * (fraction[k, j, i] + fraction[c, b, a])
        less = wp.min(fraction[k, j, i], fraction[c, b, a])
        if less < SURFACE and wp.max(fraction[k, j, i], fraction[c, b, a]) >= SURFACE:
            mean += 0.5 * less
        if mean > LEAST_FRACTION:
            m = wp.max(mean, LEAST_MASS)
            light = 1.0 / m
            u = velocity[k, j, i]
            if openings:
                open = openings[axis, k, j, i]
                light = 1.0 / wp.max(open * m, LEAST_MASS)
                if open == 0.0:
                    m = 0.0
                    light = 0.0
                    u = 0.0
    mass[k, j, i] = m
    inverse[k, j, i] = light
    start[k, j, i] = u


@cell_kernel("granular.packing")
def front_kernel(
    k,
    j,
    i,
    dimension: int,
    rate: float,
    openings: _F32X,
    mass: Faces,
    start: Faces,
    fraction: F32,
    swept: F32,
    drive: F32,
):
    """Close cells that only the mass flux of translating sand would compress.

    Where a front of sand moves through a cell, its profile is smooth over two cells, and the flux
    of its mass through the faces, a central difference, fills the cell beyond its free volume
    although nothing is compressed. Such a cell counts as full: only its volume is kept then.

    Where moving walls free space in a cell at the rate `swept` [m/s], the last layer of `openings`
    gets the part of it that counts for the cell's sand: all in full cells, its fraction in loose
    ones, as on faces. Cells filled less than the surface have no pressure: walls that close them
    take at most their free volume. A sliver of a cell with a few grains would otherwise count as
    full, and no face could let out what the walls sweep.
    """
    # w = drive + div(m' u) as in the snippet `divergence` of `sand.h`, at the velocity u before the
    # stresses, and div u; both times dx [m/s]. With drive = 0 the first becomes the second.
    free = drive[k, j, i]
    full = wp.clamp(1.0 - free / (rate * NEARLY), 0.0, 1.0)
    w = free
    volume = float(0.0)
    for axis in range(dimension):
        n = k + wp.where(axis == 2, 1, 0)
        m = j + wp.where(axis == 1, 1, 0)
        l = i + wp.where(axis == 0, 1, 0)
        low, high = _component(start, axis, k, j, i), _component(start, axis, n, m, l)
        below, above = _component(mass, axis, k, j, i), _component(mass, axis, n, m, l)
        if openings:
            low = low * openings[axis, k, j, i]
            high = high * openings[axis, n, m, l]
        w += (above + full * (1.0 - above)) * high - (below + full * (1.0 - below)) * low
        volume += high - low
    if swept:
        phi = fraction[k, j, i]
        w += (phi + full * (1.0 - phi)) * swept[k, j, i]
        volume += swept[k, j, i]
    if free > 0.0 and w < wp.min(volume, 0.0):
        drive[k, j, i] = 0.0
        full = float(1.0)
    if swept:
        phi = fraction[k, j, i]
        counted = (phi + full * (1.0 - phi)) * swept[k, j, i]
        if phi < SURFACE:
            counted = wp.max(counted, -drive[k, j, i])
        openings[2 * dimension, k, j, i] = counted


@wp.func
def _component(faces: Faces, axis: int, k: int, j: int, i: int):
    """Return the value of a component on a cell's lower face."""
    value = faces.x[k, j, i]
    if axis == 1:
        value = faces.y[k, j, i]
    if axis == 2:
        value = faces.z[k, j, i]
    return value


@cell_kernel("granular.packing")
def edge_kernel(
    k,
    j,
    first,
    end,
    alpha: int,
    beta: int,
    base: I8,
    flags: U8,
    inverse_alpha: F32,
    inverse_beta: F32,
    around: F32,
    share: F32,
):
    """Compute the weight of a copy on an edge.

    It is 1 / dense cells around the edge, or -1 / cells with a wall face that ends there, or 0.
    Where solids cut cells, it is multiplied by the open fraction around the edge.
    """
    ka = wp.where(alpha == 2, 1, 0)
    ja = wp.where(alpha == 1, 1, 0)
    ia = wp.where(alpha == 0, 1, 0)
    kb = wp.where(beta == 2, 1, 0)
    jb = wp.where(beta == 1, 1, 0)
    for i in range(first, end):
        f0 = inverse_alpha[k, j, i]
        f1 = inverse_alpha[k - kb, j - jb, i]
        g0 = inverse_beta[k, j, i]
        g1 = inverse_beta[k - ka, j - ja, i - ia]
        if f0 + f1 + g0 + g1 == 0.0:  # most edges: no face can move
            share[k, j, i] = 0.0
            continue
        solids, dense, held = int(0), int(0), int(0)
        for q in range(4):
            a, b = q & 1, q >> 1  # the cells around the edge: back along alpha, along beta
            flag = int(flags[k - a * ka - b * kb, j - a * ja - b * jb, i - a * ia])
            dense += flag & SHEARS_HERE
            if base[k - a * ka - b * kb, j - a * ja - b * jb, i - a * ia] == _SOLID:
                solids += 1
            else:
                across_alpha = (
                    base[k - (1 - a) * ka - b * kb, j - (1 - a) * ja - b * jb, i - (1 - a) * ia]
                    == _SOLID
                )
                across_beta = (
                    base[k - a * ka - (1 - b) * kb, j - a * ja - (1 - b) * jb, i - a * ia] == _SOLID
                )
                if across_alpha != across_beta:
                    held += flag & HOLDS
        weight = float(0.0)
        if solids == 0:
            if dense > 0 and f0 > 0.0 and f1 > 0.0 and g0 > 0.0 and g1 > 0.0:
                weight = float(SHEARS_HERE) / float(dense)
        elif held > 0:
            weight = -1.0 / float(held)
        if around:
            weight = weight * around[k, j, i]
        share[k, j, i] = weight


@cell_kernel("granular.packing")
def stiffness_kernel(
    k, j, i, dimension: int, flags: U8, inverse: Faces, share: Faces, openings: _F32X, stiff: F32
):
    """Compute the bound of the friction's step scale in a cell.

    It is the largest diagonal entry in the metric of the cell's yield set; 0 in cells without shear
    stress.
    """
    # Diagonal entries: 2 (1 / m_low + 1 / m_high) along an axis, times the square of its open part
    # with cut cells, and 4 share (sum of 1 / m of the four faces) at an edge. Masses are relative
    # to a full face.
    most = float(0.0)
    if int(flags[k, j, i]) & SHEARS_HERE:
        x = inverse.x[k, j, i] + inverse.x[k, j, i + 1]
        y = inverse.y[k, j, i] + inverse.y[k, j + 1, i]
        can = x > 0.0 and y > 0.0
        if openings:
            x = x * wp.pow(openings[dimension, k, j, i], 2.0)
            y = y * wp.pow(openings[dimension + 1, k, j, i], 2.0)
        most = 2.0 * wp.max(x, y)
        if dimension == 3:
            z = inverse.z[k, j, i] + inverse.z[k + 1, j, i]
            can = can and z > 0.0
            if openings:
                z = z * wp.pow(openings[dimension + 2, k, j, i], 2.0)
            most = wp.max(most, 2.0 * z)
        for b in range(2):
            for a in range(2):
                most = wp.max(
                    most, _edge(share.x, inverse.x, inverse.y, k, j + b, i + a, 0, 1, 0, 0, 0, 1)
                )
                if dimension == 3:
                    most = wp.max(
                        most,
                        _edge(share.y, inverse.x, inverse.z, k + b, j, i + a, 1, 0, 0, 0, 0, 1),
                    )
                    most = wp.max(
                        most,
                        _edge(share.z, inverse.y, inverse.z, k + b, j + a, i, 1, 0, 0, 0, 1, 0),
                    )
        if not can:
            most = 0.0
    stiff[k, j, i] = most


@wp.func
def _edge(
    share: F32,
    first: F32,
    second: F32,
    k: int,
    j: int,
    i: int,
    bk: int,
    bj: int,
    bi: int,
    ak: int,
    aj: int,
    ai: int,
):
    """Return 4 share times the sum of the inverse masses around an edge.

    0 on walls.
    """
    around = (
        first[k, j, i]
        + first[k - bk, j - bj, i - bi]
        + second[k, j, i]
        + second[k - ak, j - aj, i - ai]
    )
    return 4.0 * wp.max(share[k, j, i], 0.0) * around


@cell_kernel("granular.packing")
def span_kernel(k, j, first, end, flags: U8, own: I32):
    """Find the first and one past the last cell with sand in a row."""
    low = int(end)
    high = int(0)
    for i in range(first, end):
        if int(flags[k, j, i]) != 0:
            low = wp.min(low, i)
            high = i + 1
    own[k, j, 0] = low
    own[k, j, 1] = high


@cell_kernel("granular.packing")
def count_kernel(k, j, first, end, flags: U8, rows: F64):
    """Count the cells with sand in a row."""
    count = int(0)
    for i in range(first, end):
        if flags[k, j, i] != wp.uint8(0):
            count += 1
    rows[0, k, j] = wp.float64(count)


@cell_kernel("granular.packing")
def most_kernel(k, j, first, end, base: I8, capacity: F32, density: F32, rows: F64):
    """Find the largest fraction of a row's cells.

    Only cells with more than half of their kernel open count.
    """
    most = float(0.0)
    for i in range(first, end):
        if base[k, j, i] != _SOLID and capacity[k, j, i] > 0.5:
            most = wp.max(most, density[k, j, i] / capacity[k, j, i])
    rows[1, k, j] = wp.float64(most)


@list_kernel("granular.packing")
def fold_kernel(i, rows: F64, reduced: wp.array(dtype=wp.float64)):
    """Sum the rows' counts, and find the largest of their fractions.

    Both are exact in any order.
    """
    k = i // rows.shape[2]
    j = i - k * rows.shape[2]
    wp.atomic_add(reduced, 0, rows[0, k, j])
    wp.atomic_max(reduced, 1, rows[1, k, j])


@cell_kernel("granular.packing")
def widen_kernel(k, j, first, end, own: I32, wide: I32):
    """Widen the span of a row to the rows around it and one cell on both sides.

    The width is rounded up to whole SIMD vectors, within the range.
    """
    # Span [low, high) = [min of the spans - 1, max of the spans + 1) over the rows at most one
    # away, within [first, end); indices of cells.
    low = int(end)
    high = int(0)
    for c in range(wp.max(k - 1, 0), wp.min(k + 2, own.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, own.shape[1])):
            if own[c, b, 1] > 0:
                low = wp.min(low, own[c, b, 0])
                high = wp.max(high, own[c, b, 1])
    if high == 0:
        wide[k, j, 0] = 0
        wide[k, j, 1] = 0
    else:
        low = wp.max(low - 1, first)
        high = wp.min(high + 1, end)
        # Whole vectors of cells, which may extend to either side: the rest of a row costs as much
        # as a vector.
        more = (high - low + LANES - 1) / LANES * LANES - (high - low)
        right = wp.min(more, wp.max(end - 1 - high, 0))
        wide[k, j, 0] = wp.max(low - (more - right), first)
        wide[k, j, 1] = high + right
