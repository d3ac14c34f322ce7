# mypy: ignore-errors
"""Lines of sight past thin solids, and the nearest solid of a point."""

import warp as wp

from warp_lcp.grid.cell_kernel import U8, of_axis
from warp_lcp.grid.thin_walls_kernels import GROUPS, MISS, SHAPES, away, hit, into_group, passes_by

CENTERS = 3  # the `axis` of a field at cell centers
# Cells from a cell's center to a solid that may stand between a particle in the cell and a face
# that it touches, or an end of the cell's kernel.
REACH = 2.8
INSIDE = 2  # value of `near` where a cell's center lies in a mesh
# Cells. Points within this distance of a surface count as in the solid; particles keep a larger
# distance.
SURFACE = 1.0e-6

CERTAIN = 1.0e-3  # cells by which a line must be shorter than the distance of its end from solids
SIGHTS = 15  # places along an axis of a face that a line of sight may end at

_MISS = wp.constant(wp.float64(MISS))
TURNS, SHIFTS = wp.array(dtype=wp.mat33), wp.array(dtype=wp.vec3)


@wp.struct
class Barrier:
    """Thin solids and their grid, as kernels take them."""

    shapes: SHAPES
    groups: GROUPS
    near: U8  # not 0 where one is within REACH of a cell's center; INSIDE: the center is in a mesh
    planes: int
    dx: float
    origin: wp.vec3i  # cells of a larger grid before the first one of this
    sight_x: U8  # see `warp_lcp.grid.barriers.Barriers.sight`
    sight_y: U8
    sight_z: U8


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
def sight_code(axis: int, way: wp.vec3):
    """Return a shift [cells] within a face along its two axes as a byte; never 0.

    Each shift, from -1/2 to 1/2, is rounded to one of SIGHTS values.
    """
    half = 0.5 * float(SIGHTS - 1)
    first = way[wp.where(axis == 0, 1, 0)]
    second = way[wp.where(axis == 2, 1, 2)]
    low = int(wp.clamp(wp.round((2.0 * first + 1.0) * half), 0.0, 2.0 * half))
    high = int(wp.clamp(wp.round((2.0 * second + 1.0) * half), 0.0, 2.0 * half))
    return wp.uint8(1 + low + SIGHTS * high)


@wp.func
def sight_of(B: Barrier, axis: int, k: int, j: int, i: int):
    """Return the point [m] of a lower face at which lines of sight end.

    It is the face's center, or that of the face's open part where a thin solid ends within it.
    """
    x = place_of(B, axis, k, j, i)
    if axis < CENTERS:
        code = int(of_axis(axis, B.sight_x, B.sight_y, B.sight_z, k, j, i))
        if code > 0:
            half = 0.5 * float(SIGHTS - 1)
            first = (float((code - 1) % SIGHTS) - half) / (2.0 * half)
            second = (float((code - 1) // SIGHTS) - half) / (2.0 * half)
            way = wp.vec3()
            way[wp.where(axis == 0, 1, 0)] = B.dx * first
            way[wp.where(axis == 2, 1, 2)] = B.dx * second
            x += way
    return x


@wp.func
def wall_between(B: Barrier, x: wp.vec3, y: wp.vec3):
    """Return the first solid on the path from x to y, and where on the path it is.

    The number is 0 if no solid is on the path. A solid that contains an end of the path counts.
    """
    t = _MISS
    found = int(0)
    for g in range(B.groups.shape[0]):
        group = B.groups[g]
        end = group.end
        if passes_by(group, x, y):
            end = group.first
        a = into_group(group.turn, group.shift, wp.vec3d(x))
        b = into_group(group.turn, group.shift, wp.vec3d(y))
        for s in range(group.first, end):
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
def room_at(B: Barrier, x: wp.vec3, reach: float):
    """Return the distance [m] of a point from the nearest solid, at most `reach`.

    It is negative in a solid that is not a mesh.
    """
    least = wp.float64(reach)
    for g in range(B.groups.shape[0]):
        group = B.groups[g]
        p = into_group(group.turn, group.shift, wp.vec3d(x))
        for s in range(group.first, group.end):
            d, _n = away(B.shapes[s], p, least)
            least = wp.min(least, d)
    return float(least)


@wp.func
def sees_from(B: Barrier, x: wp.vec3, y: wp.vec3, room: float):
    """Return whether no solid stands between two points, given the distance of one from solids.

    A line that is shorter than this distance `room` [m] need not be tested.
    """
    free = bool(True)
    if wp.length(y - x) + CERTAIN * B.dx > room:
        free = sees(B, x, y)
    return free


@wp.func
def nearest_wall(B: Barrier, x: wp.vec3, reach: float):
    """Return the nearest solid of a point within `reach` [m].

    Returns its number (0 if there is none), the direction away from it and the distance [m].
    """
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
