"""`wl.linear_complementarity` with the conventions of SciPy.

The results are checked by SciPy's own solvers and by enumeration.
"""

import numpy as np
import pyamg
import pytest
import scipy.sparse
import warp as wp
from scipy.optimize import Bounds, lsq_linear, nnls
from scipy.sparse.linalg import aslinearoperator

import warp_lcp as wl
from oracle import boxed
from warp_lcp.linear_complementarity import STATUSES

N = 7
KINDS = {
    "dense": np.asarray,
    "operator": aslinearoperator,
    "warp": lambda A: wl.DenseOperator(A, device="cpu"),
    **{
        kind: lambda A, kind=kind: scipy.sparse.csr_array(A).asformat(kind)
        for kind in ("csr", "csc", "coo", "bsr", "dia", "lil", "dok")
    },
    "matrix": scipy.sparse.csc_matrix,
    "float32": lambda A: A.astype(np.float32),
}


def least_squares(seed):
    """Return C and d of min ||C x - d||.

    C'C is positive definite, and all entries are float32 numbers.
    """
    rng = np.random.default_rng(seed)
    return rng.integers(-8, 9, (N + 5, N)) / 4.0, rng.integers(-8, 9, N + 5) / 4.0


def check(found, A, b, lower, upper, x):
    """Check that all fields of the result agree."""
    assert found.success, found.message
    assert found.status == 0
    assert found.message.startswith("CONVERGED: ")
    assert found.x.shape == found.slack.shape == found.active_mask.shape == b.shape
    assert found.x.dtype == np.float64
    np.testing.assert_allclose(found.x.ravel(), x, atol=1e-6)
    np.testing.assert_allclose(found.slack.ravel(), A @ found.x.ravel() + b.ravel(), atol=1e-10)
    low, high = found.active_mask.ravel() == -1, found.active_mask.ravel() == 1
    np.testing.assert_allclose(
        found.x.ravel()[low], np.broadcast_to(lower, b.shape).ravel()[low], atol=1e-9
    )
    np.testing.assert_allclose(
        found.x.ravel()[high], np.broadcast_to(upper, b.shape).ravel()[high], atol=1e-9
    )
    assert (found.slack.ravel()[low] >= 0).all()
    assert (found.slack.ravel()[high] <= 0).all()
    np.testing.assert_allclose(found.slack.ravel()[~(low | high)], 0.0, atol=1e-5)
    assert found.nit == found.result.iterations
    assert found.residual == found.result.residual
    assert found.relative_residual <= 1e-8


@pytest.mark.parametrize("kind", KINDS)
def test_least_squares_with_signs(kind):
    C, d = least_squares(41)
    A, b = C.T @ C, -C.T @ d
    check(wl.linear_complementarity(KINDS[kind](A), b, tol=1e-8), A, b, 0.0, np.inf, nnls(C, d)[0])


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize("bounds_kind", ["pair", "numbers", "Bounds", "open"])
def test_least_squares_in_boxes(bounds_kind, seed):
    C, d = least_squares(seed)
    A, b, rng = C.T @ C, -C.T @ d, np.random.default_rng(seed)
    lower, upper = -rng.random(N), rng.random(N)
    lower, upper = {"numbers": (-0.25, 0.5), "open": (-np.inf, upper)}.get(
        bounds_kind, (lower, upper)
    )
    bounds = {"Bounds": Bounds(lower, upper), "open": (None, upper)}.get(
        bounds_kind, (lower, upper)
    )
    expected = lsq_linear(C, d, (lower, upper), method="bvls", tol=1e-14)
    found = wl.linear_complementarity(A, b, bounds=bounds, tol=1e-9, method=wl.Lemke())
    check(found, A, b, lower, upper, expected.x)
    np.testing.assert_array_equal(found.active_mask, expected.active_mask)


@pytest.mark.parametrize(
    "name", ["lemke", "interior-point", "fischer-newton", "minimum-map-newton"]
)
def test_unsymmetric_matrices_and_names(name):
    rng = np.random.default_rng(19)
    A = np.eye(N) + 0.4 * rng.standard_normal((N, N))
    A += 1.5 * np.eye(N) * abs(A).max()
    b, lower, upper = rng.standard_normal(N), np.full(N, -0.1), np.full(N, 0.15)
    found = wl.linear_complementarity(
        A, b, bounds=(lower, upper), tol=1e-9, method=name, x0=np.full(N, 0.05)
    )
    check(found, A, b, lower, upper, boxed(A, b, lower, upper))


@pytest.mark.parametrize("shape", [(12, 1), (3, 4)])
def test_shapes_are_those_of_b(shape):
    A = pyamg.gallery.poisson((3, 4))
    b = np.random.default_rng(8).standard_normal(shape)
    lower = np.full(shape, -0.1)
    found = wl.linear_complementarity(A, b, bounds=(lower, 0.2), x0=lower, tol=1e-9)
    flat = wl.linear_complementarity(A, b.ravel(), bounds=(-0.1, 0.2), tol=1e-9)
    check(found, A, b, -0.1, 0.2, flat.x)


def test_grids():
    cells = np.full((5, 6), wl.FLUID)
    cells[:, 0] = wl.AIR
    cells[2, 3] = wl.SOLID
    A, b = (
        wl.GridPoisson(cells, device="cpu", dtype=wp.float64),
        np.random.default_rng(2).standard_normal((5, 6)),
    )
    seen = []
    found = wl.linear_complementarity(A, b, tol=1e-8, callback=seen.append)
    assert found.success
    inside = cells == wl.FLUID
    y = A.apply(wp.array(found.x, dtype=wp.float64, device="cpu")).numpy() + b
    np.testing.assert_allclose(found.slack, np.where(inside, y, 0.0), atol=1e-12)
    assert (found.active_mask[~inside] == 0).all()
    assert (found.x >= 0).all()
    assert np.abs(np.where(inside, np.minimum(found.x, y), 0.0)).max() < 1e-6
    assert [x.shape for x in seen] == [(5, 6)] * found.nit


def sweeps(**options):
    """Return a problem that takes many steps."""
    n = 40
    A = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    return wl.linear_complementarity(A, np.sin(np.linspace(0, 20, n)), method="psor", **options)


@pytest.mark.parametrize("infinity", [1e20, 1e30, np.inf])
@pytest.mark.parametrize(
    "name", ["lemke", "interior-point", "fischer-newton", "minimum-map-newton", None]
)
def test_1e20_is_infinite(name, infinity):
    rng = np.random.default_rng(23)
    C, b = rng.standard_normal((N, N)), rng.standard_normal(N)
    A = C @ C.T + np.eye(N)
    lower, upper = (
        np.where(np.arange(N) % 2, -0.1, -infinity),
        np.where(np.arange(N) % 3, infinity, 0.15),
    )
    expected = boxed(
        A, b, np.where(np.arange(N) % 2, -0.1, -np.inf), np.where(np.arange(N) % 3, np.inf, 0.15)
    )
    for bounds in (
        (lower, upper),
        list(zip(lower, upper, strict=True)),
        Bounds(lower, upper),
        (wp.array(lower, device="cpu"), upper),
    ):
        check(
            wl.linear_complementarity(A, b, bounds=bounds, tol=1e-10, method=name),
            A,
            b,
            lower,
            upper,
            expected,
        )
    for bounds in ((-infinity, infinity), (None, None)):
        np.testing.assert_allclose(
            wl.linear_complementarity(A, b, bounds=bounds, tol=1e-10).x,
            np.linalg.solve(A, -b),
            atol=1e-8,
        )


ARRAYS = (np.zeros(2), np.array([0.4, 3.0]))


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ([(0, 1), (0, 1)], ([0, 0], [1, 1])),
        ([(None, 1), (-1, None)], ([-np.inf, -1], [1, np.inf])),
        ([(0, 0.4), (0, 3)], ([0, 0], [0.4, 3])),
        (([0, 0], [0.4, 3]), ([0, 0], [0.4, 3])),
        (ARRAYS, ([0, 0], [0.4, 3])),
        (([0, 0], (0.4, 3)), ([0, 0], [0.4, 3])),
        ((0, 1), ([0, 0], [1, 1])),
        ([0, 1], ([0, 0], [1, 1])),
        ((None, [0.4, 3]), ([-np.inf, -np.inf], [0.4, 3])),
        ([None, None], ([-np.inf, -np.inf], [np.inf, np.inf])),
        ([[0, 1], [1, 3]], ([0, 1], [1, 3])),  # both readings are equal
    ],
)
def test_pairs_of_two_unknowns(bounds, expected):
    A, b = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([0.5, -2.5])
    found = wl.linear_complementarity(A, b, bounds=bounds, tol=1e-10, method="lemke")
    check(
        found,
        A,
        b,
        *map(np.array, expected),
        boxed(A, b, *(np.array(side, dtype=float) for side in expected)),
    )


@pytest.mark.parametrize(
    "bounds",
    [
        [[0, 0], [1, 1]],
        list(ARRAYS),
        ((0, 0), (1, 1)),
        np.array([[0, 0], [1, 1]]),
        [(0, 1), [0, 1]],
    ],
)
def test_ambiguous_bounds_are_refused(bounds):
    with pytest.raises(
        ValueError,
        match=r"bounds is a .* of two .*, which could be \(lo, hi\) or a pair for each of two "
        r"unknowns: write",
    ):
        wl.linear_complementarity(np.eye(2), np.ones(2), bounds=bounds)


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_pairs_of_other_numbers_of_unknowns(kind):
    rng = np.random.default_rng(29)
    C, b = rng.standard_normal((4, 4)), rng.standard_normal(4)
    A, lower, upper = (
        C @ C.T + np.eye(4),
        np.array([-0.1, 0.0, -0.3, -np.inf]),
        np.array([0.0, 0.2, np.inf, 0.1]),
    )
    pairs = kind([tuple(pair) for pair in zip(lower, upper, strict=True)])
    found = wl.linear_complementarity(A, b, bounds=pairs, tol=1e-10, method="lemke")
    check(found, A, b, lower, upper, boxed(A, b, lower, upper))
    square = wl.linear_complementarity(A, b.reshape(2, 2), bounds=pairs, tol=1e-10, method="lemke")
    np.testing.assert_array_equal(square.x.ravel(), found.x)
    one = wl.linear_complementarity(
        A[:1, :1], b[:1], bounds=kind([(lower[0], upper[0])]), method="lemke"
    )
    np.testing.assert_allclose(one.x, np.clip(-b[0] / A[0, 0], lower[0], upper[0]), atol=1e-12)


def test_callbacks_see_each_iterate():
    seen = []

    def see(intermediate_result):
        seen.append(intermediate_result)

    found = sweeps(maxiter=6, callback=see)
    assert found.status == 1
    assert found.message.startswith(
        "MAX_ITERATIONS: the iteration limit was reached: raise maxiter"
    )
    assert [one.nit for one in seen] == [1, 2, 3, 4, 5, 6] == list(range(1, found.nit + 1))
    assert [one.residual for one in seen] == [
        record.residual for record in found.result.history[1:]
    ]
    norms = [np.linalg.norm(one.x - seen[-1].x) for one in seen]
    assert norms[0] > norms[2] > norms[-1] == 0.0  # copies
    np.testing.assert_array_equal(seen[-1].x, found.x)


@pytest.mark.parametrize("at", [1, 4])
def test_a_callback_stops(at):
    seen = []

    def stop(intermediate_result):
        seen.append(intermediate_result)
        if intermediate_result.nit == at:
            raise StopIteration

    found = sweeps(callback=stop)
    assert (found.status, found.success, found.nit) == (99, False, at)
    assert found.message == "STOPPED: the callback raised StopIteration: continue from this x"
    np.testing.assert_array_equal(found.x, min(seen, key=lambda one: one.residual).x)
    assert found.result.status is wl.SolveStatus.STOPPED
    assert sweeps(x0=found.x).success


def test_a_callback_stops_methods_that_have_not_begun():
    def stop(record):
        raise StopIteration

    result = wl.solve(wl.LCP(np.diag([2.0, 3.0]), -np.ones(2)), wl.ProjectedSOR(), callback=stop)
    assert (result.status, result.iterations) == (wl.SolveStatus.STOPPED, 0)
    solved = wl.solve(wl.LCP(np.diag([2.0, 3.0]), np.ones(2)), wl.ProjectedSOR(), callback=stop)
    assert solved.status is wl.SolveStatus.CONVERGED


def test_exceptions_of_a_callback_are_raised():
    def wrong(x):
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        sweeps(callback=wrong)


def test_statuses_are_all_there():
    assert set(STATUSES) == set(wl.SolveStatus)
    assert len(set(STATUSES.values())) == len(STATUSES)
    found = wl.linear_complementarity(np.array([[0.0]]), np.array([-1.0]), method="lemke")
    assert (found.status, found.success) == (2, False)


A, B = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([0.5, -2.5])


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((A * np.nan, B), {}, "matrix holds a value that is not finite"),
        ((A[:1], B), {}, r"matrix has shape \(1, 2\)"),
        ((A * 1j, B), {}, "matrix is a ndarray of type complex128"),
        ((A, B * 1j), {}, "b is a ndarray of type complex128"),
        ((A, B * np.inf), {}, "b holds 2 values that are not finite"),
        ((A, np.ones(3)), {}, r"b has shape \(3,\): expected \(2,\)"),
        ((A, B), {"bounds": (0.5, -0.5)}, "lower > upper in 2 unknowns"),
        ((A, B), {"bounds": (0.0, 1.0, 2.0)}, r"bounds is a tuple: expected a pair \(lo, hi\)"),
        (
            (A, B),
            {"bounds": [(0.0, 1.0)] * 3},
            "bounds is a list: expected a pair .* a list of 2 pairs, .*; it has 3 entries",
        ),
        (
            (A, B),
            {"bounds": np.zeros((3, 2))},
            r"bounds is a ndarray: expected a pair .*; it has shape \(3, 2\)",
        ),
        (
            (A, B),
            {"bounds": (1e20, None)},
            "bounds, lo holds 1 values of 1e20 or beyond, which is infinite: no x could meet it",
        ),
        ((A, B), {"bounds": [(0, 1), (0, -1e30)]}, "bounds, hi holds 1 values of -1e20 or beyond"),
        ((A, B), {"bounds": 3}, "bounds is a int: expected a pair"),
        ((A, B), {"bounds": (np.zeros(3), 1.0)}, r"bounds, lo has shape \(3,\): expected \(2,\)"),
        ((A, B), {"bounds": (0.0, np.nan)}, "upper holds"),
        ((A, B), {"x0": np.zeros(3)}, r"x0 has shape \(3,\): expected \(2,\)"),
        ((A, B), {"x0": [0.0, np.nan]}, "x0 holds 1 values that are not finite"),
        ((A, B), {"tol": 2}, r"tol = 2: must be in \[0, 1\)"),
        ((A, B), {"atol": -1}, "atol = -1: must be a finite number >= 0"),
        ((A, B), {"maxiter": 1.5}, "maxiter = 1.5: must be an integer >= 0"),
        (
            (A, B),
            {"method": "lemk"},
            "method = 'lemk': must be one of accelerated-projected-gradient, .*, lemke, .*, a "
            "method with",
        ),
        ((A, B), {"method": wl.Lemke}, "method is the class Lemke: expected a name in wl.METHODS"),
        ((A, B), {"method": 3}, "method is a int: expected a name"),
        (
            (A, B),
            {"method": "projected-multigrid"},
            "ProjectedMultigrid needs an operator with a stencil",
        ),
        ((A, B), {"callback": 3}, "callback is a int: expected a function of one argument"),
        ((A, B), {"preconditioner": np.eye(3)}, r"preconditioner has shape \(3, 3\)"),
        (
            (A, B),
            {"preconditioner": np.eye(2), "method": "lemke"},
            "preconditioner: Lemke does not use one",
        ),
    ],
)
def test_invalid_arguments_are_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        wl.linear_complementarity(*arguments, **options)


def test_callbacks_see_the_iterates_of_alternatives_and_stop_them():
    """Callbacks during alternatives: iterates, and stopping.

    Lemke's method follows sweeps, which cycle here: each step's x has the reported residual.
    """
    A, b, lower, upper = next(drawn for drawn in map(circling, range(100)) if drawn is not None)
    seen = []

    def see(intermediate_result):
        seen.append(intermediate_result)

    found = wl.linear_complementarity(A, b, bounds=(lower, upper), callback=see)
    assert found.success
    assert found.result.method != "psor"
    names = [record.step for record in found.result.history]
    assert any(name == f"start of {found.result.method}" for name in names)
    messages = [record for record in found.result.history if not record.step.startswith("start")]
    assert [(one.nit, one.residual) for one in seen] == [
        (record.iteration, record.residual) for record in messages
    ]
    np.testing.assert_array_equal(seen[-1].x, found.x)
    first = names.index(f"start of {found.result.method}")
    after = messages[first - 1].iteration + 1  # within the alternative

    def stop(intermediate_result):
        if intermediate_result.nit == after:
            raise StopIteration

    stopped = wl.linear_complementarity(A, b, bounds=(lower, upper), callback=stop)
    assert (stopped.status, stopped.nit) == (99, after)


def circling(seed):
    """Return a boxed matrix with a negative diagonal on which sweeps diverge.

    None if they converge.
    """
    rng = np.random.default_rng([seed, 223])
    S = rng.standard_normal((12, 12))
    A, b, lower = -np.eye(12) - 3 * (S - S.T), rng.standard_normal(12), -rng.random(12)
    upper = lower + 1
    return None if wl.solve(wl.LCP(A, b, lower, upper), wl.ProjectedSOR()) else (A, b, lower, upper)
