# mypy: ignore-errors
"""Kernels of faces and cells beside thin solids.

They find the faces that thin solids cross, and the share of each cell's density kernel that its
center sees.
"""

import warp as wp

from warp_lcp.grid.barrier_geometry import (
    CENTERS,
    INSIDE,
    REACH,
    SHIFTS,
    TURNS,
    Barrier,
    nearest_wall,
    place_of,
    sees,
    sight_code,
    sight_of,
    wall_between,
)
from warp_lcp.grid.cell_kernel import (
    F32,
    I8,
    I16,
    I32,
    INTS,
    U8,
    cell_below,
    cell_kernel,
    next_to,
    of_axis,
    spline,
)
from warp_lcp.grid.cut_cells_kernels import corner
from warp_lcp.grid.signed_distance_kernels import FAR
from warp_lcp.grid.thin_walls_kernels import MESH, into_group
from warp_lcp.operators.grid_poisson import AIR, SOLID

MODULE = "warp_lcp.grid.barriers.faces"
MOVING = "warp_lcp.grid.barriers.moving"
WHOLE = "warp_lcp.grid.barriers.whole"

WIDEST = wp.constant(1.0)  # cells from a face's center up to which its open part may reach
HALVINGS = 10  # halvings of the interval that the end of a face's open part lies in
LEAST_OPEN = 0.02  # least open fraction of a crossed face
TIE = wp.constant(1.0e-3)  # cells by which distances of two cells to a solid may differ by rounding
STEPS = wp.constant(12)  # steps along a ray, in the integral of a cell's density kernel

_AIR, _SOLID = wp.constant(wp.int8(AIR)), wp.constant(wp.int8(SOLID))


@cell_kernel(MODULE)
def near_kernel(k, j, i, B: Barrier, near: U8):
    """Mark the cells that a thin solid is near."""
    found, _n, _d = nearest_wall(B, place_of(B, CENTERS, k, j, i), REACH * B.dx)
    near[k, j, i] = wp.where(found > 0, wp.uint8(1), wp.uint8(0))


@wp.func
def mesh_around(B: Barrier, x: wp.vec3):
    """Return the number of the solid whose mesh a point lies in, 0 if it lies in none.

    x is in m. In the frame of a group, p = R'(x - shift); in the mesh's own units, q = turn (p -
    shift) / radius. A point lies in a mesh where the winding number exceeds 1/2. Where meshes
    overlap, the last one counts.
    """
    result = int(0)
    for g in range(B.groups.shape[0]):
        group = B.groups[g]
        p = into_group(group.turn, group.shift, wp.vec3d(x))
        for s in range(group.first, group.end):
            shape = B.shapes[s]
            if shape.kind == MESH:
                q = wp.vec3((shape.turn * (p - shape.shift)) / shape.radius)
                query = wp.mesh_query_point_sign_winding_number(shape.mesh, q, FAR, 2.0, 0.5)
                if query.result and query.sign < 0.0:
                    result = shape.solid
    return result


@cell_kernel("warp_lcp.grid.barriers.meshes")
def inside_kernel(k, j, i, B: Barrier, near: U8):
    """Mark those cells near thin solids whose center lies in a mesh, by INSIDE."""
    if near[k, j, i] != wp.uint8(0):
        if mesh_around(B, place_of(B, CENTERS, k, j, i)) > 0:
            near[k, j, i] = wp.uint8(INSIDE)


@cell_kernel(MODULE)
def apart_kernel(k, j, i, B: Barrier, axis: int, apart: U8):
    """Mark places of a field that a solid separates from their lower neighbors.

    Bit d is set where a solid stands between a place and the one before it along axis d.
    """
    bits = int(0)
    if B.near[k, j, i] != wp.uint8(0):
        x = sight_of(B, axis, k, j, i)
        for d in range(B.planes + 1):
            c, b, a = next_to(d, -1, k, j, i)
            y = place_of(B, axis, c, b, a)
            if c >= 0 and b >= 0 and a >= 0:
                y = sight_of(B, axis, c, b, a)
            if not sees(B, x, y):
                bits = bits | (1 << d)
    apart[k, j, i] = wp.uint8(bits)


@wp.func
def open_center(B: Barrier, axis: int, nodes: F32, k: int, j: int, i: int):
    """Return the center [m] of the open part of a lower face that another solid cuts.

    The open part is the polygon of the open corners and of the zeros of the distance along the
    edges. The center is the mean of these points. `nodes` is the distance of the solids that cut
    cells, at the cells' lower nodes [cells].
    """
    # From the first corner; a corner is shifted along the two axes of the face.
    total = wp.vec3()
    count = float(0.0)
    for n in range(4):
        # Corners 0, 1, 3, 2 follow each other around the face.
        dk, dj, di = corner(axis, B.planes, n ^ (n >> 1))
        m = (n + 1) % 4
        ek, ej, ei = corner(axis, B.planes, m ^ (m >> 1))
        here = nodes[k + dk, j + dj, i + di]
        there = nodes[k + ek, j + ej, i + ei]
        start = wp.vec3(float(di), float(dj), float(dk))
        if here > 0.0:
            total += start
            count += 1.0
        if here * there < 0.0:
            way = wp.vec3(float(ei), float(ej), float(ek)) - start
            total += start + here / (here - there) * way
            count += 1.0
    middle = wp.vec3(0.5, 0.5, 0.5 * float(B.planes - 1))
    middle[axis] = 0.0
    result = place_of(B, axis, k, j, i)
    if count > 0.0:
        result += B.dx * (total / count - middle)
    return result


@cell_kernel(MODULE)
def cross_kernel(
    k,
    j,
    i,
    B: Barrier,
    axis: int,
    apart: U8,
    nodes: F32,
    open: F32,
    wall: I16,
    number: I16,
    below: F32,
    above: F32,
):
    """Close the lower faces that a solid crosses.

    It separates the centers of the two cells, or one of the centers lies in a mesh. On a face that
    another solid cuts the centers may lie in that solid, below the edge of the thin one. Then the
    path through the open part decides.
    Faces of the domain keep their state. `below` and `above` are the distances [cells] to the solid
    from the centers of the cells below and above a face.
    """
    found = int(0)
    lines = int(0)  # 1: a line from x to y; 2: back as well
    x = wp.vec3()
    y = wp.vec3()
    is_apart = (int(apart[k, j, i]) >> axis) & 1 != 0
    if is_apart or (open[k, j, i] > 0.0 and B.near[k, j, i] != wp.uint8(0)):
        if wall[k, j, i] != wp.int16(0):
            c, b, a = next_to(axis, -1, k, j, i)
            if is_apart:
                # Rounding may make a path miss a solid on whose surface one of its ends lies.
                lines = 2
                x = place_of(B, CENTERS, k, j, i)
                y = place_of(B, CENTERS, c, b, a)
            elif B.near[k, j, i] == wp.uint8(INSIDE) or B.near[c, b, a] == wp.uint8(INSIDE):
                found, _n, _d = nearest_wall(B, place_of(B, axis, k, j, i), REACH * B.dx)
            elif open[k, j, i] < 1.0:
                lines = 1
                middle = open_center(B, axis, nodes, k, j, i)
                half = wp.vec3()
                half[axis] = 0.5 * B.dx
                x = middle - half
                y = middle + half
    forth = float(1.0)
    back = float(1.0)
    for n in range(lines):
        solid, t = wall_between(B, x, y)
        if n == 0:
            found = solid
            forth = t
        else:
            back = t
        start = x
        x = y
        y = start
    if lines == 2 or found > 0:
        above[k, j, i] = 1.0
        below[k, j, i] = 1.0
        if is_apart:
            above[k, j, i] = wp.min(forth, 1.0)
            below[k, j, i] = wp.min(back, 1.0)
        if open[k, j, i] > 0.0:
            wall[k, j, i] = wp.int16(found)
        open[k, j, i] = 0.0
    number[k, j, i] = wp.int16(found)


@wp.struct
class CrossedFaces:
    """Fields of the faces of each component, see `warp_lcp.grid.barriers`; z is null in 2-D."""

    number_x: I16
    number_y: I16
    number_z: I16
    below_x: F32
    below_y: F32
    below_z: F32
    above_x: F32
    above_y: F32
    above_z: F32
    wall_x: I16
    wall_y: I16
    wall_z: I16


@wp.func
def number_on(C: CrossedFaces, axis: int, k: int, j: int, i: int):
    """Return the number of the solid that crosses a lower face, 0 without one."""
    return int(of_axis(axis, C.number_x, C.number_y, C.number_z, k, j, i))


@wp.func
def whole(C: CrossedFaces, axis: int, k: int, j: int, i: int):
    """Return whether no solid and no side of the domain closes a part of a lower face."""
    wall = of_axis(axis, C.wall_x, C.wall_y, C.wall_z, k, j, i)
    return wall == wp.int16(-1) and number_on(C, axis, k, j, i) == 0


@wp.func
def ends_within(C: CrossedFaces, axis: int, d: int, side: int, k: int, j: int, i: int):
    """Return whether a solid that crosses one of two neighboring faces ends between them.

    Of the four faces between the cells around their common edge it crosses only this one. The faces
    are a lower face and its neighbor along axis d, on the upper `side` (1) or the lower one (0).
    """
    c, b, a = next_to(axis, -1, k, j, i)
    z, y, x = next_to(d, side, k, j, i)
    w, v, u = next_to(d, side, c, b, a)
    return whole(C, d, z, y, x) and whole(C, d, w, v, u)


@wp.func
def way_to_wall(C: CrossedFaces, d: int, side: int, k: int, j: int, i: int):
    """Return the distance [cells] from a cell's center to a thin solid before the next one.

    The next cell is that along axis d, on the upper `side` (1) or the lower one (0). Without a
    solid the distance is WIDEST.
    """
    c, b, a = next_to(d, side, k, j, i)
    result = WIDEST
    if number_on(C, d, c, b, a) > 0:
        result = of_axis(d, C.above_x, C.above_y, C.above_z, c, b, a)
        if side == 1:
            result = of_axis(d, C.below_x, C.below_y, C.below_z, c, b, a)
    return wp.min(result, WIDEST)


@wp.func
def free_line(B: Barrier, axis: int, k: int, j: int, i: int, way: wp.vec3):
    """Return whether no thin solid stands on the line between two cells' centers.

    The cells are those of a lower face. The line is shifted by `way` [m].
    """
    c, b, a = next_to(axis, -1, k, j, i)
    lower = place_of(B, CENTERS, c, b, a) + way
    return sees(B, lower, place_of(B, CENTERS, k, j, i) + way)


@wp.func
def open_width(B: Barrier, C: CrossedFaces, axis: int, d: int, side: int, k: int, j: int, i: int):
    """Return the width [cells] of an open lower face from its center on, along axis d.

    It is the distance by which the line between the cells' centers can be shifted to one side until
    a thin solid stands in the way. The part of a neighboring cell before the solid, if its center
    is behind it, so belongs to this face. Half a cell if no solid is in the way.
    """
    c, b, a = next_to(axis, -1, k, j, i)
    z, y, x = next_to(d, 2 * side - 1, k, j, i)
    result = float(0.5)
    limit = wp.min(way_to_wall(C, d, side, k, j, i), way_to_wall(C, d, side, c, b, a))
    if limit < WIDEST or number_on(C, axis, z, y, x) > 0:
        if ends_within(C, axis, d, side, k, j, i):
            limit = 0.5  # the neighboring face has its own open part
        way = wp.vec3()
        low = float(0.0)
        high = limit
        steps = int(HALVINGS)  # a variable, so that the loop is not unrolled
        for step in range(steps):
            middle = wp.where(step == 0, 0.999 * high, 0.5 * (low + high))
            way[d] = B.dx * middle * float(2 * side - 1)
            if free_line(B, axis, k, j, i, way):
                low = middle
            else:
                high = middle
        result = 0.5 * (low + high)
        if low > 0.998 * limit:
            result = limit
    return result


@wp.func
def open_lines(B: Barrier, axis: int, samples: int, k: int, j: int, i: int):
    """Return the share of a lower face's lines that are free, and the mean shift of these [cells].

    The lines join the center planes of the two cells. `samples` is their number along each axis.
    """
    first = wp.where(axis == 0, 1, 0)
    second = wp.where(axis == 2, 1, 2)
    rows = wp.where(B.planes == 2, samples, 1)
    count = float(0.0)
    total = wp.vec3()
    for m in range(rows):
        for n in range(samples):
            way = wp.vec3()
            way[first] = (float(n) + 0.5) / float(samples) - 0.5
            if B.planes == 2:
                way[second] = (float(m) + 0.5) / float(samples) - 0.5
            if free_line(B, axis, k, j, i, B.dx * way):
                count += 1.0
                total += way
    return count / float(rows * samples), total / wp.max(count, 1.0)


@cell_kernel(MODULE)
def edge_kernel(
    k,
    j,
    i,
    B: Barrier,
    axis: int,
    C: CrossedFaces,
    fixed: wp.array(dtype=wp.uint8),
    samples: int,
    open: F32,
    sight: U8,
):
    """Set the open fraction of faces that a thin solid blocks in part.

    Without this the width of an opening would be a whole number of cells.

    - A solid crosses a face and ends before the next one: on both faces the free lines between the
      two cells are open.
    - A solid goes on beside the two cells of a face that is open: the face reaches as far as the
      solid (`open_width`), since the part of the next cell before the solid belongs to these cells.
      The fraction is then up to 1.5 along each axis.

    Where the solid goes on, with the widths w [cells] of `open_width` on the two sides of the
    center, and the product over the axes d of the face:

        open = max(prod_d (w_d,lower + w_d,upper), LEAST_OPEN).

    Otherwise open is the free share of `samples`^(dimension - 1) lines; on a crossed face it is 0
    if the share is below LEAST_OPEN. `sight` stores the mean place of the free lines of a crossed
    face: lines of sight end there.
    """
    code = wp.uint8(0)
    inside = i > 0 and j > 0 and i + 1 < open.shape[2] and j + 1 < open.shape[1]
    if B.planes == 2 and (k == 0 or k + 1 == open.shape[0]):
        inside = False
    if inside and B.near[k, j, i] != wp.uint8(0):
        solid = number_on(C, axis, k, j, i)
        free = whole(C, axis, k, j, i) and open[k, j, i] == 1.0
        known = fixed[solid] != wp.uint8(0)
        ends = bool(False)
        goes_on = bool(False)
        v, u, t = next_to(axis, -1, k, j, i)
        for d in range(B.planes + 1):
            if d != axis and (solid > 0 or free):
                for side in range(2):
                    c, b, a = next_to(d, 2 * side - 1, k, j, i)
                    other = number_on(C, axis, c, b, a)
                    z, y, x = next_to(d, side, k, j, i)
                    upper = number_on(C, d, z, y, x)
                    z, y, x = next_to(d, side, v, u, t)
                    lower = number_on(C, d, z, y, x)
                    alone = ends_within(C, axis, d, side, k, j, i)
                    if solid > 0:
                        ends = ends or (alone and whole(C, axis, c, b, a))
                    else:
                        known = known and fixed[other] * fixed[upper] * fixed[lower] != wp.uint8(0)
                        ends = ends or (other > 0 and alone)
                        goes_on = goes_on or (other > 0 and not alone) or upper + lower > 0
        if known and goes_on:
            area = float(1.0)
            for d in range(B.planes + 1):
                if d != axis:
                    width = float(0.0)
                    sides = int(2)  # a variable, so that the loop is not unrolled
                    for side in range(sides):
                        width += open_width(B, C, axis, d, side, k, j, i)
                    area *= width
            open[k, j, i] = wp.max(area, LEAST_OPEN)
            code = sight_code(axis, wp.vec3())
        elif known and ends:
            share, way = open_lines(B, axis, samples, k, j, i)
            if solid > 0 and share < LEAST_OPEN:
                share = float(0.0)
            if share > 0.0:
                open[k, j, i] = share
                code = sight_code(axis, way)
                if solid == 0:
                    code = sight_code(axis, wp.vec3())
    sight[k, j, i] = code


@cell_kernel(MODULE)
def solid_kernel(k, j, i, B: Barrier, ax: F32, ay: F32, az: F32, base: I8):
    """Mark cells whose faces are all closed as SOLID."""
    if B.near[k, j, i] != wp.uint8(0) and base[k, j, i] == _AIR:
        open = ax[k, j, i] + ax[k, j, i + 1] + ay[k, j, i] + ay[k, j + 1, i]
        if B.planes == 2:
            open += az[k, j, i] + az[k + 1, j, i]
        if open == 0.0:
            base[k, j, i] = _SOLID


@cell_kernel(MODULE)
def calm_kernel(k, j, i, near: U8, base: I8, calm: I8):
    """Copy the base of cells; mark cells near a thin solid as SOLID."""
    calm[k, j, i] = wp.where(near[k, j, i] != wp.uint8(0), _SOLID, base[k, j, i])


@wp.func
def beside(B: Barrier, x: wp.vec3, y: wp.vec3, way: wp.vec3):
    """Return whether a path from x to y, shifted sideways by `way`, is free."""
    free = bool(True)
    here = x
    lines = int(3)  # a variable, so that the loop is not unrolled
    for n in range(lines):
        there = x + way
        if n == 1:
            there = y + way
        if n == 2:
            there = y
        if free:
            free = sees(B, here, there)
        here = there
    return free


@cell_kernel(MODULE, ordered=True)
def gap_kernel(k, j, i, B: Barrier, axis: int, open: F32, number: I16, gaps: INTS):
    """Count the crossed faces of each solid that are beside a gap.

    A face has a gap if the way beside its center is free although the next face is closed as well.

    With the centers x and y of the two cells [m], four shifts s along each axis of the face are
    tried: 0.2 and 0.4 cells to either side. The way is free if each of the lines x -> x + s -> y +
    s -> y is.
    """
    if number[k, j, i] > wp.int16(0) and open[k, j, i] == 0.0:
        y = place_of(B, CENTERS, k, j, i)
        c, b, a = cell_below(axis, k, j, i)
        x = place_of(B, CENTERS, c, b, a)
        found = int(0)
        ways = int(4)  # a variable, so that the loop is not unrolled
        for d in range(B.planes + 1):
            if d != axis:
                for n in range(ways):
                    side = 2 * (n & 1) - 1
                    way = wp.vec3()
                    way[d] = B.dx * float(side) * wp.where(n < 2, 0.2, 0.4)
                    if beside(B, x, y, way):
                        c, b, a = next_to(d, side, k, j, i)
                        if open[c, b, a] == 0.0:
                            found = 1
        if found > 0:
            wp.atomic_add(gaps, int(number[k, j, i]), 1)


@wp.func
def kernel_along(way: wp.vec3, end: float, planes: int):
    """Return the integral of a cell's density kernel over a thin pyramid, up to a constant.

    The pyramid has its tip at the cell's center and is cut at `end` <= 1 of its length `way`
    [cells]: the integral of s^(d - 1) B(s x) B(s y) B(s z) over s from 0 to `end`.
    """
    total = float(0.0)
    step = end / float(STEPS)
    for n in range(STEPS):
        s = (float(n) + 0.5) * step
        w = s * spline(s * way[0]) * spline(s * way[1])
        if planes == 2:
            w *= s * spline(s * way[2])
        total += w * step
    return total


@cell_kernel(MODULE)
def ray_share_kernel(k, j, i, B: Barrier, rays: int, share: F32):
    """Find the share of a cell's density kernel that its center sees.

    What the center sees is star-shaped. So the kernel is integrated along rays, each up to the
    first solid: `rays` per edge of each side of the kernel's support, which is 3 cells wide. The
    share is then smooth in the distance of a wall; with points that are seen or not it had steps.

    With the quadratic B-spline B, a ray (x, y, z) [cells] and the place t <= 1 of the first solid
    on it, `kernel_along` returns in dimension d

        F(t) = integral of s^(d - 1) B(s x) B(s y) B(s z) over s from 0 to t,

    and share = sum of F(t) / sum of F(1) over the rays; in 2-D there is no factor of z.
    """
    result = float(1.0)
    if B.near[k, j, i] != wp.uint8(0):
        x = place_of(B, CENTERS, k, j, i)
        seen = float(0.0)
        all = float(0.0)
        step = 3.0 / float(rays)
        layers = wp.where(B.planes == 2, rays, 1)
        for side in range(2 * (B.planes + 1)):
            axis = side >> 1
            for c in range(layers):
                for b in range(rays):
                    way = wp.vec3()
                    way[axis] = 1.5 * float(2 * (side & 1) - 1)
                    way[(axis + 1) % (B.planes + 1)] = (float(b) + 0.5) * step - 1.5
                    if B.planes == 2:
                        way[(axis + 2) % 3] = (float(c) + 0.5) * step - 1.5
                    found, t = wall_between(B, x, x + B.dx * way)
                    all += kernel_along(way, 1.0, B.planes)
                    free = wp.where(found > 0, wp.clamp(t, 0.0, 1.0), 1.0)
                    seen += kernel_along(way, free, B.planes)
        result = seen / all
    share[k, j, i] = result


@cell_kernel("warp_lcp.grid.barriers.room")
def room_kernel(k, j, i, B: Barrier, room: F32):
    """Limit the distance of a cell to solids [cells] by that to thin solids.

    These count as thicker by half a cell on each side: then each line of cell centers that crosses
    one has a center in it.
    """
    reach = wp.max(room[k, j, i] + 0.5, 0.0)
    if reach > 0.0:
        reach = wp.min(reach, REACH)
        found, _n, d = nearest_wall(B, place_of(B, CENTERS, k, j, i), reach * B.dx)
        if found > 0:
            room[k, j, i] = wp.min(room[k, j, i], d / B.dx - 0.5)


@cell_kernel(MODULE)
def capacity_kernel(k, j, i, share: F32, cuts: bool, capacity: F32):
    """Reduce the open share of a cell's kernel to what its center sees.

    Solids that are thin in parts also cut cells (`cuts`): both shares leave out their inside.
    """
    both = capacity[k, j, i] * share[k, j, i]
    if cuts:
        both = wp.min(capacity[k, j, i], share[k, j, i])
    capacity[k, j, i] = both


@cell_kernel(MOVING)
def forget_kernel(k, j, i, number: I16, sight: U8, velocity: F32):
    """Clear the solids' velocity on faces that they no longer cross."""
    if number[k, j, i] > wp.int16(0) or sight[k, j, i] != wp.uint8(0):
        velocity[k, j, i] = 0.0


@cell_kernel(MOVING)
def wall_velocity_kernel(
    k, j, i, B: Barrier, axis: int, number: I16, turn: TURNS, shift: SHIFTS, velocity: F32
):
    """Fill the velocity of the solids on the faces that they cross or that they close in part."""
    solid = int(number[k, j, i])
    if solid == 0 and of_axis(axis, B.sight_x, B.sight_y, B.sight_z, k, j, i) != wp.uint8(0):
        solid, _n, _d = nearest_wall(B, place_of(B, axis, k, j, i), 1.5 * B.dx)
    if solid > 0:
        v = turn[solid] * place_of(B, axis, k, j, i) + shift[solid]
        velocity[k, j, i] = v[axis]


@cell_kernel(WHOLE, ordered=True)
def whole_kernel(k, j, i, axis: int, number: I16, below: F32, above: F32, index: I32):
    """Assign the open cell nearer to a crossing solid to that solid.

    Of two cells at about the same distance it is the upper one, at every place of the grid.
    """
    if number[k, j, i] > wp.int16(0):
        c, b, a = cell_below(axis, k, j, i)
        if above[k, j, i] <= below[k, j, i] + TIE:
            c = k
            b = j
            a = i
        if index[c, b, a] < 0:
            index[c, b, a] = int(number[k, j, i])
