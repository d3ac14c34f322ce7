"""Joints of rigid bodies against integrations and closed forms.

The tests cover energy, period, momentum, limits, motors and drift.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from default_run import chosen, slow
from warp_lcp.contacts.methods import BOXED, JOINTED, STEWART_TRINKLE, RegistryContactMethod
from warp_lcp.grid.signed_distance import Box
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import RigidBody, rotation_by
from warp_lcp.rigid.joints import WORLD, Joint, JointRows, joined_pairs
from warp_lcp.rigid.mass_properties import mass_properties

DOWN = np.array([0.0, -9.81, 0.0])
Z = np.array([0.0, 0.0, 1.0])
LENGTH, HALF = 0.5, 0.05  # length of a bar and half its thickness [m]


def bar(number: int, dimension: int = 3) -> Box:
    """Return a bar along x that begins at number * LENGTH."""
    low, high = [number * LENGTH, -HALF, -HALF], [(number + 1) * LENGTH, HALF, HALF]
    return Box(lower=low[:dimension], upper=high[:dimension])


def system(
    joints: tuple[Joint, ...],
    count: int,
    *,
    dimension: int = 3,
    method: str = JOINTED,
    tolerance: float = 1e-9,
) -> RigidBodies:
    """Return a row of bars of water without surroundings."""
    shapes = [bar(number, dimension) for number in range(count)]
    bodies = [
        RigidBody(mass_properties(shape, dimension, density=1000.0), name=f"bar {i}")
        for i, shape in enumerate(shapes)
    ]
    solver = RegistryContactMethod(
        method, directions=4, tolerance=tolerance, most=2000, device="cpu"
    )
    return RigidBodies(bodies, shapes, range(1, count + 1), (), dimension, solver, joints)


def chain(count: int, kind: str = "hinge", **more: float) -> tuple[Joint, ...]:
    """Return joints of a row of bars that hangs on its first end."""
    return tuple(
        Joint(i, i - 1 if i else WORLD, np.array([i * LENGTH, 0.0, 0.0]), Z, kind=kind, **more)
        for i in range(count)
    )


def go(bodies: RigidBodies, dt: float, steps: int, gravity: np.ndarray = DOWN):
    """Step, and yield after each step."""
    last = 0.0
    for step in range(steps):
        bodies.begin_step(step * dt, dt, gravity, 0.5 * (last + dt))
        bodies.solve_contacts()
        bodies.end_step(dt)
        last = dt
        yield step


def energy(bodies: RigidBodies, dt: float, gravity: np.ndarray = DOWN) -> float:
    """Return the energy in the middle of the last step, the time of the velocities."""
    momentum = np.sum([body.momentum for body in bodies.bodies], axis=0)
    return (
        bodies.kinetic_energy()
        + bodies.potential_energy(gravity)
        + 0.5 * dt * float(momentum @ gravity)
    )


def double_pendulum(duration: float, dimension: int) -> np.ndarray:
    """Return the angles of two bars that fall from the horizontal.

    They follow from Lagrange's equations, integrated by DOP853.
    """
    m = 1000.0 * LENGTH * (2 * HALF) ** (dimension - 1)
    inertia = m * (LENGTH**2 + (2 * HALF) ** 2) / 12
    c = 0.5 * LENGTH

    def motion(_: float, y: np.ndarray) -> np.ndarray:
        a, b, u, v = y  # angles above the horizontal, and their rates
        coupling = m * LENGTH * c
        M = np.array(
            [
                [inertia + m * c**2 + m * LENGTH**2, coupling * np.cos(a - b)],
                [coupling * np.cos(a - b), inertia + m * c**2],
            ]
        )
        right = [
            -coupling * np.sin(a - b) * v**2 - 9.81 * np.cos(a) * (m * c + m * LENGTH),
            coupling * np.sin(a - b) * u**2 - 9.81 * np.cos(b) * m * c,
        ]
        return np.concatenate([[u, v], np.linalg.solve(M, right)])

    return solve_ivp(
        motion, (0.0, duration), np.zeros(4), method="DOP853", rtol=1e-11, atol=1e-12
    ).y[:2, -1]


@pytest.mark.parametrize("dimension", [3, slow(2)])
def test_a_double_pendulum_goes_as_lagrange_says(dimension):
    """Double pendulum by Lagrange's equations, of second order.

    Half the step gives a quarter of the error. The energy is conserved, and anchors stay together.
    """
    expected, errors = double_pendulum(0.32, dimension), []
    for dt in (0.016, 0.008):
        bodies = system(chain(2), 2, dimension=dimension)
        energies, apart = [], 0.0
        for _ in go(bodies, dt, round(0.32 / dt)):
            energies.append(energy(bodies, dt))
            apart = max(apart, bodies.row()["joint_error"])
        angles = np.array([joint.angle(bodies.bodies) for joint in bodies.joints])
        angles[1] += angles[0]
        errors.append(np.abs(np.angle(np.exp(1j * (angles - expected)))).max())
        fallen = max(energies) - bodies.potential_energy(DOWN)
        assert np.ptp(energies) < 40.0 * dt**2 * fallen
        assert apart < 1e-7
    assert errors[1] < 4e-3
    assert 3.0 < errors[0] / errors[1] < 5.0


def test_a_bar_swings_with_the_period_of_its_inertia():
    """Period of a bar: 2 pi sqrt(I / (m g c)) for small swings.

    It is measured by the zeros of the angle.
    """
    bodies, dt, tilt = system(chain(1), 1), 0.02, np.pi / 2 - 0.05
    turned = rotation_by(-tilt * Z)
    bodies.bodies[0].position, bodies.bodies[0].rotation = (
        turned @ bodies.bodies[0].position,
        turned,
    )
    zeros, last = [], 0.0
    for step in go(bodies, dt, 48):
        angle = bodies.joints[0].angle(bodies.bodies) + np.pi / 2
        if last * angle < 0.0:
            zeros.append((step + 1) * dt - dt * angle / (angle - last))
        last = angle
    inertia = (LENGTH**2 + (2 * HALF) ** 2) / 12 + (LENGTH / 2) ** 2
    period = 2 * np.pi * np.sqrt(inertia / (9.81 * LENGTH / 2))
    assert 2 * np.diff(zeros).mean() == pytest.approx(period, rel=1e-3)


@pytest.mark.parametrize("kind", ["fixed", slow("ball"), slow("hinge")])
def test_joined_bodies_in_flight_keep_both_momenta(kind):
    bodies = system(
        tuple(
            Joint(i, i - 1, np.array([i * LENGTH, 0.01, 0.02]), [1, 2, 3], kind=kind)
            for i in (1, 2)
        ),
        3,
    )
    rng = np.random.default_rng(5)
    for body in bodies.bodies:
        body.momentum, body.angular_momentum = (
            body.properties.mass * rng.normal(size=3),
            0.2 * rng.normal(size=3),
        )

    def momenta() -> np.ndarray:
        each = [
            np.concatenate([b.momentum, b.angular_momentum + np.cross(b.position, b.momentum)])
            for b in bodies.bodies
        ]
        return np.sum(each, axis=0)

    before = momenta()
    for _ in go(bodies, 0.01, 25, np.zeros(3)):
        pass
    # J is that of the begin of the step, where anchors are 1e-9 apart.
    assert momenta() == pytest.approx(before, abs=1e-6)
    assert bodies.row()["joint_error"] < 1e-7
    if kind == "fixed":
        turns = [b.rotation for b in bodies.bodies]
        np.testing.assert_allclose(turns[0], turns[2], atol=1e-7)


def test_a_fixed_bar_stays_and_a_ball_lets_it_turn_about_any_axis():
    bodies = system(chain(2, "fixed"), 2)
    for _ in go(bodies, 0.01, 30):
        pass
    assert np.abs(bodies.bodies[1].position - [1.5 * LENGTH, 0.0, 0.0]).max() < 1e-7
    sideways = np.array([0.0, -9.81, 9.81])
    for kind, moves in (("ball", True), ("hinge", False)):
        bodies = system(chain(1, kind), 1)
        for _ in go(bodies, 0.01, 10, sideways):
            pass
        assert (bodies.bodies[0].position[2] > 0.01) == moves
        assert bodies.bodies[0].position[1] < -0.01


def test_a_limit_stops_a_bar_and_releases_it():
    """Limit of a bar that holds and releases it.

    It falls to -0.5 rad, rests there, and leaves when gravity points up; the other limit then holds
    it at 0.3.
    """
    bodies = system(chain(1, limits=(-0.5, 0.3)), 1)
    for _ in go(bodies, 0.01, 30):
        assert bodies.joints[0].angle(bodies.bodies) > -0.5 - 1e-7
    assert bodies.joints[0].angle(bodies.bodies) == pytest.approx(-0.5, abs=1e-6)
    for _ in go(bodies, 0.01, 40, -DOWN):
        assert bodies.joints[0].angle(bodies.bodies) < 0.3 + 1e-7
    assert bodies.joints[0].angle(bodies.bodies) == pytest.approx(0.3, abs=1e-6)


def test_a_motor_reaches_its_speed_with_the_torque_that_it_has():
    """Motor that reaches its speed with its torque.

    Without gravity the speed is torque / I t up to the target; 2 N m cannot lift 5 kg, 20 N m can.
    """
    bodies = system(chain(1, motor_speed=3.0, motor_torque=2.0), 1)
    body = bodies.bodies[0]
    inertia = body.properties.inertia[2, 2] + body.properties.mass * (LENGTH / 2) ** 2
    for step in go(bodies, 0.02, 36, np.zeros(3)):
        # Velocities are those of the middle of steps; the first gravity step is half of one.
        middle = (step + 0.5) * 0.02
        assert body.angular_velocity[2] == pytest.approx(min(3.0, 2.0 / inertia * middle), rel=2e-3)
        torque = bodies.row()["joint0_torque"]
        assert abs(torque) <= 2.0 + 1e-9
    assert torque == pytest.approx(0.0, abs=1e-6)
    for most, lifts in ((2.0, False), (20.0, True)):
        bodies = system(chain(1, motor_speed=1.0, motor_torque=most), 1)
        for _ in go(bodies, 0.01, 10):
            pass
        assert (bodies.joints[0].angle(bodies.bodies) > 0.0) == lifts
    weight = 9.81 * 5.0 * LENGTH / 2 * np.cos(0.1)
    assert bodies.row()["joint0_torque"] == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize(
    "method", chosen([*BOXED, *STEWART_TRINKLE], ["nncg", "psor", "staggering", "lemke"])
)
def test_every_method_takes_the_equations_of_joints(method):
    """Equations of joints by every method.

    Two steps of a pendulum of two bars with a limit and a motor are those of the pivoting method;
    sweeps need many iterations.
    """
    joints = (chain(2)[0], Joint(1, 0, np.array([LENGTH, 0.0, 0.0]), Z, (-0.001, 1.0), 0.5, 1.0))
    found = {}
    for name in ("lemke", method):
        bodies = system(joints, 2, method=name, tolerance=1e-5)
        for _ in go(bodies, 0.01, 2):
            pass
        found[name] = np.array([body.state()[:3] for body in bodies.bodies])
        assert bodies.contact_residual <= 1e-5 or name == "projected-jacobi"
    if method != "projected-jacobi":  # its steps are too long for rows that couple so much
        np.testing.assert_allclose(found[method], found["lemke"], atol=2e-5)


def random_joints(rng: np.random.Generator) -> tuple[Joint, ...]:
    """Return a random tree of joints of all kinds between four bars.

    They have limits and motors.
    """
    joints = []
    for first in range(4):
        kind = str(rng.choice(["ball", "hinge", "fixed"]))
        more = {}
        if kind == "hinge":
            more = (
                {"limits": (-rng.uniform(0.01, 1.0), rng.uniform(0.01, 1.0))}
                if rng.random() < 0.5
                else {}
            )
            more |= (
                {"motor_speed": float(rng.normal()), "motor_torque": float(rng.uniform(0.1, 5.0))}
                if rng.random() < 0.5
                else {}
            )
        second = int(rng.integers(-1, first)) if first else WORLD
        joints.append(
            Joint(
                first,
                second,
                rng.uniform([0, -0.1, -0.1], [2.0, 0.1, 0.1]),
                rng.normal(size=3),
                kind=kind,
                **more,
            )
        )
    return tuple(joints)


def check_rows(seed: int) -> None:
    """Check that rows are the derivatives of the errors.

    J v is their difference along a motion of the bodies; errors are invariant to a common motion.
    """
    rng = np.random.default_rng(seed)
    joints, h = random_joints(rng), 1e-6
    bodies = system((), 4).bodies
    rows = JointRows.joined([joint.rows(bodies, 1.0) for joint in joints])
    assert len(rows) == sum(joint.row_count(3) for joint in joints)
    v = rng.normal(size=(4, 6))
    before = [(body.position.copy(), body.rotation.copy()) for body in bodies]
    ends = []
    for sign in (1.0, -1.0):
        for body, (position, rotation), six in zip(bodies, before, v, strict=True):
            body.position, body.rotation = (
                position + sign * h * six[:3],
                rotation_by(sign * h * six[3:]) @ rotation,
            )
        ends.append(rows.errors(bodies, 3))
    slope = (ends[0] - ends[1]) / (2 * h)
    np.testing.assert_allclose(
        (rows.jacobian(4) @ v.ravel())[~rows.motors], slope[~rows.motors], atol=1e-7
    )
    # A screw motion of all: joints to the world change, others do not.
    for body, (position, rotation) in zip(bodies, before, strict=True):
        turn, shift = rotation_by(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, -0.3])
        body.position, body.rotation = turn @ position + shift, turn @ rotation
    for joint in joints:
        if joint.second != WORLD:
            own = joint.rows(bodies, 1.0)
            assert np.abs(own.error[own.equations]).max() < 1e-12


@pytest.mark.default_cases(8)
@pytest.mark.parametrize("seed", range(20))
def test_rows_are_derivatives_of_errors(seed):
    check_rows(seed)


def test_joined_bodies_do_not_collide():
    """Pairs without collision.

    Bodies of a joint, and bodies of one rigid group of fixed ones; a hinge to a group has no effect
    on its other bodies.
    """
    at = np.zeros(3)
    joints = (
        Joint(1, 0, at, kind="fixed"),
        Joint(2, 1, at, kind="fixed"),
        Joint(3, 2, at),
        Joint(4, WORLD, at, kind="fixed"),
    )
    assert joined_pairs(joints, 5) == {(0, 1), (1, 2), (0, 2), (2, 3), (-1, 4)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"second": 0}, "must be two bodies"),
        ({"limits": (1.0, -1.0)}, "limits"),
        ({"limits": (-4.0, 1.0)}, "within half a turn"),
        ({"motor_torque": -1.0}, "motor_torque"),
        ({"motor_torque": np.inf}, "motor_torque"),
        ({"axis": np.zeros(3)}, "axis"),
        ({"kind": "rope"}, "kind"),
        ({"kind": "ball", "motor_torque": 1.0}, "only hinges have"),
    ],
)
def test_wrong_joints_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Joint(**({"first": 0, "second": WORLD, "anchor": np.zeros(3)} | change))


def test_sweeps_of_contacts_refuse_joints():
    bodies = RigidBodies(system((), 1).bodies, [bar(0)], [1], (), 3, joints=chain(1))
    with pytest.raises(ValueError, match=r"joints: the default solver .* handles only contacts"):
        bodies.begin_step(0.0, 0.01, DOWN, 0.01)
