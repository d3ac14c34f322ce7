# mypy: ignore-errors
"""Kernel of the pressure's force on thin solids.

The force acts on the vector area of the wall between cells.
"""

import warp as wp

from warp_lcp.fluids.wall_kernels import WallKernelFields, cell_center, crossing_on, fields_on, put
from warp_lcp.grid.cell_kernel import F64, INTS, U8, cell_kernel, next_to

OPEN = -1.0  # distance along an edge that no wall crosses
MIDWAY = 0.5  # cells: distance to other walls, which close a face between two cells
PASSES = 4  # passes over the corners of a cube, to find which are connected
# Share of a square by which the area in front of an inner corner exceeds that of a straight wall.
BENT = 0.02

_OPEN, _MIDWAY, _BENT = wp.constant(OPEN), wp.constant(MIDWAY), wp.constant(BENT)
Distances = wp.types.matrix(shape=(8, 3), dtype=wp.float32)
Numbers = wp.types.matrix(shape=(8, 3), dtype=wp.int32)


@wp.struct
class DualCell:
    """Cube (in 2-D the square) between the centers of neighboring cells.

    Bit `a` of a corner's number is set if the corner is the far one along axis a.
    """

    distance: Distances  # from a corner to the wall on the edge along an axis [cells], OPEN without
    number: Numbers  # number of the thin solid there, 0 for another wall
    sides: wp.vec3i  # direction of the far corners, 1 or -1
    planes: int


@wp.func
def edge_of(S: WallKernelFields, axis: int, side: int, k: int, j: int, i: int):
    """Return the distance from a cell's center to the wall before the next center.

    Also returns the number of the thin solid; the distance is OPEN without a wall.
    """
    c, b, a = next_to(axis, wp.where(side > 0, 1, 0), k, j, i)
    distance = _OPEN
    crossed, below, above = crossing_on(S, axis, c, b, a)
    if crossed > 0:
        distance = wp.where(side > 0, below, above)
    else:
        free, _wall = fields_on(S, axis, c, b, a)
        if free == 0.0:
            distance = _MIDWAY
    return distance, crossed


# Corner n is the center of cell (i, j, k) + (bits of n) * sides. distance[n, axis] is the distance
# from that center to the wall on the cube's edge along an axis [cells]; both corners of an edge
# have their own.
@wp.func
def cube_at(S: WallKernelFields, octant: int, k: int, j: int, i: int):
    """Return the cube between the centers of a cell and its neighbors in an octant.

    The cell is corner 0.
    """
    cube = DualCell()
    cube.planes = S.planes
    cube.sides = wp.vec3i(
        1 - 2 * (octant & 1), 1 - 2 * ((octant >> 1) & 1), 1 - 2 * ((octant >> 2) & 1)
    )
    for n in range(4 * S.planes):
        a = i + wp.where(n & 1 != 0, cube.sides[0], 0)
        b = j + wp.where(n & 2 != 0, cube.sides[1], 0)
        c = k + wp.where(n & 4 != 0, cube.sides[2], 0)
        for axis in range(S.planes + 1):
            side = wp.where((n >> axis) & 1 != 0, -cube.sides[axis], cube.sides[axis])
            distance, number = edge_of(S, axis, side, c, b, a)
            cube.distance[n, axis] = distance
            cube.number[n, axis] = number
    return cube


@wp.func
def connected(cube: DualCell):
    """Return the corners that edges without walls connect with corner 0, one bit each."""
    corners = int(1)
    for _pass in range(PASSES):
        for n in range(4 * cube.planes):
            if (corners >> n) & 1 != 0:
                for axis in range(cube.planes + 1):
                    if cube.distance[n, axis] == _OPEN:
                        corners = corners | (1 << (n ^ (1 << axis)))
    return corners


@wp.func
def open_length(cube: DualCell, corners: int, first: int, axis: int):
    """Return the length of an edge that belongs to the connected corners [cells]."""
    second = first ^ (1 << axis)
    length = float(0.0)
    if (corners >> first) & 1 != 0:
        length = wp.where(cube.distance[first, axis] == _OPEN, 1.0, cube.distance[first, axis])
    if (corners >> second) & 1 != 0 and cube.distance[second, axis] != _OPEN:
        length += cube.distance[second, axis]
    return length


@wp.func
def arc_area(count: int, a: float, b: float, alike: bool):
    """Return the area of a square around `count` corners in a row, between two walls.

    The walls are at a and b on the edges before and after these corners. A single solid is assumed
    to be straight between them; two solids meet at a right angle.
    """
    share = wp.where(alike, 0.5, 1.0)
    area = 0.5 * (a + b)
    if count == 1:
        area = share * a * b
    if count == 3:
        area = 1.0 - share * (1.0 - a) * (1.0 - b)
    return area


# slope = max(d_next - d_corner, 0) [cells per cell], with the distances d of the wall along `axis`
# from the corner and from the center next to it along `other`. It exists only if no wall separates
# these two centers, and if both edges cross a wall.
@wp.func
def lean(S: WallKernelFields, cube: DualCell, at: wp.vec3i, corner: int, axis: int, other: int):
    """Return the slope of a wall, from its distance at the next cell center.

    That center lies outside of the square.

    It is the increase of the wall's distance along `axis` from the corner to that center; `at` is
    the cell of corner 0. The slope is 0 for a wall along the other axis of the square, and -1 if
    there is no wall.
    """
    c, b, a = next_to(0, wp.where(corner & 1 != 0, cube.sides[0], 0), at[2], at[1], at[0])
    c, b, a = next_to(1, wp.where(corner & 2 != 0, cube.sides[1], 0), c, b, a)
    c, b, a = next_to(2, wp.where(corner & 4 != 0, cube.sides[2], 0), c, b, a)
    away = wp.where((corner >> other) & 1 != 0, cube.sides[other], -cube.sides[other])
    side = wp.where((corner >> axis) & 1 != 0, -cube.sides[axis], cube.sides[axis])
    result = float(-1.0)
    beyond = wp.vec3i(a, b, c)
    beyond[other] = beyond[other] + away
    if beyond[other] >= 0 and beyond[other] < S.open_x.shape[2 - other]:
        wall, _number = edge_of(S, other, away, c, b, a)
        if wall == _OPEN:
            distance, _number = edge_of(S, axis, side, beyond[2], beyond[1], beyond[0])
            if distance != _OPEN:
                result = wp.max(distance - cube.distance[corner, axis], 0.0)
    return result


@wp.func
def leans_of(S: WallKernelFields, cube: DualCell, at: wp.vec3i, corner: int, axis: int, other: int):
    """Return the slopes of the walls on two edges of a corner, see `lean`."""
    first = float(0.0)
    second = float(0.0)
    edges = int(2)  # a variable, so that the loop is not unrolled
    for n in range(edges):
        one = wp.where(n == 0, axis, other)
        slope = lean(S, cube, at, corner, one, axis + other - one)
        first = wp.where(n == 0, slope, first)
        second = slope
    return wp.vec2(first, second)


@wp.func
def corner_area(a: float, b: float, lean_a: float, lean_b: float):
    """Return the area between a center and walls at a and b along two axes.

    Walls x = a - lean_a y and y = b - lean_b x that meet beyond both points are the two sides of a
    corner. Otherwise, and where a slope is not known, a straight wall joins a and b.
    """
    area = 0.5 * a * b
    scale = 1.0 - lean_a * lean_b
    if lean_a >= 0.0 and lean_b >= 0.0 and scale > 0.0:
        x = (a - lean_a * b) / scale
        y = (b - lean_b * a) / scale
        if x >= 0.0 and y >= 0.0:
            area = wp.max(area, 0.5 * (a * y + b * x))
    return area


@wp.func
def open_area(
    S: WallKernelFields,
    cube: DualCell,
    at: wp.vec3i,
    corners: int,
    first: int,
    along: int,
    other: int,
):
    """Return the area of a square that belongs to the connected corners [cells^2].

    Walls on its edges divide its corners, in their order around the square, into arcs.
    """
    area = float(0.0)
    walls = int(0)
    four = int(4)  # a variable, so that the loop is not unrolled
    for n in range(four):
        here = first ^ wp.where(n == 1 or n == 2, 1 << along, 0) ^ wp.where(n > 1, 1 << other, 0)
        back = wp.where(n & 1 != 0, along, other)  # axis of the edge to the corner before
        if cube.distance[here, back] != _OPEN:
            walls += 1
            count = int(1)
            corner = int(here)
            ahead = wp.where((n + 1) & 1 != 0, along, other)
            for m in range(3):
                if count == m + 1 and cube.distance[corner, ahead] == _OPEN:
                    corner = corner ^ (1 << ahead)
                    ahead = wp.where((n + m) & 1 != 0, along, other)
                    count += 1
            if (corners >> here) & 1 != 0:
                number = cube.number[here, back]
                alike = number > 0 and number == cube.number[corner, ahead]
                a = cube.distance[here, back]
                b = cube.distance[corner, ahead]
                if count > 3:
                    area += 1.0
                elif count == 1 and alike:
                    leans = leans_of(S, cube, at, here, back, ahead)
                    area += corner_area(a, b, leans[0], leans[1])
                else:
                    area += arc_area(count, a, b, alike)
    if walls == 0 and (corners >> first) & 1 != 0:
        area = 1.0
    return area


@wp.func
def wall_area(S: WallKernelFields, cube: DualCell, at: wp.vec3i, corners: int, axis: int):
    """Return the component along an axis of the wall's vector area in the cube.

    The wall is the one around the connected corners; the vector points into it [cells, 3-D:
    cells^2]. The wall and the open parts of the cube's sides form a closed surface, so the wall's
    vector area is minus the sum of theirs.
    """
    along = (axis + 1) % (cube.planes + 1)
    difference = float(0.0)  # of the open parts of the near and the far side
    sides = int(2)  # a variable, so that the loop is not unrolled
    for n in range(sides):
        first = wp.where(n == 0, 0, 1 << axis)
        area = float(0.0)
        if cube.planes == 1:
            area = open_length(cube, corners, first, along)
        if cube.planes == 2:
            area = open_area(S, cube, at, corners, first, along, (axis + 2) % 3)
        difference = wp.where(n == 0, area, difference - area)
    return float(cube.sides[axis]) * difference


@wp.func
def is_bent(S: WallKernelFields, cube: DualCell, at: wp.vec3i, corner: int, axis: int, other: int):
    """Return whether the walls on two edges of a corner are two sides of an inner corner."""
    bent = bool(False)
    a = cube.distance[corner, axis]
    b = cube.distance[corner, other]
    if a != _OPEN and b != _OPEN:
        leans = leans_of(S, cube, at, corner, axis, other)
        bent = corner_area(a, b, leans[0], leans[1]) > (0.5 + _BENT) * a * b
    return bent


@wp.func
def shared_area(S: WallKernelFields, cube: DualCell, at: wp.vec3i, corners: int, crossed: int):
    """Return the vector area of the wall on an edge of corner 0, as a share, and its centroid.

    The centroid is a vector from the crossing [cells], 0 for plane walls.

    A plane wall of one solid is divided among all edges that it crosses: the pressure is linear, so
    its mean over the wall is that at the wall's centroid, and the mean of the crossings is the
    centroid of a segment or triangle. Where several walls meet, each component belongs to the walls
    on edges along its own axis; without such walls it is divided among all. A wall that ends at
    another one before the next edge has its centroid halfway to that.
    """
    counts = wp.vec3i()
    first = cube.number[0, crossed]
    plane = bool(first > 0)
    for n in range(4 * cube.planes):
        if (corners >> n) & 1 != 0:
            for axis in range(cube.planes + 1):
                if cube.distance[n, axis] != _OPEN:
                    counts[axis] = counts[axis] + 1
                    if cube.number[n, axis] != first:
                        plane = False
    if plane:
        for n in range(4 * cube.planes):
            if (corners >> n) & 1 != 0:
                for axis in range(cube.planes + 1):
                    if is_bent(S, cube, at, n, axis, (axis + 1) % (cube.planes + 1)):
                        plane = False
    total = counts[0] + counts[1] + counts[2]
    area = wp.vec3()
    for axis in range(cube.planes + 1):
        if plane or axis == crossed or counts[axis] == 0:
            sharing = wp.where(plane or counts[axis] == 0, total, counts[axis])
            area[axis] = wall_area(S, cube, at, corners, axis) / float(sharing)
    centroid = wp.vec3()
    if not plane:
        for axis in range(cube.planes + 1):
            if axis != crossed and cube.distance[0, axis] != _OPEN:
                centroid[axis] = 0.5 * float(cube.sides[axis]) * cube.distance[0, axis]
    return area, centroid


@cell_kernel("fluids.thin_forces")
def thin_pressure_kernel(
    k,
    j,
    first,
    end,
    S: WallKernelFields,
    references: wp.array(dtype=wp.vec3d),
    counts: INTS,
    offsets: INTS,
    owners: INTS,
    values: wp.array2d(dtype=wp.float64),
    touch: U8,
    x: F64,
    kick_x: float,
    kick_y: float,
    kick_z: float,
    scale: wp.float64,
):
    """Count where edges from a row's cells cross thin solids, or write impulses.

    An edge joins the centers of two cells. x is extrapolated along the edge to the wall, with the
    hydrostatic gradient, and acts on the wall's vector area in the cubes around the edge: the
    impulse is `scale` x per face.
    """
    # impulse = scale * sum over the octants beside the edge of (x + s d kick_axis + c . kick) A,
    # with s = +-1 along the edge, d the distance from the cell's center to the crossing [cells], A
    # the vector area [faces] and c its centroid from the crossing [cells] (`shared_area`); x and
    # kick [m/s] per cell. The impulse acts at the crossing.
    row = k * x.shape[1] + j
    begin = int(0)
    if values:
        begin = offsets[row]
    e = int(begin)
    kick = wp.vec3(kick_x, kick_y, kick_z)
    for i in range(first, end):
        if x[k, j, i] != wp.float64(0.0) and touch[k, j, i] != wp.uint8(0):
            for n in range(2 * (S.planes + 1)):
                axis = n >> 1
                side = 2 * (n & 1) - 1
                distance, solid = edge_of(S, axis, side, k, j, i)
                if solid > 0:
                    if values:
                        area = wp.vec3()
                        more = wp.vec3()  # x at the centroids beyond that at the crossing, and area
                        for octant in range(4 * S.planes):
                            if ((octant >> axis) & 1 != 0) == (side < 0):
                                cube = cube_at(S, octant, k, j, i)
                                part, centroid = shared_area(
                                    S, cube, wp.vec3i(i, j, k), connected(cube), axis
                                )
                                area += part
                                more += wp.dot(centroid, kick) * part
                        more += float(side) * distance * kick[axis] * area
                        place = cell_center(S, k, j, i)
                        way = wp.float64(float(side) * distance) * S.spacing
                        place[axis] = place[axis] + way
                        force = scale * (x[k, j, i] * wp.vec3d(area) + wp.vec3d(more))
                        put(e, solid, force, place - references[solid], owners, values)
                    e += 1
    counts[row] = e - begin
