"""Hostile matrices.

The families are zero eigenvalues, empty rows, P-matrices on which Newton's method cycles, and
matrices on which pivoting methods take 2^n steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import scipy.sparse

from warp_lcp.benchmarks.extremes.case import EITHER, INFEASIBLE, SOLVED, ExtremeCase
from warp_lcp.benchmarks.extremes.problem import MatrixProblem
from warp_lcp.benchmarks.extremes.shapes import chance, solve_cases
from warp_lcp.gallery.matrices import semidefinite, skewed, spectrum_matrix

N = 24
NEWTON, LEMKE, PIVOTING = ("minimum-map-newton",), ("lemke",), ("incremental-pivoting",)
MAY_STOP = {"single": EITHER}


def singular() -> Iterator[ExtremeCase]:
    """Yield singular symmetric positive semi-definite matrices, and tiny matrices."""
    case = partial(solve_cases, "zero eigenvalues")
    for rank in (1, N // 2, N - 1):
        make_problem = partial(MatrixProblem.of, semidefinite(N, zeros=1 - rank / N))
        methods, expected = (
            (*NEWTON, "mprgp", "interior-point", *PIVOTING, *LEMKE),
            EITHER if rank == 1 else SOLVED,
        )
        yield from case(
            f"dense of rank {rank}, b in its range",
            make_problem,
            methods,
            expected=expected,
            promises=MAY_STOP,
        )
    yield from case(
        "sparse, constants are a null space", ring, (*NEWTON, "mprgp", *PIVOTING), promises=MAY_STOP
    )
    zero = partial(MatrixProblem, matrix=np.zeros((3, 3)))
    yield from case(
        "A = 0, b >= 0", partial(zero, b=np.array([0.0, 1.0, 2.0])), (*NEWTON, *LEMKE, "psor")
    )
    yield from case(
        "A = 0, b < 0",
        partial(zero, b=np.array([0.0, 1.0, -2.0])),
        NEWTON + LEMKE,
        expected=INFEASIBLE,
    )
    for b, expected in ((1.0, SOLVED), (-1.0, INFEASIBLE)):
        yield from case(
            f"sparse with an empty row, b = {b:g} there",
            partial(empty_row, b),
            NEWTON,
            expected=expected,
        )
    for small in (1e-8, 1e-14, 1e-300):
        yield from case(
            f"smallest eigenvalue {small:g}",
            partial(nearly, small),
            NEWTON + PIVOTING,
            expected=EITHER,
        )
    for size in (1e-30, 1e30):
        two = partial(
            MatrixProblem,
            matrix=np.array([[2.0, -1.0], [-1.0, 2.0]]) * size,
            b=np.array([0.5, -2.5]) * size,
        )
        yield from case(f"entries of {size:g}", two, NEWTON + PIVOTING + LEMKE, promises=MAY_STOP)


def ring() -> MatrixProblem:
    """Return the Laplacian of a ring with b of positive sum."""
    n, one = 50, np.eye(50)
    b = chance(21).standard_normal(n)
    return MatrixProblem(
        matrix=scipy.sparse.csr_array(2 * one - np.roll(one, 1, 0) - np.roll(one, -1, 0)),
        b=b - b.mean() + 0.05,
    )


def empty_row(b: float) -> MatrixProblem:
    """Return a regular matrix with one row and column of zeros added."""
    A = np.diag([2.0, 3.0, 0.0, 4.0])
    A[0, 1] = A[1, 0] = -1.0
    return MatrixProblem(matrix=scipy.sparse.csr_array(A), b=np.array([-1.0, -2.0, b, 1.0]))


def nearly(small: float) -> MatrixProblem:
    """Return a matrix with eigenvalues from `small` to 1.

    The eigenvectors of the small eigenvalues contribute to the solution.
    """
    draw = chance(22)
    A = spectrum_matrix(np.geomspace(small, 1.0, N), draw)
    x = np.where(draw.random(N) < 0.4, 0.0, draw.uniform(0.1, 1.0, N))
    return MatrixProblem(matrix=A, b=np.where(x == 0, 0.5, 0.0) - A @ x)


def cycling() -> Iterator[ExtremeCase]:
    """Yield P-matrices on which Newton's method cycles or pivoting takes 2^n steps.

    The Newton method is that of the minimum map.
    """
    case = partial(solve_cases, "P-matrices")
    robust = (*NEWTON, "fischer-newton", *LEMKE)
    for n in (3, 4, 5, 6, 7, 9, 12, 30):
        yield from case(f"cyclic, {n} unknowns", partial(circulant, n), robust)
        for start, every in (("first", n), ("alternating", 2)):
            x0 = np.where(np.arange(n) % every == 0, 1.0, 0.0)
            yield from case(
                f"cyclic, {n} unknowns, {start} start", partial(circulant, n), NEWTON, x0=x0
            )
    for n in (8, 16):
        yield from case(
            f"Murty's, {n} unknowns",
            partial(murty, n),
            NEWTON + LEMKE,
            but={"lemke": EITHER} if n > 8 else {},
        )
        yield from case(
            f"Fathi's, {n} unknowns",
            partial(murty, n, times_transposed=True),
            NEWTON + PIVOTING + LEMKE,
            promises=MAY_STOP,
        )
    for seed in range(4):
        yield from case(f"unsymmetric, random {seed}", partial(unsymmetric, seed), robust)


def circulant(n: int) -> MatrixProblem:
    """Return I plus a cyclic shift by 2 if n is odd, by 0.9 if n is even; b < 0.

    They are P-matrices [Ben Gharbia & Gilbert 2012].
    """
    return MatrixProblem(
        matrix=np.eye(n) + (2.0 if n % 2 else 0.9) * np.roll(np.eye(n), 1, axis=1), b=-np.ones(n)
    )


def murty(n: int, *, times_transposed: bool = False) -> MatrixProblem:
    """Return Murty's P-matrix M, or Fathi's M M'.

    M has 1 on the diagonal and 2 below. Principal pivoting visits 2^n bases on it.
    """
    M = np.eye(n) + 2 * np.tril(np.ones((n, n)), -1)
    return MatrixProblem(matrix=M @ M.T if times_transposed else M, b=-np.ones(n))


def unsymmetric(seed: int) -> MatrixProblem:
    """Return a P-matrix with a definite symmetric part and a large skew part."""
    return MatrixProblem.of(skewed(N, skew=2.0, seed=seed))
