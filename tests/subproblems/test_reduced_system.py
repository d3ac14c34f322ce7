"""Reduced systems of Newton's method.

Choice by operator, a step by the protocol against NumPy, the change of system.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from method_steps import begun
from warp_lcp.subproblems.correction_system import CorrectionSystem
from warp_lcp.subproblems.fused_grid_system import FusedGridSystem
from warp_lcp.subproblems.host_system import HostSystem

SETTINGS = {"precision": "double", "eta": 1e-14}
PERIOD_THREE = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])
FORMS = {
    "dense": lambda A: wl.DenseOperator(A, device="cpu"),
    "sparse": lambda A: wl.SparseOperator(scipy.sparse.csr_array(A), device="cpu"),
    "products": lambda A: wl.LinearOperator(
        scipy.sparse.linalg.aslinearoperator(A), symmetric=True, device="cpu"
    ),
}


def matrix(rng, n=12, width=None):
    """Return an SPD matrix, banded if a width is given."""
    B = rng.standard_normal((n, n))
    A = B @ B.T / n + np.eye(n)
    return (
        A
        if width is None
        else np.where(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width, 0.1 * A, 0.0)
        + np.eye(n)
    )


@pytest.mark.default_cases(7)
@pytest.mark.parametrize("lengths", [(1.0,), (1.0, 0.5, 0.25)])
@pytest.mark.parametrize(
    ("form", "direct", "width"),
    [
        ("dense", True, None),
        ("sparse", True, None),
        ("sparse", True, 2),
        ("dense", False, None),
        ("sparse", False, None),
        ("sparse", False, 2),
        ("products", False, None),
    ],
)
def test_a_step_by_the_protocol(form, direct, width, lengths):
    """Step by the protocol.

    Active unknowns move onto their bounds, y = 0 on the others, and parts of the step from there.
    """
    rng = np.random.default_rng(7101)
    for _ in range(5):
        n = 12 if width is None else 40
        A, b, lower, upper = (
            matrix(rng, n, width),
            rng.standard_normal(n),
            -1.5 * rng.random(n),
            1.5 * rng.random(n),
        )
        x0 = np.clip(rng.standard_normal(n), lower, upper)
        problem = wl.LCP(FORMS[form](A), b, lower, upper)
        method = wl.MinimumMapNewton(direct=direct, **SETTINGS)
        work = begun(problem, method.init(problem), x0)
        system, d = work.system, work.residual.scale if direct else work.residual.diagonal.numpy()
        target = x0 - (A @ x0 + b) / d
        held, start = (
            (target < lower) | (target > upper),
            np.where(target < lower, lower, np.where(target > upper, upper, x0)),
        )
        free, e = np.flatnonzero(~held), np.zeros(n)
        e[free] = np.linalg.solve(A[np.ix_(free, free)], -(A @ start + b)[free])
        assert system.monotone_cycle() is None
        assert system.classify() is None
        assert system.restrict()
        assert system.solve() >= 1
        # Whole steps are not shortened or projected.
        for length in lengths[:1] if system.whole else lengths:
            norm = system.move(length)
            end = start + length * e
            np.testing.assert_allclose(
                work.x.numpy(), end if system.whole else np.clip(end, lower, upper), atol=1e-9
            )
            assert norm == work.residual.norm
        assert system.accept(3).active == np.count_nonzero(held)


def test_each_operator_has_its_reduced_system():
    grid, rows = (
        wl.GridPoisson(np.ones((6, 7), dtype=int), shift=1.0, device="cpu"),
        wl.DenseOperator(np.eye(5), device="cpu"),
    )
    wind = wl.Stencil(
        np.ones((9, 9), dtype=int),
        {(0, 0): 4.0, (0, 1): -0.5, (0, -1): -1.5, (1, 0): -1.0},
        outside=wl.AIR,
        device="cpu",
    )
    for A, settings, kind in (
        (grid, {}, FusedGridSystem),
        (grid, {"safeguard": False}, CorrectionSystem),
        (wind, {}, CorrectionSystem),
        (rows, {}, CorrectionSystem),
        (rows, {"direct": True}, HostSystem),
    ):
        problem, method = wl.LCP(A, np.ones(A.shape)), wl.MinimumMapNewton(**settings)
        work = method.init(problem)
        assert type(work.system) is kind
        assert work.x is work.system.iterate.x
    assert (
        type(wl.PrimalDualActiveSet().init(wl.LCP(grid, np.ones(grid.shape))).system)
        is CorrectionSystem
    )


def test_the_change_of_system_keeps_the_iterate():
    """Change of system with the same iterate.

    Whole steps cycle with period three: searched steps continue, and the next solve begins with
    whole ones again.
    """
    problem, method = (
        wl.LCP(wl.DenseOperator(PERIOD_THREE, device="cpu"), -np.ones(3)),
        wl.MinimumMapNewton(direct=True),
    )
    work = method.init(problem)
    for _ in range(2):
        result = wl.solve(
            problem,
            method,
            workspace=work,
            x0=np.array([1.0, 0.0, 0.0]),
            stopping=wl.StoppingCriteria(rtol=1e-10),
        )
        assert result
        assert type(work.system) is CorrectionSystem
        assert work.system.iterate is work.iterate
        assert {record.step for record in result.history[1:]} >= {"active set", "newton"}
        np.testing.assert_allclose(PERIOD_THREE @ result.x.numpy(), np.ones(3), atol=1e-8)
        work.start(warm=True, tolerance=1e-10)
        assert type(work.system) is HostSystem


def test_a_grid_moves_its_iterate_as_it_solves():
    """Iterate of a grid, moved during its linear solve.

    The linear solve ends at the requested accuracy; a part of its last iteration's step can be
    reverted.
    """
    rng = np.random.default_rng(7103)
    cells = np.ones((9, 11), dtype=int)
    A, b = wl.GridPoisson(cells, shift=0.5, device="cpu"), rng.standard_normal(cells.shape)
    problem = wl.LCP(A, b, -np.inf, np.inf)

    def solved(most):
        method = wl.MinimumMapNewton(precision="double", eta=1e-2, max_linear_iterations=most)
        work = begun(problem, method.init(problem), np.zeros(cells.shape))
        first = work.residual.norm
        assert work.system.classify() is None
        assert work.system.restrict()
        return work, first, work.system.solve()

    work, first, iterations = solved(100)
    assert iterations > 1
    assert work.residual.norm <= 1e-2 * first
    end = work.x.numpy().copy()
    assert work.system.move(1.0) == work.residual.norm
    np.testing.assert_array_equal(work.x.numpy(), end)
    before = solved(iterations - 1)[0].x.numpy()
    for length in (0.5, 0.25):
        work.system.move(length)
        np.testing.assert_allclose(work.x.numpy(), before + length * (end - before), atol=1e-12)
    assert np.abs(end - before).max() > 1e-6
