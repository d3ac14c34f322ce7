# mypy: ignore-errors
"""Exact geometry of thin solids: intersect paths, and stop particles.

All of it is float64: a particle keeps a distance of a thousandth of a cell from a wall, and that
must survive the transformation from the domain's coordinates into those of a shape and back.
"""

import warp as wp

from warp_lcp.grid.cell_kernel import POINTS, list_kernel

MODULE = "warp_lcp.grid.thin_walls"
BOX, SPHERE, CAPSULE, MESH = 0, 1, 2, 3
PUSHES = 4  # most times that a particle is moved off the solids that it starts in, each in turn
SLIDES = 12  # most walls along which a particle slides in a step
ROUNDS = 8  # most traces of a path among solids of different motions
ROOM = 0.25  # least distance in corners, as a fraction of the distance that particles keep
HALVINGS = 6  # most halvings of a path into a corner, until there is that room
MISS = 2.0  # parameter of a path beyond its end
ENDLESS = 1.0e30  # half extent [m] of an unbounded box

_ONE, _ZERO, _MISS = (
    wp.constant(wp.float64(1.0)),
    wp.constant(wp.float64(0.0)),
    wp.constant(wp.float64(MISS)),
)
_TINY = wp.constant(wp.float64(1.0e-300))


@wp.struct
class ThinShape:
    """Shape in the frame of its group.

    q = turn (p - shift) are the shape's own coordinates [m] of a point p of the group.
    """

    kind: int
    solid: int  # its solid's number
    turn: wp.mat33d
    shift: wp.vec3d
    half: wp.vec3d  # half extents of a box, axis of a capsule from its start [m]
    radius: wp.float64  # radius of a sphere or capsule; unit of length of a mesh [m]
    mesh: wp.uint64
    low: wp.vec3d  # corners of a box around it, in the group's frame [m]
    high: wp.vec3d


@wp.struct
class ThinGroup:
    """Shapes with one motion.

    A point p of the group is at x = turn p + shift, before and after a step.
    """

    first: int  # first of its shapes
    end: int
    turn_before: wp.mat33d
    shift_before: wp.vec3d
    turn: wp.mat33d
    shift: wp.vec3d
    low: wp.vec3  # corners of a box around its shapes after the step, with some room [m]
    high: wp.vec3


@wp.struct
class MovingBox:
    """Box around the shapes of a group that moves, with a margin, and the group's velocity.

    A point x of the group moves at turn x + shift.
    """

    low: wp.vec3d  # [m]
    high: wp.vec3d
    turn: wp.mat33d  # [1/s]
    shift: wp.vec3d  # [m/s]


SHAPES, GROUPS = wp.array(dtype=ThinShape), wp.array(dtype=ThinGroup)


@wp.func
def hit_box(a: wp.vec3d, d: wp.vec3d, half: wp.vec3d):
    """Intersect a path a + t d with a box; return t and the normal of the entry."""
    enter = -_MISS
    leave = _MISS
    axis = int(0)
    for k in range(3):
        size = wp.abs(d[k])
        if size < _TINY:
            if wp.abs(a[k]) > half[k]:
                leave = -_MISS * _MISS
        else:
            middle = -a[k] / d[k]
            reach = half[k] / size
            if middle - reach > enter:
                enter = middle - reach
                axis = k
            leave = wp.min(leave, middle + reach)
    n = wp.vec3d()
    n[axis] = -wp.sign(d[axis])
    t = enter
    if enter < _ZERO or enter > leave:
        t = _MISS
    return t, n


@wp.func
def hit_ball(a: wp.vec3d, d: wp.vec3d, radius: wp.float64):
    """Intersect a path with a ball about the origin."""
    t = _MISS
    dd = wp.dot(d, d)
    ad = wp.dot(a, d)
    rest = ad * ad - dd * (wp.dot(a, a) - radius * radius)
    if rest > _ZERO and dd > _TINY:
        s = (-ad - wp.sqrt(rest)) / dd
        if s >= _ZERO:
            t = s
    return t


@wp.func
def hit_capsule(a: wp.vec3d, d: wp.vec3d, axis: wp.vec3d, radius: wp.float64):
    """Intersect a path with a capsule from the origin along an axis.

    Returns the place on the path, and the normal there.

    The path is x = a + t d, in m, 0 <= t; the place is the least t at which it meets the ball about
    either end or the cylinder between them. The normal is x - clip(x . axis / |axis|^2, 0, 1) axis,
    normalized.
    """
    t = hit_ball(a, d, radius)
    t = wp.min(t, hit_ball(a - axis, d, radius))
    size = wp.dot(axis, axis)
    # The cylinder between the ends: the components of path and start across the axis.
    across = d - (wp.dot(d, axis) / size) * axis
    start = a - (wp.dot(a, axis) / size) * axis
    s = hit_ball(start, across, radius)
    if s < t:
        along = wp.dot(a + s * d, axis) / size
        if along >= _ZERO and along <= _ONE:
            t = s
    at = a + t * d
    n = at - wp.clamp(wp.dot(at, axis) / size, _ZERO, _ONE) * axis
    return t, wp.normalize(n)


@wp.func
def across_path(p: wp.vec3d, d: wp.vec3d, axis: int):
    """Project a point along a path d from the origin, onto the plane across a coordinate axis.

    Returns the place in the plane, rounded to float32, and the parameter t of the point along the
    path. Products of such places are exact in float64.
    """
    t = p[axis] / d[axis]
    k = (axis + 1) % 3
    m = (axis + 2) % 3
    x = wp.float64(wp.float32(p[k] - t * d[k]))
    y = wp.float64(wp.float32(p[m] - t * d[m]))
    return wp.vec3d(x, y, t)


@wp.func
def hit_mesh(a: wp.vec3d, d: wp.vec3d, unit: wp.float64, mesh: wp.uint64):
    """Intersect a path with a mesh, from either side.

    Returns the place on the path, and the normal there, against the path.

    No path slips through between triangles. The vertices are projected along the path, each to the
    same place for all its triangles. There, the path is the origin, and lies in a triangle if no
    two of the areas

        U = x_c y_b - y_c x_b, V = x_a y_c - y_a x_c, W = x_b y_a - y_b x_a

    have opposite signs. Places have 24 bits, so the signs are exact, and two triangles never both
    miss a path through their common edge. On the path, t = (U t_a + V t_b + W t_c) / (U + V + W) is
    continuous across edges. Thus the result is that of a closed surface whose vertices differ from
    the true ones by rounding (Woop, Benthin and Wald 2013, "Watertight ray/triangle intersection").
    """
    t = _MISS
    n = wp.vec3d()
    if wp.dot(d, d) > _TINY:
        p = a / unit
        way = d / unit
        q = p + way
        axis = int(0)
        for k in range(1, 3):
            if wp.abs(way[k]) > wp.abs(way[axis]):
                axis = k
        # Rounding to float32 is monotone and the vertices are float32: no triangle whose bounding
        # box meets that of the path is left out.
        query = wp.mesh_query_aabb(mesh, wp.vec3(wp.min(p, q)), wp.vec3(wp.max(p, q)))
        face = int(0)
        while wp.mesh_query_aabb_next(query, face):
            first = wp.vec3d(wp.mesh_get_point(mesh, 3 * face)) - p
            second = wp.vec3d(wp.mesh_get_point(mesh, 3 * face + 1)) - p
            third = wp.vec3d(wp.mesh_get_point(mesh, 3 * face + 2)) - p
            one = across_path(first, way, axis)
            two = across_path(second, way, axis)
            three = across_path(third, way, axis)
            u = three[0] * two[1] - three[1] * two[0]
            v = one[0] * three[1] - one[1] * three[0]
            w = two[0] * one[1] - two[1] * one[0]
            total = u + v + w
            least = wp.min(u, wp.min(v, w))
            most = wp.max(u, wp.max(v, w))
            if (least >= _ZERO or most <= _ZERO) and total != _ZERO:
                at = (u * one[2] + v * two[2] + w * three[2]) / total
                if at >= _ZERO and at <= _ONE and at < t:
                    t = at
                    n = wp.normalize(wp.cross(second - first, third - first))
                    if wp.dot(n, d) > _ZERO:
                        n = -n
    return t, n


@wp.func
def hit(shape: ThinShape, a: wp.vec3d, b: wp.vec3d):
    """Intersect the path from a to b with a shape.

    Returns the place of the entry on the path, and the normal there. The place is from 0 to 1,
    `MISS` if the path does not enter. Points are in the group's frame.
    """
    t = _MISS
    n = wp.vec3d()
    near = bool(True)
    for k in range(3):
        if wp.max(a[k], b[k]) < shape.low[k] or wp.min(a[k], b[k]) > shape.high[k]:
            near = False
    if near:
        q = shape.turn * (a - shape.shift)
        d = shape.turn * (b - a)
        if shape.kind == BOX:
            t, n = hit_box(q, d, shape.half)
        elif shape.kind == SPHERE:
            t = hit_ball(q, d, shape.radius)
            n = wp.normalize(q + t * d)
        elif shape.kind == CAPSULE:
            t, n = hit_capsule(q, d, shape.half, shape.radius)
        else:
            t, n = hit_mesh(q, d, shape.radius, shape.mesh)
        n = wp.transpose(shape.turn) * n
    if t > _ONE:
        t = _MISS
    return t, n


@wp.func
def away(shape: ThinShape, p: wp.vec3d, reach: wp.float64):
    """Return the distance [m] of a point from a shape, and the direction away from it.

    The distance is at most `reach`. A mesh has no inside here: its distance is that to its surface.
    """
    n = wp.vec3d()
    distance = reach
    near = bool(True)
    for k in range(3):
        if p[k] < shape.low[k] - reach or p[k] > shape.high[k] + reach:
            near = False
    if near:
        q = shape.turn * (p - shape.shift)
        if shape.kind == BOX:
            most = -wp.float64(ENDLESS)
            axis = int(0)
            beyond = wp.vec3d()
            for k in range(3):
                gap = wp.abs(q[k]) - shape.half[k]
                if gap > most:
                    most = gap
                    axis = k
                if gap > _ZERO:
                    beyond[k] = gap * wp.sign(q[k])
            distance = most
            n[axis] = wp.sign(q[axis])
            if most > _ZERO:
                distance = wp.length(beyond)
                n = beyond / distance
        elif shape.kind == MESH:
            query = wp.mesh_query_point_no_sign(
                shape.mesh, wp.vec3(q / shape.radius), float(reach / shape.radius)
            )
            if query.result:
                n = (
                    q
                    - wp.vec3d(wp.mesh_eval_position(shape.mesh, query.face, query.u, query.v))
                    * shape.radius
                )
                distance = wp.length(n)
                n = wp.normalize(n)
        else:
            n = q
            if shape.kind == CAPSULE:
                n = (
                    q
                    - wp.clamp(wp.dot(q, shape.half) / wp.dot(shape.half, shape.half), _ZERO, _ONE)
                    * shape.half
                )
            distance = wp.length(n) - shape.radius
            n = wp.normalize(n)
        n = wp.transpose(shape.turn) * n
    return distance, n


@wp.func
def in_plane(n: wp.vec3d, planes: int):
    """Project a normal onto the plane of a 2-D scene, at unit length or 0."""
    result = n
    if planes == 1:
        result = wp.normalize(wp.vec3d(n[0], n[1], _ZERO))
    return result


@wp.func
def first_hit(shapes: SHAPES, first: int, end: int, a: wp.vec3d, b: wp.vec3d, but: int):
    """Find the first of some shapes that the path from a to b enters.

    Returns the place, the normal there and the shape. The shape `but` is left out.
    """
    t = _MISS
    n = wp.vec3d()
    which = int(-1)
    for s in range(first, end):
        if s != but:
            at, normal = hit(shapes[s], a, b)
            if at < t:
                t = at
                n = normal
                which = s
    return t, n, which


@wp.func
def clear_of(
    shapes: SHAPES, first: int, end: int, p: wp.vec3d, margin: wp.float64, planes: int, inside: bool
):
    """Move a point off the shapes that are nearer than `margin`.

    With `inside`, only off those that it lies in. Returns the point, and whether it has moved.

    In m, for one shape after another, with its distance d and the direction n away from it:

        x <- x + (1.001 margin - d) n   where d < 0.999 margin, or d < 0 with `inside`.

    In 2-D n is taken within the plane.
    """
    x = p
    moved = bool(False)
    for s in range(first, end):
        d, n = away(shapes[s], x, margin)
        limit = margin * wp.float64(0.999)
        if inside:
            limit = _ZERO
        if d < limit:
            x = x + (margin * wp.float64(1.001) - d) * in_plane(n, planes)
            moved = True
    return x, moved


@wp.func
def has_room(shapes: SHAPES, first: int, end: int, p: wp.vec3d, room: wp.float64):
    """Return whether a point keeps a distance from some shapes."""
    result = bool(True)
    for s in range(first, end):
        d, _n = away(shapes[s], p, room)
        if d < room:
            result = False
    return result


@wp.func
def free_way(
    shapes: SHAPES,
    first: int,
    end: int,
    start: wp.vec3d,
    aim: wp.vec3d,
    margin: wp.float64,
    planes: int,
    slides_on: bool,
):
    """Return the end of a path from `start` towards `aim` among shapes at rest.

    Also returns whether a shape was in its way. The particle slides along the surface of each shape
    that it meets, at a distance of `margin` [m]. Each piece of its path is checked. If no further
    piece is free, it stops at the end of the last free one. Unless it `slides_on`, it stops at the
    first shape.
    """
    # Loops with variable counts are not unrolled: a twelfth of the code.
    pushes = int(PUSHES)
    slides = int(SLIDES)
    halvings = int(HALVINGS)
    x = start
    met = bool(False)
    for _push in range(pushes):
        x, more = clear_of(shapes, first, end, x, margin, planes, True)
        if more:
            met = True
    target = aim
    going = bool(True)
    for _slide in range(slides):
        if going:
            t, normal, which = first_hit(shapes, first, end, x, target, -1)
            n = in_plane(normal, planes)
            way = target - x
            if which >= 0:
                met = True
                p = x + t * way + margin * n
                # The other shapes, which are convex, and all of a mesh, which may have folds.
                blocked, _n, _which = first_hit(shapes, first, end, x + t * way, p, which)
                if shapes[which].kind == MESH:
                    folds, _n = hit(shapes[which], x, p)
                    blocked = wp.min(blocked, folds)
                room = wp.float64(ROOM) * margin
                if (
                    not slides_on
                    or blocked <= _ONE
                    or not has_room(shapes, first, end, p, room)
                    or wp.dot(n, n) < wp.float64(0.5)
                ):
                    # Corner of two walls: go as far as rounding does not take the place into one of
                    # the walls.
                    s = wp.max(t - margin / wp.max(wp.length(way), _TINY), _ZERO)
                    for half in range(halvings):
                        if not has_room(shapes, first, end, x + s * way, room):
                            s = wp.where(half == HALVINGS - 1, _ZERO, wp.float64(0.5) * s)
                    x = x + s * way
                    going = False
                else:
                    rest = (_ONE - t) * way
                    x = p
                    target = x + rest - wp.min(wp.dot(rest, n), _ZERO) * n
            else:
                target, near = clear_of(shapes, first, end, target, margin, planes, False)
                if near:
                    met = True
                else:
                    x = target
                    going = False
    return x, met


@wp.func
def passes_by(group: ThinGroup, x: wp.vec3, y: wp.vec3):
    """Return whether a path lies beside the box around a group's shapes after the step."""
    result = bool(False)
    for d in range(3):
        if wp.max(x[d], y[d]) < group.low[d] or wp.min(x[d], y[d]) > group.high[d]:
            result = True
    return result


@wp.func
def into_group(turn: wp.mat33d, shift: wp.vec3d, x: wp.vec3d):
    """Return the position of a point in the frame of a group."""
    return wp.transpose(turn) * (x - shift)


@list_kernel(MODULE)
def stop_kernel(
    i,
    start: POINTS,
    position: POINTS,
    shapes: SHAPES,
    groups: GROUPS,
    still: int,
    margin: wp.float64,
    planes: int,
    low: wp.vec3d,
    high: wp.vec3d,
):
    """Stop particles at thin solids on their way from `start` to `position`.

    A straight path is traced in the frame of each group, from the old place of its solids to the
    new one. This is exact for translations. Beside a solid that turns, the path differs from the
    true one by its bend, while its ends are exact. With `still` the solids have not moved. `low`
    and `high` are the corners of the box that particles may not leave.

    A particle may slide out of the box between a solid and a side of the box. The point of the box
    that is nearest may lie in the solid, so the path to that point is traced again. If this happens
    twice, the particle stops where it first meets a solid.

    Positions are in m. In the frame of a group the path leads from R0'(x - s0) to R1'(y - s1), with
    its rotations R and shifts s before and after the step; its end p becomes y = R1 p + s1. Groups
    are traced in turn until each leaves the end as it is, ROUNDS times each at most, because a
    changed end is a new path for the other groups.
    """
    x = wp.vec3d(start[i])
    y = wp.vec3d(position[i])
    count = groups.shape[0]
    agreed = int(0)  # groups that leave the end as it is, since it was last changed
    changed = bool(False)
    g = int(0)
    wedged = int(0)  # times that the path had to be shortened at a side of the box
    for _look in range(ROUNDS * count):
        if agreed < count:
            group = groups[g]
            turn = group.turn_before
            shift = group.shift_before
            if still != 0:
                turn = group.turn
                shift = group.shift
            end = wp.vec3d()
            met = bool(False)
            if still == 0 or not passes_by(group, wp.vec3(x), wp.vec3(y)):
                a = into_group(turn, shift, x)
                b = into_group(group.turn, group.shift, y)
                end, met = free_way(
                    shapes, group.first, group.end, a, b, margin, planes, wedged < 2
                )
            agreed += 1
            if met:
                slid = group.turn * end + group.shift
                y = wp.vec3d(
                    wp.clamp(slid[0], low[0], high[0]),
                    wp.clamp(slid[1], low[1], high[1]),
                    wp.clamp(slid[2], low[2], high[2]),
                )
                changed = True
                agreed = 1
                if y[0] != slid[0] or y[1] != slid[1] or y[2] != slid[2]:
                    wedged += 1
                    agreed = 0
            g = (g + 1) % count
    if changed:
        if planes == 1:
            y[2] = _ZERO
        position[i] = wp.vec3(y)


@list_kernel(MODULE)
def room_kernel(
    i,
    points: POINTS,
    shapes: SHAPES,
    groups: GROUPS,
    reach: wp.float64,
    room: wp.array(dtype=wp.float64),
):
    """Measure the distance of points from the nearest thin solid [m].

    It is at most `reach`; from a mesh it is measured to the surface on either side.
    """
    x = wp.vec3d(points[i])
    least = reach
    for g in range(groups.shape[0]):
        group = groups[g]
        p = into_group(group.turn, group.shift, x)
        for s in range(group.first, group.end):
            d, _n = away(shapes[s], p, reach)
            least = wp.min(least, d)
    room[i] = least


@list_kernel(MODULE)
def relative_speed_kernel(
    i,
    position: POINTS,
    velocity: POINTS,
    boxes: wp.array(dtype=MovingBox),
    speed: wp.array(dtype=wp.float64),
):
    """Compute the speed of a particle relative to the moving solids near it [m/s].

    It is |v - (turn x + shift)|, the largest of all boxes that the particle is in; 0 outside of
    all.
    """
    x = wp.vec3d(position[i])
    v = wp.vec3d(velocity[i])
    most = _ZERO
    for b in range(boxes.shape[0]):
        box = boxes[b]
        near = bool(True)
        for k in range(3):
            if x[k] < box.low[k] or x[k] > box.high[k]:
                near = False
        if near:
            most = wp.max(most, wp.length(v - (box.turn * x + box.shift)))
    speed[i] = most
