"""Free motion of a body: conservation, a fine reference, and poses.

Poses are those of advance.
"""

from copy import copy

import numpy as np
import pytest
from plain_motion import orthonormal
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from warp_lcp.grid import motion as prescribed
from warp_lcp.grid.motion import Motion, Motions
from warp_lcp.rigid.body import BodyMotion, BodyStates, RigidBody
from warp_lcp.rigid.mass_properties import MassProperties

CENTER = np.array([0.3, -0.2, 0.7])
UNEVEN = np.diag([1.0, 2.0, 3.0])


def body(inertia=UNEVEN, **kwargs):
    return RigidBody(
        MassProperties(mass=2.0, center=CENTER, inertia=inertia), name="body", **kwargs
    )


def tumbling():
    """Return a body that turns near its middle axis.

    A free rotation about that axis is unstable.
    """
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    return body(
        turn @ UNEVEN @ turn.T,
        angular_velocity=turn @ np.array([0.05, 4.0, -0.03]),
        velocity=np.array([1.0, 2.0, -0.5]),
    )


def test_angular_momentum_is_kept_exactly_and_energy_does_not_drift():
    top = tumbling()
    momenta, energies = top.angular_momentum.copy(), []
    start = top.kinetic_energy
    assert start == pytest.approx(
        0.5 * (2.0 * (1.0 + 4.0 + 0.25) + 0.05**2 + 2.0 * 4.0**2 + 3.0 * 0.03**2)
    )
    for _ in range(4000):
        top.advance(0.01)
        energies.append(top.kinetic_energy / start - 1.0)
    assert (top.angular_momentum == momenta).all()
    assert np.abs(energies).max() < 2e-4  # of second order in the step
    assert abs(np.mean(energies[-500:]) - np.mean(energies[:500])) < 2e-5
    assert np.abs(top.rotation @ top.rotation.T - np.eye(3)).max() < 1e-14


def test_a_free_top_follows_a_fine_reference():
    """Free top against a fine reference: Euler's equations with quaternions.

    In the body's axes, by a method of high order; it flips over more than once.
    """
    top = tumbling()
    inertia = top.properties.inertia
    inverse = np.linalg.inv(inertia)

    def rates(_, state):
        w, q = state[:3], state[3:]
        spin = np.array(
            [
                [0, w[2], -w[1], w[0]],
                [-w[2], 0, w[0], w[1]],
                [w[1], -w[0], 0, w[2]],
                [-w[0], -w[1], -w[2], 0],
            ]
        )
        return np.concatenate([inverse @ -np.cross(w, inertia @ w), 0.5 * spin @ q])

    end = 4.0
    start = np.concatenate([top.angular_velocity, [0.0, 0.0, 0.0, 1.0]])
    reference = solve_ivp(rates, (0.0, end), start, method="DOP853", rtol=1e-12, atol=1e-12).y[
        :, -1
    ]
    expected = Rotation.from_quat(reference[3:]).as_matrix()
    errors = []
    for steps in (400, 800):
        top = tumbling()
        for _ in range(steps):
            top.advance(end / steps)
        errors.append(np.abs(top.rotation - expected).max())
    assert errors[0] < 0.05
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.6)
    np.testing.assert_allclose(top.position, CENTER + end * np.array([1.0, 2.0, -0.5]), atol=1e-12)


def test_poses_are_those_of_advance():
    top = tumbling()
    motion = BodyMotion(top)
    assert isinstance(motion, Motion)
    points = np.random.default_rng(3456).normal(size=(5, 3))
    np.testing.assert_array_equal(motion.pose(0.0).apply(points), points)
    for step in range(3):
        dt = 0.02 + 0.01 * step
        before, predicted = motion.pose(top.time), motion.pose(top.time + dt)
        way = predicted.after(before.inverse())
        field = (way.apply(points) - points) / dt  # the velocity that solids use
        top.advance(dt)
        now = motion.pose(top.time)
        np.testing.assert_allclose(predicted.rotation, now.rotation, atol=1e-13)
        np.testing.assert_allclose(predicted.translation, now.translation, atol=1e-13)
        np.testing.assert_allclose(
            now.apply(before.inverse().apply(points)) - points, dt * field, atol=1e-13
        )


def test_motions_of_several_bodies_are_those_of_each():
    rng = np.random.default_rng(17)
    bodies = []
    for _ in range(4):
        root = rng.normal(size=(3, 3))
        properties = MassProperties(
            mass=rng.uniform(0.1, 3), center=rng.uniform(0, 1, 3), inertia=root @ root.T + np.eye(3)
        )
        spin = rng.normal(size=3) * rng.choice([0.0, 10.0])
        bodies.append(
            RigidBody(properties, name="top", velocity=rng.normal(size=3), angular_velocity=spin)
        )
    BodyStates(bodies).advance(0.03)
    turning = prescribed.Rotation(rate=40.0, center=[0.2, 0.1])
    each = [BodyMotion(bodies[0]), turning, *(BodyMotion(body) for body in bodies[1:])]
    motions, times = Motions(each), bodies[0].time + np.array([0.0, 0.004, 0.02])
    rotations, translations = motions.poses(times)
    for m, time in enumerate(times):
        for n, motion in enumerate(each):
            np.testing.assert_allclose(
                rotations[m, n], motion.pose(time).rotation, rtol=0, atol=1e-15
            )
            np.testing.assert_allclose(
                translations[m, n], motion.pose(time).translation, rtol=0, atol=1e-15
            )
    points, h = rng.normal(size=(5, 3)), 1e-6
    for n, (turn, shift) in enumerate(zip(*motions.velocity_fields(times[0], h), strict=True)):
        here = each[n].pose(times[0]).apply(points)
        moved = (each[n].pose(times[0] + h).apply(points) - here) / h
        np.testing.assert_allclose(here @ turn.T + shift, moved, atol=1e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_impulses_and_inverse_masses_of_several_bodies_are_those_of_each(dimension):
    rng, k = np.random.default_rng(18), 3 if dimension == 2 else 6
    bodies = [tumbling() for _ in range(3)]
    states = BodyStates(bodies)
    states.advance(0.1)
    bodies[1].hold = rng.normal(size=(k, k))
    each = [copy(body) for body in bodies]
    for one in each:
        one.values = one.values.copy()
    inverses = states.inverse_masses(dimension)
    impulses = rng.normal(size=(3, k))
    states.apply_impulses(impulses)
    for n, one in enumerate(each):
        np.testing.assert_allclose(inverses[n], one.inverse_mass(dimension), rtol=0, atol=1e-15)
        one.apply_impulse(impulses[n])
        np.testing.assert_allclose(bodies[n].values, one.values, rtol=0, atol=1e-14)


def test_the_center_of_mass_goes_where_its_pose_does():
    top = tumbling()
    top.advance(0.3)
    np.testing.assert_allclose(
        BodyMotion(top).pose(top.time).apply(CENTER), top.position, atol=1e-15
    )


def test_steps_back_in_time_undo_steps():
    top = tumbling()
    for dt in (0.05, -0.05):
        top.advance(dt)
    np.testing.assert_allclose(top.rotation, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(top.position, CENTER, atol=1e-15)


def test_an_impulse_changes_velocities_by_the_inverse_mass():
    rng = np.random.default_rng(8123)
    for dimension, k in ((2, 3), (3, 6)):
        top = tumbling() if dimension == 3 else body(angular_velocity=np.array([0.0, 0.0, 2.0]))
        top.advance(0.4)
        impulse, before = rng.normal(size=k), top.velocities(dimension)
        inverse = top.inverse_mass(dimension)
        top.apply_impulse(impulse)
        np.testing.assert_allclose(
            top.velocities(dimension) - before, inverse @ impulse, atol=1e-13
        )
        assert (np.linalg.eigvalsh(inverse) > 0.0).all()


@pytest.mark.parametrize("spread", [1.0, 10.0, 1e6])
def test_the_inverse_mass_of_a_turned_body_is_exactly_symmetric(spread):
    """Exact symmetry of the inverse mass of a turned body.

    Inversion and rotation cause rounding errors that grow with the ratio of the moments; the
    solver's matrix must be symmetric.
    """
    rng = np.random.default_rng(23)
    for rotation in Rotation.random(20, rng=rng).as_matrix():
        principal = Rotation.random(rng=rng).as_matrix()
        moments = rng.uniform(1e-3, 1e3) * np.array(
            [1.0, 1.0 / spread, rng.uniform(1.0 / spread, 1.0)]
        )
        turned = body(principal @ np.diag(moments) @ principal.T)
        turned.rotation = rotation
        W, axes = turned.inverse_mass(3), rotation @ principal
        assert np.array_equal(W, W.T)
        np.testing.assert_allclose(
            W[3:, 3:],
            axes @ np.diag(1.0 / moments) @ axes.T,
            rtol=0.0,
            atol=1e-15 * spread * np.abs(W).max(),
        )


def test_turns_are_scipys():
    rng = np.random.default_rng(77)
    for size in (0.0, 1e-9, 0.3, np.pi, 9.0):
        vector, top = rng.standard_normal(3), body()
        vector *= size / np.linalg.norm(vector)
        top.shift(np.concatenate([np.zeros(3), vector]))
        np.testing.assert_allclose(
            top.rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14
        )


def test_gravity_gives_the_velocity_of_fall():
    ball = body(velocity=np.array([1.0, 0.0, 0.0]))
    ball.accelerate(np.array([0.0, -9.81, 0.0]), 0.1)
    np.testing.assert_allclose(ball.velocity, [1.0, -0.981, 0.0])
    assert not ball.angular_velocity.any()


def test_whole_turns_are_counted_in_the_plane():
    disc = body(np.eye(3), angular_velocity=np.array([0.0, 0.0, 20.0]))
    for _ in range(100):
        disc.advance(0.01)
    assert disc.angle == pytest.approx(20.0)
    np.testing.assert_allclose(
        disc.rotation[:2, :2], [[np.cos(20), -np.sin(20)], [np.sin(20), np.cos(20)]], atol=1e-12
    )


def test_a_state_is_restored_bit_for_bit():
    one, other = tumbling(), body()
    one.advance(0.1)
    other.properties = one.properties
    other.restore(one.state())
    for dt in (0.01, 0.02):
        one.advance(dt)
        other.advance(dt)
    assert (one.state() == other.state()).all()


def test_a_state_has_the_motion_and_no_received_impulses():
    one = tumbling()
    before = one.state()
    assert before.shape == (20,)
    one.received_impulse = np.ones(6)
    np.testing.assert_array_equal(one.state(), before)


@pytest.mark.parametrize(
    "bad", [{"friction": -0.1}, {"friction": np.inf}, {"restitution": 1.5}, {"restitution": -0.1}]
)
def test_coefficients_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        body(**bad)


def test_bodies_of_one_array_move_as_each_does_alone():
    """Motion of bodies in one array: that of each alone, bit for bit.

    Some need more rounds of the fixed point, and one does not turn at all.
    """
    rng = np.random.default_rng(41)
    spin = [np.zeros(3), *rng.normal(size=(4, 3)) * [[0.1], [1.0], [10.0], [40.0]]]
    alone = [
        body(np.diag(rng.uniform(1.0, 3.0, 3)), angular_velocity=w, velocity=rng.normal(size=3))
        for w in spin
    ]
    together = BodyStates([copy(one) for one in alone])
    impulses, ways = rng.normal(size=(5, 6)), 0.1 * rng.normal(size=(5, 6))
    for dt in (0.02, 0.03):
        for one, impulse, way in zip(alone, impulses, ways, strict=True):
            one.push(impulse)
            one.advance(dt)
            one.shift(way)
        together.push(impulses)
        together.advance(dt)
        together.shift(ways)
    assert np.array_equal(together.values, [one.values for one in alone])
    assert np.array_equal(together.velocities(), [one.velocities(3) for one in alone])
    together[2].position = CENTER  # a body writes its row
    assert np.array_equal(together.position[2], CENTER)


def test_rotations_off_by_rounding_become_the_nearest_ones():
    """Rotations with rounding errors: the nearest orthogonal matrices.

    They are compared with U V' of the singular value decomposition.
    """
    rng = np.random.default_rng(6)
    off = Rotation.random(50, rng=rng).as_matrix() + 1e-9 * rng.normal(size=(50, 3, 3))
    u, _, vt = np.linalg.svd(off)
    near = orthonormal(off)
    # It has rounding errors of its own.
    np.testing.assert_allclose(near, u @ vt, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(
        near @ near.swapaxes(1, 2), np.broadcast_to(np.eye(3), near.shape), rtol=0.0, atol=2e-15
    )
