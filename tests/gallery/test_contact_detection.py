"""Contacts of pairs whose gap is known by geometry; and J, against the change of the gap as bodies move a little."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_lcp.gallery.contact_detection import GROUND, Plane, detect
from warp_lcp.gallery.rigid_bodies import FIXED, Box, RigidBodies, Sphere
from warp_lcp.rigid.box_contacts import OrientedBox, box_box

GROUND_PLANE = (Plane((0.0, 0.0, 1.0)),)


def pair(first, second, position, rotation=None):
    return RigidBodies([first, second], [1.0, 2.0], position, rotation)


def turned(*vectors):
    return [Rotation.from_rotvec(v).as_matrix() for v in vectors]


def test_spheres():
    contacts = detect(pair(Sphere(1.0), Sphere(0.5), [[0, 0, 0], [0, 0, 1.4]]), (), 0.1)
    assert len(contacts) == 1
    assert contacts.gap[0] == pytest.approx(-0.1)
    np.testing.assert_allclose(contacts.normal[0], [0, 0, -1])  # into the first, which is below
    np.testing.assert_allclose(contacts.point[0], [0, 0, 0.95])  # halfway between 1.0 and 0.9
    assert len(detect(pair(Sphere(1.0), Sphere(0.5), [[0, 0, 0], [0, 0, 1.7]]), (), 0.1)) == 0


def test_a_sphere_and_a_tilted_plane():
    normal = np.array([0.6, 0.0, 0.8])
    bodies = RigidBodies([Sphere(0.5)], [1.0], [0.55 * normal + np.array([0, 3, 0])])
    contacts = detect(bodies, (Plane(tuple(normal)),), 0.1)
    assert contacts.second[0] == GROUND
    assert contacts.gap[0] == pytest.approx(0.05)
    np.testing.assert_allclose(contacts.point[0], 0.025 * normal + [0, 3, 0], atol=1e-14)


def test_a_box_stands_on_four_corners_or_on_one():
    bodies = RigidBodies([Box((0.1, 0.2, 0.3))], [1.0], [[0, 0, 0.3]])
    contacts = detect(bodies, GROUND_PLANE, 0.01)
    assert sorted(map(tuple, contacts.point.round(12).tolist())) == [(-0.1, -0.2, 0), (-0.1, 0.2, 0), (0.1, -0.2, 0), (0.1, 0.2, 0)]
    bodies.rotation[0] = turned([0.5, 0.3, 0.0])[0]
    lowest = 0.3 - np.abs(bodies.rotation[0][2]) @ [0.1, 0.2, 0.3]  # support function of a box
    contacts = detect(bodies, (Plane((0.0, 0.0, 1.0), lowest - 0.001),), 0.01)
    assert len(contacts) == 1
    assert contacts.gap[0] == pytest.approx(0.001)


def test_a_face_on_a_face_gives_the_corners_of_the_overlap():
    contacts = detect(pair(Box((0.5, 0.5, 0.5)), Box((0.2, 0.2, 0.2)), [[0, 0, 0.5], [0.4, 0.0, 1.19]]), (), 0.02)
    np.testing.assert_allclose(contacts.gap, -0.01)
    np.testing.assert_allclose(contacts.normal, np.tile([0, 0, -1.0], (4, 1)), atol=1e-14)
    expected = {(x, y, 0.995) for x in (0.2, 0.5) for y in (-0.2, 0.2)}  # x from 0.2 to 0.6, cut at 0.5
    assert {tuple(p) for p in contacts.point.round(9).tolist()} == expected


def test_a_turned_face_gives_an_octagon():
    R = turned([0, 0, 0], [0, 0, np.pi / 4])
    contacts = detect(pair(Box((0.5, 0.5, 0.5)), Box((0.5, 0.5, 0.5)), [[0, 0, 0.5], [0, 0, 1.5]], R), (), 0.02)
    assert len(contacts) == 8
    np.testing.assert_allclose(np.linalg.norm(contacts.point[:, :2], axis=1), 0.5 / np.cos(np.pi / 8), rtol=1e-12)
    np.testing.assert_allclose(contacts.gap, 0, atol=1e-12)


def test_crossed_edges_meet_in_a_point():
    h = 0.5
    a = OrientedBox(np.zeros(3), turned([np.pi / 4, 0, 0])[0], np.full(3, h))  # an edge along x on top, at height h sqrt 2
    b = OrientedBox(np.array([0.1, 0.05, 2 * h * np.sqrt(2) + 0.01]), turned([0, np.pi / 4, 0])[0], np.full(3, h))  # along y, below
    points, normal, gaps = box_box(a, b, 0.02)
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(points, [[0.1, 0.0, h * np.sqrt(2) + 0.005]], atol=1e-12)
    np.testing.assert_allclose(gaps, [0.01], atol=1e-12)
    assert box_box(a, b, 0.005) is None
    swapped = box_box(b, a, 0.02)
    np.testing.assert_allclose(swapped[1], -normal, atol=1e-12)
    np.testing.assert_allclose(swapped[0], points, atol=1e-12)


def test_a_sphere_at_a_box_from_outside_and_inside():
    bodies = pair(Sphere(0.2), Box((0.5, 0.5, 0.5)), [[0.6, 0.6, 0.0], [0, 0, 0]])
    contacts = detect(bodies, (), 0.01)
    assert contacts.gap[0] == pytest.approx(0.1 * np.sqrt(2) - 0.2)
    np.testing.assert_allclose(contacts.normal[0], [np.sqrt(0.5), np.sqrt(0.5), 0])
    bodies.position[0] = [0.4, 0.0, 0.0]
    contacts = detect(bodies, (), 0.01)
    assert contacts.gap[0] == pytest.approx(-0.3)
    np.testing.assert_allclose(contacts.normal[0], [1, 0, 0])


@pytest.mark.parametrize("kind", ["spheres", "sphere and box", "corner on face", "edges", "box on plane"])
def test_normal_rows_of_the_jacobian_are_the_rate_of_the_gap(kind):
    """A wrong sign or arm in J shows: moving bodies by v dt changes the gap by J_n v dt."""
    rng, planes = np.random.default_rng(91), ()
    if kind == "spheres":
        bodies = pair(Sphere(0.5), Sphere(0.5), [[0, 0, 0], [0.6, 0.5, 0.6]])
    elif kind == "sphere and box":
        bodies = pair(Sphere(0.5), Box((0.3, 0.3, 0.3)), [[0, 0, 0.8], [0.1, 0, 0]], turned([0, 0, 0], [0.1, 0.05, 0]))
    elif kind == "corner on face":
        bodies = pair(Box((0.5, 0.5, 0.5)), Box((0.2, 0.2, 0.2)), [[0, 0, 0], [0.1, 0, 0.82]], turned([0, 0, 0], [0.7, 0.5, 0]))
    elif kind == "edges":
        high = np.sqrt(2)
        bodies = pair(
            Box((0.5, 0.5, 0.5)), Box((0.5, 0.5, 0.5)), [[0, 0, 0], [0.1, 0, high]], turned([np.pi / 4, 0.02, 0], [0.01, np.pi / 4, 0])
        )
    else:
        bodies, planes = RigidBodies([Box((0.1, 0.2, 0.3))], [1.0], [[0, 0, 0.34]], turned([0.4, 0.3, 0.2])), GROUND_PLANE
    contacts = detect(bodies, planes, 0.05)
    deepest = int(contacts.gap.argmin())
    bodies.velocity[:] = rng.standard_normal(bodies.velocity.shape)
    rate = (contacts.jacobian(bodies) @ bodies.velocity.ravel())[3 * deepest]
    dt, gaps = 1e-6, []
    for step in (dt, -2 * dt):
        bodies.position += step * bodies.velocity[:, :3]
        bodies.turn(step * bodies.velocity[:, 3:])
        gaps.append(detect(bodies, planes, 0.05).gap.min())
    assert (gaps[0] - gaps[1]) / (2 * dt) == pytest.approx(rate, rel=1e-4, abs=1e-4)


def test_tangential_rows_are_the_slip_along_a_right_handed_frame():
    bodies = pair(Sphere(0.5), Sphere(0.5), [[0, 0, 0], [0.6, 0.5, 0.6]])
    contacts = detect(bodies, (), 0.05)
    frame = contacts.frames()[0]
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    bodies.velocity[0] = [1.0, 2.0, 3.0, 0.3, -0.2, 0.5]
    slip = bodies.velocity[0, :3] + np.cross(bodies.velocity[0, 3:], contacts.point[0])
    np.testing.assert_allclose(contacts.jacobian(bodies) @ bodies.velocity.ravel(), frame @ slip, atol=1e-14)


def test_fixed_and_ignored_pairs_have_no_contacts():
    bodies = pair(Sphere(0.5), Sphere(0.5), [[0, 0, 0], [0, 0, 1.0]])
    assert len(detect(bodies, (), 0.01)) == 1
    assert len(detect(bodies, (), 0.01, frozenset({(0, 1)}))) == 0
    fixed = RigidBodies([Sphere(0.5)] * 2, [FIXED, FIXED], [[0, 0, 0], [0, 0, 1.0]])
    assert len(detect(fixed, GROUND_PLANE, 0.01)) == 0
    with pytest.raises(ValueError, match="normal"):
        Plane((0.0, 0.0, 2.0))
