"""Bounces with any time step.

Heights scale with the square of the restitution, and the energy does not grow.
"""

import numpy as np
import pytest
from bodies_at_hand import GRAVITY, SIDES, bodies_of

from default_run import slow
from warp_lcp.grid.signed_distance import Box, Sphere

G = 9.81
FLOOR = SIDES & ~0b000100
STEPS = {"fine": [0.002], "coarse": [0.02], "mixed": [0.011, 0.004, 0.007, 0.002, 0.009]}


def steps(bodies, lengths, duration):
    """Advance as simulations do; yield the length of each step.

    Velocities are those of the middle of steps.
    """
    last, number = 0.0, 0
    while bodies.time < duration:
        dt = lengths[number % len(lengths)]
        bodies.begin_step(bodies.time, dt, GRAVITY, 0.5 * (last + dt))
        bodies.end_step(dt)
        last, number = dt, number + 1
        yield dt


def tops(bodies, number, floor, lengths, duration):
    """Return the heights above a floor at which a body turns around [m].

    At the end of a step it has y and v, at its top y + v^2 / 2 g.
    """
    heights, rising = [], False
    for dt in steps(bodies, lengths, duration):
        body = bodies.bodies[number]
        v = body.velocity[1] - 0.5 * G * dt
        if rising and v <= 0.0:
            heights.append(body.position[1] - floor + v * v / (2.0 * G))
        rising = v > 0.0
    return np.array(heights)


@pytest.mark.default_cases(5)
@pytest.mark.parametrize("lengths", STEPS)
@pytest.mark.parametrize(
    ("restitution", "drop", "dimension"),
    [
        (0.5, 0.5, 2),
        (0.8, 0.5, 3),
        (1.0, 0.2, 2),
        (0.3, 1.0, 3),
        slow((0.5, 0.5, 3)),
        slow((0.8, 0.5, 2)),
        slow((1.0, 0.2, 3)),
        slow((0.3, 1.0, 2)),
    ],
)
def test_heights_go_by_the_square_of_the_restitution(dimension, restitution, drop, lengths):
    bodies = bodies_of(
        [Sphere(center=[0.5, 0.1 + drop, 0.5][:dimension], radius=0.1)],
        dimension,
        restitution=restitution,
        open_sides=FLOOR,
    )
    found = tops(bodies, 0, 0.1, STEPS[lengths], 1.5)[:3]
    expected = drop * restitution ** (2.0 * np.arange(1, 1 + len(found)))
    # Slower ones come to rest.
    fast = expected > 2.0 * (2.0 * G * max(STEPS[lengths]) * restitution) ** 2 / (2.0 * G)
    assert fast[0]
    np.testing.assert_allclose(found[fast], expected[fast], rtol=1e-9)


@pytest.mark.parametrize("lengths", STEPS)
def test_a_ball_bounces_on_a_box_that_rests(lengths):
    """Bounce of a ball on a resting box.

    The box does not fall with the ball, and the floor supports it at the time of the impact.
    """
    shapes = [Sphere(center=[0.5, 0.8], radius=0.1), Box(lower=[0.3, 0.0], upper=[0.7, 0.2])]
    bodies = bodies_of(shapes, 2, open_sides=FLOOR, settings=[{"restitution": 0.8}, {}])
    found = tops(bodies, 0, 0.3, STEPS[lengths], 1.2)
    np.testing.assert_allclose(found[:2], 0.5 * 0.8 ** np.array([2.0, 4.0]), rtol=1e-5)
    assert bodies.bodies[1].position[1] == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("lengths", STEPS)
def test_balls_that_meet_in_the_air_go_as_far_whatever_the_step(lengths):
    """Elastic impact in the air, independent of the step.

    Masses 1 : 4, both on parabolas: exact positions a second after the start.
    """
    shapes = [Sphere(center=[0.2, 0.5], radius=0.05), Sphere(center=[0.8, 0.5], radius=0.1)]
    start = [{"velocity": np.array([1.0, 2.0, 0.0])}, {"velocity": np.array([-0.5, 2.0, 0.0])}]
    bodies = bodies_of(shapes, 2, open_sides=SIDES, restitution=1.0, settings=start)
    for _ in steps(bodies, STEPS[lengths], 0.66 - 1e-9):
        pass
    time = bodies.time
    met = (0.6 - 0.15) / 1.5
    for body, at, before, after in zip(
        bodies.bodies, (0.2, 0.8), (1.0, -0.5), (-1.4, 0.1), strict=True
    ):
        assert body.velocity[0] == pytest.approx(after, abs=1e-9)
        expected = [at + before * met + after * (time - met), 0.5 + 2.0 * time - 0.5 * G * time**2]
        np.testing.assert_allclose(body.position[:2], expected, atol=1e-9)


@pytest.mark.parametrize("lengths", STEPS)
def test_elastic_bodies_that_rest_stay_at_rest(lengths):
    shapes = [
        Box(lower=[0.4, 0.0], upper=[0.6, 0.1]),
        Box(lower=[0.4, 0.1], upper=[0.6, 0.2]),
        Sphere(center=[0.8, 0.1], radius=0.1),
    ]
    bodies = bodies_of(shapes, 2, restitution=1.0)
    before = np.array([body.position for body in bodies.bodies])
    for _ in steps(bodies, STEPS[lengths], 0.4):
        assert bodies.kinetic_energy() < 1e-12
    np.testing.assert_allclose([body.position for body in bodies.bodies], before, atol=1e-6)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(("lengths", "gain"), [("fine", 1e-4), ("mixed", 5e-3), ("coarse", 1e-2)])
@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_a_column_of_balls_gains_no_energy(restitution, lengths, gain):
    """Energy of a column of balls.

    There are several impacts in a step, of bodies that hit others on both sides.
    """
    bodies = bodies_of(
        [Sphere(center=[0.5, 0.15 + 0.25 * k], radius=0.1) for k in range(3)],
        2,
        open_sides=FLOOR,
        restitution=restitution,
    )
    start, energies = bodies.potential_energy(GRAVITY), []
    for dt in steps(bodies, STEPS[lengths], 1.0):
        moving = [
            0.5 * body.properties.mass * np.square(body.velocity + 0.5 * dt * GRAVITY).sum()
            for body in bodies.bodies
        ]
        energies.append(sum(moving) + bodies.potential_energy(GRAVITY))
    assert max(energies) < (1.0 + gain) * start
    if restitution == 1.0 and lengths == "fine":
        assert energies[-1] == pytest.approx(start, rel=1e-4)


def test_an_impact_at_an_angle_keeps_angular_momentum():
    """Angular momentum of an impact at an angle.

    The bodies slide along each other while the gap closes, in a long step.
    """
    shapes = [Sphere(center=[0.3, 0.5], radius=0.1), Box(lower=[0.5, 0.4], upper=[0.7, 0.6])]
    start = [
        {"velocity": np.array([3.0, 1.0, 0.0]), "angular_velocity": np.array([0.0, 0.0, 4.0])},
        {},
    ]
    bodies = bodies_of(shapes, 2, open_sides=SIDES, restitution=0.6, friction=0.4, settings=start)

    def total():
        return [
            sum(
                body.angular_momentum[2] + np.cross(body.position, body.momentum)[2]
                for body in bodies.bodies
            )
        ]

    before = total()
    for _ in range(10):
        bodies.begin_step(bodies.time, 0.02, np.zeros(3), 0.02)
        bodies.end_step(0.02)
    assert bodies.bodies[1].velocity[0] > 0.1
    np.testing.assert_allclose(total(), before, rtol=1e-12)
