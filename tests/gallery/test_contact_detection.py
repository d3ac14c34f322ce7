"""Contacts of pairs with a known gap, and the Jacobian J.

J is compared with the change of the gap as bodies move a little.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_lcp.gallery.contact_scenes import box, gear
from warp_lcp.gallery.rigid_world import FIXED, GROUND, World
from warp_lcp.grid.signed_distance import Sphere
from warp_lcp.rigid.box_contacts import OrientedBox, box_box
from warp_lcp.rigid.obstacles import Obstacle


def world_of(*solids, obstacles=(), **options):
    return World("", solids, [1.0, 2.0][: len(solids)], obstacles, **options)


def ball(center, radius):
    return Sphere(center=center, radius=radius)


def plane(normal, offset=0.0):
    return Obstacle(name="plane", points=offset * np.array([normal]), normals=np.array([normal]))


def turn(*vector):
    return Rotation.from_rotvec(vector)


def test_spheres():
    contacts = world_of(ball([0, 0, 0], 1.0), ball([0, 0, 1.4], 0.5)).contacts(margin=0.1)
    assert len(contacts) == 1
    assert contacts.gap[0] == pytest.approx(-0.1)
    # Into the first body, which is above.
    np.testing.assert_allclose(contacts.frames[0, 0], [0, 0, 1])
    assert (contacts.first[0], contacts.second[0]) == (1, 0)
    np.testing.assert_allclose(contacts.point[0], [0, 0, 0.95])  # halfway between 1.0 and 0.9
    assert len(world_of(ball([0, 0, 0], 1.0), ball([0, 0, 1.7], 0.5)).contacts(margin=0.1)) == 0


def test_contacts_within_a_step_are_those_that_the_speed_closes():
    world = world_of(ball([0, 0, 0], 0.5), ball([0, 0, 1.5], 0.5))  # the gap is 0.5 m
    world.bodies[0].momentum = np.array([2.0, 0.0, 0.0])  # mass 1: 2 m/s; the other may do the same
    assert [len(world.contacts(*dt)) for dt in ((), (0.12,), (0.13,))] == [0, 0, 1]


def test_a_sphere_and_a_tilted_plane():
    normal = np.array([0.6, 0.0, 0.8])
    contacts = world_of(
        ball(0.55 * normal + np.array([0, 3, 0]), 0.5), obstacles=(plane(normal),)
    ).contacts(margin=0.1)
    assert contacts.second[0] == 1  # no second body
    assert contacts.gap[0] == pytest.approx(0.05)
    np.testing.assert_allclose(contacts.point[0], 0.025 * normal + [0, 3, 0], atol=1e-14)


def test_a_box_stands_on_four_corners_or_on_one():
    contacts = world_of(box([0, 0, 0.3], (0.1, 0.2, 0.3)), obstacles=(GROUND,)).contacts(
        margin=0.01
    )
    assert sorted(map(tuple, contacts.point.round(12).tolist())) == [
        (-0.1, -0.2, 0),
        (-0.1, 0.2, 0),
        (0.1, -0.2, 0),
        (0.1, 0.2, 0),
    ]
    leaning = turn(0.5, 0.3, 0.0)
    lowest = 0.3 - np.abs(leaning.as_matrix()[2]) @ [0.1, 0.2, 0.3]  # support function of a box
    low = plane([0.0, 0.0, 1.0], lowest - 0.001)
    contacts = world_of(box([0, 0, 0.3], (0.1, 0.2, 0.3), leaning), obstacles=(low,)).contacts(
        margin=0.01
    )
    assert len(contacts) == 1
    assert contacts.gap[0] == pytest.approx(0.001)


def test_a_face_on_a_face_gives_the_corners_of_the_overlap():
    contacts = world_of(box([0, 0, 0.5], (0.5,) * 3), box([0.4, 0.0, 1.19], (0.2,) * 3)).contacts(
        margin=0.02
    )
    np.testing.assert_allclose(contacts.gap, -0.01)
    np.testing.assert_allclose(contacts.frames[:, 0], np.tile([0, 0, 1.0], (4, 1)), atol=1e-14)
    # x from 0.2 to 0.6, cut at 0.5.
    expected = {(x, y, 0.995) for x in (0.2, 0.5) for y in (-0.2, 0.2)}
    assert {tuple(p) for p in contacts.point.round(9).tolist()} == expected


def test_a_turned_face_gives_an_octagon():
    contacts = world_of(
        box([0, 0, 0.5], (0.5,) * 3), box([0, 0, 1.5], (0.5,) * 3, turn(0, 0, np.pi / 4))
    ).contacts(margin=0.02)
    assert len(contacts) == 8
    np.testing.assert_allclose(
        np.linalg.norm(contacts.point[:, :2], axis=1), 0.5 / np.cos(np.pi / 8), rtol=1e-12
    )
    np.testing.assert_allclose(contacts.gap, 0, atol=1e-12)


def test_crossed_edges_meet_in_a_point():
    h = 0.5
    # An edge along x on top, at height h sqrt 2.
    a = OrientedBox(np.zeros(3), turn(np.pi / 4, 0, 0).as_matrix(), np.full(3, h))
    # Along y, below.
    b = OrientedBox(
        np.array([0.1, 0.05, 2 * h * np.sqrt(2) + 0.01]),
        turn(0, np.pi / 4, 0).as_matrix(),
        np.full(3, h),
    )
    points, normal, gaps = box_box(a, b, 0.02)
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(points, [[0.1, 0.0, h * np.sqrt(2) + 0.005]], atol=1e-12)
    np.testing.assert_allclose(gaps, [0.01], atol=1e-12)
    assert box_box(a, b, 0.005) is None
    swapped = box_box(b, a, 0.02)
    np.testing.assert_allclose(swapped[1], -normal, atol=1e-12)
    np.testing.assert_allclose(swapped[0], points, atol=1e-12)


@pytest.mark.parametrize("angle", [0.4, 1.1, 2.5])
def test_oblique_edges_meet_where_their_lines_cross(angle):
    """Point between an edge along x and one at an angle to it, seen from above.

    Their lines cross above (0.1, 0); the second edge's middle is 0.2 along it from there.
    """
    h, along = 0.5, np.array([np.cos(angle), np.sin(angle), 0.0])
    a = OrientedBox(np.zeros(3), turn(np.pi / 4, 0, 0).as_matrix(), np.full(3, h))
    rotation = turn(0, 0, angle) * turn(np.pi / 4, 0, 0)
    center = np.array([0.1, 0.0, 2 * h * np.sqrt(2) + 0.01]) + 0.2 * along
    points, normal, gaps = box_box(
        a, OrientedBox(center, rotation.as_matrix(), np.full(3, h)), 0.02
    )
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(points, [[0.1, 0.0, h * np.sqrt(2) + 0.005]], atol=1e-12)
    np.testing.assert_allclose(gaps, [0.01], atol=1e-12)


def test_a_sphere_at_a_box_from_outside_and_inside():
    cube = box([0, 0, 0], (0.5,) * 3)
    contacts = world_of(cube, ball([0.6, 0.6, 0.0], 0.2)).contacts(margin=0.01)
    assert contacts.gap[0] == pytest.approx(0.1 * np.sqrt(2) - 0.2)
    np.testing.assert_allclose(contacts.frames[0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0])
    contacts = world_of(cube, ball([0.4, 0.0, 0.0], 0.2)).contacts(margin=0.01)
    assert contacts.gap[0] == pytest.approx(-0.3)
    np.testing.assert_allclose(contacts.frames[0, 0], [1, 0, 0])


KINDS = {
    "spheres": lambda: world_of(ball([0, 0, 0], 0.5), ball([0.6, 0.5, 0.6], 0.5)),
    "sphere and box": lambda: world_of(
        ball([0, 0, 0.8], 0.5), box([0.1, 0, 0], (0.3,) * 3, turn(0.1, 0.05, 0))
    ),
    "sphere and gear": lambda: world_of(
        ball([0, 0, 0.52], 0.2), gear([0.05, 0, 0], (0.3, 0.05, 0.1), 0.5)
    ),
    "corner on face": lambda: world_of(
        box([0, 0, 0], (0.5,) * 3), box([0.1, 0, 0.82], (0.2,) * 3, turn(0.7, 0.5, 0))
    ),
    "edges": lambda: world_of(
        box([0, 0, 0], (0.5,) * 3, turn(np.pi / 4, 0.02, 0)),
        box([0.1, 0, np.sqrt(2)], (0.5,) * 3, turn(0.01, np.pi / 4, 0)),
    ),
    "box on plane": lambda: world_of(
        box([0, 0, 0.34], (0.1, 0.2, 0.3), turn(0.4, 0.3, 0.2)), obstacles=(GROUND,)
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_normal_rows_of_the_jacobian_are_the_rate_of_the_gap(kind):
    """Normal rows of the Jacobian against the rate of the gap.

    A wrong sign or arm in J shows: moving bodies by v dt changes the gap by J_n v dt.
    """
    world, rng = KINDS[kind](), np.random.default_rng(91)
    contacts = world.contacts(margin=0.05)
    deepest, velocity = int(contacts.gap.argmin()), rng.standard_normal((len(world.bodies), 6))
    rate = (contacts.jacobian(len(world.bodies)) @ velocity.ravel())[3 * deepest]
    dt, gaps = 1e-6, []
    for step in (dt, -2 * dt):
        for body, v in zip(world.bodies, velocity, strict=True):
            body.shift(step * v)
        gaps.append(world.contacts(margin=0.05).gap.min())
    assert (gaps[0] - gaps[1]) / (2 * dt) == pytest.approx(rate, rel=1e-4, abs=1e-4)


def test_tangential_rows_are_the_slip_along_a_right_handed_frame():
    contacts = world_of(ball([0.6, 0.5, 0.6], 0.5), ball([0, 0, 0], 0.5)).contacts(margin=0.05)
    frame = contacts.frames[0]
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    velocity = np.array([[0.0] * 6, [1.0, 2.0, 3.0, 0.3, -0.2, 0.5]])
    slip = velocity[1, :3] + np.cross(velocity[1, 3:], contacts.point[0])
    np.testing.assert_allclose(contacts.jacobian(2) @ velocity.ravel(), frame @ slip, atol=1e-14)


def test_fixed_and_ignored_pairs_have_no_contacts():
    balls = (ball([0, 0, 0], 0.5), ball([0, 0, 1.0], 0.5))
    assert len(world_of(*balls).contacts(margin=0.01)) == 1
    assert len(world_of(*balls, ignored=frozenset({(0, 1)})).contacts(margin=0.01)) == 0
    assert len(World("", balls, [FIXED, FIXED], (GROUND,)).contacts(margin=0.01)) == 0
