# mypy: ignore-errors
"""Kernels of the unilateral pressure, which prevents overfull cells."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_kernel
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.boundary_kernels import HELD, LETS_GO, RELEASED, TOUCHES
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

# Density, relative to that at rest, from which a cell counts as full: less than 1 by more than the
# sampling noise.
FULL = 0.8
# Open share of a cell's kernel below which it has no density: single particles would dominate, as
# in `warp_lcp.grid.level_set`.
LEAST_SHARE = 0.25
# Least density of a face: the pressure of a full cell beside it would throw less mass about.
LEAST_DENSITY = 0.1

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))


@wp.struct
class UnilateralSetting:
    """Fields of a step: liquid, walls and velocities, the same for all cells."""

    planes: int
    density: F32
    capacity: F32
    cells: I8  # FLUID at unknowns
    base: I8
    u: F32  # u* of each component [m/s]
    v: F32
    w: F32
    open_x: F32  # open fractions of faces
    open_y: F32
    open_z: F32
    solid_x: F32  # flux due to solids [m/s]
    solid_y: F32
    solid_z: F32


@wp.func
def open_part(s: UnilateralSetting, open: F32, k: int, j: int, i: int, c: int, b: int, a: int):
    """Return the open fraction of the lower face of cell (k, j, i).

    Beyond the face lies cell (c, b, a).
    """
    part = float(1.0)
    if open:
        part = open[k, j, i]
    elif s.base[k, j, i] == _SOLID or s.base[c, b, a] == _SOLID:
        part = float(0.0)
    return part


@wp.func
def filled(s: UnilateralSetting, k: int, j: int, i: int):
    """Return the filled fraction of a cell, at most 1."""
    return wp.min(s.density[k, j, i] / (FULL * wp.max(s.capacity[k, j, i], LEAST_SHARE)), 1.0)


@wp.func
def face_density(s: UnilateralSetting, k: int, j: int, i: int, c: int, b: int, a: int):
    """Return the density on the face between two cells, relative to a full cell."""
    total = float(0.0)
    count = float(0.0)
    if s.base[k, j, i] != _SOLID:
        total += filled(s, k, j, i)
        count += 1.0
    if s.base[c, b, a] != _SOLID:
        total += filled(s, c, b, a)
        count += 1.0
    return wp.max(total / wp.max(count, 1.0), LEAST_DENSITY)


@wp.func
def passing(
    s: UnilateralSetting,
    u: F32,
    open: F32,
    solid: F32,
    k: int,
    j: int,
    i: int,
    c: int,
    b: int,
    a: int,
):
    """Return the flux q through the lower face of cell (k, j, i) [m/s].

    See `fluids.unilateral_pressure`: relative to the flux of full cells, including the volume that
    solids take.
    """
    part = open_part(s, open, k, j, i, c, b, a)
    flow = part * u[k, j, i]
    if flow > 0.0:
        flow = flow * filled(s, c, b, a)
    elif flow < 0.0:
        flow = flow * filled(s, k, j, i)
    if solid:
        flow += (1.0 - part) * solid[k, j, i]
    return wp.float64(flow)


@wp.func
def slack(s: UnilateralSetting, rate: wp.float64, settling: float, k: int, j: int, i: int):
    """Return y of a cell without the pressure: room, settling and net outflow [m/s].

    The equation is that of `fluids.unilateral_pressure`. The rate is dx / dt [m/s]. Settling is the
    speed c at which a full cell relaxes to the density at rest [m/s].
    """
    left = passing(s, s.u, s.open_x, s.solid_x, k, j, i, k, j, i - 1)
    right = passing(s, s.u, s.open_x, s.solid_x, k, j, i + 1, k, j, i)
    low = passing(s, s.v, s.open_y, s.solid_y, k, j, i, k, j - 1, i)
    high = passing(s, s.v, s.open_y, s.solid_y, k, j + 1, i, k, j, i)
    zero = wp.float64(0.0)
    inward = wp.max(left, zero) - wp.min(right, zero) + wp.max(low, zero) - wp.min(high, zero)
    y = right - left + high - low
    if s.planes == 2:
        back = passing(s, s.w, s.open_z, s.solid_z, k, j, i, k - 1, j, i)
        front = passing(s, s.w, s.open_z, s.solid_z, k + 1, j, i, k, j, i)
        inward += wp.max(back, zero) - wp.min(front, zero)
        y += front - back
    capacity = s.capacity[k, j, i]
    y += wp.max(rate, inward) * wp.float64(wp.max(capacity - s.density[k, j, i] / FULL, 0.0))
    if capacity >= LEAST_SHARE:
        y += wp.float64(settling * wp.clamp(capacity - s.density[k, j, i], FULL - 1.0, 1.0 - FULL))
    return y


@cell_kernel("fluids.unilateral_pressure")
def prepare_kernel(
    k,
    j,
    i,
    s: UnilateralSetting,
    rate: wp.float64,
    settling: float,
    kind: I8,
    last: F64,
    ratio: wp.float64,
    least: float,
    b: F64,
    start: F64,
    shift: F32,
):
    """Mark the unknowns; set right-hand side, first guess and diagonal shift.

    The shift is that of the open sides of the domain.
    """
    # b is y of the cell without pressure [m/s], see `slack`. The first guess is the last pressure
    # times `ratio`, at least 0. Each open side of the domain beside the cell adds its open fraction
    # a_f to the diagonal: the pressure beyond is 0, so that y gets a_f (x_i - 0).
    unknown = s.base[k, j, i] != _SOLID and kind[k, j, i] != _SOLID
    value = wp.float64(0.0)
    guess = wp.float64(0.0)
    if unknown:
        value = slack(s, rate, settling, k, j, i)
        guess = wp.max(last[k, j, i] * ratio, wp.float64(0.0))
    s.cells[k, j, i] = wp.where(unknown, _FLUID, _SOLID)
    b[k, j, i] = value
    start[k, j, i] = guess
    if shift:
        more = least
        if i == 1 and s.base[k, j, 0] == _AIR:
            more += open_part(s, s.open_x, k, j, i, k, j, i - 1)
        if i + 2 == b.shape[2] and s.base[k, j, i + 1] == _AIR:
            more += open_part(s, s.open_x, k, j, i + 1, k, j, i)
        if j == 1 and s.base[k, 0, i] == _AIR:
            more += open_part(s, s.open_y, k, j, i, k, j - 1, i)
        if j + 2 == b.shape[1] and s.base[k, j + 1, i] == _AIR:
            more += open_part(s, s.open_y, k, j + 1, i, k, j, i)
        if s.planes == 2:
            if k == 1 and s.base[0, j, i] == _AIR:
                more += open_part(s, s.open_z, k, j, i, k - 1, j, i)
            if k + 2 == b.shape[0] and s.base[k + 1, j, i] == _AIR:
                more += open_part(s, s.open_z, k + 1, j, i, k, j, i)
        shift[k, j, i] = more


@cell_kernel("fluids.unilateral_pressure")
def push_kernel(
    k, j, i, s: UnilateralSetting, axis: int, x: F64, open: F32, weight: F32, field: F32, known: I8
):
    """Apply the pressure gradient to open faces with particle weight.

    These faces are marked 1 in `known`, others 0, or -1 inside solids of whole cells.
    """
    # u -= (x_i - x_below) / f_f [m/s]: the pressure changes the momentum f_f u_f of the face.
    c = k - wp.where(axis == 2, 1, 0)
    b = j - wp.where(axis == 1, 1, 0)
    a = i - wp.where(axis == 0, 1, 0)
    mark = int(0)
    if a < 0 or b < 0 or c < 0:  # the lower faces of the ring lie in the wall
        mark = -1
    elif open_part(s, open, k, j, i, c, b, a) > 0.0:
        if weight[k, j, i] > TINY_WEIGHT:
            mark = 1
            # A source's cells are no unknowns, and the velocities of their faces are prescribed.
            if s.cells[k, j, i] != _SOLID and s.cells[c, b, a] != _SOLID:
                change = x[k, j, i] - x[c, b, a]
                field[k, j, i] -= wp.float32(change) / face_density(s, k, j, i, c, b, a)
    elif not open:
        if s.base[k, j, i] == _SOLID and s.base[c, b, a] == _SOLID:
            mark = -1
    known[k, j, i] = wp.int8(mark)


@cell_kernel("fluids.unilateral_pressure")
def contact_kernel(
    k,
    j,
    first,
    end,
    s: UnilateralSetting,
    rate: wp.float64,
    settling: float,
    kind: I8,
    touch: U8,
    x: F64,
    contact: U8,
    sums: F64,
    reduced: wp.array(dtype=wp.float64),
):
    """Set the contact of wall cells; sum released cells, and find the largest |y|.

    The sums are those of a row: its cells that release liquid, and the largest |y| of its full
    cells. If `reduced` is given, it gets the total and the maximum over all rows.
    """
    released = int(0)
    worst = wp.float64(0.0)
    for i in range(first, end):
        state = int(0)
        walls = int(touch[k, j, i])
        full = x[k, j, i] > wp.float64(0.0)
        if full or kind[k, j, i] == _FLUID:
            if (walls & TOUCHES) != 0:
                state = HELD
                if (walls & LETS_GO) != 0 and not full:
                    state = RELEASED
                    released += 1
        contact[k, j, i] = wp.uint8(state)
        if full:
            y = slack(s, rate, settling, k, j, i)
            worst = wp.max(worst, wp.abs(y))
    sums[k, j, 0] = wp.float64(released)
    sums[k, j, 1] = worst
    if reduced:
        wp.atomic_add(reduced, 0, wp.float64(released))
        wp.atomic_max(reduced, 1, worst)
