"""Dense and banded random matrices of known definiteness, and P-matrices.

On the P-matrices of `period_three` plain Newton methods cycle.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from warp_lcp.gallery.planted import PlantedSolution, planted
from warp_lcp.host_problem import M_MATRIX, Problem


def spectrum_matrix(eigenvalues: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return Q diag(eigenvalues) Q' with a random orthogonal Q, exactly symmetric."""
    n = len(eigenvalues)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = (Q * eigenvalues) @ Q.T
    return 0.5 * (A + A.T)


def definite(
    n: int, *, condition: float = 100.0, plant: PlantedSolution | None = None, seed: int = 2015
) -> Problem:
    """Return a planted problem with a dense symmetric positive definite matrix.

    Args:
        n: number of unknowns.
        condition: largest over smallest eigenvalue, >= 1; they are spaced evenly on a logarithmic
            scale, the largest is 1.
        plant: settings of the solution.
        seed: seed of all random numbers.

    Raises:
        ValueError: n < 1 or condition < 1.
    """
    if not condition >= 1:
        raise ValueError(f"condition = {condition}: must be >= 1")
    rng = np.random.default_rng(seed)
    A = spectrum_matrix(np.geomspace(1 / condition, 1, n), rng)
    return planted(
        A,
        rng,
        plant or PlantedSolution(),
        name=f"definite {n}, condition {condition:g}",
        facts=M_MATRIX - {"m-matrix"},
    )


def semidefinite(
    n: int, *, zeros: float = 0.5, plant: PlantedSolution | None = None, seed: int = 2015
) -> Problem:
    """Return a planted problem with a dense semidefinite matrix.

    B B' of rank n - zeros n, symmetric; planted, hence solvable. y is the same for all solutions, x
    need not be.

    Args:
        n: number of unknowns.
        zeros: share of zero eigenvalues, in [0, 1).
        plant: settings of the solution.
        seed: seed of all random numbers.

    Raises:
        ValueError: zeros is outside [0, 1).
    """
    if not 0 <= zeros < 1:
        raise ValueError(f"zeros = {zeros}: must be in [0, 1)")
    rng = np.random.default_rng(seed)
    rank = n - round(zeros * n)
    B = rng.standard_normal((n, max(rank, 1))) / np.sqrt(n)
    facts = {"symmetric", "semidefinite", "positive-diagonal"} | (
        {"positive-definite", "p-matrix"} if rank == n else set()
    )
    return planted(
        B @ B.T,
        rng,
        plant or PlantedSolution(),
        name=f"semidefinite {n}, {zeros:.0%} zeros",
        facts=frozenset(facts),
    )


def skewed(
    n: int, *, skew: float = 1.0, plant: PlantedSolution | None = None, seed: int = 2015
) -> Problem:
    """Return a planted problem with an unsymmetric positive definite matrix.

    A P-matrix B B' + I/2 + skew (C - C').

    Args:
        n: number of unknowns.
        skew: size of the skew part's entries relative to 1 / sqrt(n).
        plant: settings of the solution.
        seed: seed of all random numbers.
    """
    rng = np.random.default_rng(seed)
    B, C = (rng.standard_normal((n, n)) / np.sqrt(n) for _ in range(2))
    facts = frozenset({"positive-definite", "p-matrix", "positive-diagonal"})
    return planted(
        B @ B.T + 0.5 * np.eye(n) + skew * (C - C.T),
        rng,
        plant or PlantedSolution(),
        name=f"skewed {n}",
        facts=facts,
    )


def period_three(
    blocks: int = 1, *, plant: PlantedSolution | None = None, seed: int | None = None
) -> Problem:
    """Return P-matrices on which the minimum-map Newton method cycles.

    Size 3; from some starts the period is 3 (Ben Gharbia, Gilbert). Each block is [[1, 0, a], [a,
    1, 0], [0, a, 1]], whose principal minors are 1, 1 and 1 + a^3. Without a plant b = -1.

    Args:
        blocks: number of blocks, each with its own a in [1.5, 4.5], and with rows and columns
            scaled by positive numbers; with seed=None one block with a = 4, unscaled.
        plant: settings of the solution; b = -1 if None.
        seed: seed of all random numbers.

    Raises:
        ValueError: blocks < 1.
    """
    if blocks < 1:
        raise ValueError(f"blocks = {blocks}: must be >= 1")
    rng = np.random.default_rng(seed if seed is not None else 2015)
    A = np.zeros((3 * blocks, 3 * blocks))
    for k in range(blocks):
        a = 4.0 if seed is None else rng.uniform(1.5, 4.5)
        block = np.eye(3) + a * np.roll(np.eye(3), 1, axis=0)
        if seed is not None:
            block = rng.uniform(0.5, 2, 3)[:, None] * block * rng.uniform(0.5, 2, 3)
        A[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    facts, name = frozenset({"p-matrix", "positive-diagonal"}), f"period three, {blocks} blocks"
    if plant is not None:
        return planted(A, rng, plant, name=name, facts=facts)
    n = len(A)
    x = np.linalg.solve(A, np.ones(n)) if seed is None else None
    return Problem(
        name, A, -np.ones(n), np.zeros(n), np.full(n, np.inf), x, facts | {"solvable", "unique"}
    )


def banded_matrix(n: int, bands: int, rng: np.random.Generator) -> scipy.sparse.csr_array:
    """Return the identity plus random constant off-diagonals, made positive definite.

    `bands` off-diagonals -U(0, 1) on each side; shifted by (0.5 - lambda_min) I if not positive
    definite.
    """
    values = -rng.random(bands)
    diagonals = [np.ones(n), *(np.full(n, v) for v in values)]
    lowest = float(
        scipy.linalg.eigvals_banded(
            np.stack(diagonals), lower=True, select="i", select_range=(0, 0)
        )[0]
    )
    shift = 0.0 if lowest > 0 else 0.5 - lowest
    offsets = [0, *(k for d in range(1, bands + 1) for k in (-d, d))]
    entries = [1.0 + shift, *(v for v in values for _ in (0, 1))]
    return scipy.sparse.diags_array(entries, offsets=offsets, shape=(n, n)).tocsr()


def banded(
    n: int, *, bands: int = 3, plant: PlantedSolution | None = None, seed: int = 2015
) -> Problem:
    """Return a planted problem with a random banded matrix.

    A symmetric positive definite M-matrix.

    Args:
        n: number of unknowns.
        bands: off-diagonals on each side, < n.
        plant: settings of the solution.
        seed: seed of all random numbers.

    Raises:
        ValueError: n or bands is out of range.
    """
    if not 0 <= bands < n:
        raise ValueError(f"bands = {bands}: must be in [0, n - 1] with n = {n}")
    rng = np.random.default_rng(seed)
    return planted(
        banded_matrix(n, bands, rng),
        rng,
        plant or PlantedSolution(),
        name=f"banded {n}, {bands} bands",
        facts=M_MATRIX,
    )
