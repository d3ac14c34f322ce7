"""Merit functions of the book in a history: formulas on matrices and grids.

They are absent by default.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import spd
from oracle import assemble

ASKED = wl.StoppingCriteria(rtol=1e-10, max_iterations=200, merits=True)


@pytest.mark.parametrize(
    "method",
    [
        wl.ProjectedSOR(omega=1.0),
        wl.FischerNewton(),
        wl.InteriorPoint(),
        wl.MinimumMapNewton(direct=True),
    ],
)
def test_each_record_has_the_merits_of_its_iterate(method, device):
    A, b = spd(12, 5101, 0.5), np.random.default_rng(5103).standard_normal(12)
    problem = wl.LCP(wl.DenseOperator(A, device=device), b)
    work, iterates = method.init(problem), []
    result = wl.solve(
        problem,
        method,
        stopping=ASKED,
        workspace=work,
        callback=lambda record: iterates.append(work.x.numpy().copy()),
    )
    assert result
    assert len(iterates) == len(result.history) > 2
    for record, x in zip(result.history, iterates, strict=True):
        y = A @ x + b
        assert record.merits.largest == pytest.approx(np.abs(x).max())  # [Book] eq. 2.55
        # [Book] eq. 2.56.
        assert record.merits.complementarity == pytest.approx(abs(x @ y), abs=1e-13)
        assert record.merits.absolute == pytest.approx(x @ np.abs(y), abs=1e-13)  # [Book] eq. 2.200
    assert result.history[0].merits.absolute == 0  # at x = 0, which is no solution
    assert result.history[-1].merits.absolute < 1e-8


def test_sweeps_converge_linearly_in_the_modified_merit():
    """[Book] fig. C.2 draws eq. 2.200 for PGS: a straight line on a logarithmic scale."""
    A, b = spd(40, 5107, 0.5), np.random.default_rng(5109).standard_normal(40)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device="cpu"), b), wl.ProjectedSOR(omega=1.0), stopping=ASKED
    )
    merits = np.array([record.merits.absolute for record in result.history[5:]])
    rates = merits[1:] / merits[:-1]
    assert rates.max() < 1
    assert np.ptp(rates[len(rates) // 2 :]) < 0.1


def test_in_a_box_distances_are_those_to_the_bound_that_y_asks_for():
    """Distances in a box: those to the bound that the sign of y implies.

    y = x + b. x is half above l where y > 0, half below u where y < 0, under u alone, and without a
    bound.
    """
    problem = wl.LCP(
        wl.DenseOperator(np.eye(4), device="cpu"),
        np.array([2.0, -5.0, 1.0, 5.0]),
        np.array([-2.25, 1.0, -np.inf, -np.inf]),
        np.array([2.0, 2.0, 4.0, np.inf]),
    )
    x = np.array([-1.75, 1.5, 0.0, 0.0])
    result = wl.solve(
        problem,
        wl.ProjectedSOR(),
        x0=x,
        stopping=wl.StoppingCriteria(max_iterations=0, merits=True),
    )
    y, distance, sign = (
        x + np.array([2.0, -5.0, 1.0, 5.0]),
        np.array([0.5, 0.5, 4.0, 0.0]),
        np.array([1.0, -1.0, -1.0, 1.0]),
    )
    merits = result.history[0].merits
    assert merits.largest == 1.75
    assert merits.complementarity == pytest.approx(abs(distance @ (sign * y)))
    assert merits.absolute == pytest.approx(distance @ np.abs(y))


def test_on_a_grid_cells_that_are_no_unknowns_do_not_count(device):
    cells = np.random.default_rng(5113).choice(3, (5, 6, 4), p=[0.2, 0.6, 0.2])
    fluid, A = cells.ravel() == wl.FLUID, assemble(cells)
    b = np.random.default_rng(5119).standard_normal(cells.shape)
    problem = wl.LCP(wl.GridPoisson(cells, device=device, dtype=wp.float64), b)
    place = problem.layout.places()[fluid]
    for method in (wl.ProjectedMultigrid(), wl.MPRGP(), wl.ProjectedSOR()):
        work, iterates = method.init(problem), []

        def note(record, work=work, found=iterates):
            found.append(work.x.numpy()[place].copy())

        result = wl.solve(problem, method, stopping=ASKED, workspace=work, callback=note)
        for record, x in zip(result.history, iterates, strict=True):
            y = A[np.ix_(fluid, fluid)] @ x + b.ravel()[fluid]
            expected = np.abs(x).max(), abs(x @ y), x @ np.abs(y)
            own = record.merits.largest, record.merits.complementarity, record.merits.absolute
            np.testing.assert_allclose(own, expected, rtol=1e-10, atol=1e-12)


def test_merits_are_recorded_on_request_only_and_do_not_change_residuals():
    A, b = (
        scipy.sparse.csr_array(spd(30, 5123, 0.5)),
        np.random.default_rng(5129).standard_normal(30),
    )
    plain, with_merits = (
        wl.solve(wl.LCP(A, b), stopping=wl.StoppingCriteria(rtol=1e-8, merits=merits))
        for merits in (False, True)
    )
    assert all(record.merits is None for record in plain.history)
    assert all(record.merits is not None for record in with_merits.history)
    np.testing.assert_array_equal(plain.x.numpy(), with_merits.x.numpy())
    assert [record.residual for record in plain.history] == [
        record.residual for record in with_merits.history
    ]
