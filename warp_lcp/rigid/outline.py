"""Surface of a shape: triangles, in 2-D the segments of its cut by z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warp_lcp.grid.signed_distance import Box, Capsule, Geometry, Sphere, TriangleMesh, Union

NO_LENGTH = 1e-9  # relative to a mesh's size
AROUND = 48  # points around a disc or ball; even


def mesh_outline(mesh: TriangleMesh) -> np.ndarray:
    """Return the segments of a placed mesh in the plane z = 0 [m], shape (m, 2, 3).

    The inside is on the left. Corners on the plane count as above it, so that each triangle gives
    at most one segment.
    """
    corners = mesh.placement.apply(mesh.surface.vertices)[mesh.surface.triangles]
    above = corners[..., 2] >= 0.0
    count = above.sum(axis=1)
    crossing = (count == 1) | (count == 2)
    corners, above, count = corners[crossing], above[crossing], count[crossing]
    if not len(corners):
        return np.zeros((0, 2, 3))
    # The corner on the other side of the plane than the two others.
    alone = np.where(count == 1, above.argmax(axis=1), above.argmin(axis=1))
    order = (alone[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0)

    def cut(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        share = p[:, 2] / (p[:, 2] - q[:, 2])
        point = p + share[:, None] * (q - p)
        point[:, 2] = 0.0
        return point

    ends = np.stack([cut(a, b), cut(a, c)], axis=1)
    # A triangle is counterclockwise seen from outside: with one corner above, the path from its
    # left side to its right one has the inside on its left.
    swap = count == 2
    ends[swap] = ends[swap][:, ::-1]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    # A triangle that only touches the plane gives a point.
    return ends[length > NO_LENGTH * mesh.placement.scale * mesh.surface.size]


@dataclass(frozen=True, eq=False)
class BodySurface:
    """Surface of a body: triangles, in 2-D segments.

    As `warp_lcp.simulation.Surface`, without a name.

    Args:
        points: [m], shape (n, 3).
        corners: point indices of triangles, shape (m, 3), counterclockwise seen from outside, or of
            segments, shape (m, 2), with the inside on the left.
        fields: values at the points.
    """

    points: np.ndarray
    corners: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def joined(cls, surfaces: Sequence[BodySurface]) -> BodySurface:
        """Return several surfaces as one."""
        first = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
        corners = np.concatenate(
            [surface.corners + start for surface, start in zip(surfaces, first, strict=False)]
        )
        fields = {
            name: np.concatenate([surface.fields[name] for surface in surfaces])
            for name in surfaces[0].fields
        }
        return cls(
            np.concatenate([surface.points for surface in surfaces]),
            corners.astype(np.int32),
            fields,
        )


def body_surface(geometry: Geometry, dimension: int) -> BodySurface:
    """Return the surface of a placed box, sphere, capsule, mesh or union of these.

    Raises:
        ValueError: the shape is of another kind.
    """
    if isinstance(geometry, Union):
        return BodySurface.joined([body_surface(part, dimension) for part in geometry.parts])
    if isinstance(geometry, TriangleMesh):
        if dimension == 3:
            return BodySurface(
                geometry.placement.apply(geometry.surface.vertices), geometry.surface.triangles
            )
        segments = mesh_outline(geometry)
        points, corners = np.unique(segments.reshape(-1, 3).round(12), axis=0, return_inverse=True)
        return BodySurface(points, corners.reshape(-1, 2))
    if isinstance(geometry, Box):
        points, corners = _box(geometry, dimension)
    elif isinstance(geometry, (Sphere, Capsule)):
        ends = (
            (geometry.center, geometry.center)
            if isinstance(geometry, Sphere)
            else (geometry.start, geometry.end)
        )
        start, end = (np.array([*point, 0.0][:3]) for point in ends)
        points, corners = _round(start, end, geometry.radius, dimension)
    else:
        raise ValueError(f"{type(geometry).__name__.lower()}: its surface is unbounded")
    return BodySurface(geometry.placement.apply(points), corners)


def _box(box: Box, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and corners of a box; in 2-D of its cut by z = 0."""
    lower, upper = (np.array([*corner, 0.0][:3]) for corner in (box.lower, box.upper))
    if dimension == 2:
        unit = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return lower + unit * (upper - lower), np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    unit = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    sides = np.array(
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    )
    return lower + unit * (upper - lower), np.concatenate(
        [sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]
    )


def _round(
    start: np.ndarray, end: np.ndarray, radius: float, dimension: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a stadium or capsule; a disc or ball if the ends coincide.

    Points are e + radius (cos(a) axis + sin(a) n) [m], where e is the end if cos(a) > 0 and else
    the start. In 2-D n is across the axis, with `AROUND` angles a; in 3-D there are AROUND / 2
    angles a and AROUND directions n each, and the two tips.
    """
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / length if length else np.array([1.0, 0.0, 0.0])
    if dimension == 2:
        angle = 2.0 * np.pi * (np.arange(AROUND) + 0.5) / AROUND - 0.5 * np.pi
        across = np.array([-axis[1], axis[0], 0.0])
        middle = np.where((np.cos(angle) > 0.0)[:, None], end, start)
        points = middle + radius * (np.cos(angle)[:, None] * axis + np.sin(angle)[:, None] * across)
        return points, np.stack([np.arange(AROUND), np.roll(np.arange(AROUND), -1)], axis=1)
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    # From the tip at the end to the tip at the start.
    down = np.pi * (np.arange(AROUND // 2) + 0.5) / (AROUND // 2)
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    rings = [
        (end if np.cos(a) > 0.0 else start) + radius * (np.cos(a) * axis + np.sin(a) * ring)
        for a in down
    ]
    points = np.concatenate([*rings, (end + radius * axis)[None], (start - radius * axis)[None]])
    i, j = np.meshgrid(np.arange(len(down) - 1), np.arange(AROUND), indexing="ij")
    a, b = (i * AROUND + j).ravel(), (i * AROUND + (j + 1) % AROUND).ravel()
    around, last, tip = np.arange(AROUND), (len(down) - 1) * AROUND, len(down) * AROUND
    beside = (around + 1) % AROUND
    end_tip, start_tip = np.full(AROUND, tip), np.full(AROUND, tip + 1)
    corners = [
        np.stack([a, a + AROUND, b + AROUND], axis=1),
        np.stack([a, b + AROUND, b], axis=1),
        np.stack([end_tip, around, beside], axis=1),
        np.stack([start_tip, last + beside, last + around], axis=1),
    ]
    return points, np.concatenate(corners)
