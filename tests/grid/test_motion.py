"""Poses against formulas and 4 x 4 matrices; motions against their velocities.

The velocities are known in closed form.
"""

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from grid_fields import distances
from warp_lcp.grid.motion import (
    Keyframes,
    Motion,
    Motions,
    Pose,
    Rotation,
    Sinusoid,
    Translation,
    kinks,
)
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.triangle_mesh import builtin_mesh

RNG = np.random.default_rng(3917)
POINTS = RNG.uniform(-2.0, 2.0, (50, 3))
STEP = 1e-5  # [s] of central differences


def cross_matrix(axis):
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn(axis, degrees):
    """Return the rotation matrix as the series of exp(angle [axis]x).

    It is independent of Rodrigues' formula and of quaternions.
    """
    generator = math.radians(degrees) * cross_matrix(np.asarray(axis) / np.linalg.norm(axis))
    term, total = np.eye(3), np.eye(3)
    for order in range(1, 60):
        term = term @ generator / order
        total = total + term
    return total


def matrix(pose):
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = pose.rotation, pose.translation
    return full


def any_pose(seed):
    rng = np.random.default_rng(seed)
    return Pose(turn(rng.standard_normal(3), rng.uniform(-170.0, 170.0)), rng.uniform(-3.0, 3.0, 3))


def velocity(motion, time, points=POINTS):
    """Return the velocity of material points that are at `points` at `time`.

    It follows from central differences of the poses.
    """
    back = motion.pose(time).inverse().apply(points)
    return (motion.pose(time + STEP).apply(back) - motion.pose(time - STEP).apply(back)) / (
        2 * STEP
    )


def rigid(points, linear, angular, center):
    """Return v = linear + angular x (p - center); angular velocity in degrees/s."""
    return np.asarray(linear) + np.cross(np.radians(angular), points - center)


@given(st.integers(0, 10**6), st.integers(0, 10**6))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_poses_compose_like_matrices(first, second):
    a, b = any_pose(first), any_pose(second)
    np.testing.assert_allclose(matrix(a.after(b)), matrix(a) @ matrix(b), atol=1e-13)
    np.testing.assert_allclose(matrix(a.inverse()), np.linalg.inv(matrix(a)), atol=1e-13)
    np.testing.assert_allclose(a.after(b).apply(POINTS), a.apply(b.apply(POINTS)), atol=1e-13)
    np.testing.assert_allclose(a.inverse().apply(a.apply(POINTS)), POINTS, atol=1e-13)


def test_poses_keep_shapes_and_arrays():
    np.testing.assert_array_equal(Pose.identity().apply(POINTS), POINTS)
    assert any_pose(3).apply(np.zeros((4, 5, 3))).shape == (4, 5, 3)
    with pytest.raises(ValueError, match="read-only"):
        Pose.identity().translation[0] = 1.0
    turned = Pose.about(np.array([1.0, 2.0, 0.0]), turn([0, 0, 1], 90.0), np.array([0.0, 0.0, 5.0]))
    np.testing.assert_allclose(
        turned.apply(np.array([[2.0, 2.0, 0.0]])), [[1.0, 3.0, 5.0]], atol=1e-14
    )


def test_translation():
    motion = Translation(velocity=[0.3, -2.0], start=0.5, stop=1.5)
    assert isinstance(motion, Motion)
    for time, shift in ((-1.0, 0.0), (0.5, 0.0), (0.75, 0.25), (1.5, 1.0), (9.0, 1.0)):
        pose = motion.pose(time)
        np.testing.assert_allclose(pose.translation, [0.3 * shift, -2.0 * shift, 0.0], atol=1e-15)
        np.testing.assert_array_equal(pose.rotation, np.eye(3))
    np.testing.assert_allclose(velocity(motion, 1.1), np.tile([0.3, -2.0, 0.0], (50, 1)), atol=1e-8)
    assert not velocity(motion, 0.2).any()
    assert not velocity(motion, 2.0).any()


def test_rotation():
    center, axis = np.array([0.2, -0.4, 0.7]), np.array([1.0, -2.0, 2.0])
    motion = Rotation(rate=75.0, center=center, axis=axis, start=0.2, stop=1.2)
    for time, degrees in ((0.0, 0.0), (0.6, 30.0), (1.2, 75.0), (4.0, 75.0)):
        np.testing.assert_allclose(motion.pose(time).rotation, turn(axis, degrees), atol=1e-14)
        np.testing.assert_allclose(motion.pose(time).apply(center), center, atol=1e-15)
    np.testing.assert_allclose(
        velocity(motion, 0.9), rigid(POINTS, [0, 0, 0], 75.0 * axis / 3.0, center), atol=1e-8
    )


def test_flat_rotations_are_counterclockwise_and_do_not_drift():
    motion = Rotation(rate=90.0, center=[1.0, 0.0])
    np.testing.assert_allclose(
        motion.pose(1.0).apply(np.array([[2.0, 0.0, 0.0]])), [[1.0, 1.0, 0.0]], atol=1e-15
    )
    # A thousand turns.
    np.testing.assert_allclose(matrix(motion.pose(4000.0)), np.eye(4), atol=1e-12)


def test_sinusoid():
    center, axis = np.array([0.1, 0.2, 0.3]), np.array([0.0, 3.0, 4.0])
    motion = Sinusoid(
        period=0.8, amplitude=[0.5, 0.0, -0.2], phase=-30.0, angle=20.0, center=center, axis=axis
    )
    for time in (0.0, 0.13, 2.9):
        argument = 2 * math.pi * time / 0.8 - math.pi / 6
        swing, rate = math.sin(argument), 2 * math.pi / 0.8 * math.cos(argument)
        shift = swing * np.array([0.5, 0.0, -0.2])
        pose = motion.pose(time)
        np.testing.assert_allclose(pose.rotation, turn(axis, 20.0 * swing), atol=1e-14)
        np.testing.assert_allclose(pose.apply(center), center + shift, atol=1e-14)
        expected = rigid(
            POINTS, rate * np.array([0.5, 0.0, -0.2]), 20.0 * rate * axis / 5.0, center + shift
        )
        np.testing.assert_allclose(velocity(motion, time), expected, atol=2e-7)


def test_sinusoids_begin_where_their_phase_says():
    middle, end = (
        Sinusoid(period=2.0, amplitude=[0.3, 0.0], phase=phase) for phase in (0.0, -90.0)
    )
    np.testing.assert_array_equal(middle.pose(0.0).translation, np.zeros(3))
    np.testing.assert_allclose(velocity(middle, 0.0)[0], [0.3 * math.pi, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(end.pose(0.0).translation, [-0.3, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(velocity(end, 0.0)[0], 0.0, atol=1e-8)


TIMES = [0.0, 1.0, 1.5, 4.0]
SHIFTS = [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [-1.0, 2.0]]


@pytest.mark.parametrize("smooth", [False, True])
def test_keyframes_pass_their_places(smooth):
    motion = Keyframes(
        times=TIMES,
        translate=SHIFTS,
        rotate=[0.0, 90.0, 810.0, 800.0],
        center=[0.5, 0.5],
        smooth=smooth,
    )
    center = np.array([0.5, 0.5, 0.0])
    for time, shift, degrees in zip(
        [-1.0, *TIMES, 5.0], [[0, 0], *SHIFTS, [-1, 2]], [0, 0, 90, 810, 800, 800], strict=True
    ):
        np.testing.assert_allclose(
            motion.pose(time).apply(center), center + np.array([*shift, 0.0]), atol=1e-14
        )
        np.testing.assert_allclose(
            motion.pose(time).rotation, turn([0, 0, 1], degrees % 360), atol=1e-14
        )


def test_linear_keyframes_have_constant_velocities_between():
    motion = Keyframes(
        times=TIMES, translate=SHIFTS, rotate=[0.0, 90.0, 810.0, 800.0], center=[0.5, 0.5]
    )
    for time, linear, rate in (
        (0.3, [1.0, 0.0, 0.0], 90.0),
        (1.2, [0.0, 4.0, 0.0], 1440.0),
        (3.9, [-0.8, 0.0, 0.0], -4.0),
    ):
        center = motion.pose(time).apply(np.array([0.5, 0.5, 0.0]))
        np.testing.assert_allclose(
            velocity(motion, time), rigid(POINTS, linear, [0, 0, rate], center), atol=3e-5
        )
    assert not velocity(motion, 7.0).any()


def test_smooth_keyframes_rest_at_their_ends_and_do_not_overshoot_or_jump():
    """Smooth keyframes: rest at the ends, no overshoot, no jump.

    A plain cubic spline through these places overshoots the plateau by 6 %; one without clamped
    ends starts at 2 m/s.
    """
    motion = Keyframes(
        times=[0.0, 1.0, 2.0, 3.0],
        translate=[[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 1.0]],
        smooth=True,
    )
    times = np.linspace(-0.5, 3.5, 1601)
    x = np.array([motion.pose(time).translation[0] for time in times])
    assert (np.diff(x) >= 0.0).all()
    assert x[(times >= 1.0) & (times <= 2.0)] == pytest.approx(1.0, abs=1e-14)
    speed = np.diff(x) / np.diff(times)
    assert np.abs(np.diff(speed)).max() < 0.02  # of at most 1.5 m/s, in 1/400 s
    assert speed.max() > 1.4
    assert motion.pose(0.5).translation[0] == pytest.approx(0.5)


@pytest.mark.parametrize("smooth", [False, True])
def test_turns_in_space_are_about_fixed_axes(smooth):
    motion = Keyframes(
        times=[0.0, 1.0, 3.0],
        rotate=[[0, 0, 0], [90, 0, 0], [90, 90, 0]],
        center=[0.1, 0.2, 0.3],
        smooth=smooth,
    )
    # x first, then y.
    for time, expected in (
        (1.0, turn([1, 0, 0], 90)),
        (3.0, turn([0, 1, 0], 90) @ turn([1, 0, 0], 90)),
    ):
        np.testing.assert_allclose(motion.pose(time).rotation, expected, atol=1e-14)
    for time, axis in ((0.4, [1.0, 0.0, 0.0]), (1.7, [0.0, 1.0, 0.0]), (2.6, [0.0, 1.0, 0.0])):
        rate = np.linalg.norm(
            velocity(
                motion, time, np.array([0.1, 0.2, 0.3]) + np.cross(axis, [0.3, 0.5, 0.7])[None]
            )
        )
        speed = rate / np.linalg.norm(np.cross(axis, np.cross(axis, [0.3, 0.5, 0.7])))
        expected = rigid(POINTS, [0, 0, 0], np.degrees(speed) * np.array(axis), [0.1, 0.2, 0.3])
        np.testing.assert_allclose(velocity(motion, time), expected, atol=1e-6)
        if not smooth:
            assert np.degrees(speed) == pytest.approx(90.0 if time < 1.0 else 45.0)
    if smooth:  # the axis changes at 1 s, where angular velocities could only jump
        for time in (0.0, 1.0, 3.0):
            assert np.abs(velocity(motion, time)).max() < 1e-3


def test_smooth_turns_go_on_where_their_axis_stays():
    motion = Keyframes(
        times=[0.0, 1.0, 2.0],
        rotate=[[0, 0, 0], [0, 0, 120], [0, 0, 240]],
        center=[0, 0, 0],
        smooth=True,
    )
    np.testing.assert_allclose(
        velocity(motion, 1.0), rigid(POINTS, [0, 0, 0], [0, 0, 120.0], [0, 0, 0]), atol=2e-4
    )
    fixed_axis = Keyframes(
        times=[0.0, 1.0, 2.0],
        rotate=[[0, 0, 10], [0, 0, 10], [0, 0, 40]],
        center=[0, 0, 0],
        smooth=True,
    )
    np.testing.assert_allclose(fixed_axis.pose(0.5).rotation, turn([0, 0, 1], 10), atol=1e-14)


@pytest.mark.parametrize(
    "motion",
    [
        Translation(velocity=[0.5, 0.0], start=0.5, stop=1.25),
        Translation(velocity=[0.5, 0.0]),
        Rotation(rate=40.0, center=[0.3, 0.1], start=0.25, stop=2.0),
        Keyframes(times=[0.25, 1.0, 1.75], translate=[[0.0, 0.0], [0.4, 0.0], [0.1, 0.3]]),
        Keyframes(times=[0.5, 1.0, 1.75], rotate=[0.0, 40.0, -30.0], smooth=True),
        Sinusoid(period=1.0, amplitude=[0.2, 0.0]),
    ],
)
def test_kinks_are_where_the_velocity_jumps(motion):
    def jumps(time):
        change = velocity(motion, time + 2 * STEP) - velocity(motion, time - 2 * STEP)
        return np.abs(change).max() > 0.01

    assert [time for time in np.arange(0.0, 3.0, 0.125) if jumps(time)] == [
        time for time in kinks(motion) if time < 3.0
    ]


def top_speed(motion, bounds, size, time, span):
    return Motions([motion]).top_speed([bounds], size, time, span)


@pytest.mark.parametrize("dimension", [2, 3])
def test_top_speeds(dimension):
    size = np.array([2.0, 1.0, 1.0 if dimension == 3 else 0.0])
    rod = Box(lower=[0.9, 0.4, 0.4][:dimension], upper=[1.5, 0.6, 0.6][:dimension]).bounds()
    drive = Translation(velocity=[3.0, -4.0], start=1.0, stop=1.1)
    assert top_speed(drive, rod, size, 1.02, 0.01) == pytest.approx(5.0)
    assert top_speed(drive, rod, size, 0.0, 0.5) == 0.0
    # The motion starts within the interval.
    assert top_speed(drive, rod, size, 0.99, 0.04) == pytest.approx(5.0)
    turn_about_end = Rotation(rate=math.degrees(2.0), center=[0.9, 0.5, 0.5])
    radius = math.hypot(0.6, 0.1)  # the far corners of the rod; z is along the axis
    assert (
        2.0 * radius * 0.99 < top_speed(turn_about_end, rod, size, 0.0, 0.02) < 2.0 * radius * 1.1
    )
    # Distance to the room's corner.
    assert top_speed(turn_about_end, None, size, 0.0, 0.02) == pytest.approx(
        2.0 * math.hypot(1.1, 0.5), rel=1e-3
    )
    leaving = Translation(velocity=[10.0, 0.0])
    assert top_speed(leaving, rod, size, 0.0, 0.01) == pytest.approx(10.0)
    assert top_speed(leaving, rod, size, 0.2, 0.01) == 0.0  # it is out of the domain


def test_top_speed_is_the_mean_one_of_the_fastest_sampled_point():
    rng = np.random.default_rng(71)
    size = np.array([1.0, 1.2, 0.8])
    for _ in range(5):
        motions = [
            Rotation(
                rate=rng.uniform(-90, 90), center=rng.uniform(0, 1, 3), axis=rng.normal(size=3)
            ),
            Translation(velocity=rng.normal(size=3)),
            Sinusoid(
                period=3.0,
                amplitude=rng.normal(size=3) * 0.1,
                angle=rng.uniform(0, 30),
                center=rng.uniform(0, 1, 3),
            ),
        ]
        corners = [np.sort(rng.uniform(0.1, 0.7, (2, 3)), axis=0) for _ in motions]
        span, fastest = 0.02, 0.0
        for motion, (low, high) in zip(motions, corners, strict=True):
            points = low + (high - low) * np.stack(
                np.meshgrid(*[np.linspace(0, 1, 5)] * 3), axis=-1
            ).reshape(-1, 3)
            for start in np.linspace(0.0, span, 5)[:-1]:
                ends = motion.pose(start).apply(points), motion.pose(start + span / 4).apply(points)
                inside = np.any([((end >= 0) & (end <= size)).all(axis=1) for end in ends], axis=0)
                way = np.linalg.norm(ends[1] - ends[0], axis=1)
                fastest = max(fastest, float(way[inside].max(initial=0.0)) * 4 / span)
        found = Motions(motions).top_speed(corners, size, 0.0, span)
        # Boxes around turned solids are larger.
        assert fastest * (1 - 1e-12) <= found <= 1.3 * fastest
    assert Motions([]).top_speed([], size, 0.0, 0.1) == 0.0


SHAPES = {
    "box": Box(lower=[-0.5, 0.1, -0.2], upper=[0.4, 0.5, 0.9]),
    "flat box": Box(lower=[-0.5, 0.1], upper=[0.4, 0.5]),
    "sphere": Sphere(center=[0.1, 0.2, -0.3], radius=0.6),
    "capsule": Capsule(start=[-0.3, 0.2, 0.1], end=[0.5, -0.1, 0.4], radius=0.25),
    "plane": Plane(point=[0.1, 0.2, -0.3], normal=[1.0, 2.0, -2.0]),
    "mesh": TriangleMesh(surface=builtin_mesh("knot")),
}


@pytest.mark.every_case
@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_the_distance_to_a_moved_shape_is_that_of_points_moved_back(name, invert):
    placement = Placement.from_degrees(1.3, [25.0, -70.0, 130.0], [0.3, -0.4, 0.9], 3)
    shape = dataclasses.replace(SHAPES[name], placement=placement, invert=invert)
    pose = any_pose(771)
    moved = shape.moved(pose)
    points = pose.apply(placement.translation) + np.random.default_rng(515).uniform(
        -1.5, 1.5, (1000, 3)
    )
    np.testing.assert_allclose(
        distances(moved, points), distances(shape, pose.inverse().apply(points)), atol=5e-6
    )
    assert type(moved) is type(shape)
    assert moved.invert == invert
    if not invert and name != "plane" and name != "flat box":
        low, high = moved.bounds()
        inside = points[distances(moved, points) < 0.0]
        assert len(inside) >= 10
        assert ((inside > low - 1e-5) & (inside < high + 1e-5)).all()


def test_moved_meshes_share_their_surface():
    mesh = SHAPES["mesh"]
    distances(mesh, POINTS)
    moved = mesh.moved(any_pose(5))
    assert moved.surface is mesh.surface
    assert moved.surface.on_device(wp.get_device("cpu")) is mesh.surface.on_device(
        wp.get_device("cpu")
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pose(np.eye(2), np.zeros(3)), "3 x 3"),
        (lambda: Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3)), "proper rotation"),
        (lambda: Pose(np.full((3, 3), np.nan), np.zeros(3)), "proper rotation"),
        (lambda: Pose(np.eye(3), [0.0, np.inf, 0.0]), "3 finite numbers"),
        (lambda: Translation(velocity=[1.0]), "velocity needs 2 or 3 numbers, not 1"),
        (lambda: Translation(velocity=[1.0, np.nan]), "velocity must be finite"),
        (
            lambda: Translation(velocity=[1.0, 0.0], start=2.0, stop=2.0),
            "stop must be later than start = 2.0 s, not 2.0",
        ),
        (lambda: Translation(velocity=[1.0, 0.0], stop=np.nan), "stop must be later"),
        (lambda: Translation(velocity=[1.0, 0.0], start=-np.inf), "start must be a finite number"),
        (lambda: Rotation(rate=np.nan, center=[0.0, 0.0]), "rate must be a finite number"),
        (
            lambda: Rotation(rate=1.0, center=[0.0, 0.0], axis=[0.0, 0.0, 0.0]),
            "axis must not be zero",
        ),
        (lambda: Sinusoid(period=0.0), "period must be a positive number"),
        (lambda: Sinusoid(period=np.inf), "period must be a positive number"),
        (lambda: Sinusoid(period=1.0, angle=np.inf), "angle must be a finite number"),
        (lambda: Keyframes(times=[0.0], translate=[[0.0, 0.0]]), "at least two numbers"),
        (lambda: Keyframes(times=[0.0, 0.0], translate=[[0.0, 0.0]] * 2), "finite and increase"),
        (lambda: Keyframes(times=[0.0, np.nan], translate=[[0.0, 0.0]] * 2), "finite and increase"),
        (lambda: Keyframes(times=[0.0, 1.0]), "translate, rotate or both"),
        (
            lambda: Keyframes(times=[0.0, 1.0], translate=[[0.0, 0.0]]),
            "an entry for each of the 2 times, not 1",
        ),
        (
            lambda: Keyframes(times=[0.0, 1.0], translate=[[0.0, 0.0], [0.0]]),
            "as many numbers at every time",
        ),
        (
            lambda: Keyframes(times=[0.0, 1.0], translate=[[0.0], [0.0]]),
            "translate must have 2 or 3 numbers",
        ),
        (
            lambda: Keyframes(times=[0.0, 1.0], rotate=[[0.0, 0.0], [0.0, 0.0]]),
            "rotate must have 1 or 3 numbers",
        ),
        (lambda: Keyframes(times=[0.0, 1.0], rotate=[0.0, np.inf]), "rotate must be finite"),
        (
            lambda: Keyframes(times=[0.0, 1.0], rotate=[[0, 0, 0], [0, 180, 0]]),
            "less than 180 degrees from one keyframe to the next",
        ),
    ],
)
def test_bad_values_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
