"""Native loops of rigid bodies against plain NumPy, step by step.

The loops are motion, planar contacts, impulses and supported bodies. They sum in the order of NumPy
and OpenBLAS on processors with AVX2 and have their bits; elsewhere rounding may differ.
"""

import dataclasses

import numpy as np
import plain_motion
import pytest
from scipy.spatial.transform import Rotation

from warp_lcp.grid import motion
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, Plane, Sphere
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import BodyMotion, BodyStates, RigidBody
from warp_lcp.rigid.contact_detection import ContactDetection
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contact_solve import ContactSolve
from warp_lcp.rigid.mass_properties import MassProperties, mass_properties
from warp_lcp.rigid.obstacles import domain_walls, obstacle
from warp_lcp.rigid.planar_contacts import SLOP

ROUNDING = 1e-14  # relative, of a step
DT, GRAVITY = 4e-3, np.array([0.0, -9.81, 0.0])


def about_z(angles):
    return Rotation.from_rotvec(
        np.asarray(angles)[..., None] * np.array([0.0, 0.0, 1.0])
    ).as_matrix()


def close(found, expected, atol=0.0):
    np.testing.assert_allclose(
        found,
        expected,
        rtol=ROUNDING,
        atol=atol or ROUNDING * max(1.0, np.abs(expected).max(initial=0.0)),
    )


def drawn_states(rng, flat):
    """Return bodies anywhere, some at rest; in a plane if `flat`."""
    n, bodies = int(rng.integers(1, 6)), []
    for number in range(n):
        root = np.diag(rng.uniform(0.2, 2.0, 3)) if flat else rng.standard_normal((3, 3))
        inertia = root @ root.T + 0.1 * np.eye(3)
        center = rng.standard_normal(3) * ([1.0, 1.0, 0.0] if flat else 1.0)
        bodies.append(
            RigidBody(
                MassProperties(mass=float(rng.uniform(0.1, 5.0)), center=center, inertia=inertia),
                name=f"body {number}",
            )
        )
    states = BodyStates(bodies)
    moves = rng.random(n) < 0.8
    states.position[:] = rng.standard_normal((n, 3))
    states.rotation[:] = Rotation.random(n, random_state=int(rng.integers(1 << 30))).as_matrix()
    states.momentum[:], states.angular_momentum[:] = (
        rng.standard_normal((n, 3)) * moves[:, None] for _ in range(2)
    )
    if flat:
        states.position[:, 2] = states.momentum[:, 2] = states.angular_momentum[:, :2] = 0.0
        states.rotation[:] = about_z(rng.uniform(-3.0, 3.0, n))
    states.angular_momentum[:] *= 10.0 ** rng.uniform(-3.0, 1.0, (n, 1))
    states.time[:] = 0.5
    return states


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("seed", range(12))
def test_motion_is_that_of_plain_numpy(seed):
    rng = np.random.default_rng([1, seed])
    states = drawn_states(rng, flat=bool(seed % 2))
    each = states.mass, states.inverse_inertia
    dt = rng.uniform(1e-4, 2e-2)
    motions = motion.Motions([BodyMotion(body) for body in states])
    times = np.array([0.5, 0.5 + dt, 0.5 - dt])
    R, t = motions.poses(times)
    for time, rotation, translation in zip(times, R, t, strict=True):
        later = (
            plain_motion.advanced(states.values, *each, np.full(len(states), time - 0.5))
            if time != 0.5
            else states.values
        )
        close(rotation, later[:, 3:12].reshape(-1, 3, 3))
        close(translation, later[:, :3] - (rotation @ states.center[..., None])[..., 0])
    for found, expected in zip(
        motions.velocity_fields(0.5, dt),
        plain_motion.velocity_fields(states.values, *each),
        strict=True,
    ):
        close(found, expected)
    low = rng.uniform(-1.0, 1.0, (len(states), 3))
    boxes = np.stack([low, low + rng.uniform(0.0, 1.0, low.shape)], axis=1)
    boxes[rng.random(len(states)) < 0.2] = motion.UNLIMITED
    size, ends = np.array([1.5, 1.0, 0.0 if seed % 2 else 1.2]), 0.5 + dt * np.arange(5.0) / 4.0
    close(
        motions.top_speed(boxes, size, 0.5, dt),
        plain_motion.top_speed(*motions.poses(ends), boxes, size, dt),
        atol=1e-12,
    )
    expected = plain_motion.advanced(states.values, *each, np.full(len(states), dt))
    states.advance(dt)
    close(states.values, expected)


def test_motion_with_zero_time_and_non_finite_values():
    states = drawn_states(np.random.default_rng(5), flat=False)
    before = states.values.copy()
    states.advance(0.0)
    close(states.values[:, [0, 1, 2, *range(12, 20)]], before[:, [0, 1, 2, *range(12, 20)]])
    states.angular_momentum[0, 1] = np.nan
    states.advance(1e-3)
    assert np.isnan(states.rotation[0]).any() and np.isfinite(states.values[1:]).all()


def drawn_shape(rng):
    """Return a box, disc or capsule.

    Some are at right angles and of round sizes, so that sides touch exactly.
    """
    neat = rng.random() < 0.4
    size = rng.choice([0.05, 0.1], 2) if neat else rng.uniform(0.03, 0.15, 2)
    angle, scale = (
        (float(rng.choice([0.0, np.pi / 2])), 1.0)
        if neat
        else (float(rng.uniform(-3.0, 3.0)), float(rng.uniform(0.7, 1.3)))
    )
    at = np.round(rng.uniform(0.15, 0.85, 2), 1 if neat else 9)
    place = Placement(rotation=about_z(angle), translation=np.array([*at, 0.0]), scale=scale)
    kind = rng.integers(4)
    if kind < 2:
        return Box(lower=tuple(-size), upper=tuple(size), placement=place)
    if kind == 2:
        return Sphere(center=(0.0, 0.0), radius=float(size[0]), placement=place)
    way = rng.uniform(-0.1, 0.1, 2)
    return Capsule(start=tuple(-way), end=tuple(way), radius=float(0.6 * size[0]), placement=place)


def drawn_world(seed, most=6):
    """Return bodies, their shapes, and obstacles.

    Walls, inverted boxes, planes, shapes that stand or move.
    """
    rng = np.random.default_rng([2, seed])
    shapes = [drawn_shape(rng) for _ in range(int(rng.integers(1, most + 1)))]
    bodies = []
    for number, shape in enumerate(shapes):
        speed, spin = (
            np.array([*rng.standard_normal(2), 0.0]),
            np.array([0.0, 0.0, 5.0 * rng.standard_normal()]),
        )
        touch = {
            "friction": float(rng.uniform(0.0, 1.0)),
            "restitution": 0.5 * float(seed % 3 == 0),
        }
        properties = mass_properties(shape, 2, density=500.0)
        bodies.append(
            RigidBody(
                properties, name=f"body {number}", velocity=speed, angular_velocity=spin, **touch
            )
        )
    solids = []
    for number in range(int(rng.integers(0, 3))):
        others = [
            Plane(point=tuple(rng.uniform(0.0, 1.0, 2)), normal=tuple(rng.standard_normal(2))),
            Box(lower=(0.1, 0.1), upper=(0.9, 0.95), invert=True),
        ]
        geometry = drawn_shape(rng) if rng.random() < 0.6 else others[rng.integers(2)]
        moves = motion.Rotation(rate=50.0, center=(0.5, 0.5)) if rng.random() < 0.3 else None
        solids.append(
            PlacedSolid(geometry=geometry, separating=False, name=f"solid {number}", motion=moves)
        )
    walls = (
        [domain_walls([1.0, 1.0], open_sides=int(rng.choice([0, 1, 8])))]
        if rng.random() < 0.9
        else []
    )
    return rng, bodies, shapes, (*walls, *(obstacle(solid, 2) for solid in solids))


def solve_of(bodies, shapes, obstacles, loops=True):
    solve = ContactSolve(
        ContactDetection(bodies, [ContactShape.of(shape, 2) for shape in shapes], obstacles, 2)
    )
    assert solve._planar is not None
    if not loops:
        solve._planar = None
    return solve


@pytest.mark.parametrize("first", range(0, 24, 6))
def test_contacts_in_a_plane_are_those_of_the_detection(first):
    """Planar contacts against the detection.

    Bodies anywhere, overlapping, on a lattice where sides touch exactly, and far from others.
    """
    touching = 0
    for seed in range(first, first + 6):
        rng, bodies, shapes, obstacles = drawn_world(seed)
        solve = solve_of(bodies, shapes, obstacles)
        plain, states = solve_of(solve.bodies, shapes, obstacles, loops=False), solve.bodies
        for turn in range(3):
            states.position[:, :2] += 0.05 * rng.standard_normal((len(bodies), 2))
            states.rotation[:] = about_z(rng.uniform(-3.0, 3.0, len(bodies)))
            if turn == 2:
                states.position[:, :2], states.rotation[:] = (
                    np.round(states.position[:, :2], 1),
                    np.eye(3),
                )
            gravity = GRAVITY * rng.integers(2)
            found, expected = (which.find(0.1, DT, gravity) for which in (solve, plain))
            touching += len(expected)
            for field in dataclasses.fields(found):
                close(getattr(found, field.name), getattr(expected, field.name))
    assert touching > 50


def test_more_contacts_than_there_is_room_for_are_found_all_the_same():
    box = Box(lower=(-0.02, -0.02), upper=(0.02, 0.02))
    shapes = [
        dataclasses.replace(box, placement=Placement(translation=np.array([x, y, 0.0])))
        for x in np.arange(8) / 25
        for y in np.arange(6) / 25
    ]
    bodies = [RigidBody(mass_properties(shape, 2, density=500.0), name="box") for shape in shapes]
    solve = solve_of(bodies, shapes, (domain_walls([1.0, 1.0]),))
    plain = solve_of(solve.bodies, shapes, solve.detection.obstacles, loops=False)
    expected = plain.find(0.0, DT, GRAVITY)
    assert len(expected) > 64
    for room in (solve._planar._capacity, len(expected) - 1):
        solve._planar._capacity = room
        close(solve.find(0.0, DT, GRAVITY).gap, expected.gap)


def test_overlaps_at_the_end_of_a_step_are_seen():
    """Overlaps at the end of a step.

    Contacts that separate leave no overlap after a long time, others keep theirs.
    """
    seen = []
    for seed in range(30, 50):
        _, bodies, shapes, obstacles = drawn_world(seed)
        solve, dt = solve_of(bodies, shapes, obstacles), 0.5
        contacts = solve.find(0.0, DT, GRAVITY)
        impulses = solve.push_apart(contacts, dt=dt)
        if len(contacts) and solve._pushed is not None and solve._pushed.impulses is impulses:
            gap = (
                contacts.gap
                + dt * contacts.velocities(solve.bodies.velocities()[:, [0, 1, 5]])[:, 0]
            )
            seen.append(bool((gap < -SLOP * contacts.size).any()))
            assert (solve._pushed.ways is not None) == seen[-1]
    assert set(seen) == {True, False}


def stepped(seed, loops, steps):
    """Return the history of a world.

    It consists of supported bodies, values, contacts, and remembered impulses.
    """
    rng, bodies, shapes, obstacles = drawn_world(seed)
    world = object.__new__(RigidBodies)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ContactSolve, "check_start", lambda *_: None)  # random bodies may overlap
        world.__init__(bodies, shapes, list(range(len(bodies))), obstacles, 2)
    if not loops:
        world._solve._planar = None
    recorded = []
    for step in range(steps):
        world.begin_step(world.time, DT, GRAVITY, DT)
        recorded.append([np.eye(3) if body.hold is None else body.hold for body in world.bodies])
        if step % 2:
            world.bodies.apply_impulses(
                0.01 * rng.standard_normal((len(bodies), 3)) * world.bodies.mass[:, None]
            )
        world.end_step(DT)
        recorded += [world.bodies.values.copy(), world._solve.memory.values, [world.contacts]]
    return recorded


@pytest.mark.parametrize("first", range(100, 112, 4))
def test_a_world_steps_as_with_plain_numpy(first):
    """Steps of a world with and without the native loops.

    It falls, rests, is pushed, bounces and is separated.
    """
    for seed in range(first, first + 4):
        for found, expected in zip(stepped(seed, True, 6), stepped(seed, False, 6), strict=True):
            close(found, np.asarray(expected), atol=1e-9)  # solves stop at 1e-7 of the impulses


def test_a_body_alone_without_obstacles_touches_nothing():
    shape = Sphere(center=(0.5, 0.5), radius=0.1)
    body = RigidBody(mass_properties(shape, 2, density=500.0), name="disc")
    solve = solve_of([body], [shape], ())
    contacts = solve.find(0.0, DT, GRAVITY)
    assert len(contacts) == 0 and contacts.one.shape == (0, 2, 3)
    assert solve.push_apart(contacts).shape == (0, 2)
    assert solve.separation(contacts, DT) is None
