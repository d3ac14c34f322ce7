"""Edge contacts of capsules, boxes and meshes.

Against dense samples, and by letting them fall on each other.
"""

import numpy as np
import pytest
from bodies_at_hand import GRAVITY, SIDES, bodies_of, run
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from default_run import slow
from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, TriangleMesh
from warp_lcp.grid.triangle_mesh import close_surface
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.rigid.contact_detection import between
from warp_lcp.rigid.contact_shape import ContactShape

FAR = 10.0
R, HALF = 0.0075, 0.01  # half widths of capsules and bars [m]
HERE = Pose.identity()


def capsule_of(rng, radius):
    ends = rng.uniform(-0.4, 0.4, (2, 3))
    return Capsule(start=ends[0].tolist(), end=ends[1].tolist(), radius=radius), ends


def sampled(ends, count=4001):
    return ends[0] + np.linspace(0.0, 1.0, count)[:, None] * (ends[1] - ends[0])


def to_segment(points, ends):
    """Return the distances of points from a segment."""
    way = ends[1] - ends[0]
    share = np.clip((points - ends[0]) @ way / (way @ way), 0.0, 1.0)
    return np.linalg.norm(points - ends[0] - share[:, None] * way, axis=1)


@pytest.mark.default_cases(12)
@pytest.mark.parametrize("seed", range(30, 50))
def test_the_gap_of_two_capsules_is_that_of_their_axes(seed):
    rng = np.random.default_rng(seed)
    (one, a), (other, b) = capsule_of(rng, 0.03), capsule_of(rng, 0.05)
    touch = between(ContactShape.of(one, 3), HERE, ContactShape.of(other, 3), HERE, FAR, 3)
    best = int(touch.gap.argmin())
    dense = to_segment(sampled(a), b).min() - 0.08
    assert dense - 1e-6 < touch.gap[best] <= dense + 1e-12
    # Halfway between both.
    np.testing.assert_allclose(
        to_segment(touch.point[best][None], a), 0.03 + 0.5 * touch.gap[best], atol=1e-7
    )
    np.testing.assert_allclose(
        to_segment(touch.point[best][None], b), 0.05 + 0.5 * touch.gap[best], atol=1e-7
    )


@pytest.mark.default_cases(12)
@pytest.mark.parametrize("seed", range(50, 80))
def test_the_gap_of_a_capsule_and_a_box_is_that_of_its_axis(seed):
    """Gap of a capsule and a box: that of its axis.

    The axis is beside a face, across an edge, at a corner, or inside.
    """
    rng = np.random.default_rng(seed)
    capsule, ends = capsule_of(rng, 0.02)
    half, turned, at = (
        rng.uniform(0.03, 0.2, 3),
        Rotation.random(rng=rng).as_matrix(),
        rng.uniform(-0.2, 0.2, 3),
    )
    box, pose = Box(lower=(-half).tolist(), upper=half.tolist()), Pose(turned, at)
    touch = between(ContactShape.of(capsule, 3), HERE, ContactShape.of(box, 3), pose, FAR, 3)
    beyond = np.abs((sampled(ends) - at) @ turned) - half
    signed = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    assert signed.min() - 0.02 - 5e-4 < touch.gap.min() <= signed.min() - 0.02 + 1e-9
    if signed.min() > 0.0:
        assert touch.gap.min() > signed.min() - 0.02 - 1e-5


def bar(low, high, tilt=(0.0, 0.0, 0.0)):
    """Return a mesh of twelve triangles."""
    low, high = np.array(low), np.array(high)
    vertices = np.array(
        [[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]
    ) * (high - low)
    placement = Placement.from_degrees(1.0, list(tilt), (0.5 * (low + high)).tolist(), 3)
    return TriangleMesh(
        surface=close_surface(vertices, ConvexHull(vertices).simplices, "bar"), placement=placement
    )


def lying(kind, top, x):
    """Return a long thin body along z whose top is at a height."""
    y = top - HALF
    if kind == "capsule":
        return Capsule(start=[x, top - R, 0.1], end=[x, top - R, 0.9], radius=R)
    low, high = [x - HALF, y - HALF, 0.03], [x + HALF, y + HALF, 0.97]
    return (
        Box(lower=low, upper=high)
        if kind == "box"
        else bar(low, high, (0.0, 0.0, 45.0) if kind == "edge" else (0.0, 0.0, 0.0))
    )


def across(kind, bottom):
    """Return a long thin body along x whose bottom is at a height."""
    if kind == "capsule":
        return Capsule(start=[0.2, bottom + R, 0.47], end=[0.8, bottom + R, 0.47], radius=R)
    low, high = [0.1, bottom, 0.455], [0.9, bottom + 2.0 * HALF, 0.455 + 2.0 * HALF]
    return Box(lower=low, upper=high) if kind == "box" else bar(low, high)


@pytest.mark.parametrize(
    ("falling", "standing"),
    [
        ("capsule", "capsule"),
        ("capsule", "box"),
        slow(("box", "capsule")),
        slow(("mesh", "mesh")),
        slow(("capsule", "mesh")),
        ("mesh", "capsule"),
        slow(("mesh", "box")),
        slow(("mesh", "edge")),
    ],
)
def test_a_capsule_dropped_across_two_others_comes_to_rest(falling, standing):
    """Rest of a body that falls across two others.

    Away from the ends and middles of both, where points of a coarse sample lie.
    """
    raised = HALF * (np.sqrt(2.0) - 1.0) if standing == "edge" else 0.0
    solids = [
        PlacedSolid(geometry=lying(standing, 0.2, x), separating=True, name="solid", motion=None)
        for x in (0.33, 0.67)
    ]
    bodies = bodies_of([across(falling, 0.23)], 3, open_sides=SIDES, solids=solids)
    run(bodies, 0.3, dt=0.005)
    body, half = bodies.bodies[0], R if falling == "capsule" else HALF
    assert body.position[1] == pytest.approx(0.2 + raised + half, abs=3e-4)
    assert np.linalg.norm(body.velocity) < 0.02


def test_capsules_that_fly_at_each_other_crosswise_meet():
    """Crosswise impact of two flying capsules.

    The nearest points of both lie between their sampled ones.
    """
    shapes = [
        Capsule(start=[0.3, 0.2, 0.2], end=[0.3, 0.9, 0.2], radius=R),
        Capsule(start=[0.5, 0.53, 0.05], end=[0.5, 0.53, 0.61], radius=R),
    ]
    bodies = bodies_of(
        shapes, 3, open_sides=SIDES, settings=[{"velocity": np.array([2.0, 0.0, 0.0])}, {}]
    )
    momentum = bodies.bodies[0].momentum[0]
    for _ in range(30):
        run(bodies, 0.005, dt=0.005, gravity=0.0 * GRAVITY)
    assert bodies.bodies[1].momentum[0] > 0.2 * momentum
    assert sum(body.momentum[0] for body in bodies.bodies) == pytest.approx(momentum)
