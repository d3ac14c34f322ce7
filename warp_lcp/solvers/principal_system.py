"""The linear system that all Newton-type methods share: (P A P + P D P) e = r on the free unknowns.

Grids take multigrid-preconditioned conjugate gradients, dense matrices a factorization, other symmetric operators conjugate gradients
preconditioned by the diagonal.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.multigrid.hierarchy import CycleSettings, Hierarchy
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_poisson import GridPoisson, mask_diagonal
from warp_lcp.problem import LCP
from warp_lcp.program import Launch, Program
from warp_lcp.solvers.principal_system_kernels import divide_kernel, mask_kernel


class PrincipalSystem(Protocol):
    """The system on a free set.

    Attributes:
        r: stored field; the right-hand side, zero off the free set, overwritten by `solve`.
        e: stored field; the solution, zero off the free set.
    """

    r: wp.array[Any]
    e: wp.array[Any]

    def refresh(self) -> None:
        """Take A's entries again after they changed in place."""

    def restrict(self, free: wp.array[Any]) -> None:
        """Take another free set (stored uint8 field)."""

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Solve to ||r|| <= tolerance; return iterations and the norm reached."""


class GridSystem:
    """Conjugate gradients on a grid, preconditioned by a linear multigrid cycle on the free set."""

    def __init__(self, A: GridPoisson, real: Any, *, bounded: bool, settings: CycleSettings | None = None) -> None:
        self._A = A
        self._version = A.version
        self.hierarchy = Hierarchy(A.stencil, real, bounded=bounded, settings=settings)
        self.r, self.z = self.hierarchy.finest.b, self.hierarchy.finest.x
        self._krylov = ConjugateGradient(self.hierarchy.finest.stencil.product, self)
        self.e = self._krylov.x

    def refresh(self) -> None:
        """Take the rows and the weights again if the operator has changed."""
        if self._version != self._A.version:
            self._version = self._A.version
            self.hierarchy.refresh()

    def restrict(self, free: wp.array[Any]) -> None:
        """Mask the finest diagonal and coarsen."""
        mask_diagonal(self._A.stencil.d, free, self.hierarchy.finest.stencil.d)
        self.hierarchy.rebuild()

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate."""
        return self._krylov.solve(tolerance, max_iterations)

    @property
    def program(self) -> Program:
        """Precondition: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Precondition."""
        self.program.run()

    def monotone_cycle(self) -> None:
        """One projected cycle on r within the finest level's bounds; the correction is `z`."""
        self.hierarchy.monotone_cycle.run()


class DenseSystem:
    """LU factors of the free block, on the host; the minimum-norm least-squares step where the block is singular."""

    def __init__(self, A: DenseOperator) -> None:
        self._A = A
        self.r, self.e = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
        self.refresh()

    def refresh(self) -> None:
        """Copy the matrix to the host."""
        self._matrix = self._A.matrix.numpy().astype(np.float64)

    def restrict(self, free: wp.array[Any]) -> None:
        """Remember the free set."""
        self._free = np.flatnonzero(free.numpy())

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Factor and solve."""
        free, r, e = self._free, self.r.numpy(), np.zeros(self.e.size)
        norm = 0.0
        if free.size:
            block = self._matrix[np.ix_(free, free)]
            e[free] = _solve_or_least_squares(block, r[free])
            norm = float(np.linalg.norm(block @ e[free] - r[free]))
        self.e.assign(e)
        return 1, norm


def _solve_or_least_squares(block: np.ndarray, r: np.ndarray) -> np.ndarray:
    factors, pivots, info = scipy.linalg.lapack.dgetrf(block)
    pivot = np.abs(np.diag(factors))
    if info != 0 or pivot.min() <= 1e-13 * pivot.max():
        return np.linalg.lstsq(block, r, rcond=1e-12)[0]
    return scipy.linalg.lapack.dgetrs(factors, pivots, r)[0]


class DiagonalSystem:
    """Conjugate gradients preconditioned by the diagonal, for any symmetric operator, in float64."""

    def __init__(self, problem: LCP) -> None:
        self._A, self._layout = problem.A, problem.layout
        self.r, self.z = self._layout.zeros(wp.float64), self._layout.zeros(wp.float64)
        self._krylov = ConjugateGradient(self._product, self)
        self.e = self._krylov.x
        self.refresh()

    def refresh(self) -> None:
        """Take the diagonal again."""
        self._d = self._layout.load(self._A.diagonal().numpy(), wp.float64)

    def restrict(self, free: wp.array[Any]) -> None:
        """Remember the free set."""
        self._free = free

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate."""
        return self._krylov.solve(tolerance, max_iterations)

    def apply(self) -> None:
        """Precondition: z = r / d."""
        wp.launch(divide_kernel, self.r.size, [self.r, self._d, self.z], device=self._layout.device)

    def _product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        shape = self._layout.stored_shape
        self._A.apply(p.reshape(shape), q.reshape(shape))
        wp.launch(mask_kernel, q.size, [self._free, q], device=self._layout.device)


def principal_system(problem: LCP, real: Any, *, bounded: bool, settings: CycleSettings | None = None) -> PrincipalSystem:
    """Return the system for a problem's operator.

    Raises:
        ValueError: the operator is not symmetric and not dense.
    """
    A = problem.A
    if isinstance(A, GridPoisson):
        return GridSystem(A, real, bounded=bounded, settings=settings)
    if isinstance(A, DenseOperator):
        return DenseSystem(A)
    if not A.symmetric:
        raise ValueError(
            f"{type(A).__name__} is not symmetric: conjugate gradients need a symmetric A (dense matrices are factored instead)"
        )
    return DiagonalSystem(problem)
