"""Families of matrices: zero eigenvalues, empty rows, cycling P-matrices, and those on which pivoting methods take 2^n steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse

from warp_lcp.benchmarks.extremes.case import EITHER, INFEASIBLE, Case, Promise, SolveCase
from warp_lcp.benchmarks.extremes.problem import MatrixProblem
from warp_lcp.benchmarks.extremes.shapes import SEED, same

N = 24


def given(family: str, name: str, make: Callable[[], Any], methods: tuple[str, ...], **more: Any) -> Iterator[SolveCase]:
    """Yield the case for each method; `more` as of SolveCase, `but` holds promises of single methods."""
    but: Mapping[str, Mapping[str, Promise]] = more.pop("but", {})
    for method in methods:
        own = {"promises": but[method]} if method in but else {}
        yield SolveCase(family, f"{name}, {method}", make, method, **(more | own))


def singular() -> Iterator[Case]:
    """Yield symmetric positive semi-definite matrices with a null space, and matrices of a few numbers."""
    case = partial(given, "zero eigenvalues")
    convex = ("minimum-map-newton", "mprgp", "interior-point", "incremental-pivoting", "lemke")
    for rank in (1, N // 2, N - 1):
        yield from case(
            f"dense of rank {rank}, b in its range",
            partial(in_range, rank),
            convex,
            promises=same(EITHER) if rank == 1 else {"single": EITHER},
        )
    yield from case(
        "sparse, constants are a null space", ring, ("minimum-map-newton", "mprgp", "incremental-pivoting"), promises={"single": EITHER}
    )
    yield from case(
        "A = 0, b >= 0",
        lambda: MatrixProblem(matrix=np.zeros((3, 3)), b=np.array([0.0, 1.0, 2.0])),
        ("minimum-map-newton", "lemke", "psor"),
    )
    yield from case(
        "A = 0, b < 0",
        lambda: MatrixProblem(matrix=np.zeros((3, 3)), b=np.array([0.0, 1.0, -2.0])),
        ("minimum-map-newton", "lemke"),
        promises=same(INFEASIBLE),
    )
    for b, promises in ((1.0, {}), (-1.0, same(INFEASIBLE))):
        yield from case(f"sparse with an empty row, b = {b:g} there", partial(empty_row, b), ("minimum-map-newton",), promises=promises)
    for small in (1e-8, 1e-14, 1e-300):
        yield from case(
            f"smallest eigenvalue {small:g}", partial(nearly, small), ("minimum-map-newton", "incremental-pivoting"), promises=same(EITHER)
        )
    for size in (1e-30, 1e30):
        matrix = np.array([[2.0, -1.0], [-1.0, 2.0]]) * size
        yield from case(f"entries of {size:g}", partial(MatrixProblem, matrix=matrix, b=np.array([0.5, -2.5]) * size),
            ("minimum-map-newton", "incremental-pivoting", "lemke"), promises={"single": EITHER},
        )  # fmt: skip


def in_range(rank: int) -> MatrixProblem:
    """Return A = B B' of a rank and b = -A x* + y* with x* >= 0, y* >= 0 complementary: there is a solution."""
    chance = np.random.default_rng(SEED + 20)
    B = chance.standard_normal((N, rank))
    A = B @ B.T / rank
    held = chance.random(N) < 0.4
    x, y = np.where(held, 0.0, chance.uniform(0.1, 1.0, N)), np.where(held, chance.uniform(0.1, 1.0, N), 0.0)
    return MatrixProblem(matrix=(A + A.T) / 2, b=y - (A + A.T) / 2 @ x)


def ring() -> MatrixProblem:
    """Return the Laplacian of a ring with b that adds up to more than 0."""
    n = 50
    A = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tolil()
    A[0, n - 1] = A[n - 1, 0] = -1.0
    b = np.random.default_rng(SEED + 21).standard_normal(n)
    return MatrixProblem(matrix=A.tocsr(), b=b - b.mean() + 0.05)


def empty_row(b: float) -> MatrixProblem:
    """Return a regular matrix with a row and column of zeros in it."""
    A = np.diag([2.0, 3.0, 0.0, 4.0])
    A[0, 1] = A[1, 0] = -1.0
    return MatrixProblem(matrix=scipy.sparse.csr_array(A), b=np.array([-1.0, -2.0, b, 1.0]))


def nearly(small: float) -> MatrixProblem:
    """Return a matrix with eigenvalues from `small` to 1 and a solution that its small ones take part in."""
    chance = np.random.default_rng(SEED + 22)
    Q = np.linalg.qr(chance.standard_normal((N, N)))[0]
    A = (Q * np.geomspace(max(small, 1e-300), 1.0, N)) @ Q.T
    A = (A + A.T) / 2
    x = np.where(chance.random(N) < 0.4, 0.0, chance.uniform(0.1, 1.0, N))
    return MatrixProblem(matrix=A, b=np.where(x == 0, 0.5, 0.0) - A @ x)


def cycling() -> Iterator[Case]:
    """Yield P-matrices on which Newton's method with the minimum map goes round in circles, and those that take pivots 2^n steps."""
    case = partial(given, "P-matrices")
    robust = ("minimum-map-newton", "fischer-newton", "lemke")
    for n in (3, 4, 5, 6, 7, 9, 12, 30):
        yield from case(f"cyclic, {n} unknowns", partial(circulant, n), robust)
        for start in ("first", "alternating"):
            x0 = np.zeros(n)
            x0[:: n if start == "first" else 2] = 1.0
            yield from case(f"cyclic, {n} unknowns, {start} start", partial(circulant, n), ("minimum-map-newton",), x0=x0)
    for n in (8, 16):
        yield from case(
            f"Murty's, {n} unknowns", partial(murty, n), ("minimum-map-newton", "lemke"), but={"lemke": same(EITHER)} if n > 8 else {}
        )
        yield from case(
            f"Fathi's, {n} unknowns",
            partial(fathi, n),
            ("minimum-map-newton", "incremental-pivoting", "lemke"),
            promises={"single": EITHER},
        )
    for seed in range(4):
        yield from case(f"unsymmetric, random {seed}", partial(unsymmetric, seed), robust)


def circulant(n: int) -> MatrixProblem:
    """Return I plus a cyclic shift by 2 where n is odd, 0.9 where it is even: P-matrices [Ben Gharbia & Gilbert 2012], b < 0."""
    a = 2.0 if n % 2 else 0.9
    return MatrixProblem(matrix=np.eye(n) + a * np.roll(np.eye(n), 1, axis=1), b=-np.ones(n))


def murty(n: int) -> MatrixProblem:
    """Return Murty's triangular P-matrix, 1 on the diagonal and 2 below, on which principal pivoting visits 2^n bases."""
    return MatrixProblem(matrix=np.eye(n) + 2 * np.tril(np.ones((n, n)), -1), b=-np.ones(n))


def fathi(n: int) -> MatrixProblem:
    """Return the symmetric positive definite M M' of Murty's M."""
    M = murty(n).matrix
    return MatrixProblem(matrix=M @ M.T, b=-np.ones(n))


def unsymmetric(seed: int) -> MatrixProblem:
    """Return a P-matrix with a positive definite symmetric part and a large skew one."""
    chance = np.random.default_rng(SEED + 30 + seed)
    B, C = chance.standard_normal((2, N, N))
    return MatrixProblem(matrix=B @ B.T / N + np.eye(N) + 2 * (C - C.T) / np.sqrt(N), b=chance.standard_normal(N))
