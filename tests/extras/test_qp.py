"""Quadratic programs by qpsolvers.

They are compared with another of its solvers, and with the conditions of Karush, Kuhn and Tucker.
"""

import numpy as np
import pytest
import scipy.sparse
from scipy.optimize import lsq_linear

from warp_lcp.extras import qp

qpsolvers = pytest.importorskip("qpsolvers")
USES = {
    "box": "",
    "inequalities": "G",
    "equations": "A",
    "both": "GA",
    "no box": "GA-",
    "nothing": "-",
    "rows that bound nothing": "Gh",
}


@pytest.fixture(autouse=True)
def registered():
    qp.register()


def program(use, rank, seed, sparse):
    n, m, k = 12, 8, 3
    rng = np.random.default_rng(seed)
    root, x = rng.standard_normal((n, rank)), rng.standard_normal(n)
    G, A = rng.standard_normal((m, n)), rng.standard_normal((k, n))
    h = G @ x + np.where(rng.random(m) < 0.5, 0.0, rng.random(m))
    lower, upper = x - rng.random(n), x + rng.random(n)
    lower[:2], upper[3] = -np.inf, np.inf
    if "h" in use:
        h[2] = np.inf
    matrix_type = scipy.sparse.csc_matrix if sparse else np.asarray
    # In P's range: a minimizer exists.
    q = root @ rng.standard_normal(rank) if "-" in use or rank < n else rng.standard_normal(n)
    rows = ((matrix_type(G), h) if "G" in use else (None, None)) + (
        (matrix_type(A), A @ x) if "A" in use else (None, None)
    )
    return qpsolvers.Problem(
        matrix_type(root @ root.T), q, *rows, *((None, None) if "-" in use else (lower, upper))
    )


def satisfied(problem, found, accuracy=1e-6):
    """Check the first-order conditions, written out."""
    P, q, G, h, A, b, lower, upper = problem.unpack_as_dense()
    x, gradient = found.x, P @ found.x + q
    if A is not None:
        np.testing.assert_allclose(A @ x, b, atol=accuracy)
        gradient = gradient + A.T @ found.y
    if G is not None:
        assert (G @ x <= h + accuracy).all()
        assert (found.z >= 0).all()
        tight = np.isfinite(h)
        np.testing.assert_allclose((found.z * np.where(tight, h - G @ x, 0.0)), 0.0, atol=accuracy)
        assert (found.z[~tight] == 0).all()
        gradient = gradient + G.T @ found.z
    if lower is not None:
        assert ((lower <= x) & (x <= upper)).all()
        assert (x[found.z_box < 0] <= lower[found.z_box < 0] + accuracy).all()
        assert (x[found.z_box > 0] >= upper[found.z_box > 0] - accuracy).all()
        gradient = gradient + found.z_box
    else:
        assert found.z_box is None
    np.testing.assert_allclose(gradient, 0.0, atol=accuracy)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("rank", [12, 5])
@pytest.mark.parametrize("use", USES)
def test_programs_against_their_conditions_and_another_solver(use, rank, sparse):
    problem = program(USES[use], rank, 71 + rank, sparse)
    found = qpsolvers.solve_problem(problem, "warp_lcp")
    assert found.found, found.extras["result"].message
    satisfied(problem, found)
    if "h" not in USES[use]:
        assert found.is_optimal(1e-6)
    if "piqp" in qpsolvers.available_solvers:
        other = qpsolvers.solve_problem(problem, "piqp", eps_abs=1e-10, eps_rel=1e-10)
        P, q = problem.P, problem.q
        assert found.obj == pytest.approx(0.5 * other.x @ (P @ other.x) + q @ other.x, abs=1e-6)


def test_least_squares_of_qpsolvers():
    rng = np.random.default_rng(13)
    R, s = rng.standard_normal((15, 6)), rng.standard_normal(15)
    x = qpsolvers.solve_ls(R, s, lb=np.full(6, -0.1), ub=np.full(6, 0.2), solver="warp_lcp")
    np.testing.assert_allclose(
        x, lsq_linear(R, s, (-0.1, 0.2), method="bvls", tol=1e-14).x, atol=1e-7
    )


def test_linear_programs():
    """Linear program: max x + 2 y, x + y <= 4, x + 3 y <= 6, x, y >= 0.

    The maximum is at (3, 1).
    """
    x = qpsolvers.solve_qp(
        np.zeros((2, 2)),
        np.array([-1.0, -2.0]),
        np.array([[1.0, 1.0], [1.0, 3.0]]),
        np.array([4.0, 6.0]),
        lb=np.zeros(2),
        solver="warp_lcp",
    )
    np.testing.assert_allclose(x, [3.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("why", ["infeasible", "unbounded"])
def test_programs_without_a_solution_are_not_found(why, capsys):
    programs = {
        "infeasible": qpsolvers.Problem(
            np.eye(2), np.ones(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-1.0, -1.0])
        ),
        "unbounded": qpsolvers.Problem(np.diag([1.0, 0.0]), -np.ones(2), lb=np.zeros(2)),
    }
    found = qpsolvers.solve_problem(programs[why], "warp_lcp", verbose=True)
    assert found.found is False
    assert found.x is None
    assert found.z is None
    assert capsys.readouterr().out.startswith("warp_lcp: ")
    P, q, *rest = programs[why].unpack()
    assert qpsolvers.solve_qp(P, q, *rest, solver="warp_lcp") is None


def test_limits_and_methods():
    problem = program("", 12, 5, False)
    short = qp.solve_problem(problem, method="psor", maxiter=1)
    assert short.found is False
    assert short.extras["result"].status == 1
    found = qp.solve_problem(problem, initvals=np.zeros(12), method="lemke")
    satisfied(problem, found)
    x0 = qp.solve_problem(program("G", 12, 5, False), initvals=found.x, method="fischer-newton")
    assert x0.found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"P": -np.eye(2)}, "P is not positive semi-definite: the program is not convex"),
        ({"P": np.eye(3)}, r"P has shape \(3, 3\): expected \(2, 2\), after q"),
        ({"P": np.eye(2) * 1j}, "P is a ndarray of type complex128"),
        ({"P": np.eye(2) * np.nan}, "P holds a value that is not finite"),
        ({"q": np.array([1.0, np.nan])}, "q holds 1 values that are not finite"),
        ({"lb": np.zeros(3)}, r"lb has shape \(3,\) and 0 NaN"),
        ({"ub": np.array([np.nan, 1.0])}, r"ub has shape \(2,\) and 1 NaN"),
        ({"lb": np.full(2, 2.0)}, "lb > ub in 2 unknowns, 0 the first"),
        ({"lb": np.array([0.0, 1e20])}, r"lb\[1\] is inf \(1e20 and more are infinite\)"),
        ({"ub": np.array([-1e30, 1.0])}, r"ub\[0\] is -inf"),
        ({"A": np.eye(2), "b": np.array([0.0, np.inf])}, "b holds 1 values that are not finite"),
        ({"G": np.eye(2), "h": np.array([0.0, np.nan])}, r"h has shape \(2,\) and 1 NaN"),
        ({"G": np.eye(3), "h": np.ones(3)}, r"G has shape \(3, 3\): expected 2 columns"),
        ({"A": np.eye(2), "b": np.ones(1)}, r"b has shape \(1,\)"),
        ({"A": np.eye(2)}, "A and b: one is missing"),
    ],
)
def test_invalid_programs_are_refused(change, message):
    problem = qpsolvers.Problem(**{"P": np.eye(2), "q": np.ones(2), "ub": np.ones(2)} | change)
    with pytest.raises(ValueError, match=message):
        qp.solve_problem(problem)


def test_names_are_there_once():
    qp.register()
    for names in (qpsolvers.available_solvers, qpsolvers.dense_solvers, qpsolvers.sparse_solvers):
        assert names.count("warp_lcp") == 1
