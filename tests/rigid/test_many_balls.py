"""Fast paths of many bodies.

They are pairs by a sweep along an axis, balls all at once, and impulses recalled by pairs.
"""

from types import SimpleNamespace

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import Box, Sphere
from warp_lcp.rigid.body import BodyStates, RigidBody
from warp_lcp.rigid.contact_detection import (
    ContactDetection,
    UncheckedPose,
    between,
    close_pairs,
    on_plane,
)
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contacts import SAME_PLACE, ContactMemory
from warp_lcp.rigid.mass_properties import MassProperties
from warp_lcp.rigid.obstacles import Obstacle


def test_close_pairs_are_those_that_overlap():
    """Close pairs against all pairs, including boxes that just touch."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 30))
        middle, half = rng.integers(0, 12, (n, 3)) / 4.0, rng.integers(0, 4, (n, 3)) / 8.0
        low, high = middle - half, middle + half
        expected = np.argwhere(
            np.tril(((low[:, None] <= high) & (low <= high[:, None])).all(axis=2), -1)
        )
        np.testing.assert_array_equal(np.column_stack(close_pairs(middle, half)), expected)


def turned(rng):
    return np.linalg.qr(rng.standard_normal((3, 3)))[0]


def placed(positions, rng):
    """Return randomly turned bodies with given centers of mass."""
    unit = MassProperties(mass=1.0, center=np.zeros(3), inertia=np.eye(3))
    bodies = BodyStates([RigidBody(unit, name=f"body {i}") for i in range(len(positions))])
    bodies.position[:], bodies.rotation[:] = positions, [turned(rng) for _ in positions]
    return bodies


def test_balls_touch_where_each_two_of_them_do():
    """Contacts of balls against pairwise distances.

    Two have the same center.
    """
    rng, n = np.random.default_rng(3), 25
    shapes = [
        ContactShape.of(Sphere(center=[0.0, 0.0, 0.0], radius=float(rng.uniform(0.1, 0.3))), 3)
        for _ in range(n)
    ]
    at = rng.uniform(0.0, 1.2, (n, 3))
    at[7] = at[3]
    bodies = placed(at, rng)
    ways = rng.uniform(0.0, 0.02, n)
    found = ContactDetection(bodies, shapes, (), 3).find(0.0, ways, np.zeros(0), 0.01)
    places = [UncheckedPose(body.rotation, body.position) for body in bodies]
    expected = {}
    for i in range(n):
        for j in range(i):
            points = between(
                shapes[i], places[i], shapes[j], places[j], 0.01 + ways[i] + ways[j], 3
            )
            expected |= {(i, j): points} if len(points) else {}
    assert list(zip(found.first.tolist(), found.second.tolist(), strict=True)) == list(expected)
    assert len(expected) > 20 and (7, 3) in expected
    for name in ("point", "normal", "gap"):
        each = np.concatenate([getattr(points, name) for points in expected.values()])
        np.testing.assert_allclose(getattr(found.points, name), each, atol=1e-12)


class TouchingPairs(SimpleNamespace):
    def __len__(self):
        return len(self.first)


def test_impulses_come_back_to_the_nearest_contact_of_the_same_two():
    """Recalled impulses: from the nearest contact of the same pair.

    Each from at most one of the last step, whose place is the nearest.
    """
    recalled = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n, k, m = (int(count) for count in rng.integers((1, 1, 1), (5, 30, 30)))
        bodies = placed(rng.standard_normal((n, 3)), rng)
        contacts = TouchingPairs(
            first=rng.integers(0, n, k),
            second=rng.integers(0, n + 1, k),
            point=rng.standard_normal((k, 3)).round(1),
            size=np.full(k, rng.uniform(0, 40)),
            frames=rng.standard_normal((k, 3, 3)),
            wall=np.zeros((k, 3)),
        )
        memory = ContactMemory(n)
        ends = rng.integers(0, n, m), rng.integers(0, n + 1, m)
        memory.values = np.column_stack(
            [*ends, rng.standard_normal((m, 3)).round(1), rng.standard_normal((m, 3))]
        )
        start, old = memory.initial_impulses(contacts, bodies), memory.values
        places = [
            (p - bodies[i].position) @ bodies[i].rotation
            for p, i in zip(contacts.point, contacts.first, strict=True)
        ]
        way = np.linalg.norm(np.array(places)[:, None] - old[:, 2:5], axis=2)
        way[(contacts.first[:, None] != old[:, 0]) | (contacts.second[:, None] != old[:, 1])] = (
            np.inf
        )
        for c in range(k):
            nearest = int(way[c].argmin())
            known = (
                way[c, nearest] < SAME_PLACE * contacts.size[c]
                and int(way[:, nearest].argmin()) == c
            )
            np.testing.assert_allclose(
                start[c], contacts.frames[c] @ old[nearest, 5:] if known else 0.0, atol=1e-14
            )
            recalled += known
    assert recalled > 20


def test_balls_touch_planes_where_each_of_them_does():
    """Contacts of balls with planes, body by body and plane by plane.

    With a box among the balls and an obstacle that has moved.
    """
    rng, n = np.random.default_rng(8), 12
    shapes = [
        ContactShape.of(Sphere(center=[0.0, 0.0, 0.0], radius=float(rng.uniform(0.1, 0.3))), 3)
        for _ in range(n)
    ]
    shapes[4] = ContactShape.of(Box(lower=[-0.2, -0.1, -0.3], upper=[0.2, 0.1, 0.3]), 3)
    bodies, normals = placed(rng.uniform(-0.3, 0.5, (n, 3)), rng), turned(rng)
    still = SimpleNamespace(
        pose=lambda time: Pose(rotation=np.eye(3), translation=np.array([0.0, 0.1, 0.0]))
    )
    planes = Obstacle(
        name="planes", points=rng.uniform(-0.3, 0.0, (3, 3)), normals=normals, motion=still
    )
    ways = rng.uniform(0.0, 0.02, n)
    found = ContactDetection(bodies, shapes, (planes,), 3, every=True).find(
        0.0, ways, np.full(1, 0.01)
    )
    found, expected = found.where(found.obstacle == 0), []
    for i, body in enumerate(bodies):
        for point, normal in zip(planes.points + 0.1 * np.eye(3)[1], normals, strict=True):
            touch = on_plane(
                shapes[i],
                UncheckedPose(body.rotation, body.position),
                point,
                normal,
                0.01 + ways[i],
            )
            expected += [
                (i, *touch.point[k], *touch.normal[k], touch.gap[k]) for k in range(len(touch))
            ]
    assert len({i for i, *_ in expected}) > 5 and 4 in found.first and (found.second == n).all()
    rows = np.column_stack([found.first, found.points.point, found.points.normal, found.points.gap])
    np.testing.assert_allclose(rows, expected, atol=1e-12)
