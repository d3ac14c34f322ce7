"""Self-intersections of a closed surface, and parts inside other parts.

There the winding number is neither 0 nor 1. Two triangles cross where the segments that each shares
with the other's plane overlap. Parts that only touch, face to face or along edges, do so too;
therefore the winding numbers on the four sides of the crossing decide. A part that crosses no other
has the same winding number everywhere, so one of its triangles decides for it.
"""

import typing
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from warp_lcp.kernels.compiler import forward_kernel

MODULE = "warp_lcp.grid.mesh_crossings"
# Half diagonals of the mesh. Rounding of float64 coordinates hides smaller distances.
NEAR = wp.constant(1.0e-9)
# A common segment that is shorter counts as a point: vertices are equal within 1e-6.
SHORT = wp.constant(1.0e-5)
# Distance from the surface at which winding numbers are evaluated; float32 resolves it.
ASIDE = wp.constant(1.0e-4)
DOUBLED = wp.constant(1)
INVERTED = wp.constant(2)
# Points of the surface at which both sides are evaluated, to estimate the wrong share of it to 1 %.
SAMPLE = 4096


@dataclass(frozen=True)
class SelfIntersections:
    """Self-intersections of a surface.

    Attributes:
        count: triangles that cross others.
        place: the first crossing triangle, or else the first triangle of a part that lies inside
            another, in the mesh's units, shape (3,); None if the surface is correct.
        doubled: estimated share of the surface's area that lies inside the solid, between regions
            that are surrounded once and twice.
        inverted: estimated share of the area that is turned inside out, so that the volume it
            surrounds counts as outside.
    """

    count: int = 0
    place: np.ndarray | None = None
    doubled: float = 0.0
    inverted: float = 0.0


Points, Corners = wp.array(dtype=wp.vec3d), wp.array2d(dtype=wp.int32)


@wp.func
@typing.no_type_check
def triangle(points: Points, corners: Corners, t: int):
    """Return the corners of a triangle."""
    return points[corners[t, 0]], points[corners[t, 1]], points[corners[t, 2]]


@wp.func
@typing.no_type_check
def side_of(mesh: wp.uint64, point: wp.vec3d) -> int:
    """Return DOUBLED where the winding number exceeds 1, INVERTED where it is below 0.

    Otherwise returns 0.
    """
    x = wp.vec3(point)
    if wp.mesh_query_point_sign_winding_number(mesh, x, 1.0e10, 2.0, 1.5).sign < 0.0:
        return DOUBLED
    if wp.mesh_query_point_sign_winding_number(mesh, x, 1.0e10, 2.0, -0.5).sign > 0.0:
        return INVERTED
    return 0


@wp.func
@typing.no_type_check
def cut_by_plane(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, h: wp.vec3d, along: wp.vec3d):
    """Intersect a triangle with a plane.

    `h` are the heights of its corners above the plane. Returns the first and the last point along
    the direction `along`, and the number of points.

    An edge from p to q with heights h_p h_q < 0 meets the plane at x = p + (q - p) h_p / (h_p -
    h_q); a corner of height 0 is a point itself.
    """
    low = a
    high = a
    count = int(0)
    for side in range(3):
        p = wp.where(side == 0, a, wp.where(side == 1, b, c))
        q = wp.where(side == 0, b, wp.where(side == 1, c, a))
        hp = h[side]
        hq = h[(side + 1) % 3]
        x = p
        meets = hp == wp.float64(0.0)
        if hp * hq < wp.float64(0.0):
            x = p + (q - p) * (hp / (hp - hq))
            meets = True
        if meets:
            if count == 0 or wp.dot(x, along) < wp.dot(low, along):
                low = x
            if count == 0 or wp.dot(x, along) > wp.dot(high, along):
                high = x
            count += 1
    return low, high, count


@wp.func
@typing.no_type_check
def height(x: wp.vec3d, origin: wp.vec3d, normal: wp.vec3d, shared: bool) -> wp.float64:
    """Return the height of a point above a plane; 0 for a corner that lies in it."""
    h = wp.dot(x - origin, normal)
    return wp.where(shared or wp.abs(h) < wp.float64(NEAR), wp.float64(0.0), h)


@forward_kernel(module=MODULE)
@typing.no_type_check
def find_crossings(
    mesh: wp.uint64, points: Points, corners: Corners, crosses: wp.array(dtype=wp.uint8)
):
    """Mark the triangles that cross another one.

    With the unit normals n and m of two triangles, their planes meet along the direction n x m.
    Each triangle cuts an interval off that line; they cross where the common part is longer than
    SHORT, and where the winding number at one of the four points middle +- ASIDE n +- ASIDE m is
    neither 0 nor 1. Lengths are in half diagonals of the mesh. The winding numbers come last,
    for few pairs.
    """
    t = wp.tid()
    a, b, c = triangle(points, corners, t)
    n = wp.normalize(wp.cross(b - a, c - a))
    margin = wp.vec3d(wp.float64(1.0e-6))
    low = wp.vec3(wp.min(wp.min(a, b), c) - margin)
    high = wp.vec3(wp.max(wp.max(a, b), c) + margin)
    query = wp.mesh_query_aabb(mesh, low, high)
    other = int(0)
    while wp.mesh_query_aabb_next(query, other):
        if other == t or crosses[t] > wp.uint8(0):
            continue
        shared = int(0)
        ours = wp.vec3i(0)
        theirs = wp.vec3i(0)
        for i in range(3):
            for j in range(3):
                if corners[t, i] == corners[other, j]:
                    shared += 1
                    ours[i] = 1
                    theirs[j] = 1
        if shared >= 2:  # neighbors
            continue
        d, e, f = triangle(points, corners, other)
        m = wp.normalize(wp.cross(e - d, f - d))
        line = wp.cross(n, m)
        if wp.length(line) < wp.float64(1.0e-6):  # the planes are parallel
            continue
        along = wp.normalize(line)
        h = wp.vec3d(
            height(a, d, m, ours[0] == 1),
            height(b, d, m, ours[1] == 1),
            height(c, d, m, ours[2] == 1),
        )
        g = wp.vec3d(
            height(d, a, n, theirs[0] == 1),
            height(e, a, n, theirs[1] == 1),
            height(f, a, n, theirs[2] == 1),
        )
        low1, high1, found1 = cut_by_plane(a, b, c, h, along)
        low2, high2, found2 = cut_by_plane(d, e, f, g, along)
        if found1 < 2 or found2 < 2:
            continue
        first = low1
        if wp.dot(low2, along) > wp.dot(low1, along):
            first = low2
        last = high1
        if wp.dot(high2, along) < wp.dot(high1, along):
            last = high2
        if wp.dot(last - first, along) < wp.float64(SHORT):
            continue
        middle = (first + last) * wp.float64(0.5)
        trouble = int(0)
        for quadrant in range(4):
            s = wp.float64(ASIDE) * wp.where(quadrant % 2 == 0, wp.float64(1.0), wp.float64(-1.0))
            r = wp.float64(ASIDE) * wp.where(quadrant // 2 == 0, wp.float64(1.0), wp.float64(-1.0))
            trouble = wp.max(trouble, side_of(mesh, middle + n * s + m * r))
        if trouble > 0:
            crosses[t] = wp.uint8(1)


@forward_kernel(module=MODULE)
@typing.no_type_check
def look_beside(
    mesh: wp.uint64,
    points: Points,
    corners: Corners,
    which: wp.array(dtype=wp.int32),
    at: Points,
    kind: wp.array(dtype=wp.uint8),
):
    """Mark points of triangles `which` that have a doubled or inverted side.

    DOUBLED: one side is surrounded twice. INVERTED: one side has a negative winding number.
    """
    i = wp.tid()
    a, b, c = triangle(points, corners, which[i])
    n = wp.normalize(wp.cross(b - a, c - a)) * wp.float64(ASIDE)
    outside = side_of(mesh, at[i] + n)
    inside = side_of(mesh, at[i] - n)
    kind[i] = wp.uint8(wp.max(outside, inside))


def find_self_crossings(
    mesh: wp.Mesh, vertices: np.ndarray, triangles: np.ndarray
) -> SelfIntersections:
    """Find where a closed surface crosses itself or lies inside itself.

    Args:
        mesh: the surface.
        vertices: vertices of the surface, in half diagonals of its bounding box from its center,
            float64 of shape (n, 3).
        triangles: triangles of the surface, int32 of shape (m, 3).
    """
    device = mesh.points.device
    inputs = [
        mesh.id,
        wp.array(vertices, dtype=wp.vec3d, device=device),
        wp.array(triangles, dtype=wp.int32, device=device),
    ]
    marks = wp.zeros(len(triangles), dtype=wp.uint8, device=device)
    wp.launch(find_crossings, len(triangles), inputs, outputs=[marks], device=device)
    crossing = np.flatnonzero(marks.numpy())

    corners = vertices[triangles]

    def beside(which: np.ndarray, weights: np.ndarray) -> np.ndarray:
        points = np.einsum("ij,ijk->ik", weights, corners[which])
        sides = [
            wp.array(which, dtype=wp.int32, device=device),
            wp.array(points, dtype=wp.vec3d, device=device),
        ]
        kind = wp.zeros(len(which), dtype=wp.uint8, device=device)
        wp.launch(look_beside, len(which), [*inputs, *sides], outputs=[kind], device=device)
        return kind.numpy()

    firsts = _first_of_parts(triangles, len(vertices))
    nested = (
        firsts[beside(firsts, np.full((len(firsts), 3), 1.0 / 3.0)) > 0]
        if len(firsts) > 1
        else firsts[:0]
    )
    if not len(crossing) and not len(nested):
        return SelfIntersections()
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    chance = np.random.default_rng(SAMPLE)
    which = np.searchsorted(np.cumsum(area), area.sum() * (np.arange(SAMPLE) + 0.5) / SAMPLE).clip(
        max=len(triangles) - 1
    )
    kind = beside(which, chance.dirichlet(np.ones(3), SAMPLE))
    first = crossing[0] if len(crossing) else nested[0]
    return SelfIntersections(
        len(crossing),
        corners[first].mean(axis=0),
        *(float((kind == int(what)).mean()) for what in (DOUBLED, INVERTED)),
    )


def _first_of_parts(triangles: np.ndarray, vertices: int) -> np.ndarray:
    """Return the first triangle of each part; parts have no vertex in common."""
    rows, columns = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]]).T
    links = coo_array((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(vertices, vertices))
    _, label = connected_components(links, directed=False)
    return np.unique(label[triangles[:, 0]], return_index=True)[1]
