"""Problems of the gallery: host data, known solution and properties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.grid_poisson import FLUID, GridPoisson
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.affine_bounds import AffineBounds
from warp_lcp.problem.lcp import LCP

Matrix: TypeAlias = scipy.sparse.sparray | np.ndarray
"""Sparse or dense matrix on the host, shape (n, n)."""


FACTS = frozenset(
    {
        "symmetric",
        "positive-definite",  # x'Ax > 0, also for unsymmetric A
        "semidefinite",  # x'Ax >= 0
        "p-matrix",  # every principal minor is positive: one solution for every b
        "m-matrix",  # a P-matrix without positive entries off the diagonal
        "copositive",  # x'Ax >= 0 for x >= 0
        "positive-diagonal",
        "boxed",  # there are finite upper bounds
        "affine",  # bounds depend on x
        "mixed",  # there are rows without bounds
        "strict",  # the known solution is strictly complementary
        "unique",  # there is one solution
        "solvable",  # there is at least one solution
    }
)
# Facts of Laplacians.
M_MATRIX = frozenset(
    {"symmetric", "positive-definite", "p-matrix", "m-matrix", "positive-diagonal"}
)


@dataclass(frozen=True, eq=False)
class Problem:
    """Test problem: y = A x + b, lower <= x <= upper.

    Args:
        name: name, with its parameters.
        A: a GridPoisson, a scipy.sparse matrix or a numpy array.
        b: field of A's shape; 0 where a grid has no unknown.
        lower: l, a field like b, or AffineBounds.
        upper: u, likewise.
        solution: a solution, a field like b; None if unknown.
        facts: properties, members of FACTS.

    Raises:
        ValueError: a fact is no member of FACTS.
    """

    name: str
    A: GridPoisson | Matrix
    b: np.ndarray
    lower: np.ndarray | AffineBounds
    upper: np.ndarray | AffineBounds
    solution: np.ndarray | None
    facts: frozenset[str]

    def __post_init__(self) -> None:
        """Check that all facts are members of FACTS."""
        unknown = sorted(self.facts - FACTS)
        if unknown:
            raise ValueError(f"facts holds {unknown}: allowed are {sorted(FACTS)}")

    @property
    def grid(self) -> GridPoisson:
        """The operator of a problem on a grid.

        Raises:
            TypeError: the problem has a matrix.
        """
        if not isinstance(self.A, GridPoisson):
            raise TypeError(f"{self.name} has a matrix, not a grid")
        return self.A

    @property
    def kind(self) -> str:
        """Family of the operator: "grid", "sparse" or "dense"."""
        if isinstance(self.A, GridPoisson):
            return "grid"
        return "sparse" if scipy.sparse.issparse(self.A) else "dense"

    def lcp(self, *, device: wp.DeviceLike = None, dtype: type = wp.float64) -> LCP:
        """Return the problem as an LCP for a solver.

        The operator of a grid already has its device and type.

        Args:
            device: Warp device of a matrix; the default device if None.
            dtype: storage type of a matrix.
        """
        make = {
            "grid": lambda: self.A,
            "sparse": lambda: SparseOperator(self.A, device=device, dtype=dtype),
        }
        A = make.get(self.kind, lambda: DenseOperator(self.A, device=device, dtype=dtype))()
        return LCP(A, self.b, _number_or_field(self.lower), _number_or_field(self.upper))

    def energy(self, x: np.ndarray | DeviceArray) -> float:
        """Return the energy x'A x / 2 + b'x in float64.

        A solution minimizes it within the bounds if A is symmetric.

        Args:
            x: a field like b, numpy or wp.array.
        """
        A, b = self.lcp(device="cpu").A, self.b
        host = np.asarray(x.numpy() if isinstance(x, wp.array) else x, dtype=np.float64)
        Ax = A.apply(wp.array(host, dtype=wp.float64, device=A.device)).numpy()
        return float((host * (Ax / 2 + b)).sum())

    def sparse(self) -> Problem:
        """Return the problem with a scipy.sparse matrix of the grid's FLUID cells.

        Rows have the order of the cells; a problem without a grid is returned unchanged.
        """
        if not isinstance(self.A, GridPoisson):
            return self
        rows = np.flatnonzero(self.A.cells.numpy()[1:-1, 1:-1, 1:-1].ravel() == FLUID)
        assert isinstance(self.lower, np.ndarray) and isinstance(self.upper, np.ndarray)
        b, lower, upper = (f.ravel()[rows] for f in (self.b, self.lower, self.upper))
        x = None if self.solution is None else self.solution.ravel()[rows]
        return Problem(
            f"{self.name} as sparse", grid_matrix(self.A), b, lower, upper, x, self.facts
        )

    def dense(self) -> Problem:
        """Return the problem with a numpy matrix; of a grid, only its FLUID cells."""
        if self.kind == "dense":
            return self
        p = self.sparse()
        assert not isinstance(p.A, GridPoisson | np.ndarray), "a sparse matrix"
        return Problem(
            f"{self.name} as dense", p.A.toarray(), p.b, p.lower, p.upper, p.solution, p.facts
        )


def _number_or_field(bound: np.ndarray | AffineBounds) -> float | np.ndarray | AffineBounds:
    """Return a constant bound as a number, for which methods are faster."""
    if isinstance(bound, AffineBounds):
        return bound
    first = float(bound.flat[0])
    return first if (bound == first).all() else bound
