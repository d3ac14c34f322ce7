"""MPRGP on grids, dense and sparse matrices: oracles, refusals, steps."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from matrices import spd
from oracle import boxed, lemke, natural_residual
from warp_lcp.gallery import (
    PlantedSolution,
    ball_obstacle,
    banded,
    definite,
    poisson,
    semidefinite,
    skewed,
    splash,
)
from warp_lcp.solvers.mprgp import MPRGP

TIGHT = wl.StoppingCriteria(rtol=1e-9, max_iterations=2000, patience=200)


def test_a_solve_ends_where_rounding_hides_the_fall_of_the_energy():
    """Status of a solve to a residual of 0, which rounding does not allow: at the floor.

    A step may raise the residual while the energy falls. At the floor the energy's changes are
    rounding, so that steps do not count as successful and the solve is not continued for ever.
    """
    matrix = scipy.sparse.csr_array(spd(60, seed=3, shift=0.01))
    problem = wl.LCP(matrix, np.random.default_rng(5).standard_normal(60), 0.0)
    result = wl.solve(problem, MPRGP(), stopping=wl.StoppingCriteria(rtol=0.0, max_iterations=3000))
    assert result.status is wl.SolveStatus.FLOOR
    assert result.iterations < 300


@pytest.mark.parametrize(
    ("plant", "shape", "precision"),
    covering(
        [
            PlantedSolution(),
            PlantedSolution(weak=0.5, active=0.6),
            PlantedSolution(boxed=True, mixed=0.2, active=0.5),
            PlantedSolution(active=1.0),
        ],
        [(17, 13), (7, 6, 8)],
        ["mixed", "double"],
    ),
)
def test_grids_reach_the_planted_solution(shape, plant, precision, device):
    for air, coefficients in ((0.0, "uniform"), (0.15, "random")):
        p = poisson(
            shape,
            plant=plant,
            air=air,
            solid=air,
            coefficients=coefficients,
            dtype=wp.float64,
            device=device,
        )
        result = wl.solve(p.lcp(), MPRGP(precision=precision), stopping=TIGHT)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), p.solution, atol=1e-6)
        dense = p.dense()
        x = result.x.numpy()[p.A.cells.numpy()[1:-1, 1:-1, 1:-1].reshape(p.b.shape) == wl.FLUID]
        own = natural_residual(dense.A, dense.b, dense.lower, dense.upper, x)
        assert own == pytest.approx(result.residual, rel=1e-4, abs=1e-13)


@pytest.mark.parametrize(
    "problem",
    [
        definite(40, seed=3),
        semidefinite(40, zeros=0.6, seed=4),
        banded(60, seed=5),
        banded(300, seed=6),
    ],
)
def test_matrices_against_lemke(problem, device):
    result = wl.solve(problem.lcp(device=device), MPRGP(), stopping=TIGHT)
    assert result, result.status
    d = problem.dense()
    assert natural_residual(d.A, d.b, d.lower, d.upper, result.x.numpy()) <= 1e-8 * np.linalg.norm(
        d.b
    )
    if "unique" in problem.facts:
        np.testing.assert_allclose(result.x.numpy(), lemke(d.A, d.b), atol=1e-5)


def test_boxes_against_exhaustive_search():
    for seed in range(20):
        p = definite(6, plant=PlantedSolution(boxed=True, mixed=0.3, active=0.5), seed=seed)
        b = np.random.default_rng(seed).standard_normal(6)
        result = wl.solve(
            wl.LCP(wl.DenseOperator(p.A, device="cpu"), b, p.lower, p.upper),
            MPRGP(),
            stopping=TIGHT,
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), boxed(p.A, b, p.lower, p.upper), atol=1e-6)


def test_sparse_multigrid_is_used_and_grid_independent():
    counts = []
    for n in (20, 80):
        p = poisson((n, n), seed=7, dtype=wp.float64, device="cpu").sparse()
        assert scipy.sparse.issparse(p.A)
        result = wl.solve(p.lcp(device="cpu"), MPRGP())
        assert result, result.status
        counts.append(result.iterations)
    assert counts[1] <= counts[0] + 12


def test_energy_falls_from_step_to_step_off_grids():
    p = definite(50, condition=1e3, plant=PlantedSolution(active=0.5), seed=8)
    problem, method = p.lcp(device="cpu"), MPRGP()
    work = method.init(problem)
    energies = []
    wl.solve(
        problem,
        method,
        workspace=work,
        callback=lambda record: energies.append(work.residual.energy),
    )
    x = work.x.numpy()
    assert energies[-1] == pytest.approx(0.5 * x @ p.A @ x + p.b @ x, rel=1e-9)
    assert (np.diff(energies) <= 1e-11 * np.abs(energies[0] - energies[-1])).all()


def test_without_bounds_it_is_conjugate_gradients():
    rng = np.random.default_rng(9)
    A = definite(12, condition=50, seed=10).A
    b = rng.standard_normal(12)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower=-np.inf), MPRGP(), stopping=TIGHT
    )
    assert result, result.status
    assert result.iterations <= 14  # conjugate gradients end after n steps, up to rounding
    np.testing.assert_allclose(result.x.numpy(), np.linalg.solve(A, -b), atol=1e-7)


@pytest.mark.parametrize("bounds", ["walls", "everywhere"])
def test_budget_on_the_splash(bounds):
    small, large = (
        wl.solve(splash(n).named(bounds, device="cpu").lcp(), MPRGP()) for n in (32, 64)
    )
    assert small
    assert large
    assert large.linear_iterations <= 14
    assert large.iterations <= small.iterations + 2


def test_closed_domain_with_a_null_space():
    rng = np.random.default_rng(11)
    cells = np.ones((8, 9), dtype=int)
    b = rng.standard_normal(cells.shape)
    b -= b.mean()
    result = wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower=-np.inf), MPRGP())
    assert result, result.status
    b[3, 3] += 1.0  # now the sum is not 0
    assert (
        wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower=-np.inf), MPRGP()).status
        is wl.SolveStatus.INFEASIBLE
    )
    # Bounds make it solvable: sum of b > 0.
    held = wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b), MPRGP(), stopping=TIGHT)
    assert held, held.status


def test_periodic_axes():
    rng = np.random.default_rng(12)
    cells = np.ones((6, 8), dtype=int)
    cells[0, 0] = wl.AIR
    A = wl.GridPoisson(cells, periodic=(True, True, False), device="cpu")
    b = np.where(cells == wl.FLUID, rng.standard_normal(cells.shape), 0)
    found, other = (
        wl.solve(wl.LCP(A, b), m, stopping=TIGHT) for m in (MPRGP(), wl.MinimumMapNewton())
    )
    assert found, found.status
    np.testing.assert_allclose(found.x.numpy(), other.x.numpy(), atol=1e-6)


def test_best_iterate_comes_back_and_a_workspace_serves_again():
    p = ball_obstacle(33, device="cpu")
    problem, method = p.lcp(), MPRGP()
    work = method.init(problem)
    limited = wl.solve(
        problem, method, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-12, max_iterations=4)
    )
    assert limited.status is wl.SolveStatus.MAX_ITERATIONS
    assert limited.residual == min(r.residual for r in limited.history)
    first = wl.solve(problem, method, workspace=work)
    again = wl.solve(problem, method, workspace=work)
    np.testing.assert_array_equal(first.x.numpy(), again.x.numpy())
    warm = wl.solve(
        problem, method, workspace=work, x0=first.x, stopping=wl.StoppingCriteria(rtol=1e-8)
    )
    assert warm
    assert warm.iterations <= 5


def test_single_precision_says_floor_and_mixed_goes_on():
    p = ball_obstacle(65, device="cpu")
    tight = wl.StoppingCriteria(rtol=1e-9)
    assert wl.solve(p.lcp(), MPRGP(precision="single"), stopping=tight).status in (
        wl.SolveStatus.FLOOR,
        wl.SolveStatus.STAGNATED,
    )
    assert wl.solve(p.lcp(), MPRGP(precision="single"), stopping=wl.StoppingCriteria(rtol=1e-3))
    assert wl.solve(p.lcp(), MPRGP(), stopping=tight)


def test_unsupported_problems_are_refused():
    with pytest.raises(ValueError, match="not symmetric"):
        MPRGP().init(skewed(5).lcp(device="cpu"))
    with pytest.raises(ValueError, match="negative diagonal"):
        MPRGP().init(wl.LCP(wl.DenseOperator(np.diag([1.0, -1.0]), device="cpu"), np.ones(2)))
    with pytest.raises(ValueError, match="gamma"):
        MPRGP(gamma=0.0)
    with pytest.raises(ValueError, match="patience"):
        MPRGP(patience=0)
    indefinite = np.array([[1.0, -3.0], [-3.0, 1.0]])  # the energy is unbounded below along (1, 1)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(indefinite, device="cpu"), np.array([-1.0, -1.0])), MPRGP()
    )
    assert result.status is wl.SolveStatus.DIVERGED
