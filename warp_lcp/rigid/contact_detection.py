"""Contact detection: a few points, normals and gaps for each pair of bodies."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.rigid.body import BodyStates, RigidBody, lengths
from warp_lcp.rigid.box_contacts import OrientedBox, box_box
from warp_lcp.rigid.contact_shape import ON_SURFACE, ContactShape
from warp_lcp.rigid.obstacles import Obstacle

FLAT = {2: 2, 3: 4}  # contacts of a pair with about one normal: enough for a flat support
MOST = {2: 4, 3: 8}  # most contacts of a pair
OTHER_SIDE = 0.1  # difference of normals below which contacts count as of one side
SAME = 1e-6  # relative to a shape's size: contact points this close are merged
# Penalty of the gap above the deepest point, relative to the distance from the chosen points.
LOWER = 20.0
# The same for additional points, which lie lower than some chosen ones: a round rim rests on other
# points than those over which it may tip.
MUCH_LOWER = 200.0
MORE = 2  # most additional points of this kind
NONE = -1  # obstacle number of contacts between bodies
LEVEL = 1e-4  # relative to the smaller shape's size: gaps that differ by less are equal


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Contact points of a pair.

    Args:
        point: points halfway between the surfaces [m], shape (k, 3).
        normal: unit vectors from the second shape to the first, shape (k, 3).
        gap: [m], negative where they overlap, shape (k,).
    """

    point: np.ndarray
    normal: np.ndarray
    gap: np.ndarray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.gap)

    def turned(self) -> ContactPoints:
        """Return the same points with first and second shape exchanged."""
        return ContactPoints(self.point, -self.normal, self.gap)

    def where(self, chosen: np.ndarray) -> ContactPoints:
        """Return selected points, by a mask or indices."""
        return ContactPoints(self.point[chosen], self.normal[chosen], self.gap[chosen])

    @classmethod
    def joined(cls, several: Sequence[ContactPoints]) -> ContactPoints:
        """Return the points of several pairs as one object."""
        some = [points for points in several if len(points.gap)]
        if len(some) < 2:
            point, normal, gap = (
                (some[0].point, some[0].normal, some[0].gap)
                if some
                else (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
            )
            return cls(np.ascontiguousarray(point), np.ascontiguousarray(normal), gap)
        return cls(
            np.concatenate([points.point for points in some]),
            np.concatenate([points.normal for points in some]),
            np.concatenate([points.gap for points in some]),
        )


class UncheckedPose(NamedTuple):
    """Pose of a body: p becomes rotation @ p + translation.

    A `Pose` without checks.
    """

    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return transformed points [m], shape (n, 3)."""
        return np.asarray(points @ self.rotation.T + self.translation)


def on_plane(
    shape: ContactShape,
    pose: Pose | UncheckedPose,
    point: np.ndarray,
    normal: np.ndarray,
    margin: float,
) -> ContactPoints:
    """Return the contact points of a shape with a plane.

    Args:
        shape: shape of the body, as placed.
        pose: pose of the body.
        point: a point of the plane [m], shape (3,).
        normal: unit vector into the open, shape (3,).
        margin: gap [m] up to which there is a contact.
    """
    centers = pose.apply(shape.points)
    gap = (centers - point) @ normal - shape.radius
    near = gap <= margin
    places = centers[near] - (shape.radius + 0.5 * gap[near])[:, None] * normal
    return ContactPoints(places, np.broadcast_to(normal, places.shape), gap[near])


def between(
    one: ContactShape,
    at: Pose | UncheckedPose,
    other: ContactShape,
    other_pose: Pose | UncheckedPose,
    margin: float,
    dimension: int,
) -> ContactPoints:
    """Return the contact points of two shapes; normals point to the first.

    For boxes, see `box_contacts`. For other shapes, the points of either surface are tested with
    the distance to the other shape. In space, so are the points of either's edges that are nearest
    to the other.

    Args:
        one: a shape, as placed.
        at: its pose.
        other: the other shape.
        other_pose: its pose.
        margin: gap [m] up to which there is a contact.
        dimension: 2 or 3.
    """
    if one.boxes and other.boxes:
        return ContactPoints.joined(
            [
                _boxes(_moved(a, at), _moved(b, other_pose), margin, dimension)
                for a in one.boxes
                for b in other.boxes
            ]
        )
    single = [len(shape.points) == 1 for shape in (one, other)]  # one point: the center of a ball
    candidates = []
    if not single[1] or single[0]:
        candidates.append(_points_of(one, at, other, other_pose, margin, one.points))
    if not single[0] and len(other.points):
        candidates.append(_points_of(other, other_pose, one, at, margin, other.points).turned())
    if dimension == 3:
        candidates.append(
            _points_of(
                one, at, other, other_pose, margin, _nearest_of(one, at, other, other_pose, margin)
            )
        )
        candidates.append(
            _points_of(
                other, other_pose, one, at, margin, _nearest_of(other, other_pose, one, at, margin)
            ).turned()
        )
    return ContactPoints.joined(candidates)


def _nearest_of(
    one: ContactShape,
    at: Pose | UncheckedPose,
    other: ContactShape,
    other_pose: Pose | UncheckedPose,
    margin: float,
) -> np.ndarray:
    """Return the points of one shape's edges that are nearest to the other.

    Only if the other shape has a surface between its own points.
    """
    if not len(one.edges) or len(other.points) == 1:
        return np.zeros((0, 3))
    ends = (at.apply(one.edges.reshape(-1, 3)) - other_pose.translation) @ other_pose.rotation
    points = other.nearest_on(ends.reshape(-1, 2, 3), margin + one.radius)
    return np.asarray((other_pose.apply(points) - at.translation) @ at.rotation)


def _points_of(
    one: ContactShape,
    at: Pose | UncheckedPose,
    other: ContactShape,
    other_pose: Pose | UncheckedPose,
    margin: float,
    points: np.ndarray,
) -> ContactPoints:
    """Return the contacts of some points of one shape with the other.

    Points are in the axes in which the shape is placed.
    """
    centers = at.apply(points)
    local = (centers - other_pose.translation) @ other_pose.rotation
    if other.closed and len(local) > 1:  # most points are far away
        reach = margin + one.radius
        near = ((local >= other.low - reach) & (local <= other.high + reach)).all(axis=1)
        centers, local = centers[near], local[near]
    if not len(local):
        return ContactPoints.joined([])
    distance, direction = other.distance(local)
    gap = distance - one.radius
    near = gap <= margin
    normal = direction[near] @ other_pose.rotation.T
    return ContactPoints(
        centers[near] - (one.radius + 0.5 * gap[near])[:, None] * normal, normal, gap[near]
    )


def _moved(box: OrientedBox, pose: Pose | UncheckedPose) -> OrientedBox:
    return OrientedBox(pose.apply(box.center[None])[0], pose.rotation @ box.rotation, box.half)


def _boxes(a: OrientedBox, b: OrientedBox, margin: float, dimension: int) -> ContactPoints:
    """Return the contacts of two boxes.

    In 2-D they are thick, and only the contacts of one face count.
    """
    if dimension == 2:
        deep = max(a.half[2], b.half[2])
        a, b = (
            OrientedBox(box.center, box.rotation, np.array([*box.half[:2], deep])) for box in (a, b)
        )
    hit = box_box(a, b, margin)
    if hit is None:
        return ContactPoints.joined([])
    points, normal, gaps = hit
    if dimension == 2:
        points, gaps = points[points[:, 2] > 0.0], gaps[points[:, 2] > 0.0]
        points[:, 2] = 0.0
    return ContactPoints(points, np.broadcast_to(normal, points.shape), gaps)


def spread(points: ContactPoints, size: float, dimension: int) -> ContactPoints:
    """Return the deepest point and points far from it, enough to support a body.

    If all have about one normal these are two points in 2-D and four in 3-D, and up to two more if
    some of these are higher than others.

    Args:
        points: the points.
        size: size of the smaller shape [m].
        dimension: 2 or 3.
    """
    if len(points) < 2:
        return points
    above = points.gap - points.gap.min()
    chosen = [int(points.gap.argmin())]
    way = lengths(points.point - points.point[chosen[0]])
    side = lengths(points.normal - points.normal[chosen[0]])
    for lower, flat in ((LOWER, FLAT[dimension]), (MUCH_LOWER, FLAT[dimension] + MORE)):
        allowed = above < (above[chosen].max() - LEVEL * size if lower == MUCH_LOWER else np.inf)
        while len(chosen) < MOST[dimension]:
            usable = allowed & ((side > OTHER_SIDE) | ((way > SAME * size) & (len(chosen) < flat)))
            if not usable.any():
                break
            following = int(np.where(usable, way + size * side - lower * above, -np.inf).argmax())
            chosen.append(following)
            way = np.minimum(way, lengths(points.point - points.point[following]))
            side = np.minimum(side, lengths(points.normal - points.normal[following]))
    return points.where(np.array(chosen))


def close_pairs(middle: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs i > j of overlapping axis-aligned boxes, in order.

    Candidates are found by sorting along the longest axis (sweep and prune).

    Args:
        middle: centers of the boxes [m], shape (n, 3).
        half: half their sides [m], shape (n, 3).
    """
    low, high = middle - half, middle + half
    first, *shorter_axes = np.argsort(-np.ptp(middle, axis=0), kind="stable").tolist()
    order = np.argsort(low[:, first], kind="stable")
    # Later boxes that begin before the end of this one.
    ends = np.searchsorted(low[order, first], high[order, first], side="right")
    after = ends - np.arange(len(order)) - 1
    one = np.repeat(np.arange(len(order)), after)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(after) - after, after)
    one, other = order[one], order[other]
    for axis in shorter_axes:  # each axis removes most of the pairs
        begin, end = np.ascontiguousarray(low[:, axis]), np.ascontiguousarray(high[:, axis])
        both = (begin[one] <= end[other]) & (begin[other] <= end[one])
        one, other = one[both], other[both]
    pairs = np.sort(np.stack([one, other]), axis=0)
    pairs = pairs[:, np.lexsort(pairs)]
    return pairs[1], pairs[0]


@dataclass(frozen=True, eq=False)
class DetectedContacts:
    """Contact points of bodies, k of them.

    Args:
        first: body that the normal points into, shape (k,).
        second: body that the normal comes from; the number of bodies for an obstacle, shape (k,).
        obstacle: number of the obstacle; NONE for contacts between bodies, shape (k,).
        points: the contact points.
    """

    first: np.ndarray
    second: np.ndarray
    obstacle: np.ndarray
    points: ContactPoints

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.first)

    def where(self, chosen: np.ndarray) -> DetectedContacts:
        """Return selected contacts, by a mask or indices."""
        return DetectedContacts(
            self.first[chosen],
            self.second[chosen],
            self.obstacle[chosen],
            self.points.where(chosen),
        )

    def without(self, pairs: Collection[tuple[int, int]]) -> DetectedContacts:
        """Return the contacts without those of some pairs, smaller number first."""
        if not pairs:
            return self
        count = 1 + max(int(self.second.max(initial=0)), *(high for _, high in pairs))
        keys = [low * count + high for low, high in pairs]
        return self.where(~np.isin(self.second * count + self.first, keys))

    @classmethod
    def of(
        cls,
        first: Sequence[int] | np.ndarray,
        second: Sequence[int] | np.ndarray,
        obstacle: int,
        points: Sequence[ContactPoints],
    ) -> DetectedContacts:
        """Join the contact points of pairs; first, second: shape (pairs,)."""
        counts = [len(each) for each in points]
        one, other = (
            np.repeat(np.asarray(side, dtype=np.int64), counts) for side in (first, second)
        )
        return cls(one, other, np.full(len(one), obstacle), ContactPoints.joined(points))

    @classmethod
    def joined(cls, several: Sequence[DetectedContacts]) -> DetectedContacts:
        """Return several objects as one."""
        some = [contacts for contacts in several if len(contacts.first)]
        if len(some) < 2:
            return some[0] if some else several[0]
        return cls(
            np.concatenate([contacts.first for contacts in some]),
            np.concatenate([contacts.second for contacts in some]),
            np.concatenate([contacts.obstacle for contacts in some]),
            ContactPoints.joined([contacts.points for contacts in some]),
        )


class ContactDetection:
    """Detection of contacts of bodies with each other and with obstacles.

    Args:
        bodies: all bodies.
        shapes: shapes of the bodies as placed.
        obstacles: walls and solids.
        dimension: 2 or 3.
        every: keep every point of a pair, not only the few that support a body.
    """

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        shapes: Sequence[ContactShape],
        obstacles: Sequence[Obstacle],
        dimension: int,
        every: bool = False,
    ) -> None:
        self.bodies = BodyStates.of(bodies)
        self.shapes, self.obstacles, self.dimension, self.every = (
            shapes,
            obstacles,
            dimension,
            every,
        )
        self._middle = np.array([0.5 * (shape.low + shape.high) for shape in shapes])
        self._half = np.array([0.5 * (shape.high - shape.low) - shape.radius for shape in shapes])
        self._radius = np.array([shape.radius for shape in shapes])
        self._ball = np.array(
            [shape.closed and len(shape.points) == 1 and not shape.boxes for shape in shapes]
        )

    def find(
        self, time: float, ways: np.ndarray, brought: np.ndarray, near: float = 0.0
    ) -> DetectedContacts:
        """Return the contacts: obstacle by obstacle, then pairs of bodies, in order.

        Args:
            time: time of the state [s].
            ways: largest displacement of each body [m], shape (n,).
            brought: gap up to which a body at rest touches each obstacle [m].
            near: gap up to which bodies at rest touch each other [m].
        """
        turns, at = self.bodies.rotation, self.bodies.position
        shifts = at - (turns @ self.bodies.center[:, :, None])[:, :, 0]
        poses = [UncheckedPose(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
        middle = (turns @ self._middle[:, :, None])[:, :, 0] + shifts
        half = (np.abs(turns) @ self._half[:, :, None])[:, :, 0] + self._radius[:, None]
        contacts = [
            self._with_obstacle(number, obstacle.pose(time), poses, middle, half, ways + more)
            for number, (obstacle, more) in enumerate(zip(self.obstacles, brought, strict=True))
        ]
        first, second = close_pairs(middle, half + ways[:, None] + 0.5 * near)
        margins = near + ways[first] + ways[second]
        way = lengths(middle[first] - middle[second])
        balls = self._ball[first] & self._ball[second] & (way > ON_SURFACE * self._radius[second])
        touching = self._balls(first[balls], second[balls], middle, margins[balls])
        if not balls.all():
            first, second, margins, points = first[~balls], second[~balls], margins[~balls], []
            for i, j, margin in zip(first.tolist(), second.tolist(), margins.tolist(), strict=True):
                one, other = self.shapes[i], self.shapes[j]
                points.append(
                    self._kept(
                        between(one, poses[i], other, poses[j], margin, self.dimension),
                        min(one.size, other.size),
                    )
                )
            touching = DetectedContacts.joined(
                [touching, DetectedContacts.of(first, second, NONE, points)]
            )
            touching = touching.where(np.lexsort((touching.second, touching.first)))
        return DetectedContacts.joined([*contacts, touching])

    def _balls(
        self, i: np.ndarray, j: np.ndarray, centers: np.ndarray, margins: np.ndarray
    ) -> DetectedContacts:
        """Return the contacts of balls i with balls j.

        Each is the point between the balls on the line of their centers.
        """
        way = centers[i] - centers[j]
        length = lengths(way)
        gap = length - self._radius[j] - self._radius[i]
        near = gap <= margins
        i, j, gap = i[near], j[near], gap[near]
        normal = way[near] / length[near, None]
        point = centers[i] - (self._radius[i] + 0.5 * gap)[:, None] * normal
        return DetectedContacts(i, j, np.full(len(i), NONE), ContactPoints(point, normal, gap))

    def _kept(self, points: ContactPoints, size: float) -> ContactPoints:
        return points if self.every else spread(points, size, self.dimension)

    def _with_obstacle(
        self,
        number: int,
        obstacle_pose: Pose,
        poses: list[UncheckedPose],
        middle: np.ndarray,
        half: np.ndarray,
        margins: np.ndarray,
    ) -> DetectedContacts:
        """Return the contacts of bodies with an obstacle.

        A body is tested if the boxes around it and the obstacle are at most its margin apart [m]:
        |c_a - c_b| - h_a - h_b <= margin along each axis, with centers c and half sizes h. A
        rotated box has h_b = |R| h.
        """
        shape, n = self.obstacles[number].shape, len(poses)
        if shape is None:
            return self._with_planes(number, obstacle_pose, poses, middle, half, margins)
        near = np.ones(n, dtype=bool)
        if shape.closed:
            center, reach = (
                obstacle_pose.apply(0.5 * (shape.low + shape.high)),
                np.abs(obstacle_pose.rotation) @ (0.5 * (shape.high - shape.low)),
            )
            near = (np.abs(middle - center) - half - reach).max(axis=1) <= margins
        first, points = np.flatnonzero(near), []
        for i in first.tolist():
            touch = between(
                self.shapes[i], poses[i], shape, obstacle_pose, float(margins[i]), self.dimension
            )
            points.append(self._kept(touch, min(self.shapes[i].size, shape.size)))
        return DetectedContacts.of(first, np.full(len(first), n), number, points)

    def _with_planes(
        self,
        number: int,
        obstacle_pose: Pose,
        poses: list[UncheckedPose],
        middle: np.ndarray,
        half: np.ndarray,
        margins: np.ndarray,
    ) -> DetectedContacts:
        """Return the contacts of bodies with the planes of an obstacle.

        All balls, with one point each, are tested at once.

        A body is tested if n.(c - p) - |n|.h <= margin [m], with the plane's point p and normal n,
        and the center c and the half size h of the box around the body. A ball of radius r has
        gap = n.(c - p) - r, and its contact point c - (r + gap / 2) n is in the middle of the gap.
        """
        obstacle, n = self.obstacles[number], len(poses)
        points, normals = (
            obstacle_pose.apply(obstacle.points),
            obstacle.normals @ obstacle_pose.rotation.T,
        )
        heights = middle @ normals.T - (points * normals).sum(axis=1)
        i, m = np.nonzero(heights - half @ np.abs(normals).T <= margins[:, None])
        balls = self._ball[i]
        gap = heights[i, m] - self._radius[i]
        near = balls & (gap <= margins[i])
        ball, gap, normal = i[near], gap[near], normals[m[near]]
        touch = ContactPoints(
            middle[ball] - (self._radius[ball] + 0.5 * gap)[:, None] * normal, normal, gap
        )
        contacts = DetectedContacts(ball, np.full(len(ball), n), np.full(len(ball), number), touch)
        if balls.all():
            return contacts
        i, m = i[~balls], m[~balls]
        each = [
            self._kept(
                on_plane(self.shapes[a], poses[a], points[b], normals[b], margins[a]),
                self.shapes[a].size,
            )
            for a, b in zip(i.tolist(), m.tolist(), strict=True)
        ]
        contacts = DetectedContacts.joined(
            [contacts, DetectedContacts.of(i, np.full(len(i), n), number, each)]
        )
        return contacts.where(np.argsort(contacts.first, kind="stable"))
