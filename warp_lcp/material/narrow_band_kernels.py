# mypy: ignore-errors
"""Kernels of the narrow band: depth of cells, exchange of particles, sums."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, F64, I8, I32, INTS, POINTS, U8, cell_kernel, list_kernel
from warp_lcp.kernels import KernelFile
from warp_lcp.material.boundary_kernels import RELEASED
from warp_lcp.operators.grid_poisson import FLUID, SOLID

NEAR = 1.0  # cells from a solid inside the domain within which particles stay
INSET = 1e-3  # least distance of new particles from a cell's faces [cells]
COLUMNS = 15  # columns of a row's sums, see `sum_kernel`

_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))
_RELEASED = wp.constant(wp.uint8(RELEASED))

KERNELS = KernelFile(Path(__file__).parent / "headers/particle_models.h")
RELAX = KERNELS["warp_lcp.material.narrow_band.relax_depth"]


@wp.func
def solid_inside(distance: F32, k: int, j: int, i: int, planes: int):
    """Return whether a solid is near one of a cell's corners.

    The domain's walls are not in the distance.
    """
    result = bool(False)
    for c in range(planes):
        for b in range(2):
            for a in range(2):
                if distance[k + c, j + b, i + a] < NEAR:
                    result = True
    return result


@cell_kernel("warp_lcp.material.narrow_band")
def shore_kernel(
    k,
    j,
    i,
    planes: int,
    most: float,
    kind: I8,
    phi: F32,
    contact: U8,
    keep: I8,
    distance: F32,
    thin: U8,
    depth: F32,
):
    """Initialize the depth of a cell.

    It is -phi in air, 0 where particles stay for another reason, and unknown elsewhere, solids
    included.
    """
    value = most
    if kind[k, j, i] == _FLUID:
        if contact[k, j, i] == _RELEASED:
            value = 0.0
        if keep:
            if keep[k, j, i] != wp.int8(0):
                value = 0.0
        if distance:
            if solid_inside(distance, k, j, i, planes):
                value = 0.0
        if thin:
            if thin[k, j, i] != wp.uint8(0):
                value = 0.0
    elif kind[k, j, i] != _SOLID:
        value = -0.5
        if phi:
            value = -wp.clamp(phi[k, j, i], 0.0, 1.0)
    depth[k, j, i] = value


@cell_kernel("warp_lcp.material.narrow_band")
def fill_kernel(k, j, i, least: float, filled: float, depth: F32, capacity: F32, density: F32):
    """Set the density of cells deeper than `least` to `filled` times their open share."""
    if depth[k, j, i] >= least:
        room = float(1.0)
        if capacity:
            room = capacity[k, j, i]
        density[k, j, i] = filled * room


@cell_kernel("warp_lcp.material.narrow_band")
def blend_kernel(
    k,
    j,
    first,
    end,
    axis: int,
    start: float,
    full_weight: float,
    depth: F32,
    base: I8,
    carried: F32,
    field: F32,
    weight: F32,
):
    """Blend the carried velocity into the faces, over one cell from depth `start` on."""
    # u += s (u_carried - u) [m/s] with s = clip(d - start, 0, 1), where d is the mean depth of the
    # open cells beside the face [cells]. A face without particles takes u_carried wherever s > 0.
    c = wp.max(k - wp.where(axis == 2, 1, 0), 0)
    b = wp.max(j - wp.where(axis == 1, 1, 0), 0)
    for i in range(wp.max(first, 1), end):
        a = i - wp.where(axis == 0, 1, 0)
        here = base[k, j, i] != _SOLID
        below = base[c, b, a] != _SOLID
        mean = float(-1.0)  # mean over the open cells beside the face
        if here and below:
            mean = 0.5 * (depth[k, j, i] + depth[c, b, a])
        elif here:
            mean = depth[k, j, i]
        elif below:
            mean = depth[c, b, a]
        share = wp.clamp(mean - start, 0.0, 1.0)
        if share > 0.0:
            if weight[k, j, i] > 0.0:
                field[k, j, i] = field[k, j, i] + share * (carried[k, j, i] - field[k, j, i])
            else:
                field[k, j, i] = carried[k, j, i]
            weight[k, j, i] = wp.max(weight[k, j, i], full_weight)


@wp.func
def renewed(now: float, before: float, width: float):
    """Return whether a cell gets fresh particles.

    These are cells at the band's inner edge, and cells that were below it and are now shallower,
    however near a new surface is.
    """
    return now <= width and (now > width - 1.0 or (now >= 0.0 and before > width - 1.0))


@wp.struct
class CellNumbering:
    """Numbering of cells that is the same in all parts of a grid."""

    origin: wp.vec3i  # cells (x, y, z) of a larger grid before the first one of this
    across: wp.vec2i  # stored cells of the larger grid along x and y


@wp.func
def number_of(where: CellNumbering, k: int, j: int, i: int):
    """Return the number of a stored cell in the larger grid."""
    return (
        ((k + where.origin[2]) * where.across[1] + j + where.origin[1]) * where.across[0]
        + i
        + where.origin[0]
    )


@cell_kernel("warp_lcp.material.narrow_band")
def quota_kernel(
    k,
    j,
    i,
    where: CellNumbering,
    width: float,
    particles: float,
    seed: int,
    shift: float,
    base: I8,
    depth: F32,
    before: F32,
    quota: I32,
):
    """Set the number of fresh particles of each cell.

    It is `particles` on average: over the cells by a random offset and, as `shift` advances, over
    the steps.
    """
    count = int(0)
    if base[k, j, i] != _SOLID and renewed(depth[k, j, i], before[k, j, i], width):
        cell = number_of(where, k, j, i)
        count = int(particles + 0.9999 * wp.frac(wp.randf(wp.rand_init(seed, cell)) + shift))
    quota[k, j, i] = count


@list_kernel("warp_lcp.material.narrow_band")
def leave_kernel(
    i,
    width: float,
    key: INTS,
    depth: wp.array(dtype=wp.float32),
    before: wp.array(dtype=wp.float32),
    marks: INTS,
):
    """Mark the particles of cells below the band, and of cells that get fresh ones."""
    cell = key[i]
    now = depth[cell]
    marks[i] = wp.where(now > width or renewed(now, before[cell], width), 1, 0)


@wp.struct
class JitteredLattice:
    """A jittered lattice of sites in a cell, with a number of sites along each axis."""

    planes: int
    per_axis: int
    jitter: float
    seed: int
    dx: float


@cell_kernel("warp_lcp.material.narrow_band")
def seed_kernel(
    k,
    j,
    i,
    S: JitteredLattice,
    where: CellNumbering,
    shift_x: float,
    shift_y: float,
    shift_z: float,
    behind: int,
    ny: int,
    nx: int,
    total: INTS,
    position: POINTS,
):
    """Put a cell's fresh particles on its sites, moved through the cell by a shift.

    `total` is the inclusive prefix sum of the particles of cells.
    """
    planes, per_axis, seed, shift = S.planes, S.per_axis, S.seed, wp.vec3(shift_x, shift_y, shift_z)
    sites = per_axis * per_axis * wp.where(planes == 2, per_axis, 1)
    here = (k * ny + j) * nx + i
    start = total[here - 1]
    count = total[here] - start
    cell = number_of(where, k, j, i)
    if count > 0:
        own = wp.rand_init(seed, cell)
        way = shift + wp.vec3(wp.randf(own), wp.randf(own), wp.randf(own))
        # First site of the cell.
        skip = int(wp.randf(own) * float(sites)) + int(shift[0] * float(sites))
        for n in range(count):
            site = (skip + n) % sites
            state = wp.rand_init(seed + 1, cell * 64 + n)
            x = wp.vec3(
                float(site % per_axis),
                float((site // per_axis) % per_axis),
                float(site // (per_axis * per_axis)),
            )
            x = (x + S.jitter * wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))) / float(
                per_axis
            ) + way
            x = wp.vec3(wp.frac(x[0]), wp.frac(x[1]), wp.frac(x[2])) * (
                1.0 - 2.0 * INSET
            ) + wp.vec3(INSET, INSET, INSET)
            at = wp.vec3i(i - 1, j - 1, k - 1) + where.origin
            x = (x + wp.vec3(float(at[0]), float(at[1]), float(at[2]))) * S.dx
            position[behind + start + n] = wp.vec3(x[0], x[1], wp.where(planes == 2, x[2], 0.0))


@cell_kernel("warp_lcp.material.narrow_band")
def sum_kernel(
    k,
    j,
    first,
    end,
    planes: int,
    width: float,
    base: I8,
    depth: F32,
    u: F32,
    v: F32,
    w: F32,
    sums: F64,
):
    """Sum up a row's cells that are deeper than the band.

    [0] cells, [1] |u|^2, [2-4] indices (i, j, k), [5] largest |u|^2, [6-8] lowest, [9-11] highest
    indices, [12-14] u.
    """
    count = int(0)
    squares = wp.float64(0.0)
    along = int(0)
    fastest = float(0.0)
    way = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    low = int(1 << 30)
    high = int(-1)
    for i in range(first, end):
        if depth[k, j, i] > width and base[k, j, i] != _SOLID:
            count += 1
            along += i
            low = wp.min(low, i)
            high = wp.max(high, i)
            mean = wp.vec3(u[k, j, i] + u[k, j, i + 1], v[k, j, i] + v[k, j + 1, i], 0.0)
            square = 0.5 * (u[k, j, i] * u[k, j, i] + u[k, j, i + 1] * u[k, j, i + 1])
            square += 0.5 * (v[k, j, i] * v[k, j, i] + v[k, j + 1, i] * v[k, j + 1, i])
            if planes == 2:
                mean[2] = w[k, j, i] + w[k + 1, j, i]
                square += 0.5 * (w[k, j, i] * w[k, j, i] + w[k + 1, j, i] * w[k + 1, j, i])
            squares += wp.float64(square)
            way += wp.vec3d(0.5 * mean)
            fastest = wp.max(fastest, square)
    sums[k, j, 0] = wp.float64(count)
    sums[k, j, 1] = squares
    sums[k, j, 2] = wp.float64(along)
    sums[k, j, 3] = wp.float64(count * j)
    sums[k, j, 4] = wp.float64(count * k)
    sums[k, j, 5] = wp.float64(fastest)
    sums[k, j, 6] = wp.float64(low)
    sums[k, j, 7] = wp.float64(wp.where(count > 0, j, 1 << 30))
    sums[k, j, 8] = wp.float64(wp.where(count > 0, k, 1 << 30))
    sums[k, j, 9] = wp.float64(high)
    sums[k, j, 10] = wp.float64(wp.where(count > 0, j, -1))
    sums[k, j, 11] = wp.float64(wp.where(count > 0, k, -1))
    for d in range(3):
        sums[k, j, 12 + d] = way[d]
