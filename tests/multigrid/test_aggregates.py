"""Projected cycles on aggregates.

Solutions are their fixed points, bounds hold, and Newton's method starts near its end.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import lemke, natural_residual
from warp_lcp.multigrid.aggregates import MonotoneAggregation


def convection_diffusion(n, wind):
    """Return upwind differences on n x n cells of the unit square, times h^2."""
    h, one = 1 / (n + 1), scipy.sparse.eye_array(n)
    second = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    first = h * scipy.sparse.diags_array([-1.0, 1.0], offsets=[-1, 0], shape=(n, n))
    along, across = second + wind * first, second + 0.5 * wind * first
    return (scipy.sparse.kron(one, along) + scipy.sparse.kron(across, one)).tocsr()


def load(n, shift=2.0):
    x = np.arange(1, n + 1) / (n + 1)
    return (
        (shift - 10 * np.outer(np.sin(2 * np.pi * x), np.sin(3 * np.pi * x))) / (n + 1) ** 2
    ).ravel()


def fields(device, *values):
    return [wp.array(v, dtype=wp.float64, device=device) for v in values]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("wind", [0.0, 30.0])
@pytest.mark.parametrize("dtype", [wp.float64, wp.float32])
def test_cycles_alone_solve_and_stay_there(wind, dtype, device):
    """Convergence of cycles alone, and solutions as fixed points.

    More cycles than a CPU graph is recorded after. A coarse bound of the wrong sign or child would
    overstep, or never release an unknown.
    """
    n = 15
    A, b = convection_diffusion(n, wind), load(n)
    cycles = MonotoneAggregation(wl.SparseOperator(A, device=device, dtype=dtype))
    assert cycles.refresh()
    expected = lemke(A.toarray(), b)
    assert 30 < np.count_nonzero(expected) < n * n - 30
    x, right, lower, upper = fields(
        device, np.zeros(n * n), b, np.zeros(n * n), np.full(n * n, np.inf)
    )
    for _ in range(120):
        cycles.cycle(x, right, lower, upper)
        assert x.numpy().min() >= 0
    error = 1e-9 if dtype is wp.float64 else 1e-5
    np.testing.assert_allclose(x.numpy(), expected, atol=error * expected.max())


def test_boxes_and_the_energy(device):
    n = 20
    A, b, rng = convection_diffusion(n, 0.0), load(n), np.random.default_rng(127)
    low, high = -0.02 * rng.random(n * n), 0.02 * rng.random(n * n)
    cycles = MonotoneAggregation(wl.SparseOperator(A, device=device))
    assert cycles.refresh()
    x, right, lower, upper = fields(
        device, np.clip(0.05 * rng.standard_normal(n * n), low, high), b, low, high
    )
    energies = []
    for _ in range(25):
        host = x.numpy()
        energies.append(0.5 * host @ (A @ host) + b @ host)
        cycles.cycle(x, right, lower, upper)
        assert ((x.numpy() >= low) & (x.numpy() <= high)).all()
    assert (np.diff(energies) <= 1e-12 * abs(energies[-1])).all()
    assert natural_residual(A.toarray(), b, low, high, x.numpy()) <= 1e-3 * natural_residual(
        A.toarray(), b, low, high, np.clip(0, low, high)
    )


def test_an_unknown_in_no_aggregate_is_not_moved_with_one(device):
    """Unknown in no aggregate: not moved with one.

    It is stiff and almost decoupled; the correction of another would come out of its neighbor's
    energy.
    """
    # Almost 1e-3 of sqrt(a_ii a_jj), from which on unknowns aggregate.
    n, stiff, coupling = 20, 1e12, 1999.0
    A = scipy.sparse.block_array(
        [[scipy.sparse.eye_array(1) * stiff, None], [None, convection_diffusion(n, 0.0)]]
    ).tolil()
    A[0, 1] = A[1, 0] = -coupling
    A, b = A.tocsr(), np.concatenate([[0.0], load(n)])
    cycles = MonotoneAggregation(wl.SparseOperator(A, device=device))
    assert cycles.refresh()
    x, right, lower, upper = fields(
        device, np.zeros(n * n + 1), b, np.full(n * n + 1, -1.0), np.full(n * n + 1, 1.0)
    )
    energies = []
    for _ in range(12):
        host = x.numpy()
        energies.append(0.5 * host @ (A @ host) + b @ host)
        cycles.cycle(x, right, lower, upper)
    assert (np.diff(energies) <= 1e-12 * abs(energies[-1])).all()


def test_a_matrix_may_change_and_so_may_the_fields():
    n = 11
    A, b = convection_diffusion(n, 30.0), load(n)
    operator = wl.SparseOperator(A, device="cpu")
    cycles = MonotoneAggregation(operator)
    for factor, sign in ((1.0, 1.0), (3.0, 1.0), (3.0, -1.0)):
        operator.update(factor * A)
        assert cycles.refresh()
        x, right, lower, upper = fields(
            "cpu", np.zeros(n * n), sign * b, np.zeros(n * n), np.full(n * n, np.inf)
        )
        for _ in range(60):
            cycles.cycle(x, right, lower, upper)
        expected = lemke(factor * A.toarray(), sign * b)
        np.testing.assert_allclose(x.numpy(), expected, atol=1e-5 * expected.max())


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("method", [wl.MinimumMapNewton, wl.PrimalDualActiveSet])
@pytest.mark.parametrize("wind", [0.0, 40.0, 1000.0])
def test_newton_does_not_change_one_layer_per_step(wind, method, device):
    """Number of Newton steps from a cold start.

    Without cycles the boundary of the active set moved by a row per step: 14 to 32 steps at 65^2,
    22 to 57 at 129^2 and twice as many at 257^2.
    """
    counts = []
    for n in (65, 129):
        problem = wl.LCP(wl.SparseOperator(convection_diffusion(n, wind), device=device), load(n))
        result = wl.solve(problem, method())
        assert result, result.status
        assert [r.step for r in result.history][1:5] == ["monotone cycle"] * 4
        counts.append(result.iterations)
    assert counts[0] <= 10
    assert counts[1] <= 12
    plain = method(monotone_cycles=0)
    work = plain.init(problem)
    work.system.coarse = None
    cold = wl.solve(
        problem, plain, stopping=wl.StoppingCriteria(max_iterations=200), workspace=work
    )
    assert cold, cold.status
    assert cold.iterations >= 20
    np.testing.assert_allclose(result.x.numpy(), cold.x.numpy(), atol=1e-4 * cold.x.numpy().max())


def test_warm_starts_and_other_matrices_take_none(device):
    n = 40
    A, b = convection_diffusion(n, 40.0), load(n)
    problem = wl.LCP(wl.SparseOperator(A, device=device), b)
    first = wl.solve(problem, wl.MinimumMapNewton())
    again = wl.solve(problem, wl.MinimumMapNewton(), x0=first.x.numpy())
    assert "monotone cycle" not in {r.step for r in again.history}
    # Positive off the diagonal: aggregates would average alternating values.
    plus = scipy.sparse.csr_array(abs(A))
    assert not MonotoneAggregation(wl.SparseOperator(plus, device=device)).refresh()
    result = wl.solve(
        wl.LCP(wl.SparseOperator(plus + 4 * scipy.sparse.eye_array(n * n), device=device), b),
        wl.MinimumMapNewton(),
    )
    assert result, result.status
    assert "monotone cycle" not in {r.step for r in result.history}
