# mypy: ignore-errors
"""Open fraction of a face, and the solid that closes the rest."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I16, I32, cell_below, of_axis
from warp_lcp.grid.cut_cells_kernels import MovingSolids, moving_part, open_face


@wp.struct
class WallKernelFields:
    """Open fractions and numbers of the solids on faces and cells.

    See `warp_lcp.grid.cut_cells`; for whole cells `index` has the solids, see
    `warp_lcp.grid.voxelize`.
    """

    planes: int
    spacing: wp.float64
    origin: wp.vec3i  # offset of this grid's first cell in a larger grid
    index: I32  # null with cut cells
    distance: F32  # distance of nodes from the solids [cells]; only with cut cells
    moving: MovingSolids  # share and number of moving solids
    open_x: F32
    open_y: F32
    open_z: F32
    wall_x: I16
    wall_y: I16
    wall_z: I16
    number_x: I16  # thin solids that cross faces, see `warp_lcp.grid.barriers`
    number_y: I16
    number_z: I16
    # Their distances from the cells below and above a face [cells].
    below_x: F32
    below_y: F32
    below_z: F32
    above_x: F32
    above_y: F32
    above_z: F32


@wp.func
def fields_on(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the open fraction of a face of cut cells, and the closing solid."""
    free = of_axis(axis, S.open_x, S.open_y, S.open_z, k, j, i)
    wall = of_axis(axis, S.wall_x, S.wall_y, S.wall_z, k, j, i)
    return free, int(wall)


@wp.func
def crossing_on(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the thin solid that crosses a face, and its distances.

    0 without one. The distances are those from the cells below and above [cells].
    """
    number = of_axis(axis, S.number_x, S.number_y, S.number_z, k, j, i)
    below = of_axis(axis, S.below_x, S.below_y, S.below_z, k, j, i)
    above = of_axis(axis, S.above_x, S.above_y, S.above_z, k, j, i)
    return int(number), below, above


@wp.func
def reach_across(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the area of a thin solid's side toward a cell, across an axis [faces].

    The part of a neighbor that the thin solid cuts off belongs to the cell.
    """
    area = float(1.0)
    for d in range(S.planes + 1):
        if d != axis:
            crossed, _below, above = crossing_on(S, d, k, j, i)
            length = wp.where(crossed > 0, above, 0.5)
            crossed, below, _above = crossing_on(
                S,
                d,
                k + wp.where(d == 2, 1, 0),
                j + wp.where(d == 1, 1, 0),
                i + wp.where(d == 0, 1, 0),
            )
            area *= length + wp.where(crossed > 0, below, 0.5)
    return area


@wp.func
def moving_on(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return open fraction, moving solid and its share of a face.

    The solid is 0 if no moving one covers the face; the share is that of the closed part.
    """
    free = float(1.0)
    solid = int(0)
    part = float(0.0)
    if axis == 0:
        free = S.open_x[k, j, i]
        solid, part = moving_part(S.moving, 0, S.planes, k, j, i, S.open_x, S.wall_x)
    elif axis == 1:
        free = S.open_y[k, j, i]
        solid, part = moving_part(S.moving, 1, S.planes, k, j, i, S.open_y, S.wall_y)
    else:
        free = S.open_z[k, j, i]
        solid, part = moving_part(S.moving, 2, S.planes, k, j, i, S.open_z, S.wall_z)
    return free, solid, part


@wp.func
def moves(S: WallKernelFields, solid: int):
    """Return whether a solid moves."""
    found = bool(False)
    if S.moving.moves:
        found = S.moving.moves[wp.max(solid, 0)] != wp.uint8(0)
    return found


# The closed part of a face is 1 - its open fraction [faces]. Of equal parts the first counts, in
# the order low x, high x, low y, ...
@wp.func
def standing_of(S: WallKernelFields, k: int, j: int, i: int):
    """Return the standing solid with the largest closed part of a face of a cell.

    0, the domain, if none does.
    """
    owner = int(0)
    most = float(0.0)
    for n in range(2 * (S.planes + 1)):
        axis = n >> 1
        high = n & 1
        free, wall = fields_on(
            S,
            axis,
            k + wp.where(axis == 2, high, 0),
            j + wp.where(axis == 1, high, 0),
            i + wp.where(axis == 0, high, 0),
        )
        if wall > 0 and 1.0 - free > most and not moves(S, wall):
            most = 1.0 - free
            owner = wall
    return owner


# The three shares add up to the closed part: own + covered + moved = 1 - open fraction [faces]. The
# moving solid takes moved = (1 - open fraction) part. Of the rest on a side of the domain (owner
# 0), solids have what their distance closes, covered = 1 - open fraction of that distance - moved.
# If the owner itself is the moving solid, the rest belongs to the standing solid of the cell.
@wp.func
def closed_on(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the owner of a face, and the shares of the solids that close it.

    In this order: an owner and its share of a face, the share of the standing solid of the cell
    (`standing_of`), a moving solid and its share. Of a face of the domain's sides, solids have the
    part that they cover.
    """
    owner = int(-1)
    own = float(0.0)
    covered = float(0.0)
    mover = int(0)
    moved = float(0.0)
    if S.index:
        c, b, a = cell_below(axis, k, j, i)
        owner = wp.max(S.index[k, j, i], S.index[c, b, a])
        own = wp.where(owner >= 0, 1.0, 0.0)
    else:
        free, wall = fields_on(S, axis, k, j, i)
        owner = wall
        if free < 1.0 and wall >= 0:  # -1 beside the edge of a thin solid
            own = 1.0 - free
            if S.moving.moves:
                _free, solid, part = moving_on(S, axis, k, j, i)
                if solid > 0:
                    mover = solid
                    moved = own * part
                    own = own - moved
            if owner == 0:
                covered = wp.clamp(
                    1.0 - open_face(S.distance, axis, S.planes, k, j, i) - moved, 0.0, own
                )
                own = own - covered
            elif owner == mover:
                covered = own
                own = 0.0
    return owner, own, covered, mover, moved


@wp.func
def wall_way(S: WallKernelFields, k: int, j: int, i: int):
    """Return the vector from a cut cell's center to the solids' nearest point [cells]."""
    mean = float(0.0)
    slope = wp.vec3()
    corners = 4 * S.planes
    for n in range(corners):
        d = S.distance[k + (n >> 2), j + ((n >> 1) & 1), i + (n & 1)]
        mean += d / float(corners)
        slope += d * wp.vec3(
            float(2 * (n & 1) - 1),
            float(2 * ((n >> 1) & 1) - 1),
            wp.where(S.planes == 2, float(2 * (n >> 2) - 1), 0.0),
        )
    return -mean * wp.normalize(slope)


@wp.func
def cell_center(S: WallKernelFields, k: int, j: int, i: int):
    """Return the center of a cell [m], z = 0 in 2-D."""
    o = S.origin
    half = wp.float64(0.5)
    x = wp.vec3d(
        wp.float64(i + o[0]) - half, wp.float64(j + o[1]) - half, wp.float64(k + o[2]) - half
    )
    x = x * S.spacing
    if S.planes == 1:
        x[2] = wp.float64(0.0)
    return x


@wp.func
def face_center(S: WallKernelFields, axis: int, k: int, j: int, i: int):
    """Return the center of a cell's lower face [m], with z = 0 in 2-D."""
    o = S.origin
    half = wp.float64(0.5)
    x = wp.vec3d(
        wp.float64(i + o[0]) - half, wp.float64(j + o[1]) - half, wp.float64(k + o[2]) - half
    )
    x[axis] = x[axis] - half
    x = x * S.spacing
    if S.planes == 1:
        x[2] = wp.float64(0.0)
    return x


@wp.func
def put(
    e: int,
    solid: int,
    force: wp.vec3d,
    lever: wp.vec3d,
    owners: wp.array(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
):
    """Write entry e: an impulse on a solid, and its moment about a reference point.

    `lever` is the vector from the reference point.
    """
    turn = wp.cross(lever, force)
    owners[e] = solid
    for n in range(3):
        values[e, n] = force[n]
        values[e, 3 + n] = turn[n]
