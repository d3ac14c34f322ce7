# mypy: ignore-errors
"""Kernels that even out the particles of cells deep inside the material."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I32, INTS, POINTS, U8, cell_kernel, list_kernel
from warp_lcp.material.boundary_kernels import TOUCHES
from warp_lcp.operators.grid_poisson import AIR

# Width of the uniform random displacement from the center of a part of a cell, as a fraction of
# the part's edge dx / 2: a particle lies up to JITTER dx / 4 from the center along each axis. It is
# the default width of the first particles.
JITTER = 0.25
# Fraction of the particles that the cells around a cell can hold. A cell with less around it is
# near a surface (a level one: 2/3), or in a bubble of more than a cell.
FULL = 0.75

_AIR = wp.constant(wp.int8(AIR))
_TOUCHES = wp.constant(wp.uint8(TOUCHES))


@wp.struct
class ReseedingParameters:
    """Wanted numbers of particles of a cell, and other settings of a step."""

    planes: int
    origin: wp.vec3i  # cells of a larger grid before the first one of this
    across: wp.vec2i  # stored cells of the larger grid along x and y
    dx: float
    inverse_dx: float
    least: int
    at_rest: int
    most: int


@cell_kernel("warp_lcp.material.reseeding")
def count_kernel(k, j, i, offsets: INTS, count: I32):
    """Count the particles of each cell from the offsets."""
    cell = (k * count.shape[1] + j) * count.shape[2] + i
    count[k, j, i] = offsets[cell + 1] - offsets[cell]


@cell_kernel("warp_lcp.material.reseeding", ordered=True)
def find_kernel(
    k,
    j,
    i,
    s: ReseedingParameters,
    count: I32,
    capacity: F32,
    base: I8,
    touch: U8,
    takers: INTS,
    numbers: INTS,
):
    """List open cells that want particles and whose surroundings are nearly full.

    No wall touches them. The surroundings include the cell itself. The order of the list differs
    from run to run on CUDA; it has no effect.
    """
    # Nearly full: sum of the particles >= FULL at_rest (sum of the capacities), over the open cells
    # among the 3^d around the cell. It wants particles if it has less than `least`, or less than
    # `at_rest` beside a cell with more than `most`.
    has = count[k, j, i]
    if has < s.at_rest and base[k, j, i] == _AIR and (touch[k, j, i] & _TOUCHES) == wp.uint8(0):
        held = int(0)
        crowd = int(0)
        room = float(0.0)
        for c in range(k - s.planes + 1, k + s.planes):
            for b in range(j - 1, j + 2):
                for a in range(i - 1, i + 2):
                    if base[c, b, a] == _AIR:
                        held += count[c, b, a]
                        crowd = wp.max(crowd, count[c, b, a])
                        room += capacity[c, b, a]
        if (has < s.least or crowd > s.most) and float(held) >= FULL * float(s.at_rest) * room:
            takers[wp.atomic_add(numbers, 0, 1)] = (k * count.shape[1] + j) * count.shape[2] + i


@wp.func
def emptiest(
    planes: int,
    cell: wp.vec3i,
    start: int,
    here: int,
    inverse_dx: float,
    position: wp.array(dtype=wp.vec3),
):
    """Return the part of a cell (x, y, z) with the fewest particles at the sort.

    There are 2^dimension parts. The cell's particles are `start` ... `start + here`.
    """
    part = int(0)
    fewest = int(1 << 30)
    for q in range(2 << planes):
        inside = int(0)
        for p in range(start, start + here):
            x = position[p] * inverse_dx + wp.vec3(1.0, 1.0, 1.0)
            bits = wp.where(x[0] - float(cell[0]) >= 0.5, 1, 0) + wp.where(
                x[1] - float(cell[1]) >= 0.5, 2, 0
            )
            if planes == 2:
                bits += wp.where(x[2] - float(cell[2]) >= 0.5, 4, 0)
            if bits == q:
                inside += 1
        if inside < fewest:
            fewest = inside
            part = q
    return part


# The particle in part (p_x, p_y, p_z) of cell (i, j, k), p = 0 or 1, is at
# x = (i - 1 + 1/4 + p_x / 2 + JITTER (r - 1/2) / 2) dx [m] with r uniform in [0, 1), and likewise y
# and z. The donor gives its particles from the last one backward, so that none is moved twice. The
# parts of the cell get one each in turn, from the emptiest on. Random numbers depend on the cell's
# number in the whole domain and on its count, and so are the same on any number of ranks.
@wp.func
def take_from(
    cell: int,
    way: wp.vec3i,
    seed: int,
    s: ReseedingParameters,
    offsets: INTS,
    count: I32,
    position: POINTS,
    numbers: INTS,
):
    """Move particles to a cell that wants some from the neighbor in one direction.

    There is no race, although a cell may be the neighbor of several takers: a giving cell holds
    more than `at_rest` before and no less after; a taking cell holds less before and no more after.
    """
    i = cell % count.shape[2]
    j = (cell // count.shape[2]) % count.shape[1]
    k = cell // (count.shape[2] * count.shape[1])
    dk, dj, di = way[0], way[1], way[2]
    planes, dx, least, at_rest, most = s.planes, s.dx, s.least, s.at_rest, s.most
    has = count[k, j, i]
    gives = count[k + dk, j + dj, i + di]
    if gives <= at_rest or (has >= least and (has >= at_rest or gives <= most)):
        return
    start = offsets[cell]
    here = offsets[cell + 1] - start
    other = cell + (dk * count.shape[1] + dj) * count.shape[2] + di
    donor = offsets[other]
    here_too = offsets[other + 1] > donor  # its particles: those of another rank's cell may not be
    place = wp.vec3i(i, j, k) + s.origin
    # The same number in all parts of a grid.
    own = (place[2] * s.across[1] + place[1]) * s.across[0] + place[0]
    first_part = emptiest(planes, place, start, here, s.inverse_dx, position)
    taken = int(0)
    while gives > at_rest and (has < least or (has < at_rest and gives > most)):
        part = (first_part + has - here) % (2 << planes)
        state = wp.rand_init(seed, own * 64 + has)
        x = (
            float(place[0] - 1)
            + 0.25
            + 0.5 * float(part % 2)
            + 0.5 * JITTER * (wp.randf(state) - 0.5)
        )
        y = (
            float(place[1] - 1)
            + 0.25
            + 0.5 * float((part // 2) % 2)
            + 0.5 * JITTER * (wp.randf(state) - 0.5)
        )
        z = (
            float(place[2] - 1)
            + 0.25
            + 0.5 * float(part // 4)
            + 0.5 * JITTER * (wp.randf(state) - 0.5)
        )
        if here_too:
            position[donor + gives - 1] = wp.vec3(
                x * dx, y * dx, wp.where(planes == 2, z * dx, 0.0)
            )
        gives -= 1
        has += 1
        taken += 1
    count[k, j, i] = has
    count[k + dk, j + dj, i + di] = gives
    wp.atomic_add(numbers, 1, taken)


@list_kernel("warp_lcp.material.reseeding")
def exchange_kernel(
    i,
    way: wp.vec3i,
    seed: int,
    s: ReseedingParameters,
    takers: INTS,
    offsets: INTS,
    count: I32,
    position: POINTS,
    numbers: INTS,
):
    """Move particles to each cell that wants some from the neighbor in one direction."""
    take_from(takers[i], way, seed, s, offsets, count, position, numbers)
