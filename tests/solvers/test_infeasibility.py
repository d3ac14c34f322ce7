"""INFEASIBLE as a proof.

Random problems with a planted solution, or with a planted proof that there is none, and singular
Laplacians.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import covering
from warp_lcp.subproblems.dense_problem import (
    DenseProblem,
    certifies,
    diagonally_dominant,
    inconsistent,
)

NONE = wl.SolveStatus.INFEASIBLE


def units(rng, n):
    """Return scales of rows and columns over 12 decades, or 1."""
    D = 10 ** rng.uniform(-6, 6, n) if rng.random() < 0.5 else np.ones(n)
    return D, 10 ** rng.uniform(-6, 6, n) if rng.random() < 0.3 else D


def planted_solution(seed):
    """Return A, b, l, u with b = y - A x for a solution x, y.

    A is positive semi-definite, of low rank, and perhaps reducible.
    """
    rng = np.random.default_rng([5, seed])
    n = int(rng.integers(1, 30))
    F, K = rng.standard_normal((n, int(rng.integers(0, n + 1)))), rng.standard_normal((n, n))
    A = F @ F.T + (rng.random() < 0.3) * (K - K.T)
    if rng.random() < 0.3:
        k = int(rng.integers(0, n))
        A[:k, k:] = A[k:, :k] = 0
    below, above = rng.random((2, n)) < 0.5
    lower, upper = (
        np.where(below, -rng.random(n) * rng.integers(0, 2), -np.inf),
        np.where(above, rng.random(n) * rng.integers(1, 3), np.inf),
    )
    x = np.clip(
        rng.standard_normal(n) * 10 ** rng.uniform(0, 6 if rng.random() < 0.3 else 0), lower, upper
    )
    low = below & (rng.random(n) < 0.5)
    high = above & ~low & (rng.random(n) < 0.5)
    x = np.where(low, lower, np.where(high, upper, x))
    return (
        A,
        np.where(low, rng.random(n), np.where(high, -rng.random(n), 0.0)) - A @ x,
        lower,
        upper,
    )


def planted_proof(seed):
    """Return A, b, l, u without a solution, by construction of a certificate z.

    z has the signs that the bounds require, b'z + max g'x < 0 and g = A'z; None where z = 0.
    """
    A, b, lower, upper = planted_solution(seed)
    rng, n = np.random.default_rng([6, seed]), len(b)
    below, above = np.isfinite(lower), np.isfinite(upper)
    sign = np.where(
        below & above, 0, np.where(below, 1, np.where(above, -1, rng.choice([-1, 1], n)))
    )
    z = sign * rng.integers(0, 2, n) * rng.integers(1, 5, n)
    if not z.any():
        return None
    g, drawn = A.T @ z, rng.random(n) * rng.integers(0, 2, n)
    A = A - np.outer(
        z, g - np.where(below & above, g, np.where(below, -drawn, np.where(above, drawn, 0.0)))
    ) / (z @ z)
    g = A.T @ z
    gains = np.where(g > 0, np.where(above, upper, 0.0) * g, np.where(below, lower, 0.0) * g).sum()
    return (
        A,
        b - z * (b @ z + gains + 0.01 * (np.abs(b) @ np.abs(z) + abs(gains) + 1)) / (z @ z),
        lower,
        upper,
    )


def in_units(drawn, seed, sparse=False):
    A, b, lower, upper = drawn
    R, C = units(np.random.default_rng([7, seed]), len(b))
    matrix = R[:, None] * A * C
    return DenseProblem(
        np.arange(len(b)),
        scipy.sparse.csr_array(matrix) if sparse else matrix,
        R * b,
        lower / C,
        upper / C,
        False,
    )


def check(seeds):
    proved = drawn = 0
    for seed in seeds:
        assert not inconsistent(in_units(planted_solution(seed), seed)), seed
        other = planted_proof(seed)
        if other is not None:
            drawn, proved = (
                drawn + 1,
                proved + inconsistent(in_units(other, seed, sparse=seed % 2 == 0)),
            )
    assert proved >= 0.99 * drawn, (proved, drawn)


def test_drawn_problems():
    """Random problems: no false proof, and nearly all proofs found, in any units."""
    check(range(60))


@pytest.mark.slow
def test_more_drawn_problems():
    check(range(1000, 2000))


@pytest.mark.parametrize(
    ("A", "b", "lower", "upper", "none"),
    [
        # y_1 = -1, whatever the large row is.
        ([[0.0, 0.0], [0.0, 1.0]], [-1.0, 1e16], 0.0, np.inf, True),
        ([[0.0, 0.0], [0.0, 1.0]], [1.0, -1e16], 0.0, np.inf, False),
        (
            [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [-1.0, -1.0, 1e16],
            0.0,
            np.inf,
            True,
        ),
        (
            [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [-1.0, 1.0, -1e16],
            0.0,
            np.inf,
            False,
        ),
        ([[1.0, -1.0], [-1.0, 1.0]], [-1.0, 1.0 - 1e-15], 0.0, np.inf, False),  # rounding
        ([[1e-17, 0.0], [0.0, 1.0]], [-1.0, -1.0], 0.0, np.inf, False),  # x = (1e17, 1)
        ([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0], -np.inf, 0.0, True),
        ([[1.0, -1.0], [-1.0, 1.0]], [-1.0, -1.0], -np.inf, 0.0, False),
        ([[-1.0]], [-1.0], 0.0, np.inf, True),  # y = -x - 1
        # y_1 = x_2 - 3 <= -1.
        ([[0.0, 1.0], [0.0, 0.0]], [-3.0, 1.0], [0.0, 0.0], [np.inf, 2.0], True),
        ([[0.0, 1.0], [0.0, 0.0]], [-1.0, 1.0], [0.0, 0.0], [np.inf, 2.0], False),
    ],
)
def test_small_cases(A, b, lower, upper, none):
    n = len(b)
    bounds = (np.broadcast_to(np.asarray(side, dtype=float), (n,)) for side in (lower, upper))
    assert (
        inconsistent(DenseProblem(np.arange(n), np.array(A), np.array(b), *bounds, False)) is none
    )


def test_multipliers_of_a_wrong_sign_prove_nothing():
    A, b = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([1.0, 1.0])
    lower, upper = np.zeros(2), np.full(2, np.inf)
    data = DenseProblem(np.arange(2), A, b, lower, upper)
    assert not certifies(data, -np.ones(2)) and not certifies(data, np.ones(2))
    assert certifies(DenseProblem(np.arange(2), A, -b, lower, upper), np.ones(2))
    assert certifies(DenseProblem(np.arange(2), A, b, -upper, -lower), -np.ones(2))


def ring(n, face=None):
    """Return the matrix of a periodic chain with coefficients between i and i + 1."""
    face, here = np.ones(n) if face is None else face, np.arange(n)
    off = scipy.sparse.csr_array((face, (here, np.roll(here, -1))), shape=(n, n))
    return scipy.sparse.csr_array(scipy.sparse.diags_array(face + np.roll(face, 1)) - off - off.T)


def reynolds(n, eccentricity):
    """Return A, b of a journal bearing's film.

    b sums to 0 up to rounding, and a full film plus a constant is a solution.
    """
    h = 1 + eccentricity * np.cos(2 * np.pi * np.arange(n) / n)
    b = np.roll(h, -1) - np.roll(h, 1)
    return ring(n, ((h + np.roll(h, -1)) / 2) ** 3), b - b.mean()


@pytest.mark.parametrize("method", [None, wl.InteriorPoint()], ids=["default", "interior point"])
@pytest.mark.parametrize(("n", "eccentricity"), [(360, 0.999), (90, 0.99)])
def test_a_full_film(n, eccentricity, method):
    A, b = reynolds(n, eccentricity)
    result = wl.solve(wl.LCP(A, b), method)
    x = result.x.numpy()
    assert result and (x >= 0).all(), result.status
    assert np.linalg.norm(np.minimum(x, (A @ x + b) / A.diagonal())) <= 1e-5 * np.linalg.norm(
        b / A.diagonal()
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("method", "lower", "dense"),
    covering([None, wl.InteriorPoint()], [0.0, -np.inf], [False, True], count=4),
)
def test_a_ring(method, lower, dense):
    n = 120 if dense else 720
    A, b = ring(n), np.sin(2 * np.pi * np.arange(n) / n)
    A = A.toarray() if dense else A
    assert wl.solve(wl.LCP(A, b, lower), method)
    less = np.full(n, 0.1) if np.isneginf(lower) else np.full(n, -0.1)
    assert wl.solve(wl.LCP(A, b + less, lower), method).status is NONE


def test_an_empty_row_stays():
    """Empty row: x_2 stays.

    Any x_2 is a solution; the central path once moved it to 1e23.
    """
    A = scipy.sparse.csr_array(np.array([[2.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 2.0]]))
    result = wl.solve(wl.LCP(A, np.array([-1.0, 0.0, 1.0])), wl.InteriorPoint())
    assert result and abs(result.x.numpy()[1]) <= 1.0


def equations(seed, largest):
    """Return a dense singular matrix and a vector w with A'w = 0.

    It is symmetric or not, scaled or not.
    """
    rng = np.random.default_rng([seed, 409])
    n = int(rng.integers(largest // 2, largest))
    kind = rng.choice(["graph", "low rank", "directed graph"])
    if kind == "low rank":
        B = rng.standard_normal((n, n // 2))
        A = B @ B.T
        w = rng.standard_normal(n)
        w -= B @ np.linalg.lstsq(B, w, rcond=None)[0]
    else:
        W = np.roll(np.diag(rng.uniform(0.5, 2, n)), 1, axis=1) + rng.uniform(0.5, 2, (n, n)) * (
            rng.random((n, n)) < 3 / n
        )
        W = W if kind == "directed graph" else W + W.T
        A, w = np.diag(W.sum(axis=0)) - W, np.ones(n)  # columns sum to 0
    units = 10 ** rng.uniform(-2, 2, n) if rng.random() < 0.5 else np.ones(n)
    return units[:, None] * A * units, w / units, rng


def check_equations(seed, largest):
    A, w, rng = equations(seed, largest)
    b = A @ (rng.standard_normal(len(A)) / np.abs(A).max(axis=0))
    good = wl.solve(wl.LCP(wl.DenseOperator(A, device="cpu"), b, -np.inf, np.inf))
    assert good.status is not wl.SolveStatus.INFEASIBLE, seed
    bad = wl.solve(
        wl.LCP(
            wl.DenseOperator(A, device="cpu"),
            b + 0.01 * np.linalg.norm(b) * w / np.linalg.norm(w),
            -np.inf,
            np.inf,
        )
    )
    return good, bad


def test_dense_equations_are_proved_to_have_no_solution():
    """Proof that dense equations have no solution, in three steps.

    By multipliers from the null space; otherwise linear programs of up to 100 s at 770 unknowns
    would follow.
    """
    found = [check_equations(seed, 300) for seed in range(16)]
    assert all(good for good, _ in found), [good.status for good, _ in found]
    assert all(bad.status is wl.SolveStatus.INFEASIBLE for _, bad in found), [
        bad.status for _, bad in found
    ]
    assert max(bad.iterations for _, bad in found) <= 12, [bad.iterations for _, bad in found]


def drawn_dominant(seed):
    """Return a matrix with dominant rows, most of them weakly.

    And whether each row leads to a strictly dominant one.
    """
    rng = np.random.default_rng([8, seed])
    n = int(rng.integers(1, 25))
    A = np.where(
        rng.random((n, n)) < rng.uniform(0.02, 0.3),
        rng.standard_normal((n, n)) * 10 ** rng.uniform(-6, 6, (n, n)),
        0.0,
    )
    np.fill_diagonal(A, 0.0)
    strict = rng.random(n) < rng.choice([0.0, 0.1, 0.5])
    beside = np.abs(A).sum(axis=1)
    np.fill_diagonal(A, np.where(strict, beside * rng.uniform(1.001, 2.0, n) + 1e-3, beside))
    leads = strict.copy()
    for _ in range(n):  # row i leads where row j does, for any a_ij != 0
        leads |= (A != 0) @ leads
    return A, bool(leads.all() and (A.diagonal() > 0).all())


def check_dominance(seeds):
    """Check the dominance test against a plain loop.

    Such matrices are P-matrices, by principal minors of random index sets.
    """
    yes = 0
    for seed in seeds:
        A, expected = drawn_dominant(seed)
        assert (
            diagonally_dominant(A) == diagonally_dominant(scipy.sparse.csr_array(A)) == expected
        ), seed
        yes += expected
        if expected:
            rng = np.random.default_rng([9, seed])
            for _ in range(5):
                rows = np.flatnonzero(rng.random(len(A)) < 0.5)
                block = A[np.ix_(rows, rows)] / A.diagonal()[rows, None]
                assert np.linalg.slogdet(block)[0] > 0, seed
    assert 0.1 * len(seeds) < yes < 0.9 * len(seeds)


def test_diagonal_dominance():
    check_dominance(range(200))


def test_matrices_without_dominance():
    laplacian = np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert not diagonally_dominant(laplacian)  # singular: no row is strictly dominant
    assert diagonally_dominant(laplacian + np.diag([1e-3, 0.0]))
    assert not diagonally_dominant(-np.eye(2))
    assert not diagonally_dominant(np.array([[1.0, -1.1], [0.0, 1.0]]))
    assert not diagonally_dominant(
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [-1.0, 0.0, 1.0]]) - np.diag([0.0, 0.0, 0.5])
    )


def test_a_dominant_matrix_needs_no_linear_program(monkeypatch):
    monkeypatch.setattr(
        "scipy.optimize.linprog", lambda *_, **__: pytest.fail("a linear program was solved")
    )
    A = np.array([[2.0, -1.0], [-1.0, 1.0]])
    for lower, upper in ((0.0, np.inf), (-np.inf, 0.0), (-np.inf, np.inf)):
        assert not inconsistent(
            DenseProblem(
                np.arange(2), A, np.array([-3.0, 1.0]), np.full(2, lower), np.full(2, upper)
            )
        )
