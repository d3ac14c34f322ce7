"""A small problem as arrays on the host: what the direct methods, which factorize blocks of A, work on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

from warp_lcp.deadline import check_time, seconds_left
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasRows, has
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.scale import scale_of_matrix, scaled, sizes_of_matrix
from warp_lcp.problem.solve import IterateMemory, Precision, Step

SEMIDEFINITE = 1e-10  # shift with which an equilibrated semi-definite matrix must have a Cholesky factor
PROVABLE = 250_000  # entries of A up to which a linear program is asked whether there is a solution: seconds
EQUILIBRATIONS = 8  # sweeps of Ruiz's iteration, which halves the logarithms of rows that differ
SINGULAR = 1e-13  # of the matrix's largest row sum: a pivot below it is rounding
RANK = 1e-12  # singular values below this part of the largest are zero to least-squares solutions (methods.md: all solved with it)


@dataclass(frozen=True)
class DenseProblem:
    """A problem's unknowns alone, float64.

    Attributes:
        rows: index of each unknown in a stored field, shape (n,).
        A: matrix, shape (n, n); scipy.sparse if it was read so.
        b: shape (n,), units of y.
        lower: l, shape (n,).
        upper: u, shape (n,).
        symmetric: whether A is, and is to stay so in other units.
    """

    rows: np.ndarray
    A: Any
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    symmetric: bool = True

    @classmethod
    def read(cls, problem: LCP, *, keep_sparse: bool = False) -> DenseProblem:
        """Copy a problem's data as they are now to the host."""
        problem.bounds.refresh()
        rows = np.flatnonzero(problem.unknown.numpy() == 1)
        b, lower, upper = (f.numpy()[rows].astype(np.float64) for f in (problem.b, *(problem.bounds.as_field(k) for k in (0, 1))))
        sparse = sparse_matrix(problem) if keep_sparse else None
        return cls(rows, assemble(problem, rows) if sparse is None else sparse, b, lower, upper, problem.A.symmetric)

    def affine(self, x: np.ndarray) -> np.ndarray:
        """Return y = A x + b."""
        return self.A @ x + self.b

    def scaled(self) -> tuple[DenseProblem, np.ndarray]:
        """Return the problem in units in which A's rows and columns have entries near 1, and b too, and those units of x.

        With x = beta C x', y = beta R^-1 y' it is R A C, R b / beta and l / (beta C), u / (beta C), of which methods that pivot choose the
        same pivots but for ties; R = C where A is symmetric. The units are powers of 2, so that nothing is rounded.
        """
        R, C = self._units()
        b, start = R * self.b, R * (self.A @ np.clip(0.0, self.lower, self.upper))
        beta = power_of_two(max(np.abs(b).max(), np.abs(start).max()) or 1.0)
        units = beta * C
        with np.errstate(over="ignore"):  # a bound beyond all numbers in these units is infinite
            sides = self.lower / units, self.upper / units
        return DenseProblem(self.rows, scaled(self.A, R, C), b / beta, *sides, self.symmetric), units

    def _units(self) -> tuple[np.ndarray, np.ndarray]:
        """Return R and C of `scaled`, powers of 2."""
        if not self.symmetric:
            return unit_rows_and_columns(self.A)
        S = equilibration(self.A)
        return S, S

    @cached_property
    def _scale(self) -> np.ndarray:
        return scale_of_matrix(self.A)

    def residual(self, x: np.ndarray) -> float:
        """Return the norm of the natural residual."""
        d = self._scale
        return float(np.linalg.norm(d * (x - np.clip(x - self.affine(x) / d, self.lower, self.upper))))

    def polished(self, x: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return x after two Newton steps on the unknowns `free` for y = 0 there; x itself where that is no improvement.

        Args:
            x: within the bounds, shape (n,).
            free: shape (n,), bool.
        """
        rows, out = np.flatnonzero(free), x.copy()
        block: Any = self.A[np.ix_(rows, rows)] if len(rows) else None
        for _ in range(2 if len(rows) else 0):
            y = self.affine(out)[rows]
            out[rows] -= scipy.sparse.linalg.lsmr(block, y, atol=0.0, btol=0.0)[0] if scipy.sparse.issparse(block) else _solved(block, y)
        out = np.clip(out, self.lower, self.upper)
        return out if np.isfinite(out).all() and self.residual(out) < self.residual(x) else x


def sparse_matrix(problem: LCP) -> scipy.sparse.csr_array | None:
    """Return the matrix of an operator that has sparse rows, None for other operators."""
    matrix = problem.A.rows().matrix() if has(problem.A, HasRows) else None
    return matrix if scipy.sparse.issparse(matrix) else None


def assemble(problem: LCP, rows: np.ndarray) -> np.ndarray:
    """Return A between the unknowns `rows`, shape (n, n), float64: copied where there are rows, else column by column."""
    if has(problem.A, HasRows):
        whole = problem.A.rows().matrix()
        return (whole.toarray() if scipy.sparse.issparse(whole) else whole)[np.ix_(rows, rows)]
    layout = problem.layout
    unit, image, zero = (layout.zeros(wp.float64) for _ in range(3))
    host, matrix = np.zeros(layout.size), np.empty((len(rows), len(rows)))
    for column, row in enumerate(rows):
        check_time()
        host[row] = 1.0
        unit.assign(host)
        problem.apply_plus(unit, zero, image)
        matrix[:, column] = image.numpy()[rows]
        host[row] = 0.0
    return matrix


def power_of_two(value: Any) -> Any:
    """Return the nearest power of 2, on a logarithmic scale; 1 for 0."""
    return 2.0 ** np.round(np.log2(np.where(value > 0, value, 1.0)))


def unit_rows_and_columns(A: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return R and C > 0, powers of 2, so that R A C has a largest entry near 1 in each row and in each column, or its diagonal near 1."""
    _, rows, columns = sizes_of_matrix(A)
    return power_of_two(1 / rows), power_of_two(1 / columns)


def equilibration(A: Any) -> np.ndarray:
    """Return S > 0 so that S A S has a largest entry near 1 in each row and column together (Ruiz's iteration, kept symmetric)."""
    magnitude, S = abs(A), np.ones(A.shape[0])
    sparse = scipy.sparse.issparse(A)
    for _ in range(EQUILIBRATIONS):
        check_time()
        scaled = magnitude.multiply(S[:, None]).multiply(S).tocsr() if sparse else S[:, None] * magnitude * S
        rows, columns = (scaled.max(axis=k).toarray().ravel() if sparse else scaled.max(axis=k) for k in (1, 0))
        S = S * power_of_two(1 / np.sqrt(np.where(np.maximum(rows, columns) > 0, np.maximum(rows, columns), 1.0)))
    return S


def factored(block: np.ndarray, r: np.ndarray) -> np.ndarray | None:
    """Return block^-1 r, None where a pivot is so small that the block looks singular."""
    factors, pivots, info = scipy.linalg.lapack.dgetrf(block)
    if info != 0 or np.abs(factors.diagonal()).min() <= SINGULAR * np.abs(block).sum(axis=1).max():
        return None
    return scipy.linalg.lapack.dgetrs(factors, pivots, r)[0]


def _solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return A^-1 r, the least-squares solution where A is singular."""
    try:
        return np.linalg.solve(A, r)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(A, r, rcond=RANK)[0]


def semidefinite(A: np.ndarray) -> bool:
    """Return whether A + A' is positive semi-definite, by the Cholesky factor of A slightly shifted."""
    S = equilibration(A)
    scaled = S[:, None] * A * S
    try:
        scipy.linalg.cholesky((scaled + scaled.T) / 2 + SEMIDEFINITE * np.eye(len(A)), overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return False
    return True


def inconsistent(data: DenseProblem) -> bool:
    """Return whether no x within its bounds gives every y a sign that its bounds allow, so that no solution exists (a linear program).

    For a positive semi-definite A, symmetric or not, such an x is also enough for a solution to exist.
    """
    from scipy.optimize import linprog  # a fifth of a second to import, and seldom needed

    data, _ = data.scaled()
    below, above = np.isfinite(data.lower), np.isfinite(data.upper)
    parts = {"ub": [(-1.0, below & ~above), (1.0, above & ~below)], "eq": [(1.0, ~below & ~above)]}
    stack = scipy.sparse.vstack if scipy.sparse.issparse(data.A) else np.vstack
    rows: dict[str, Any] = {}
    for name, pieces in parts.items():
        rows[f"A_{name}"] = stack([sign * data.A[mask] for sign, mask in pieces])
        rows[f"b_{name}"] = np.concatenate([-sign * data.b[mask] for sign, mask in pieces])
    limits = np.stack([data.lower, data.upper], axis=1)
    found = linprog(np.zeros(len(data.b)), **rows, bounds=limits, method="highs", options={"time_limit": seconds_left()})
    check_time()
    return bool(found.status == 2)  # HiGHS: infeasible


def proved_infeasible(problem: LCP) -> bool:
    """Return whether `inconsistent` says so of a dense or sparse problem; False where that would take long."""
    sparse = sparse_matrix(problem)
    entries = sparse.nnz if sparse is not None else problem.layout.size**2
    return entries <= PROVABLE and inconsistent(DenseProblem.read(problem, keep_sparse=True))


def check_size(problem: LCP, method: str, most: int) -> int:
    """Return the number of unknowns.

    Raises:
        ValueError: there are more than `most`.
    """
    n = int(np.count_nonzero(problem.unknown.numpy() == 1))
    if n > most:
        raise ValueError(f"A has {n} unknowns: {method} is a dense method for at most {most}; larger problems need an iterative method")
    return n


class DenseWorkspace(IterateMemory):
    """Memory of a method that works on a DenseProblem and writes its iterate back.

    Attributes:
        data: the problem on the host, read when a solve starts.
        ended: the status with which the method gives up if the iterate does not meet the criteria; None while it goes on.
    """

    def __init__(self, problem: LCP, precision: str = Precision.DOUBLE) -> None:
        super().__init__(problem, precision)
        self.data: DenseProblem = None  # type: ignore[assignment]
        self.ended: SolveStatus | None = None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the problem as it is now."""
        self.data, self.ended = self.read(), None

    def read(self) -> DenseProblem:
        """Copy the problem to the host."""
        return DenseProblem.read(self.problem)

    def read_iterate(self) -> np.ndarray:
        """Return the iterate's unknowns, shape (n,)."""
        return self.x.numpy()[self.data.rows].copy()

    def write_iterate(self, values: np.ndarray) -> None:
        """Set the iterate's unknowns, shape (n,), projected onto the bounds."""
        stored = self.x.numpy().copy()
        stored[self.data.rows] = np.clip(values, self.data.lower, self.data.upper)
        self.x.assign(stored)

    @property
    def held(self) -> int:
        """Number of unknowns at a bound."""
        x = self.read_iterate()
        return int(np.count_nonzero((x <= self.data.lower) | (x >= self.data.upper)))

    def result(self, name: str, pivots: int) -> Step:
        """Return what a step did: interim while the method goes on."""
        return Step(name, pivots, self.held, self.ended, interim=self.ended is None)


def pivots_of(setting: int | None, n: int) -> int:
    """Return how many pivots a step makes: the setting, or n / 8, so that 100 steps are 12 n pivots, and never less than 2."""
    return setting if setting is not None else max(2, n // 8)
