"""A small problem as arrays on the host: what the direct methods, which factorize blocks of A, work on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import SolveStatus
from warp_lcp.solve import IterateInPlace, Precision, Step


@dataclass(frozen=True)
class DenseProblem:
    """A problem's unknowns alone, float64.

    Attributes:
        rows: index of each unknown in a stored field, shape (n,).
        A: matrix, shape (n, n); scipy.sparse if it was read so.
        b: shape (n,), units of y.
        lower: l, shape (n,).
        upper: u, shape (n,).
    """

    rows: np.ndarray
    A: Any
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def read(cls, problem: LCP, *, keep_sparse: bool = False) -> DenseProblem:
        """Copy a problem's data as they are now to the host."""
        problem.bounds.refresh()
        rows = np.flatnonzero(problem.unknown.numpy() == 1)
        fields = (field.numpy()[rows].astype(np.float64) for field in (problem.b, *(problem.bounds.as_field(k) for k in (0, 1))))
        sparse = sparse_matrix(problem) if keep_sparse else None
        return cls(rows, assemble(problem, rows) if sparse is None else sparse, *fields)

    def affine(self, x: np.ndarray) -> np.ndarray:
        """Return y = A x + b."""
        return self.A @ x + self.b

    def rounding(self, x: np.ndarray) -> np.ndarray:
        """Return |A| |x| + |b|, whose product with eps is what rounding leaves of y."""
        return np.abs(self.A) @ np.abs(x) + np.abs(self.b)


def sparse_matrix(problem: LCP) -> scipy.sparse.csr_array | None:
    """Return the matrix of a sparse operator, None for other operators."""
    matrix = getattr(problem.A, "matrix", None)
    found: Any = matrix() if callable(matrix) else None
    return found.astype(np.float64) if scipy.sparse.issparse(found) else None


def assemble(problem: LCP, rows: np.ndarray) -> np.ndarray:
    """Return A between the unknowns `rows`, shape (n, n), float64: a copy of a dense operator's, else column by column."""
    if isinstance(problem.A, DenseOperator):
        return problem.A.matrix.numpy().astype(np.float64)[np.ix_(rows, rows)]
    sparse = sparse_matrix(problem)
    if sparse is not None:
        return sparse.toarray()[np.ix_(rows, rows)]
    layout, A = problem.layout, problem.A
    unit, image = layout.zeros(wp.float64), layout.zeros(wp.float64)
    host, matrix = np.zeros(layout.size), np.empty((len(rows), len(rows)))
    for column, row in enumerate(rows):
        host[row] = 1.0
        unit.assign(host)
        A.apply(unit.reshape(layout.stored_shape), image.reshape(layout.stored_shape))
        matrix[:, column] = image.numpy()[rows]
        host[row] = 0.0
    return matrix


def check_size(problem: LCP, method: str, most: int) -> int:
    """Return the number of unknowns.

    Raises:
        ValueError: there are more than `most`.
    """
    n = int(np.count_nonzero(problem.unknown.numpy() == 1))
    if n > most:
        raise ValueError(f"A has {n} unknowns: {method} is a dense method for at most {most}; larger problems need an iterative method")
    return n


class DenseWorkspace(IterateInPlace):
    """Memory of a method that works on a DenseProblem and writes its iterate back.

    Attributes:
        data: the problem on the host, read when a solve starts.
        ended: the status with which the method gives up if the iterate does not meet the criteria; None while it goes on.
    """

    precision = Precision.DOUBLE

    def __init__(self, problem: LCP) -> None:
        self.problem = problem
        self.x = problem.layout.zeros(wp.float64)
        self.residual = NaturalResidual(problem)
        self.floating: Any = None
        self.data: DenseProblem = None  # type: ignore[assignment]
        self.ended: SolveStatus | None = None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the problem as it is now."""
        self.data, self.ended = self.read(), None

    def read(self) -> DenseProblem:
        """Copy the problem to the host."""
        return DenseProblem.read(self.problem)

    def round_iterate(self) -> None:
        """The iterate is float64."""

    def read_iterate(self) -> np.ndarray:
        """Return the iterate's unknowns, shape (n,)."""
        return self.x.numpy()[self.data.rows].copy()

    def write_iterate(self, values: np.ndarray) -> None:
        """Set the iterate's unknowns, shape (n,), projected onto the bounds."""
        stored = self.x.numpy().copy()
        stored[self.data.rows] = np.clip(values, self.data.lower, self.data.upper)
        self.x.assign(stored)

    def result(self, name: str, pivots: int, active: int | None) -> Step:
        """Return what a step did: interim while the method goes on."""
        return Step(name, pivots, active, self.ended, interim=self.ended is None)


def pivots_of(setting: int | None, n: int) -> int:
    """Return how many pivots a step makes: the setting, or n / 8, so that 100 steps are 12 n pivots, and never less than 2."""
    return setting if setting is not None else max(2, n // 8)
