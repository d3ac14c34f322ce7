"""Worlds of rigid bodies: mass properties, moving bodies, refusals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_lcp.gallery.contact_scenes import about, box, gear
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.rigid_world import FIXED, World
from warp_lcp.grid.signed_distance import Sphere


def sampled_inertia(half, mass, n=60):
    """Return midpoint sums of (|r|^2 1 - r r') over a box.

    No formula of the code is used.
    """
    axes = [(np.arange(n) + 0.5) / n * 2 * h - h for h in half]
    r = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return mass * (
        (r * r).sum(axis=1)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None, :]
    ).mean(axis=0)


def test_a_gear_has_the_mass_and_inertia_of_its_bars():
    """Mass and inertia of a gear of bars.

    Overlapping parts count twice: three bars of a third of the mass, in the xz plane.
    """
    body = World("", [gear([1.0, 2.0, 3.0], (0.3, 0.05, 0.1), 0.2)], [6.0]).bodies[0]
    upright, total = Rotation.from_rotvec([np.pi / 2, 0, 0]), np.zeros((3, 3))
    for k in range(3):
        Q = (upright * Rotation.from_rotvec([0, 0, 0.2 + np.pi * k / 3])).as_matrix()
        total += Q @ sampled_inertia((0.3, 0.05, 0.1), 2.0) @ Q.T
    np.testing.assert_allclose(body.inertia, total, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(body.position, [1.0, 2.0, 3.0])
    assert body.properties.mass == pytest.approx(6.0)


def tumbling():
    """Return a turning box, a ball, and a fixed box."""
    turn = Rotation.random(random_state=np.random.default_rng(5))
    solids = [
        box([0, 0, 1], (0.1, 0.2, 0.5), turn),
        Sphere(center=[1, 2, 3], radius=0.3),
        box([5, 5, 5], (0.1, 0.1, 0.1)),
    ]
    world, rng = (
        World("", solids, [1.0, 2.0, FIXED], obstacles=(), gravity=(0.0, 0.0, 0.0)),
        np.random.default_rng(6),
    )
    for body in world.bodies[:2]:
        body.momentum, body.angular_momentum = rng.standard_normal(3), rng.standard_normal(3)
    return world


def test_fixed_bodies_stay_and_ignore_impulses():
    world = tumbling()
    energy, stepper = world.energy(), ContactStepper(world, dt=0.01)
    for _ in range(200):
        stepper.step()
    np.testing.assert_array_equal(world.bodies[2].position, [5, 5, 5])
    np.testing.assert_array_equal(world.bodies[2].rotation, np.eye(3))
    assert np.linalg.norm(world.bodies[0].rotation - np.eye(3)) > 0.1
    assert world.energy() == pytest.approx(energy, rel=1e-2)
    held = World(
        "", [box([0, 0, 1], (0.1,) * 3), Sphere(center=[0, 0, 1.2], radius=0.1)], [FIXED, 1.0]
    )
    assembly = held.assemble(0.01)
    assert len(assembly.contacts) == 1
    np.testing.assert_array_equal(assembly.velocity(np.ones(3))[0], 0.0)
    assert assembly.response[6:].toarray().any()


def test_the_inverse_mass_is_that_of_the_energy():
    """Inverse mass against the kinetic energy.

    The energy is v'M v / 2 with M^-1 of the velocity problem, along the effect of a contact.
    """
    world = World(
        "",
        [box([0, 0, 0.5], (0.1, 0.2, 0.5), about((0.0, 0.0, 1.0), 0.4))],
        [3.0],
        gravity=(0.0, 0.0, 0.0),
    )
    assembly, body = world.assemble(0.01), world.bodies[0]
    r = np.random.default_rng(6).standard_normal(len(assembly.system.q))
    impulse = assembly.J.T @ r
    body.push(impulse)
    assert 0.5 * impulse @ assembly.velocity(r)[0] == pytest.approx(body.kinetic_energy, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: World("", [], []), "solids is empty"),
        (
            lambda: World("", [box([0, 0, 0], (1.0, -1.0, 1.0))], [1.0]),
            "min must be less than its max",
        ),
        (
            lambda: World("", [Sphere(center=[0, 0, 0], radius=1.0)], [-1.0]),
            "mass = -1.0: must be positive",
        ),
        (
            lambda: World(
                "", [Sphere(center=[0, 0, 0], radius=1.0)], [1.0], gravity=(0.0, 0.0, np.nan)
            ),
            "gravity",
        ),
    ],
)
def test_wrong_worlds_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
