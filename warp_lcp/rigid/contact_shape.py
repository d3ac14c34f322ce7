"""Shapes for contacts: surface points, signed distance and its gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull

from warp_lcp.grid.signed_distance import Box, Capsule, Geometry, Sphere, TriangleMesh
from warp_lcp.rigid.body import lengths
from warp_lcp.rigid.box_contacts import OrientedBox
from warp_lcp.rigid.outline import mesh_outline

# Maps points [m], shape (n, 3), to distances [m] and outward directions.
Distance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

ALONG = np.linspace(0.0, 1.0, 9)  # points along an edge of a box or the axis of a capsule
MOST_POINTS = 1500  # most points of a mesh
LONG = 0.1  # relative to a mesh's size: the corners of shorter edges are close enough
ROUNDS = 12  # rounds of the search along an edge; each reduces the interval to a quarter
DIFFERENCE = 2e-3  # relative to a mesh's size: step of its gradient, since its distance is float32
ON_SURFACE = 1e-9  # relative to a shape's size: distance from the surface without a direction
THICK = 1.0  # half thickness of a 2-D box in contacts of a plane, relative to its sides


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactShape:
    """Shape for contacts, as placed by the scene.

    Args:
        points: points at a distance of `radius` from the surface: shape (n, 3) [m].
        radius: [m].
        distance: signed distance and its gradient.
        boxes: boxes of the shape if it consists of boxes; in 2-D a thick one.
        size: about half its extent [m].
        closed: whether the inside is bounded; contacts with unbounded shapes need points of the
            other.
        signed: the signed distance alone, if that is faster.
        edges: in space, segments that may be nearer to another surface between their ends than at
            `points`: shape (m, 2, 3) [m].
        own: parameters of discs, capsules and boxes of a plane; see `numbers`.

    Attributes:
        low, high: bounds of closed shapes [m], shape (3,).
    """

    points: np.ndarray
    radius: float
    distance: Distance
    size: float
    boxes: tuple[OrientedBox, ...] = ()
    closed: bool = True
    signed: Callable[[np.ndarray], np.ndarray] | None = None
    edges: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    own: np.ndarray | None = None
    low: np.ndarray = field(init=False)
    high: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Compute the bounds of the points and their radius."""
        points = self.points if len(self.points) else np.zeros((1, 3))
        object.__setattr__(self, "low", points.min(axis=0) - self.radius)
        object.__setattr__(self, "high", points.max(axis=0) + self.radius)

    @classmethod
    def of(cls, geometry: Geometry, dimension: int) -> ContactShape:
        """Return a box, sphere, capsule or mesh as a contact shape.

        Inverted shapes have no points.

        Raises:
            ValueError: the shape is of another kind.
        """
        if isinstance(geometry, Box):
            shape = _box(geometry, dimension)
        elif isinstance(geometry, Sphere):
            shape = _sphere(geometry)
        elif isinstance(geometry, Capsule):
            shape = _capsule(geometry)
        elif isinstance(geometry, TriangleMesh):
            shape = _polygon(geometry) if dimension == 2 else _surface(geometry)
        else:
            raise ValueError(
                f"{type(geometry).__name__.lower()}: contacts are available for boxes, spheres, "
                "capsules, meshes and planes"
            )
        if not geometry.invert:
            return shape

        def outside(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            distance, direction = shape.distance(points)
            return -distance, -direction

        return cls(
            points=np.zeros((0, 3)), radius=0.0, distance=outside, size=shape.size, closed=False
        )

    @classmethod
    def united(cls, boxes: Sequence[Box]) -> ContactShape:
        """Return boxes in space as one shape.

        Its points are only their corners: a flat face first touches a plane at a corner.
        """
        parts = [_box(box, 3) for box in boxes]

        def nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            distances, directions = (
                np.array(of) for of in zip(*(part.distance(points) for part in parts), strict=True)
            )
            which, each = distances.argmin(axis=0), np.arange(len(points))
            return distances[which, each], directions[which, each]

        merged = tuple(box for part in parts for box in part.boxes)
        corners = np.concatenate([box.corners() for box in merged])
        return cls(
            points=corners,
            radius=0.0,
            distance=nearest,
            size=max(part.size for part in parts),
            boxes=merged,
        )

    @cached_property
    def numbers(self) -> np.ndarray | None:
        """Numbers of a disc, capsule or box for `headers/planar_contacts.h`.

        Shape (55,); None for other shapes.
        """
        if self.own is None or len(self.points) > len(ALONG):
            return None
        points = np.zeros((len(ALONG), 3))
        points[: len(self.points)] = self.points
        kind, ball = float(bool(self.boxes)), float(len(self.points) == 1 and not self.boxes)
        first = [kind, self.radius, self.size, len(self.points), ball, 1.0]
        return np.concatenate(
            [first, self.low, self.high, points.ravel(), self.own, np.zeros(16 - len(self.own))]
        )

    def nearest_on(self, edges: np.ndarray, margin: float) -> np.ndarray:
        """Return the point of each edge nearest to this shape, shape (n, 3).

        Or the deepest point in the shape. Edges that cannot be within the margin are omitted. The
        distance to a convex shape has one minimum along a segment; for other shapes it is the
        minimum beside the nearest of nine points.

        Args:
            edges: in the axes in which this shape is placed, shape (m, 2, 3) [m].
            margin: [m].
        """
        signed = self.signed or (lambda points: self.distance(points)[0])
        start, way = edges[:, 0], edges[:, 1] - edges[:, 0]
        near = signed(start + 0.5 * way) - 0.5 * lengths(way) <= margin
        start, way = start[near], way[near]
        low, high, each = np.zeros(len(start)), np.ones(len(start)), np.arange(len(start))
        for _ in range(ROUNDS if len(start) else 0):
            shares = low[:, None] + (high - low)[:, None] * ALONG
            points = start[:, None] + shares[..., None] * way[:, None]
            k = signed(points.reshape(-1, 3)).reshape(shares.shape).argmin(axis=1)
            low, high = (
                shares[each, np.maximum(k - 1, 0)],
                shares[each, np.minimum(k + 1, len(ALONG) - 1)],
            )
        return np.asarray(start + (0.5 * (low + high))[:, None] * way)

    def reach(self, center: np.ndarray) -> float:
        """Return the largest distance of a surface point from a center [m]."""
        return float(lengths(self.points - center).max(initial=0.0)) + self.radius


def _box(shape: Box, dimension: int) -> ContactShape:
    """Return a placed box as a shape.

    In space its points are corners and points along the edges; in 2-D corners only.
    """
    place = shape.placement
    lower, upper = (np.array([*corner, 0.0][:3]) for corner in (shape.lower, shape.upper))
    center, half = (
        place.apply((0.5 * (lower + upper))[None])[0],
        0.5 * place.scale * (upper - lower),
    )
    R = place.rotation
    signs = np.array(
        [
            [i, j, k]
            for i in (-1, 1)
            for j in (-1, 1)
            for k in ((-1, 1) if dimension == 3 else (0,))
        ],
        dtype=np.float64,
    )
    corners = signs * half
    points, edges = [corners], []
    if dimension == 3:
        for a in range(3):  # edges along each axis
            low = corners[signs[:, a] < 0]
            edges.append(np.stack([low, low + 2.0 * half * np.eye(3)[a]], axis=1))
            points += [low + share * 2.0 * half * np.eye(3)[a] for share in ALONG[1:-1]]
    flat = half[:dimension]

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # With q = |x| - h, in the axes of the box: |max(q, 0)| outside, else the largest q [m]. The
        # direction is the gradient: max(q, 0) normalized, or the axis of the largest q.
        local = ((points - center) @ R)[:, :dimension]
        beyond = np.abs(local) - flat
        out, deepest = np.maximum(beyond, 0.0), beyond.argmax(axis=1)
        length = lengths(out)
        inside = length <= ON_SURFACE * flat.max()
        each = np.arange(len(local))
        direction = np.where(
            inside[:, None],
            np.eye(dimension)[deepest],
            out / np.where(inside, 1.0, length)[:, None],
        )
        direction *= np.where(local < 0.0, -1.0, 1.0)
        signed = np.where(inside, beyond[each, deepest], length)
        return signed, direction @ R[:, :dimension].T

    thick = np.array([*flat, THICK * flat.max()][:3])
    return ContactShape(
        points=center + np.concatenate(points) @ R.T,
        radius=0.0,
        distance=distance,
        size=float(flat.max()),
        boxes=(OrientedBox(center, R.copy(), thick),),
        edges=center + np.concatenate(edges) @ R.T if edges else np.zeros((0, 2, 3)),
        own=np.concatenate([center, R.ravel(), thick, [ON_SURFACE * flat.max()]])
        if dimension == 2
        else None,
    )


def _sphere(shape: Sphere) -> ContactShape:
    center = shape.placement.apply(np.array([[*shape.center, 0.0][:3]]))
    return _around(center, center, np.zeros(1), shape.radius * shape.placement.scale)


def _capsule(shape: Capsule) -> ContactShape:
    ends = shape.placement.apply(np.array([[*end, 0.0][:3] for end in (shape.start, shape.end)]))
    return _around(ends[:1], ends[1:], ALONG, shape.radius * shape.placement.scale)


def _around(start: np.ndarray, end: np.ndarray, along: np.ndarray, radius: float) -> ContactShape:
    """Return the shape of all points within a radius of a segment.

    Points are along the segment, at shares `along` of its length.
    """
    axis = (end - start)[0]
    square = float(axis @ axis)
    other = (
        np.array([0.0, 1.0, 0.0])
        if not square
        else np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    )

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # |p - s - t a| - radius [m], with t = clip((p - s).a / a.a, 0, 1) on the segment
        # s ... s + a. Points on the segment have no gradient; they get a fixed direction across it.
        share = (
            np.clip((points - start) @ axis / square, 0.0, 1.0) if square else np.zeros(len(points))
        )
        way = points - start - share[:, None] * axis
        length = lengths(way)
        middle = length <= ON_SURFACE * radius
        direction = np.where(
            middle[:, None],
            other / np.linalg.norm(other),
            way / np.where(middle, 1.0, length)[:, None],
        )
        return length - radius, direction

    edges = np.stack([start, end], axis=1) if square and len(along) > 1 else np.zeros((0, 2, 3))
    return ContactShape(
        points=start + along[:, None] * axis,
        radius=radius,
        distance=distance,
        size=radius + 0.5 * float(np.sqrt(square)),
        edges=edges,
        own=np.concatenate(
            [start[0], axis, [square], other / np.linalg.norm(other), [ON_SURFACE * radius]]
        ),
    )


def _polygon(shape: TriangleMesh) -> ContactShape:
    """Return the cut of a mesh by z = 0 as a shape of the plane.

    The distance is that to the nearest segment; it is negative where the outline winds around the
    point.
    """
    segments = mesh_outline(shape)
    if not len(segments):
        raise ValueError("the mesh does not meet the plane z = 0")
    start, way = segments[:, 0, :2], segments[:, 1, :2] - segments[:, 0, :2]
    squares = np.square(way).sum(axis=1)
    keep = squares > 0.0
    start, way, squares = start[keep], way[keep], squares[keep]
    size = 0.5 * float(np.ptp(start, axis=0).max())
    normals = np.stack([way[:, 1], -way[:, 0]], axis=1) / np.sqrt(squares)[:, None]

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Distance to the nearest segment s ... s + a as for a capsule [m]. Its sign is negative if
        # the angles under which the segments are seen add up to more than pi in size.
        from_start = points[:, None, :2] - start
        share = np.clip((from_start * way).sum(axis=2) / squares, 0.0, 1.0)
        ways = from_start - share[..., None] * way
        away = np.linalg.norm(ways, axis=2)
        each, nearest = np.arange(len(points)), away.argmin(axis=1)
        a, b = from_start, from_start - way  # the outline winds around interior points by 2 pi
        turns = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(axis=2)).sum(
            axis=1
        )
        length, sign = away[each, nearest], np.where(np.abs(turns) > np.pi, -1.0, 1.0)
        on = length <= ON_SURFACE * size
        direction = np.where(
            on[:, None],
            normals[nearest],
            sign[:, None] * ways[each, nearest] / np.where(on, 1.0, length)[:, None],
        )
        return sign * length, np.column_stack([direction, np.zeros(len(points))])

    middles = start + 0.5 * way
    points = np.concatenate([start, middles]) if len(start) < 8 else start
    return ContactShape(
        points=np.column_stack([points, np.zeros(len(points))]),
        radius=0.0,
        distance=distance,
        size=size,
    )


def _surface(shape: TriangleMesh) -> ContactShape:
    """Return a placed mesh as a shape.

    The gradient of the distance is by central differences.
    """
    vertices, triangles = shape.placement.apply(shape.surface.vertices), shape.surface.triangles
    size = 0.5 * float(np.ptp(vertices, axis=0).max())
    step = DIFFERENCE * size

    def signed(points: np.ndarray) -> np.ndarray:
        if not len(points):
            return np.zeros(0)
        asked = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
        out = wp.empty(len(asked), dtype=wp.float32, device="cpu")
        shape.signed_distance(asked, out)
        return np.asarray(out.numpy().astype(np.float64))

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not len(points):
            return np.zeros(0), np.zeros((0, 3))
        around = (
            points[None] + step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])[:, None]
        )
        values = signed(around.reshape(-1, 3)).reshape(7, -1)
        slope = (values[1:4] - values[4:]).T
        length = lengths(slope)
        return values[0], slope / np.where(length > 0.0, length, 1.0)[:, None]

    ends = vertices[_edges_of(triangles)]
    long = lengths(ends[:, 1] - ends[:, 0]) > LONG * size
    return ContactShape(
        points=_spread(vertices, triangles),
        radius=0.0,
        distance=distance,
        size=size,
        signed=signed,
        edges=ends[long],
    )


def _edges_of(triangles: np.ndarray) -> np.ndarray:
    """Return the corner pairs of the unique edges of triangles, shape (m, 2)."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.asarray(np.unique(np.sort(sides, axis=1), axis=0))


def _spread(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return at most `MOST_POINTS` points of a surface.

    The corners of its convex hull first, then other corners, and middles of long edges.

    With more than `MOST_POINTS` corners every n-th one is taken, from the hull and from the others.
    Otherwise an edge from a to b gets the points a + n / m (b - a), n = 1 ... m - 1, with the same
    m for all edges.
    """
    hull = ConvexHull(vertices).vertices
    rest = np.setdiff1d(np.arange(len(vertices)), hull)
    points = np.concatenate([vertices[hull], vertices[rest]])
    edges = _edges_of(triangles)
    if len(points) > MOST_POINTS:
        kept = min(len(hull), MOST_POINTS // 2)
        others = points[len(hull) :]
        return np.concatenate(
            [
                points[: len(hull)][:: -(-len(hull) // kept)],
                others[:: max(1, -(-len(others) // (MOST_POINTS - kept)))],
            ]
        )
    pieces = max(1, min(len(ALONG) - 1, (MOST_POINTS - len(points)) // len(edges) + 1))
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    return np.concatenate([points, *(a + n / pieces * (b - a) for n in range(1, pieces))])
