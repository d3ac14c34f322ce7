"""Contact problem: the fused solve, its memory, and supported bodies.

It is compared with the package's own residual and methods.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from bodies_at_hand import GRAVITY, bodies_of, run
from scipy.sparse.csgraph import connected_components

import warp_lcp as wl
from warp_lcp.grid.signed_distance import Box, Sphere
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.contact_models import BoxedModel, ContactSystem
from warp_lcp.rigid.contact_problem import ContactProblem
from warp_lcp.rigid.contacts import jacobian

EXACT = StoppingCriteria(rtol=1e-7, max_iterations=2000)


def problem_of(dimension, seed):
    """Return contacts of four bodies: chains over three, and a separate one."""
    rng, q = np.random.default_rng(seed), 3 * dimension - 3
    first, second = np.array([0, 1, 3, 2, 0]), np.array([4, 0, 4, 1, 4])
    one, other = rng.normal(size=(5, dimension, q)), rng.normal(size=(5, dimension, q))
    other[second == 4] = 0.0
    b = rng.normal(size=(5, dimension))
    b[:, 0] = -np.abs(b[:, 0])
    return ContactProblem(first, second, one, other, b, rng.uniform(0.1, 0.9, 5), 4)


def test_islands_are_the_connected_components_of_pairs():
    rng = np.random.default_rng(77)
    for _ in range(30):
        bodies, k = int(rng.integers(1, 12)), int(rng.integers(0, 15))
        first, second = rng.integers(0, bodies, k), rng.integers(0, bodies + 1, k)
        second[second == first] = bodies
        rows = np.zeros((k, 2, 3))
        order, starts = ContactProblem(
            first, second, rows, rows, np.zeros((k, 2)), np.zeros(k), bodies
        ).islands()
        pairs = second < bodies
        links = scipy.sparse.coo_array(
            (np.ones(pairs.sum()), (first[pairs], second[pairs])), shape=(bodies, bodies)
        )
        labels = connected_components(links, directed=False)[1][first]
        expected = np.argsort(labels, kind="stable")
        np.testing.assert_array_equal(order, expected)
        np.testing.assert_array_equal(
            starts, np.append(np.flatnonzero(np.diff(labels[expected], prepend=-1)), k)
        )


def stack(dimension, count=3):
    far = [[0.4], [0.6]] if dimension == 3 else [[], []]
    return [
        Box(lower=[0.4, 0.1 * k, *far[0]], upper=[0.6, 0.1 * k + 0.1, *far[1]])
        for k in range(count)
    ]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", [611, 87, 9203])
def test_impulses_solve_the_lcp_with_affine_bounds(dimension, seed):
    """Impulses as the solution of the LCP with affine bounds.

    The package recomputes the residual from the matrix, and its NNCG finds the same impulses.
    """
    made = problem_of(dimension, seed)
    x, relative, _ = made.solve(EXACT)
    J = jacobian(made.first, made.second, made.one, made.other, made.bodies)
    B = scipy.sparse.csr_array(J @ J.T + scipy.sparse.diags_array(made.yields()[1]))
    system = ContactSystem("", B, made.b.ravel(), made.friction, dim=dimension)
    problem = BoxedModel().problem(system).dense().lcp(device="cpu")
    residual, field = NaturalResidual(problem), problem.layout.load(x.ravel(), wp.float64, "x")
    problem.bounds.refresh()
    norm, none = (residual.evaluate(values) for values in (field, problem.layout.zeros(wp.float64)))
    assert norm <= 2e-7 * none
    assert relative <= 1e-7
    reference = wl.solve(
        problem,
        wl.NNCG(precision="double"),
        stopping=wl.StoppingCriteria(rtol=1e-9, max_iterations=5000, patience=5000),
    )
    np.testing.assert_allclose(x.ravel(), reference.x.numpy(), atol=1e-5 * np.abs(x).max())


def test_the_order_of_contacts_does_not_matter():
    made, order = problem_of(3, 443), np.array([3, 0, 4, 2, 1])
    fields = (made.first, made.second, made.one, made.other, made.b, made.friction)
    turned = ContactProblem(*(field[order] for field in fields), made.bodies)
    np.testing.assert_allclose(turned.solve(EXACT)[0], made.solve(EXACT)[0][order], atol=1e-5)


def test_contacts_that_part_need_no_impulse():
    made = problem_of(2, 29)
    made.b[:, 0] = 1.0
    made.b[:, 1] = 0.0
    x, relative, _ = made.solve(EXACT, np.ones((5, 2)))
    assert not x.any()
    assert relative == 0.0


def test_too_few_iterations_are_reported():
    x, relative, _ = problem_of(3, 611).solve(StoppingCriteria(rtol=1e-12, max_iterations=2))
    assert relative > 1e-12
    assert (x[:, 0] >= 0.0).all()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_stack_on_the_floor_is_held_to_its_top(dimension):
    """Supported stack on the floor, up to its top.

    If the lowest one is supported, those on it are too; one that floats beside them is not.
    """
    beside = Sphere(center=[0.8, 0.5, 0.5][:dimension], radius=0.1)
    bodies = bodies_of([*stack(dimension), beside], dimension)
    run(bodies, 0.05)
    bodies.begin_step(bodies.time, 0.01, GRAVITY, 0.01)
    for body in bodies.bodies[:3]:
        assert (
            np.abs(body.inverse_mass(dimension)).max()
            < 1e-9 * np.abs(body.free_inverse_mass(dimension)).max()
        )
    assert bodies.bodies[3].hold is None


def test_a_body_on_a_smooth_one_is_held_upward_only():
    made = stack(2, 2)
    bodies = bodies_of(made, 2, settings=[{"friction": 0.0}, {"friction": 0.5}])
    bodies.begin_step(0.0, 0.01, GRAVITY, 0.01)
    upper = bodies.bodies[1]
    before = upper.velocities(2)
    upper.apply_impulse(np.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(
        upper.velocities(2) - before, [1.0 / upper.properties.mass, 0.0, 0.0], atol=1e-9
    )


def test_a_state_with_contacts_is_continued_bit_for_bit():
    through, later = (bodies_of(stack(3), 3) for _ in range(2))
    run(through, 0.05)
    later.restore(through.state())
    for bodies in (through, later):
        run(bodies, 0.05)
    for name, values in through.state().items():
        np.testing.assert_array_equal(values, later.state()[name], err_msg=name)
    assert np.count_nonzero(through.state()["body_contacts"][:, 0] >= 0) >= 12


def test_a_warm_start_uses_the_impulses_of_the_last_step():
    """Warm start from the impulses of the last step.

    The impulses from the floor bear the weight of the stack before any solve.
    """
    bodies = bodies_of(stack(2), 2)
    run(bodies, 0.2)
    touching = bodies._solve.find(bodies.time, 0.01, GRAVITY)
    start = bodies._solve.memory.initial_impulses(touching, bodies.bodies)
    weights = sum(body.properties.mass for body in bodies.bodies) * 9.81 * 0.01
    on_floor = touching.second == 3
    assert start[on_floor, 0].sum() == pytest.approx(weights, rel=1e-4)
