"""Where bodies touch each other and what surrounds them: points, normals and gaps, a few for each pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.rigid.box_contacts import OrientedBox, box_box
from warp_lcp.rigid.contact_shape import ContactShape

FLAT = {2: 2, 3: 4}  # contacts of a pair with about one normal: a flat rest needs no more
MOST = {2: 4, 3: 8}  # contacts of a pair
OTHER_SIDE = 0.1  # of normals' difference: contacts of sides that differ by less count as of one
SAME = 1e-6  # of a shape's size: points of contact this close are one
LOWER = 20.0  # so many times the gap must a point be farther from the others to count more than one with less
MUCH_LOWER = 200.0  # for those that come on top where others lie lower: what a round rim rests on is not what it may tip over
MORE = 2  # of these, at most
LEVEL = 1e-4  # of the smaller shape's size: gaps that differ by less are of one height


@dataclass(frozen=True, eq=False)
class Touch:
    """Points where one thing touches another.

    Args:
        point: halfway between the surfaces [m], shape (k, 3).
        normal: unit vectors from the other to the one, shape (k, 3).
        gap: [m], negative where they overlap, shape (k,).
    """

    point: np.ndarray
    normal: np.ndarray
    gap: np.ndarray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.gap)

    def turned(self) -> Touch:
        """Return the same points as the other sees them."""
        return Touch(self.point, -self.normal, self.gap)

    def where(self, chosen: np.ndarray) -> Touch:
        """Return some of the points."""
        return Touch(self.point[chosen], self.normal[chosen], self.gap[chosen])

    @classmethod
    def joined(cls, touches: Sequence[Touch]) -> Touch:
        """Return the points of several."""
        if not touches:
            return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        return cls(*(np.concatenate([getattr(touch, name) for touch in touches]) for name in ("point", "normal", "gap")))


class Place(NamedTuple):
    """Where a body is: p becomes rotation @ p + translation; a `Pose` that nobody gave, so that nobody checks it."""

    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return points [m], shape (n, 3), after the change of place."""
        return np.asarray(points @ self.rotation.T + self.translation)


def on_planes(shape: ContactShape, pose: Pose | Place, points: np.ndarray, normals: np.ndarray, margin: float, dimension: int) -> Touch:
    """Return where a shape touches planes.

    Args:
        shape: of the body, as placed.
        pose: of the body.
        points: of the planes [m], shape (m, 3).
        normals: unit vectors into the open, shape (m, 3).
        margin: gap [m] up to which there is a contact.
        dimension: 2 or 3.
    """
    centers = pose.apply(shape.points)
    found = []
    for point, normal in zip(points, normals, strict=True):
        gap = (centers - point) @ normal - shape.radius
        near = gap <= margin
        if near.any():
            places = centers[near] - (shape.radius + 0.5 * gap[near])[:, None] * normal
            touch = Touch(places, np.broadcast_to(normal, places.shape), gap[near])
            found.append(spread(touch, shape.size, dimension))
    return Touch.joined(found)


def between(one: ContactShape, at: Pose | Place, other: ContactShape, there: Pose | Place, margin: float, dimension: int) -> Touch:
    """Return where two shapes touch, normals from the other to the one.

    Boxes by the axis along which they overlap least; others by points of either surface and the distance to the other one.

    Args:
        one: a shape, as placed.
        at: its pose.
        other: the other one.
        there: its pose.
        margin: gap [m] up to which there is a contact.
        dimension: 2 or 3.
    """
    size = min(one.size, other.size)
    if one.box is not None and other.box is not None:
        return spread(_boxes(_moved(one.box, at), _moved(other.box, there), margin, dimension), size, dimension)
    single = [len(shape.points) == 1 for shape in (one, other)]  # the center of a ball says all
    found = []
    if not single[1] or single[0]:
        found.append(_points_of(one, at, other, there, margin))
    if not single[0] and len(other.points):
        found.append(_points_of(other, there, one, at, margin).turned())
    return spread(Touch.joined(found), size, dimension)


def _points_of(one: ContactShape, at: Pose | Place, other: ContactShape, there: Pose | Place, margin: float) -> Touch:
    """Return the points of one shape that are near the other."""
    centers = at.apply(one.points)
    local = (centers - there.translation) @ there.rotation
    if other.closed and len(local) > 1:  # most points are far away
        reach = margin + one.radius
        near = ((local >= other.low - reach) & (local <= other.high + reach)).all(axis=1)
        centers, local = centers[near], local[near]
    if not len(local):
        return Touch.joined([])
    distance, direction = other.distance(local)
    gap = distance - one.radius
    near = gap <= margin
    normal = direction[near] @ there.rotation.T
    return Touch(centers[near] - (one.radius + 0.5 * gap[near])[:, None] * normal, normal, gap[near])


def _moved(box: OrientedBox, pose: Pose | Place) -> OrientedBox:
    return OrientedBox(pose.apply(box.center[None])[0], pose.rotation @ box.rotation, box.half)


def _boxes(a: OrientedBox, b: OrientedBox, margin: float, dimension: int) -> Touch:
    """Return where two boxes touch; in 2-D they are thick, and of their contacts those of one face count."""
    if dimension == 2:
        deep = max(a.half[2], b.half[2])
        a, b = (OrientedBox(box.center, box.rotation, np.array([*box.half[:2], deep])) for box in (a, b))
    hit = box_box(a, b, margin)
    if hit is None:
        return Touch.joined([])
    points, normal, gaps = hit
    if dimension == 2:
        points, gaps = points[points[:, 2] > 0.0], gaps[points[:, 2] > 0.0]
        points[:, 2] = 0.0
    return Touch(points, np.broadcast_to(normal, points.shape), gaps)


def spread(touch: Touch, size: float, dimension: int) -> Touch:
    """Return the deepest of a pair's points and others that are low and far from each other, as many as hold a body.

    Where all have about one normal that is two points in 2-D and four in 3-D, and up to two more if some of these are higher than others.

    Args:
        touch: the points.
        size: of the smaller shape [m].
        dimension: 2 or 3.
    """
    if len(touch) < 2:
        return touch
    above = touch.gap - touch.gap.min()
    chosen = [int(touch.gap.argmin())]
    way = np.linalg.norm(touch.point - touch.point[chosen[0]], axis=1)
    side = np.linalg.norm(touch.normal - touch.normal[chosen[0]], axis=1)
    for lower, flat in ((LOWER, FLAT[dimension]), (MUCH_LOWER, FLAT[dimension] + MORE)):
        allowed = above < (above[chosen].max() - LEVEL * size if lower == MUCH_LOWER else np.inf)
        while len(chosen) < MOST[dimension]:
            usable = allowed & ((side > OTHER_SIDE) | ((way > SAME * size) & (len(chosen) < flat)))
            if not usable.any():
                break
            following = int(np.where(usable, way + size * side - lower * above, -np.inf).argmax())
            chosen.append(following)
            way = np.minimum(way, np.linalg.norm(touch.point - touch.point[following], axis=1))
            side = np.minimum(side, np.linalg.norm(touch.normal - touch.normal[following], axis=1))
    return touch.where(np.array(chosen))
