# mypy: ignore-errors
"""Viscosity beside thin solids: links end at the solid and do not cross it."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, U8, cell_kernel
from warp_lcp.material.boundary_kernels import RELEASED
from warp_lcp.operators.grid_poisson import FLUID

MODULE = "fluids.viscosity_barriers"
HALF = wp.constant(0.5)  # cells from a face to a thin solid that separates it from its neighbor
_FLUID, _RELEASED = wp.constant(wp.int8(FLUID)), wp.constant(wp.uint8(RELEASED))
FLOATS = wp.array(dtype=wp.float32)
TURNS, SHIFTS = wp.array(dtype=wp.mat33), wp.array(dtype=wp.vec3)


@wp.func
def apart_below(apart: U8, axis: int, k: int, j: int, i: int):
    """Return whether a solid separates a place from the one before it along an axis."""
    return ((int(apart[k, j, i]) >> axis) & 1) == 1


@cell_kernel(MODULE)
def crossed_kernel(k, j, i, number: I16, slip: FLOATS, distance: F32, hold: F32):
    """Set the wall distance of faces that thin solids cross: they lie on the solid."""
    solid = int(number[k, j, i])
    if solid > 0:
        distance[k, j, i] = 0.0
        hold[k, j, i] = slip[solid]


@cell_kernel(MODULE)
def pull_kernel(
    k,
    j,
    i,
    axis: int,
    other: int,
    apart: U8,
    number: I16,
    volume: F32,
    thick: F32,
    kind: I8,
    contact: U8,
    tau: float,
    slip: FLOATS,
    turn: TURNS,
    shift: SHIFTS,
    origin: wp.vec3i,
    planes: int,
    dx: float,
    begins: int,
    weight: F32,
    speed: F32,
    owner: I16,
):
    """Sum up the links of a face to thin solids beside it along another axis.

    A link that a solid cuts ends at the solid, half a cell away, or behind it by the slip length.
    Its weight is tau V nu_rel / (1/2 + slip).

    Args:
        k: plane of the face.
        j: row of the face.
        i: place in its row.
        axis: axis of the component.
        other: axis along which the neighboring faces lie.
        apart: bits of the component's faces, see `warp_lcp.grid.barriers`.
        number: numbers of the solids that cross the faces of the component along `other`, 0 for
            none.
        volume: liquid fraction of each face's cube.
        thick: viscosity of cells, see `fluids.viscosity_transfer`; null if all are equal.
        kind: kind of cells.
        contact: contact of cells; RELEASED cells have no link to walls.
        tau: weight of a link.
        slip: slip length of each solid [cells].
        turn: a solid's point x moves at turn x + shift.
        shift: see `turn` [m/s].
        origin: cells of the larger grid before the first cell of this one.
        planes: 1 in 2-D, else 2.
        dx: edge of a cell [m].
        begins: whether `other` is the first of the other axes; earlier sums are then discarded.
        weight: total weight of the links (updated).
        speed: mean velocity of the solids along the axis [m/s] (updated).
        owner: number of one of the solids (updated).
    """
    total = float(0.0)
    moved = float(0.0)
    found = int(0)
    if begins == 0:
        found = int(owner[k, j, i])
        total = weight[k, j, i]
        moved = total * speed[k, j, i]
    back_k = wp.max(k - wp.where(axis == 2, 1, 0), 0)
    back_j = wp.max(j - wp.where(axis == 1, 1, 0), 0)
    back_i = wp.max(i - wp.where(axis == 0, 1, 0), 0)
    held = bool(False)
    released = bool(False)
    if kind[k, j, i] == _FLUID:
        held = contact[k, j, i] != _RELEASED
        released = not held
    if kind[back_k, back_j, back_i] == _FLUID:
        if contact[back_k, back_j, back_i] == _RELEASED:
            released = True
        else:
            held = True
    link = float(0.0)
    if held and not released:
        link = tau * volume[k, j, i]
        if thick:
            here = thick[k, j, i]
            below = thick[back_k, back_j, back_i]
            if here > 0.0 and below > 0.0:
                link *= 0.5 * (here + below)
            else:
                link *= here + below
    for side in range(2):
        c = k + wp.where(other == 2, side, 0)
        b = j + wp.where(other == 1, side, 0)
        a = i + wp.where(other == 0, side, 0)
        if c < apart.shape[0] and b < apart.shape[1] and a < apart.shape[2]:
            if apart_below(apart, other, c, b, a):
                back_c = wp.max(c - wp.where(axis == 2, 1, 0), 0)
                back_b = wp.max(b - wp.where(axis == 1, 1, 0), 0)
                back_a = wp.max(a - wp.where(axis == 0, 1, 0), 0)
                solid = wp.max(int(number[c, b, a]), int(number[back_c, back_b, back_a]))
                if solid > 0:
                    w = link / (HALF + slip[solid])  # 0 of a solid that lets it slip
                    cell = wp.vec3(float(i + origin[0]), float(j + origin[1]), float(k + origin[2]))
                    x = dx * (cell - wp.vec3(0.5, 0.5, 0.5))
                    x[axis] = x[axis] - 0.5 * dx
                    x[other] = x[other] + (float(side) - 0.5) * dx
                    if planes == 1:
                        x[2] = 0.0
                    found = solid
                    total += w
                    moved += w * (wp.dot(turn[solid][axis], x) + shift[solid][axis])
    owner[k, j, i] = wp.int16(found)
    weight[k, j, i] = total
    speed[k, j, i] = wp.where(total > 0.0, moved / wp.max(total, 1.0e-30), 0.0)


@cell_kernel(MODULE)
def part_kernel(k, j, i, a: int, b: int, apart_a: U8, apart_b: U8, edge: F32):
    """Cut the links across an edge of axes a and b at a thin solid."""
    if apart_below(apart_a, b, k, j, i) or apart_below(apart_b, a, k, j, i):
        edge[k, j, i] = 0.0


@cell_kernel(MODULE)
def mix_kernel(k, j, i, near: U8, cell: F32, mixed: F32):
    """Count all squares of the strain rate near thin solids.

    The products of different components vanish there, since their edges are cut.
    """
    if near[k, j, i] != wp.uint8(0):
        cell[k, j, i] = cell[k, j, i] + mixed[k, j, i]
        mixed[k, j, i] = 0.0
