# mypy: ignore-errors
"""Which solid closes how much of a face: what rigid bodies' coupling, forces on solids and drag along walls ask alike."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I16, I32, cell_below, of_axis
from warp_lcp.grid.cut_cells_kernels import Moving, moving_part, open_face


@wp.struct
class Walls:
    """What solids leave open, see `warp_lcp.grid.cut_cells`; of whole cells `index` says it, see `warp_lcp.grid.voxelize`."""

    planes: int
    spacing: wp.float64
    origin: wp.vec3i  # cells of a larger grid before the first one of this
    index: I32  # without cut cells
    distance: F32  # of nodes from the solids [cells], with cut cells
    moving: Moving  # where a solid moves
    open_x: F32
    open_y: F32
    open_z: F32
    wall_x: I16
    wall_y: I16
    wall_z: I16
    number_x: I16  # of thin solids that cross faces, with barriers, see `warp_lcp.grid.barriers`
    number_y: I16
    number_z: I16
    # and how far they are from the centers of the cells below and above a face [cells]
    below_x: F32
    below_y: F32
    below_z: F32
    above_x: F32
    above_y: F32
    above_z: F32


@wp.func
def fields_on(S: Walls, axis: int, k: int, j: int, i: int):
    """Return the open fraction of a face among cut cells, and the number of the solid that closes it."""
    free = of_axis(axis, S.open_x, S.open_y, S.open_z, k, j, i)
    wall = of_axis(axis, S.wall_x, S.wall_y, S.wall_z, k, j, i)
    return free, int(wall)


@wp.func
def crossing_on(S: Walls, axis: int, k: int, j: int, i: int):
    """Return the thin solid that crosses a face, 0 if none does, and its distance from the cells below and above [cells]."""
    number = of_axis(axis, S.number_x, S.number_y, S.number_z, k, j, i)
    below = of_axis(axis, S.below_x, S.below_y, S.below_z, k, j, i)
    above = of_axis(axis, S.above_x, S.above_y, S.above_z, k, j, i)
    return int(number), below, above


@wp.func
def reach_across(S: Walls, axis: int, k: int, j: int, i: int):
    """Return the area of a cell's side of thin solids, across an axis, in faces: what they cut off another cell is its."""
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
def moving_on(S: Walls, axis: int, k: int, j: int, i: int):
    """Return the open fraction of a face, the moving solid that covers it, 0 if none does, and its part of what is not open."""
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
def moves(S: Walls, solid: int):
    """Return whether a solid moves."""
    found = bool(False)
    if S.moving.moves:
        found = S.moving.moves[wp.max(solid, 0)] != wp.uint8(0)
    return found


@wp.func
def standing_of(S: Walls, k: int, j: int, i: int):
    """Return the solid that stands still and closes the most of a face of a cut cell; 0, the domain, if none does."""
    found = int(0)
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
            found = wall
    return found


@wp.func
def closed_on(S: Walls, axis: int, k: int, j: int, i: int):
    """Return an owner and its share of a face, the share of what stands in the cell (`standing_of`), and a solid that moves and its share.

    Of a domain's face solids have the part that they cover.
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
        if free < 1.0:
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
def wall_way(S: Walls, k: int, j: int, i: int):
    """Return the way from a cut cell's center to the nearest point of the solids' surface [cells]."""
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
def cell_center(S: Walls, k: int, j: int, i: int):
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
def face_center(S: Walls, axis: int, k: int, j: int, i: int):
    """Return the center of a lower face [m], z = 0 in 2-D."""
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
    """Write entry e: an impulse on a solid, and its moment with a lever."""
    turn = wp.cross(lever, force)
    owners[e] = solid
    for n in range(3):
        values[e, n] = force[n]
        values[e, 3 + n] = turn[n]
