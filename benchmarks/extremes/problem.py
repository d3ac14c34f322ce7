"""Hostile problems as NumPy arrays, and their solvability.

Both the library's problem and the independent residual are made from the same arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypedDict

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import warp as wp

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.benchmarks.extremes.exact import ExactEquations, stencil
from warp_lcp.files import Tables, TableView
from warp_lcp.host_problem import Matrix

BALANCED = 1e-10  # share of sum |b|: a sum of b below it is 0 up to rounding
# Share of the mean |b| that is added to a pool's b if its sum has the sign that no bound can
# balance.
GENTLY = 0.01


class GridFields(TypedDict, total=False):
    """Arguments of `GridProblem` besides its cells."""

    b: np.ndarray
    lower: float | np.ndarray
    upper: float | np.ndarray
    faces: TableView
    shift: float | np.ndarray | None
    periodic: tuple[bool, ...]
    columns: np.ndarray | None
    weights: np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class GridProblem:
    """Grid problem: cells, face coefficients, bounds, optional rigid bodies U W U'."""

    cells: np.ndarray  # AIR, FLUID, SOLID, shape (nz, ny, nx) or (ny, nx)
    b: np.ndarray  # field of the shape of `cells`
    lower: float | np.ndarray = 0.0  # number or field
    upper: float | np.ndarray = np.inf  # number or field
    faces: TableView = field(default_factory=dict)  # `face_x` and so on, numbers or arrays
    shift: float | np.ndarray | None = None  # None, number or field
    periodic: tuple[bool, ...] = (False, False, False)  # whether x, y, z wrap around
    columns: np.ndarray | None = None  # U, shape of `cells` and (k,); none if None
    weights: np.ndarray | None = None  # W, shape (k, k)

    def lcp(self, device: str, storage: type) -> wl.LCP:
        """Return the problem for the library.

        `storage` is the type of coefficients, wp.float32 or wp.float64.
        """
        A: wl.GridPoisson | wl.SumOperator = wl.GridPoisson(
            self.cells,
            shift=self.shift,
            periodic=self.periodic,
            device=device,
            dtype=storage,
            **self.faces,
        )
        if self.columns is not None:
            A = wl.SumOperator(A, wl.LowRankOperator(self.columns, self.weights, device=device))
        return wl.LCP(A, self.b, self.lower, self.upper)

    def exact(self) -> ExactEquations:
        """Return the problem for the independent residual."""
        matrix, fluid = stencil(self.cells, self.faces, self.shift, self.periodic)
        b, lower, upper = (
            np.broadcast_to(f, self.cells.shape).ravel()[fluid].astype(np.float64)
            for f in (self.b, self.lower, self.upper)
        )
        U = (
            None
            if self.columns is None
            else self.columns.reshape(-1, self.columns.shape[-1])[fluid]
        )
        return ExactEquations(matrix, b, lower, upper, U, self.weights)

    def unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns of a field x, shape (n,), float64."""
        return x.astype(np.float64).ravel()[self.cells.ravel() == wl.FLUID]

    def rounded(self, storage: type) -> bool:
        """Return whether `storage` rounds the coefficients: arrays or unequal numbers."""
        faces = [self.faces.get(f"face_{axis}", 1.0) for axis in "xyz"[: self.cells.ndim]]
        uneven = (
            self.shift is not None
            or any(np.ndim(f) > 0 for f in faces)
            or len({float(f) for f in faces}) > 1
        )
        return uneven and storage is not wp.float64


@dataclass(frozen=True, kw_only=True)
class MatrixProblem:
    """Dense or sparse matrix problem with bounds."""

    matrix: Matrix
    b: np.ndarray
    lower: float | np.ndarray = 0.0
    upper: float | np.ndarray = np.inf

    @staticmethod
    def of(problem: gallery.Problem | ExactEquations) -> MatrixProblem:
        """Return a problem of the gallery; one on a grid as GridProblem."""
        matrix = problem.matrix if isinstance(problem, ExactEquations) else problem.A
        lower, upper = problem.lower, problem.upper
        assert not isinstance(matrix, wl.GridPoisson)
        assert isinstance(lower, np.ndarray) and isinstance(upper, np.ndarray)
        return MatrixProblem(matrix=matrix, b=problem.b, lower=lower, upper=upper)

    def lcp(self, device: str, storage: type) -> wl.LCP:
        """Return the problem for the library."""
        kind = wl.SparseOperator if scipy.sparse.issparse(self.matrix) else wl.DenseOperator
        return wl.LCP(
            kind(self.matrix, device=device, dtype=storage), self.b, self.lower, self.upper
        )

    def exact(self) -> ExactEquations:
        """Return the problem for the independent residual."""
        lower, upper = (
            np.broadcast_to(f, self.b.shape).astype(np.float64) for f in (self.lower, self.upper)
        )
        return ExactEquations(
            scipy.sparse.csr_array(self.matrix, dtype=np.float64),
            self.b.astype(np.float64),
            lower,
            upper,
        )

    def unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return x."""
        return x.astype(np.float64).ravel()

    def rounded(self, storage: type) -> bool:
        """Return whether entries are rounded."""
        return storage is wp.float32


Problem = GridProblem | MatrixProblem


def faces_of(shape: tuple[int, ...], value: Callable[[tuple[int, ...]], np.ndarray]) -> Tables:
    """Return arrays of face coefficients; `value` maps an array's shape to its values."""
    axes = list(zip("xyz", range(len(shape))[::-1], strict=False))
    return {
        f"face_{name}": value(tuple(n + (q == axis) for q, n in enumerate(shape)))
        for name, axis in axes
    }


def with_solution(cells: np.ndarray, x: np.ndarray, y: np.ndarray) -> GridProblem:
    """Return a problem with p >= 0 and solution x on FLUID cells, A x + b = y."""
    problem, inside = GridProblem(cells=cells, b=np.zeros(cells.shape)), cells == wl.FLUID
    problem.b[inside] = y[inside] - problem.exact().matrix @ x[inside]
    return problem


@dataclass(frozen=True)
class ProblemComponents:
    """Connected components of the unknowns, and their solvability.

    A pool is loose if no AIR, shift or bound holds it.
    """

    label: np.ndarray  # pool of each unknown
    loose: np.ndarray  # whether a pool's constants are in the null space, by pool
    net: np.ndarray  # sum of b, by pool; 0 if within rounding
    size: np.ndarray  # sum of |b|, by pool
    cells: np.ndarray  # unknowns, by pool
    below: np.ndarray  # whether one of a pool's lower bounds is finite
    above: np.ndarray  # whether one of its upper bounds is

    @staticmethod
    def of(exact: ExactEquations) -> ProblemComponents:
        """Return the pools of a symmetric problem whose off-diagonal entries are <= 0."""
        count, label = scipy.sparse.csgraph.connected_components(exact.matrix != 0, directed=False)
        tied = np.asarray(exact.matrix.sum(axis=1)).ravel() > 1e-12 * exact.matrix.diagonal()
        at_bound, below, above = (
            np.bincount(label, v, count) > 0
            for v in (tied, np.isfinite(exact.lower), np.isfinite(exact.upper))
        )
        net, size = (np.bincount(label, v, count) for v in (exact.b, np.abs(exact.b)))
        net = np.where(np.abs(net) <= BALANCED * size, 0.0, net)
        return ProblemComponents(
            label, ~at_bound, net, size, np.bincount(label, minlength=count), below, above
        )

    @property
    def lost(self) -> np.ndarray:
        """Pools without a solution: constants lower the energy without bound."""
        return self.loose & (((self.net > 0) & ~self.below) | ((self.net < 0) & ~self.above))


def solvable(problem: GridProblem) -> GridProblem:
    """Return the problem with b changed so that every pool has a solution.

    On pools without a solution, b moves by the least amount that gives them one, and a little more.
    """
    pools = ProblemComponents.of(problem.exact())
    # If the sum is 0, a solution barely exists. Where only one bound exists, b moves towards the
    # sign that the bound can balance.
    moved = pools.lost | (pools.loose & (pools.net == 0) & (pools.below ^ pools.above))
    taken_up = pools.below.astype(float) - pools.above
    shift = np.where(
        moved, (taken_up * GENTLY * (pools.size + (pools.size == 0)) - pools.net) / pools.cells, 0.0
    )
    b = np.where(problem.cells == wl.FLUID, problem.b, 0.0)
    b[problem.cells == wl.FLUID] += shift[pools.label]
    return replace(problem, b=b)


def equality(problem: GridProblem) -> GridProblem | None:
    """Return the problem without bounds; None if it has no solution.

    If b = 0 on all FLUID cells, which makes it trivial, b is replaced by a constant.
    """
    b = problem.b if np.any(problem.b[problem.cells == wl.FLUID]) else -np.ones(problem.cells.shape)
    free = replace(problem, b=b, lower=-np.inf, upper=np.inf)
    return None if ProblemComponents.of(free.exact()).lost.any() else free
