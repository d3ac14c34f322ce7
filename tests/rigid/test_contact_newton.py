"""Contacts that sweeps leave unsolved.

Alternating stacks of heavy and light bodies stand, and Newton's methods agree with sweeps.
"""

import numpy as np
import pytest
from bodies_at_hand import GRAVITY, run
from test_contact_problem import EXACT, problem_of

from default_run import slow
from warp_lcp.grid.signed_distance import Box
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import RigidBody
from warp_lcp.rigid.contact_newton import ContactNewton
from warp_lcp.rigid.contact_problem import ContactProblem
from warp_lcp.rigid.mass_properties import mass_properties
from warp_lcp.rigid.obstacles import domain_walls

SIDE = 0.1


def stack(count, ratio, dimension, heavy_on_top=True):
    """Return a stack of cubes of two densities in turn."""
    far = [[0.4], [0.4 + SIDE]] if dimension == 3 else [[], []]
    shapes = [
        Box(lower=[0.4, SIDE * k, *far[0]], upper=[0.4 + SIDE, SIDE * (k + 1), *far[1]])
        for k in range(count)
    ]
    densities = [100.0 * ratio if (k % 2 == 1) == heavy_on_top else 100.0 for k in range(count)]
    bodies = [
        RigidBody(
            mass_properties(shape, dimension, density=density), name=f"body {k}", friction=0.5
        )
        for k, (shape, density) in enumerate(zip(shapes, densities, strict=True))
    ]
    walls = domain_walls([1.0, 10.0, 1.0][:dimension])
    return RigidBodies(bodies, shapes, list(range(1, 1 + count)), (walls,), dimension)


def creep(bodies, steps, lengths):
    """Return the largest displacement, in sides of a cube, and the largest residual."""
    before, worst = np.array([body.position for body in bodies.bodies]), 0.0
    for _, dt in zip(range(steps), lengths, strict=False):
        bodies.begin_step(bodies.time, dt, GRAVITY, dt)
        worst = max(worst, bodies.contact_residual)
        bodies.end_step(dt)
        worst = max(worst, bodies.contact_residual)
    return np.abs(np.array([body.position for body in bodies.bodies]) - before).max() / SIDE, worst


@pytest.mark.parametrize(
    ("dimension", "count", "ratio", "heavy_on_top"),
    [
        (2, 20, 1e3, True),
        slow((3, 20, 1e2, False)),
        (3, 8, 1e6, True),
        slow((2, 20, 1e3, False)),
        slow((3, 20, 1e2, True)),
        slow((3, 8, 1e6, False)),
        slow((2, 40, 1e1, False)),
        slow((2, 40, 1e1, True)),
    ],
)
def test_a_stack_of_heavy_and_light_boxes_stands(dimension, count, ratio, heavy_on_top):
    """Stack of heavy and light boxes at rest.

    Steps differ in length, so that the last step's impulses are never those of the next.
    """
    lengths = np.random.default_rng(2718).uniform(0.003, 0.01, 40)
    moved, residual = creep(stack(count, ratio, dimension, heavy_on_top), 40, lengths)
    assert moved < 1e-5
    assert residual < 1.1e-5


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ratio", [1.0, 1e2, 1e3, 1e4, 1e6])
def test_fifty_boxes_stand_for_a_second(dimension, ratio):
    moved, residual = creep(stack(50, ratio, dimension), 100, np.full(100, 0.01))
    assert moved < 1e-3
    assert residual < 1.1e-5


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("method", ["active_set", "interior_point"])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", [611, 87, 9203])
def test_newton_finds_the_impulses_of_sweeps(method, dimension, seed):
    made = problem_of(dimension, seed)
    many = made.part(np.array([0, 1, 3, 4]))  # three bodies in contact
    swept, residual, _ = many.solve(StoppingCriteria(rtol=1e-10, max_iterations=20_000))
    assert residual <= 1e-9
    newton = ContactNewton(many, swept * np.random.default_rng(seed).uniform(0.9, 1.1, swept.shape))
    assert newton.residual > 1e-3
    getattr(newton, method)(1e-9)
    assert newton.residual <= 1e-9
    np.testing.assert_allclose(newton.x, swept.ravel(), atol=1e-6 * np.abs(swept).max())


def test_islands_that_sweeps_solve_stay_as_they_are():
    """Islands that sweeps solve stay unchanged.

    The residual of the other groups is that of Newton's method.
    """
    problem = problem_of(3, 611)
    rough = StoppingCriteria(rtol=1e-9, max_iterations=16)
    swept, before, _ = problem.solve(rough)
    better, after, _ = problem.solve(rough, None, 1e-7)
    assert before > 1e-7
    assert after <= 1e-9
    alone = np.flatnonzero(problem.first == 3)
    np.testing.assert_array_equal(better[alone], swept[alone])


@pytest.mark.slow
def test_a_toppling_column_is_solved():
    """Toppling column, solved.

    Bodies that hit each other in a column that falls: interior points stall, and active sets start
    too far away.
    """
    bodies = stack(10, 1e2, 3)
    worst = 0.0
    for _ in range(80):
        run(bodies, 0.01, gravity=GRAVITY + np.array([4.0, 0.0, 4.0 / 3.0]))
        worst = max(worst, bodies.contact_residual)
    assert bodies.bodies[-1].position[1] < 9.0 * SIDE  # it has fallen
    assert worst < 1.1e-5


def test_a_part_has_its_own_bodies():
    problem = problem_of(2, 29)
    part = problem.part(np.array([3, 1]))
    assert part.first.tolist() == [2, 1]
    assert part.second.tolist() == [1, 0]
    assert part.bodies == 3
    np.testing.assert_array_equal(part.b, problem.b[[3, 1]])
    whole, _, _ = ContactProblem(
        problem.first[[2]],
        problem.second[[2]],
        problem.one[[2]],
        problem.other[[2]],
        problem.b[[2]],
        problem.friction[[2]],
        4,
    ).solve(EXACT)
    np.testing.assert_allclose(problem.part(np.array([2])).solve(EXACT)[0], whole, rtol=1e-12)
