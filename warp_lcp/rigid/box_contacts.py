"""Contact points of two boxes by the separating axis test.

The points lie on a face, or between a pair of edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Relative to a half side: an edge axis must separate more than faces by this much, as faces give
# more points.
FACE_FIRST = 1e-2
PARALLEL = 1e-6  # squared sine of two edges below which their cross product is not used as an axis


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """Oriented box: center [m], rotation (columns are the axes), half sides [m]."""

    center: np.ndarray
    rotation: np.ndarray
    half: np.ndarray

    def corners(self) -> np.ndarray:
        """Return the corners [m], shape (8, 3)."""
        signs = np.array(
            [[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64
        )
        return self.center + (signs * self.half) @ self.rotation.T

    def reach(self, axes: np.ndarray) -> np.ndarray:
        """Return the support distance along unit vectors [m], shape (m,)."""
        return np.abs(axes @ self.rotation) @ self.half


def box_box(
    a: OrientedBox, b: OrientedBox, margin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return contact points, unit normal and gaps of two boxes.

    Points [m], shape (k, 3); normal from b to a; gaps [m], shape (k,), negative where they overlap.

    Of 15 axes (3 face normals of each box, 9 cross products of edges) the one with the largest gap,
    or the least overlap, is the normal. For a face, the opposite face of the other box is clipped
    against its sides (Sutherland and Hodgman), and points within the margin are contacts. For edges
    there is one point, halfway between them.

    Args:
        a: one box.
        b: the other one.
        margin: gap [m] up to which there is a contact.

    Returns:
        None if the gap is larger.
    """
    between = a.center - b.center
    cross = np.cross(a.rotation.T[:, None], b.rotation.T[None]).reshape(9, 3)
    squares = np.square(cross).sum(axis=1)
    usable = squares > PARALLEL
    axes = np.vstack([a.rotation.T, b.rotation.T, cross[usable] / np.sqrt(squares[usable, None])])
    along = axes @ between
    apart = np.abs(along) - a.reach(axes) - b.reach(axes)
    if apart.max() > margin:
        return None
    bias = FACE_FIRST * min(a.half.min(), b.half.min())
    face, edge = int(apart[:6].argmax()), 6 + int(apart[6:].argmax()) if len(axes) > 6 else -1
    if edge > 0 and apart[edge] > apart[face] + bias:
        normal = axes[edge] * (1.0 if along[edge] >= 0 else -1.0)
        first, second = divmod(int(np.flatnonzero(usable)[edge - 6]), 3)
        point, gap = _edges(a, b, first, second, normal)
        return point[None], normal, np.array([gap])
    reference, incident, sign = (a, b, -1.0) if face < 3 else (b, a, 1.0)
    outward = axes[face] * np.sign(axes[face] @ (incident.center - reference.center) or 1.0)
    points, gaps = _clip(reference, incident, face % 3, outward)
    near = gaps <= margin
    if not near.any():
        return None
    return points[near] - 0.5 * gaps[near, None] * outward, sign * outward, gaps[near]


def _edges(
    a: OrientedBox, b: OrientedBox, first: int, second: int, normal: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the point between supporting edges of a and b, and their gap.

    The point is halfway between them; the edge of a is along axis `first`; the gap is along the
    normal [m].
    """
    ends = []
    for box, axis, toward in ((a, first, -normal), (b, second, normal)):
        side = np.where(box.rotation.T @ toward >= 0, 1.0, -1.0)
        side[axis] = 0.0
        ends.append(box.center + box.rotation @ (side * box.half))
    u, v, w = a.rotation[:, first], b.rotation[:, second], ends[0] - ends[1]
    uv, uw, vw = u @ v, u @ w, v @ w
    s, t = (uv * vw - uw) / (1 - uv**2), (vw - uv * uw) / (1 - uv**2)
    p = ends[0] + np.clip(s, -a.half[first], a.half[first]) * u
    q = ends[1] + np.clip(t, -b.half[second], b.half[second]) * v
    return 0.5 * (p + q), float((p - q) @ normal)


def _clip(
    reference: OrientedBox, incident: OrientedBox, axis: int, outward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the clipped corners of the incident face, and their heights.

    They are clipped by the sides of the reference face; heights are above it [m].
    """
    facing = incident.rotation.T @ outward
    k = int(np.abs(facing).argmax())
    center = incident.center - np.sign(facing[k]) * incident.half[k] * incident.rotation[:, k]
    i, j = (k + 1) % 3, (k + 2) % 3
    u, v = incident.half[i] * incident.rotation[:, i], incident.half[j] * incident.rotation[:, j]
    polygon = [center + u + v, center - u + v, center - u - v, center + u - v]
    for side in ((axis + 1) % 3, (axis + 2) % 3):
        for sign in (1.0, -1.0):
            plane = sign * reference.rotation[:, side]
            polygon = _cut(polygon, plane, plane @ reference.center + reference.half[side])
    points = np.array(polygon).reshape(-1, 3)
    return points, (points - reference.center) @ outward - reference.half[axis]


def _cut(polygon: list[np.ndarray], normal: np.ndarray, offset: float) -> list[np.ndarray]:
    """Return the part of a convex polygon where normal.x <= offset.

    A corner on the plane counts as inside.
    """
    corners = []
    heights = [float(normal @ p) - offset for p in polygon]
    tiny = 1e-12 * (1 + abs(offset))
    for n, p in enumerate(polygon):
        q, h, next_height = (
            polygon[(n + 1) % len(polygon)],
            heights[n],
            heights[(n + 1) % len(polygon)],
        )
        if h <= tiny:
            corners.append(p)
        if (h > tiny and next_height < -tiny) or (h < -tiny and next_height > tiny):
            corners.append(p + h / (h - next_height) * (q - p))
    return corners
