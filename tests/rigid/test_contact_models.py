"""Friction models against Coulomb's law and closed forms of one contact.

The polyhedral cone is compared with the circular one.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from warp_lcp.gallery.contact_scenes import box_stack, contact_scene, incline, motor_arm
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactSystem,
    FrozenBoxModel,
    StewartTrinkleModel,
    proximal_sweeps,
)

# [m/s] Friction turns the slip by a thousandth at most, so that it is almost never shared by two
# vectors.
FAST = 300.0
TIGHT = wl.StoppingCriteria(rtol=1e-12, max_iterations=2000, patience=2000)


def particle(slip, mu, weight=1.0, mass=2.0):
    """Return a particle on the ground with the impulse `weight` and the slip `slip`."""
    return ContactSystem(
        "particle",
        scipy.sparse.csr_array(np.eye(3) / mass),
        np.array([-weight / mass, *slip]),
        np.array([mu]),
    )


def solved(system, model, method=None):
    result = wl.solve(
        model.problem(system).dense().lcp(device="cpu"), method or wl.Lemke(), stopping=TIGHT
    )
    assert result, result.status
    return model.impulses(system, result.x.numpy())


@pytest.mark.parametrize("directions", [4, 8, 16])
def test_friction_dissipates_the_most_that_its_cone_allows(directions):
    """Dissipation of friction: the largest that its cone allows.

    KKT conditions with the resulting slip: u.r_t is the minimum over the polygon of mu r_n times
    the K vectors.
    """
    angles = 2 * np.pi * np.arange(directions) / directions
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for slip in np.random.default_rng(23).standard_normal((8, 2)) * 0.5:
        system = particle(slip, 0.5)
        r = solved(system, StewartTrinkleModel(directions))
        u = (system.B @ r + system.q)[1:]
        assert u @ r[1:] == pytest.approx(0.5 * r[0] * (vectors @ u).min(), abs=1e-9)
        sides = np.stack(
            [np.cos(angles + np.pi / directions), np.sin(angles + np.pi / directions)], axis=1
        )
        # Inside the polygon.
        assert (sides @ r[1:]).max() <= 0.5 * r[0] * np.cos(np.pi / directions) + 1e-9


@pytest.mark.parametrize("directions", [4, 8, 16])
def test_a_sliding_particle_is_held_along_the_nearest_vector(directions):
    mu, mass, model = 0.5, 2.0, StewartTrinkleModel(directions)
    for angle in np.random.default_rng(19).uniform(0, 2 * np.pi, 12):
        slip = FAST * np.array([np.cos(angle), np.sin(angle)])
        r = solved(particle(slip, mu, mass=mass), model)
        assert r[0] == pytest.approx(1.0)
        # The particle slides: friction is on the cone.
        assert np.linalg.norm(r[1:]) == pytest.approx(mu * r[0])
        nearest = 2 * np.pi / directions * np.round((angle + np.pi) / (2 * np.pi / directions))
        np.testing.assert_allclose(
            r[1:], mu * np.array([np.cos(nearest), np.sin(nearest)]), atol=1e-9
        )


@pytest.mark.slow
def test_the_polyhedral_cone_converges_to_the_circular_one():
    """Convergence of the polyhedral cone to the circular one.

    The largest error of a sliding particle's friction is 2 sin(pi / 2K) of it: it halves when K
    doubles.
    """
    mu, worst = 0.5, {}
    for K in (4, 8, 16, 32):
        errors = []
        for angle in np.linspace(0, 2 * np.pi / K, 41)[1:-1]:
            slip = FAST * np.array([np.cos(angle), np.sin(angle)])
            system = particle(slip, mu)
            exact, residual, _ = proximal_sweeps(system)
            # Opposite to the slip: Coulomb's law.
            np.testing.assert_allclose(exact[1:], -mu * slip / FAST, atol=1e-9)
            assert residual < 1e-9
            errors.append(np.linalg.norm(solved(system, StewartTrinkleModel(K)) - exact) / mu)
        worst[K] = max(errors)
        assert worst[K] == pytest.approx(2 * np.sin(np.pi / (2 * K)), rel=0.08)
    assert worst[4] > 1.9 * worst[8] > 3.6 * worst[16] > 6.9 * worst[32]


def test_in_a_stack_velocities_converge_to_those_of_the_circular_cone():
    """Convergence of velocities in a stack to those of the circular cone.

    Impulses of face contacts are not unique; velocities of sliding bodies are. Boxes thrown along
    the ground in odd directions.
    """
    world = incline(3, angle=0.0, friction=0.3)
    for body, thrown in zip(
        world.bodies, ([2.0, 0.7, 0.0], [0.3, 1.1, 0.0], [-1.3, 0.4, 0.0]), strict=True
    ):
        body.momentum = body.properties.mass * np.array(thrown)
    assembly = world.assemble(0.01)
    system = assembly.system
    r, residual, _ = proximal_sweeps(system, tolerance=1e-10, most=3000)
    assert residual <= 1e-10 * system.residual(np.zeros_like(r))
    exact, errors = assembly.velocity(r), []
    for K in (4, 8, 16):
        errors.append(
            np.abs(assembly.velocity(solved(system, StewartTrinkleModel(K))) - exact)[:, :2].max()
        )
    assert errors[2] < 0.5 * errors[0]
    assert errors[2] < 0.2 * 0.3 * 9.81 * 0.01  # share of the change by friction in the step


def test_in_the_plane_both_models_are_coulombs_law():
    B = scipy.sparse.csr_array(np.array([[1.0, 0.3], [0.3, 2.0]]))
    for slip, expected in ((5.0, -1), (-5.0, 1), (0.01, 0)):
        system = ContactSystem("plane", B, np.array([-1.0, slip]), np.array([0.4]), dim=2)
        for r in (
            solved(system, StewartTrinkleModel()),
            solved(system, BoxedModel(), wl.ProjectedSOR(omega=1.0)),
            proximal_sweeps(system)[0],
        ):
            u = B @ r + system.q
            assert r[0] > 0 and abs(u[0]) < 1e-8
            if expected:
                assert r[1] == pytest.approx(expected * 0.4 * r[0]) and u[1] * expected < 0
            else:
                assert abs(u[1]) < 1e-8 and abs(r[1]) < 0.4 * r[0]
            assert system.residual(r) < 1e-7


def test_the_boxed_model_is_tighter_than_nothing_and_wider_than_the_cone():
    system = particle(np.array([3.0, 3.0]), 0.5)
    r = solved(system, BoxedModel(), wl.ProjectedSOR(omega=1.0))
    # sqrt(2) mu along a diagonal, as documented.
    np.testing.assert_allclose(r, [1.0, -0.5, -0.5], atol=1e-9)
    frozen = solved(system, FrozenBoxModel(np.array([2.0])), wl.IncrementalPivoting())
    np.testing.assert_allclose(frozen, [1.0, -1.0, -1.0], atol=1e-9)


@pytest.mark.parametrize("model", [StewartTrinkleModel(8), BoxedModel()])
def test_a_guess_has_the_impulses_it_was_made_of(model):
    system, rng = box_stack(2).assemble(0.01).system, np.random.default_rng(8)
    r = rng.uniform(0.1, 1.0, len(system.q))
    r[system.tangents] *= 0.3 * rng.choice([-1, 1], system.tangents.shape)
    r[system.tangents] = np.clip(
        r[system.tangents], -0.5 * r[system.normals][:, None], 0.5 * r[system.normals][:, None]
    )
    np.testing.assert_allclose(model.impulses(system, model.guess(system, r)), r, atol=1e-13)


def test_equations_and_limits_of_motors_are_rows_of_every_model():
    system = motor_arm(2).assemble(0.01).system
    assert system.contacts == 0
    r = solved(system, StewartTrinkleModel())
    np.testing.assert_allclose(
        solved(system, BoxedModel(), wl.ProjectedSOR(omega=1.0)), r, atol=1e-6 * abs(r).max()
    )
    u, free = system.B @ r + system.q, np.isinf(system.lower)
    np.testing.assert_allclose(u[free], 0, atol=1e-9)
    assert ((r >= system.lower - 1e-12) & (r <= system.upper + 1e-12)).all()


def test_blocks_are_a_partition_with_contacts_and_equations_together():
    system = contact_scene("box-stack", 2)
    assert system.A.shape == (24, 24)
    arm = motor_arm(3).assemble(0.01).system
    rows = np.sort(np.concatenate(arm.blocks()))
    np.testing.assert_array_equal(rows, np.arange(len(arm.q)))
    assert sorted(map(len, arm.blocks())) == [1, 1, 1, 5, 5, 5]


def test_wrong_systems_are_named():
    with pytest.raises(ValueError, match="directions = 5"):
        StewartTrinkleModel(5)
    with pytest.raises(ValueError, match="friction holds"):
        particle(np.zeros(2), -1.0)
    with pytest.raises(ValueError, match="expected 6 rows"):
        ContactSystem("two", scipy.sparse.csr_array(np.eye(3)), np.zeros(3), np.zeros(2))
