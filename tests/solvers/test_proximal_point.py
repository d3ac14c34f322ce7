"""Problems with singular free blocks.

They are solved by the proximal-point method, and by the fallbacks of active-set methods.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from matrices import posed
from oracle import lemke, natural_residual
from warp_lcp.gallery import semidefinite

METHODS = [wl.MinimumMapNewton(), wl.PrimalDualActiveSet()]
NAMES = ["newton", "active-set"]
ALL, ALL_NAMES = [*METHODS, wl.ProximalPoint()], [*NAMES, "proximal-point"]
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


def solved(p, method, **more):
    """Solve by a method and its fallbacks."""
    return wl.solve(p, wl.default_chain(method, p), **more)


def program(rng, m, n):
    """Return the optimality conditions of min c'x, G x >= h, x >= 0.

    They have a solution and are skew, so that every diagonal entry is 0.
    """
    G, x, z = (
        rng.standard_normal((m, n)),
        rng.random(n) * (rng.random(n) < 0.5),
        rng.random(m) * (rng.random(m) < 0.5),
    )
    h = G @ x - np.where(z > 0, 0.0, rng.random(m))
    c = G.T @ z + np.where(x > 0, 0.0, rng.random(n))
    A = np.block([[np.zeros((n, n)), -G.T], [G, np.zeros((m, m))]])
    return A, np.r_[c, -h]


@pytest.mark.parametrize("method", ALL, ids=ALL_NAMES)
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_a_quarter_turn(kind, method):
    """Quarter turn, y = (x_2 - 1, 1 - x_1).

    Free blocks of one unknown are 0, and active-set methods alone stay at x = 0.
    """
    result = solved(
        posed(TURN, np.array([-1.0, 1.0]), kind), method, stopping=wl.StoppingCriteria(rtol=1e-9)
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), [1.0, 1.0], atol=1e-8)
    assert result.iterations <= 30


@pytest.mark.parametrize("method", ALL, ids=ALL_NAMES)
@pytest.mark.parametrize("kind", ["dense", "sparse"])
@pytest.mark.parametrize("b", [(-1.0, -1.0), (1.0, -1.0)])
def test_no_solution_is_proved(b, kind, method):
    """y_2 = -x_1 - 1 < 0 whatever x >= 0 is."""
    assert solved(posed(TURN, np.array(b), kind), method).status is wl.SolveStatus.INFEASIBLE


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("method", METHODS, ids=NAMES)
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_linear_programs(kind, method):
    rng = np.random.default_rng(97)
    for _ in range(6):
        A, b = program(rng, 6, 9)
        result = solved(posed(A, b, kind), method)
        assert result, result.status
        x, c, h = result.x.numpy(), b[:9], -b[9:]
        assert x.min() >= -1e-6
        # Strong duality, which no other pair of feasible points has.
        assert c @ x[:9] == pytest.approx(h @ x[9:], abs=1e-5)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("method", METHODS, ids=NAMES)
@pytest.mark.parametrize("zeros", [0.5, 0.8])
def test_semidefinite_matrices_are_solved(zeros, method):
    """Semi-definite matrices.

    With 80 % zero eigenvalues only 1 of 20 was solved before, by either method.
    """
    for seed in range(10):
        p = semidefinite(100, zeros=zeros, seed=seed)
        result = solved(posed(p.A, p.b, "dense"), method)
        assert result, (seed, result.status)
        assert result.residual == pytest.approx(
            natural_residual(p.A, p.b, p.lower, p.upper, result.x.numpy()), rel=1e-6, abs=1e-14
        )
        # y is unique.
        np.testing.assert_allclose(p.A @ (result.x.numpy() - p.solution), 0.0, atol=1e-4)


def test_regular_problems_take_no_proximal_step():
    rng = np.random.default_rng(101)
    B = rng.standard_normal((30, 30))
    A, b = B @ B.T / 30 + 0.1 * np.eye(30), rng.standard_normal(30)
    for method in METHODS:
        result = solved(posed(A, b, "dense"), method, stopping=wl.StoppingCriteria(rtol=1e-10))
        assert "proximal point" not in {r.step for r in result.history}
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-8)


def test_the_rounding_floor_is_no_reason_for_it():
    rng = np.random.default_rng(103)
    B = rng.standard_normal((30, 30))
    p = posed(B @ B.T / 30 + 0.1 * np.eye(30), rng.standard_normal(30), "dense")
    result = solved(p, wl.MinimumMapNewton(), stopping=wl.StoppingCriteria(rtol=1e-30))
    assert result.status is wl.SolveStatus.FLOOR
    assert "proximal point" not in {r.step for r in result.history}


def test_operators_that_cannot_be_assembled_are_refused():
    grid = wl.LCP(wl.GridPoisson(np.array([[1, 1, 0]]), device="cpu"), np.array([[1.0, -1.0, 0.0]]))
    products = wl.LCP(wl.LinearOperator(lambda x: TURN @ x, shape=(2,)), np.ones(2))
    for p in (grid, products):
        with pytest.raises(ValueError, match="ProximalPoint needs"):
            wl.solve(p, wl.ProximalPoint())


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_the_method_alone_against_lemke(kind):
    """Proximal-point method alone, against Lemke.

    Semi-definite matrices of half the rank: y is unique, and x is where y = 0.
    """
    for seed in range(3):
        p = semidefinite(40, zeros=0.5, seed=seed)
        result = wl.solve(
            posed(p.A, p.b, kind),
            wl.ProximalPoint(),
            stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=400),
        )
        assert result, result.status
        assert {record.step for record in result.history[1:]} == {"proximal point"}
        assert natural_residual(
            p.A, p.b, p.lower, p.upper, result.x.numpy()
        ) <= 1e-7 * np.linalg.norm(p.b)
        np.testing.assert_allclose(p.A @ (result.x.numpy() - p.solution), 0.0, atol=1e-5)


def test_a_workspace_begins_anew():
    """Reset of a workspace.

    After a solve that ended in the proximal-point iteration the next one, with another b, does
    without it.
    """
    b = wp.array([-1.0, 1.0], dtype=wp.float64, device="cpu")
    p = wl.LCP(wl.DenseOperator(TURN + 0.5 * np.diag([0.0, 1.0]), device="cpu"), b)
    for first in METHODS:
        method = wl.default_chain(first, p)
        work = method.init(p)
        b.assign([-1.0, 1.0])
        assert wl.solve(p, method, workspace=work), method
        b.assign([1.0, -1.0])
        result = wl.solve(p, method, workspace=work)
        y = p.A.matrix.numpy() @ result.x.numpy() + [1.0, -1.0]
        assert result, result.status
        assert "proximal point" not in {r.step for r in result.history}
        np.testing.assert_allclose(np.minimum(result.x.numpy(), y), 0.0, atol=1e-6)


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_the_solution_nearest_to_the_start_is_found(kind):
    """Solution nearest to the start.

    A = [[1, -1], [-1, 1]] fixes x_1 - x_2 = 1 alone; D (x - c) lies in A's range, so that x_1 + x_2
    stays 8.
    """
    p = posed(np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([-1.0, 1.0]), kind)
    result = wl.solve(
        p, wl.ProximalPoint(), x0=np.array([5.0, 3.0]), stopping=wl.StoppingCriteria(rtol=1e-9)
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), [4.5, 3.5], atol=1e-4)
