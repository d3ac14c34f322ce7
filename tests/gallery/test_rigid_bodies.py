"""Bodies against integrals over their volume, SciPy's rotations and the conservation laws of free motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_lcp.gallery.rigid_bodies import FIXED, Box, Gear, RigidBodies, Sphere, rotation


def sampled_inertia(inside, half, mass, n=60):
    """Midpoint sums of (|r|^2 1 - r r') over the points inside: no formula of the code."""
    axes = [(np.arange(n) + 0.5) / n * 2 * h - h for h in half]
    r = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    r = r[inside(r)]
    return mass * ((r * r).sum(axis=1)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None, :]).mean(axis=0)


def test_inertia_is_that_of_the_volume():
    sphere = sampled_inertia(lambda r: (r * r).sum(axis=1) <= 0.49, (0.7, 0.7, 0.7), 3.0)
    np.testing.assert_allclose(Sphere(0.7).inertia(3.0), sphere, rtol=3e-3, atol=1e-3)
    half = (0.1, 0.2, 0.5)
    np.testing.assert_allclose(Box(half).inertia(3.0), sampled_inertia(lambda r: r[:, 0] > -1, half, 3.0), rtol=1e-3, atol=1e-12)
    gear, total = Gear(0.3, 0.05, 0.1, 3), np.zeros((3, 3))  # bars count where they overlap: three bars of a third of the mass
    for k in range(3):
        Q = Rotation.from_rotvec([0, 0, np.pi * k / 3]).as_matrix()
        total += Q @ sampled_inertia(lambda r: r[:, 0] > -1, (0.3, 0.05, 0.1), 2.0) @ Q.T
    np.testing.assert_allclose(gear.inertia(6.0), total, rtol=1e-3, atol=1e-12)


def test_rotation_is_scipys():
    rng = np.random.default_rng(77)
    for size in (0.0, 1e-9, 0.3, np.pi, 9.0):
        vector = rng.standard_normal(3)
        vector *= size / np.linalg.norm(vector)
        np.testing.assert_allclose(rotation(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)


def tumbling():
    R = Rotation.random(3, random_state=np.random.default_rng(5)).as_matrix()
    velocity = np.random.default_rng(6).standard_normal((3, 6)) * 3
    shapes = [Box((0.1, 0.2, 0.5)), Sphere(0.3), Box((0.1, 0.1, 0.1))]
    return RigidBodies(shapes, [1.0, 2.0, FIXED], [[0, 0, 1], [1, 2, 3], [5, 5, 5]], R, velocity)


def test_free_motion_keeps_momentum_and_bounds_energy():
    bodies = tumbling()
    before, energy = bodies.momentum(), bodies.kinetic_energy()
    for _ in range(200):
        bodies.move(0.01)
    np.testing.assert_allclose(bodies.momentum(), before, rtol=1e-11, atol=1e-12)
    assert bodies.kinetic_energy() == pytest.approx(energy, rel=0.1)  # first order in dt; momentum is exact
    np.testing.assert_allclose(bodies.rotation @ bodies.rotation.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-13)
    np.testing.assert_array_equal(bodies.position[2], [5, 5, 5])  # a fixed body stays, whatever velocity it was given


def test_inverse_mass_inverts_what_the_energy_weighs():
    bodies = tumbling()
    v = bodies.velocity[:2].ravel()
    impulse = np.linalg.solve(bodies.inverse_mass().toarray()[:12, :12], v)
    assert 0.5 * v @ impulse == pytest.approx(bodies.kinetic_energy(), rel=1e-12)
    assert bodies.inverse_mass()[12:].nnz == 0 or abs(bodies.inverse_mass()[12:]).max() == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(0.0), "radius = 0.0: must be a finite number > 0"),
        (lambda: Box((1.0, -1.0, 1.0)), "half"),
        (lambda: Gear(1.0, 0.1, 0.1, 0), "bars = 0: must be an integer >= 1"),
        (lambda: RigidBodies([], [], []), "shapes is empty"),
        (lambda: RigidBodies([Sphere(1.0)], [-1.0], [[0, 0, 0]]), "mass holds"),
        (lambda: RigidBodies([Sphere(1.0)], [1.0], [[0, 0]]), "position has shape"),
        (lambda: RigidBodies([Sphere(1.0)], [1.0], [[0, 0, np.nan]]), "position holds"),
    ],
)
def test_wrong_bodies_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
