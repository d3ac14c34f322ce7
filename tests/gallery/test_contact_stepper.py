"""Time steps of rigid bodies against closed forms.

Fall, rest, sliding, collision; conservation laws; stable scenes.
"""

import numpy as np
import pytest

import warp_lcp as wl
from default_run import slow
from warp_lcp.gallery.contact_scenes import (
    SCENES,
    box,
    box_stack,
    driven_gears,
    hanging_snake,
    heavy_on_light,
    incline,
    sphere_stack,
    wall,
)
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.rigid_world import World
from warp_lcp.grid.signed_distance import Sphere
from warp_lcp.rigid.contact_models import StewartTrinkleModel
from warp_lcp.rigid.joints import WORLD, Joint

DT = 0.01
TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=3000, patience=3000)
DIRECT = wl.SubspaceMinimization(precision="double", backtracks=-1)
AXIS = np.array([0.0, 1.0, 0.0])


def drop(height=1.0):
    return World("ball", [Sphere(center=[0, 0, 0.5 + height], radius=0.5)], [2.0])


def positions(world):
    return np.array([body.position for body in world.bodies])


def momentum(world):
    """Return the momentum of all bodies, and the angular one about the origin."""
    turns = [
        np.cross(body.position, body.momentum) + body.angular_momentum for body in world.bodies
    ]
    return np.concatenate(
        [np.sum([body.momentum for body in world.bodies], axis=0), np.sum(turns, axis=0)]
    )


def test_a_ball_falls_then_rests_with_the_impulse_of_its_weight():
    world = drop()
    stepper = ContactStepper(world, dt=DT)
    for n in range(1, 11):
        stepper.step()
        assert world.bodies[0].velocity[2] == pytest.approx(-9.81 * DT * n)
        # Semi-implicit Euler, summed.
        assert world.bodies[0].position[2] == pytest.approx(1.5 - 9.81 * DT**2 * n * (n + 1) / 2)
    for _ in range(60):
        report = stepper.step()
        assert world.bodies[0].position[2] > 0.5 - 1e-6  # gaps are closed, never crossed
    assert report.impulses[0] == pytest.approx(2.0 * 9.81 * DT, rel=1e-6)
    assert abs(world.bodies[0].velocity[2]) < 1e-6
    assert report.time == pytest.approx(0.7)


def collision():
    rng = np.random.default_rng(44)
    position = [[0, 0, 0], [1.05, 0.2, 0.1], [0.3, 1.1, -0.2], [-1.2, 0.1, 0.3]]
    halves = [(0.4, 0.4, 0.4), (0.5, 0.3, 0.4), None, (0.4, 0.5, 0.3)]
    solids = [
        box(x, half) if half else Sphere(center=x, radius=0.5)
        for x, half in zip(position, halves, strict=True)
    ]
    hinge = Joint(0, 1, np.array([0.5, 0.1, 0.05]), AXIS)
    world = World(
        "collision",
        solids,
        [1.0, 2.0, 0.5, 3.0],
        obstacles=(),
        hinges=(hinge,),
        gravity=(0.0, 0.0, 0.0),
    )
    for body, spin in zip(world.bodies, rng.standard_normal((4, 3)), strict=True):
        body.momentum, body.angular_momentum = (
            -2 * body.properties.mass * body.position,
            body.properties.inertia @ spin,
        )
    return world


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("stabilization", ["none", "baumgarte", "split"])
def test_momentum_stays_without_gravity(stabilization):
    """Momentum without gravity.

    Impulses are opposite and on one line: a wrong sign or arm in J changes momentum or angular
    momentum.
    """
    world = collision()
    before, touched = momentum(world), 0
    stepper = ContactStepper(world, dt=DT, stabilization=stabilization)
    for _ in range(40):
        report = stepper.step()
        touched += report.contacts > 0 and bool(
            (report.impulses[: 3 * report.contacts : 3] > 1e-3).any()
        )
        np.testing.assert_allclose(momentum(world)[:3], before[:3], atol=1e-10)
        if stabilization != "split":  # "split" moves bodies without momentum
            np.testing.assert_allclose(momentum(world)[3:], before[3:], atol=1e-10)
    assert touched > 2


@pytest.mark.parametrize("steps", [14, slow(35)])
def test_energy_does_not_grow(steps):
    world = collision()
    stepper = ContactStepper(world, wl.NNCG(), dt=DT, stabilization="none", stopping=TIGHT)
    energies = [world.energy()]
    for _ in range(steps):
        stepper.step()
        energies.append(world.energy())
    assert energies[-1] < 0.9 * energies[0]  # the collisions are plastic
    rise = np.diff(energies).max()
    # Energy of turning bodies with their angular momentum kept, first order in dt.
    assert rise < 5e-3 * energies[0]


@pytest.mark.parametrize(
    ("method", "model"),
    [
        (None, None),
        *map(slow, [(wl.NNCG(), None), (DIRECT, None)]),
        (wl.Lemke(), StewartTrinkleModel(4)),
    ],
)
def test_a_box_slides_down_a_slope_with_the_acceleration_of_coulombs_law(method, model):
    mu, angle = 0.3, 0.5
    world = incline(1, angle=angle, friction=mu)
    start = world.bodies[0].position.copy()
    stepper = ContactStepper(world, method, model=model, dt=DT, stopping=TIGHT)
    for _ in range(50):
        stepper.step()
    a = 9.81 * (np.sin(angle) - mu * np.cos(angle))
    assert np.linalg.norm(world.bodies[0].velocity) == pytest.approx(a * 50 * DT, rel=1e-5)
    assert np.linalg.norm(world.bodies[0].position - start) == pytest.approx(
        a * DT**2 * 50 * 51 / 2, rel=1e-5
    )


@pytest.mark.parametrize("steps", [20, slow(100)])
def test_a_box_rests_on_a_gentle_slope(steps):
    world = incline(1, angle=0.28, friction=0.3)  # tan 0.28 = 0.288
    start = positions(world)
    stepper = ContactStepper(world, dt=DT, stopping=TIGHT)
    for _ in range(steps):
        stepper.step()
    np.testing.assert_allclose(positions(world), start, atol=1e-6)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("stabilization", ["baumgarte", "split", "none"])
def test_overlaps_are_removed_as_asked(stabilization):
    world = World("sunk", [box([0, 0, 0.23], (0.25, 0.25, 0.25))], [1.0])  # 2 cm into the ground
    stepper, top = ContactStepper(world, dt=DT, stabilization=stabilization), 0.0
    for _ in range(60):
        stepper.step()
        top = max(top, float(world.bodies[0].velocity[2]))
    assert (
        world.deepest() == pytest.approx(0.02, abs=1e-6)
        if stabilization == "none"
        else world.deepest() < 0.0015
    )
    # Baumgarte's correction gives the body the velocity of the move.
    assert (top > 0.1) == (stabilization == "baumgarte")


@pytest.mark.parametrize("until", [0.6, slow(1.7)])
def test_a_pendulum_keeps_its_length_and_its_period(until):
    """Length, and times of the lowest point: a quarter of a period, and half a period more."""
    bob = Sphere(center=[np.sin(0.1), 0, -np.cos(0.1)], radius=0.1)
    world = World(
        "pendulum", [bob], [1.0], obstacles=(), hinges=(Joint(0, WORLD, np.zeros(3), AXIS),)
    )
    stepper, crossings, last = (
        ContactStepper(world, wl.Lemke(), model=StewartTrinkleModel(4), dt=DT),
        [],
        1.0,
    )
    while stepper.time < until:
        stepper.step()
        x = float(world.bodies[0].position[0])
        if last * x < 0:
            crossings.append(stepper.time - DT * x / (x - last))
        last = x
    assert np.linalg.norm(world.bodies[0].position) == pytest.approx(1.0, abs=2e-3)
    inertia = 1.0 + 0.4 * 0.01
    half = np.pi * np.sqrt(inertia / 9.81)
    assert crossings[0] == pytest.approx(0.5 * half, abs=DT)
    assert np.diff(crossings) == pytest.approx([half] * (until > 1.6), rel=5e-3)


@pytest.mark.slow
def test_limits_hold_a_hanging_chain():
    world = hanging_snake(4)
    stepper = ContactStepper(world, DIRECT, dt=DT, stopping=TIGHT)
    for _ in range(150):
        stepper.step()
    angles = [hinge.angle(world.bodies) for hinge in world.hinges]
    for angle, hinge in zip(angles, world.hinges, strict=True):
        assert hinge.limits[0] - 0.005 < angle < hinge.limits[1] + 0.005
    assert np.abs(world.velocities()).max() < 0.01


@pytest.mark.parametrize("steps", [40, slow(80)])
def test_gears_turn_each_other(steps):
    gears = driven_gears(2)
    stepper = ContactStepper(gears, wl.NNCG(), dt=DT)
    for _ in range(steps):
        stepper.step()
    assert gears.bodies[0].angular_velocity[1] == pytest.approx(1.0, rel=0.05)  # the motor's speed
    assert gears.hinges[1].angle(gears.bodies) < -0.4 * steps * DT  # and the other direction


def test_warm_starting_saves_iterations():
    counts = {}
    for warm in (False, True):
        stepper = ContactStepper(sphere_stack(5), dt=DT, warm=warm)
        counts[warm] = sum(stepper.step().iterations for _ in range(10))
    assert counts[True] < 0.3 * counts[False]


BLOCKED = {
    "blocked": lambda s: wl.BlockedGaussSeidel(blocks=s.blocks()),
    "staggering": lambda s: wl.Staggering(blocks=s.staggered()),
}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "method", [None, slow(wl.NNCG()), DIRECT, BLOCKED["blocked"], slow(BLOCKED["staggering"])]
)
def test_a_stack_stands_with_every_method(method):
    world = box_stack(3)
    start = positions(world)
    stepper = ContactStepper(world, method, dt=DT)
    for _ in range(40):
        stepper.step()
    np.testing.assert_allclose(positions(world), start, atol=2e-3)
    assert np.abs(world.velocities()).max() < 0.02


def test_lemke_steps_a_stack_too():
    world = box_stack(2)
    start = positions(world)
    stepper = ContactStepper(world, wl.Lemke(), model=StewartTrinkleModel(4), dt=DT)
    for _ in range(10):
        assert stepper.step().status is wl.SolveStatus.CONVERGED
    np.testing.assert_allclose(positions(world), start, atol=1e-6)


def test_methods_without_affine_bounds_refuse_the_boxed_model():
    with pytest.raises(ValueError, match="cannot use bounds that are affine"):
        ContactStepper(box_stack(1), wl.Lemke()).step()
    with pytest.raises(ValueError, match="stabilization"):
        ContactStepper(box_stack(1), stabilization="glue")
    with pytest.raises(ValueError, match="dt = 0"):
        ContactStepper(box_stack(1), dt=0)


@pytest.mark.slow
@pytest.mark.parametrize("stabilization", ["baumgarte", "split"])
@pytest.mark.parametrize(
    "make",
    [
        lambda: box_stack(10),
        lambda: sphere_stack(6),
        lambda: wall(4, columns=4),
        lambda: heavy_on_light(2, ratio=1000.0),
    ],
)
def test_stacks_stand_for_five_seconds(make, stabilization):
    world = make()
    start = positions(world)
    stepper = ContactStepper(world, wl.NNCG(), dt=DT, stabilization=stabilization)
    while stepper.time < 5:
        stepper.step()
    assert np.abs(positions(world) - start).max() < 0.02 * world.size
    assert world.deepest() < 0.01 * world.size


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_no_scene_gains_energy(name):
    world = SCENES[name]()
    start, stepper = world.energy(), ContactStepper(world, wl.NNCG(), dt=DT)
    motors = sum(hinge.motor_torque for hinge in world.hinges)
    for _ in range(200):
        stepper.step()
        if not motors:
            assert world.energy() <= start + 1e-3 * abs(start)
    assert np.isfinite(positions(world)).all()
