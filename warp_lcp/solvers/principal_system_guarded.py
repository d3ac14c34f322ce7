"""Systems of grid operators whose geometric cycles may fail: algebraic multigrid, then factors, of the matrix take over."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg
import warp as wp

from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.protocol import FLUID, HasStencil
from warp_lcp.rows.fields import zeros_like
from warp_lcp.solvers.principal_system_sparse import IncompleteFactors, SparseSystem

REDUCED = 1e-2  # of a right-hand side: what any preconditioner worth its name comes to, whatever rounding leaves
ENOUGH = 60  # iterations by which it should


FACTORED_IN_PLANE, FACTORED_IN_SPACE = 1 << 17, 1 << 14  # unknowns up to which factors are complete: a second or two
RAISED = 1e-13  # share by which diagonals are raised then


class GuardedSystem(KrylovSystem):
    """A Krylov method on a grid, by whose own preconditioner first, and where that fails by the matrix's.

    A preconditioner fails if its solve stalls, or is cut off after `ENOUGH` iterations, before the residual is at the tolerance or
    `REDUCED`. What takes over stays until the operator changes.
    """

    _A: HasStencil
    _matrix: MatrixSystem | None = None
    _saved: wp.array[Any] | None = None
    _restriction: tuple[wp.array[Any], wp.array[Any] | None] | None = None  # the free set and the shift there are

    def _guard(self) -> None:
        """Take over where needed, from now on; not where other processes have parts of the grid."""
        self._saved = zeros_like(self.r) if self._A.stencil.ghosts is None else None

    def _note(self, free: wp.array[Any], shift: wp.array[Any] | None) -> None:
        """Remember the free set and the shift."""
        self._restriction = free, shift
        if self._matrix is not None:
            self._matrix.restrict(free, shift)

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from e = 0 until the norm is at most the tolerance; return iterations and the norm reached."""
        if self._saved is None or self._restriction is None:
            return super().solve(tolerance, max_iterations)
        done, start = 0, self.norm()
        if self._matrix is None:
            wp.copy(self._saved, self.r)
            done, norm = super().solve(tolerance, max_iterations)
            if norm <= max(tolerance, REDUCED * start) or ENOUGH > done >= max_iterations:
                return done, norm
            wp.copy(self.r, self._saved)
            self._matrix = MatrixSystem(self._A, shifted=self._weighted_by is not None)
            self._matrix.restrict(*self._restriction)
        iterations, norm = self._matrix.solve(self.r, self.e, tolerance, max_iterations)
        return done + iterations, norm


class MatrixSystem:
    """The systems of a grid operator's matrix, in double precision.

    Args:
        A: the operator.
        shifted: as of `PrincipalSystem`.
    """

    def __init__(self, A: HasStencil, *, shifted: bool) -> None:
        self._rows = np.flatnonzero(A.cells.numpy().ravel() == FLUID)
        self._most = FACTORED_IN_SPACE if A.stencil.padding.counts[0] > 1 else FACTORED_IN_PLANE
        self._operator, self._shifted = SparseOperator(grid_matrix(A), device=A.device, dtype=wp.float64), shifted
        self._system: KrylovSystem = SparseSystem(self._operator, wp.float64, shifted=shifted)
        self._preconditioner: Any = self._system.preconditioner

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None) -> None:
        """Take another free set and shift, stored fields of the grid."""
        device = self._operator.device
        self._free = wp.array(free.numpy()[self._rows], dtype=wp.uint8, device=device)
        self._shift = None if shift is None else wp.array(shift.numpy()[self._rows], dtype=wp.float64, device=device)
        self._preconditioner.restrict(self._free, self._shift)

    def solve(self, r: wp.array[Any], e: wp.array[Any], tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Solve for e, by factors from the first failure on; fields of the grid."""
        right = r.numpy()[self._rows].astype(np.float64)
        iterations, norm = self._solve(right, tolerance, max_iterations)
        if not norm <= max(tolerance, REDUCED * self._start) and not isinstance(self._preconditioner, IncompleteFactors):
            made = _CompleteFactors if len(self._rows) <= self._most else IncompleteFactors
            self._preconditioner = made(self._operator, wp.float64)
            self._preconditioner.restrict(self._free, self._shift)
            self._system = _Factored(self._preconditioner, weighted=self._shifted)
            more, norm = self._solve(right, tolerance, max_iterations)
            iterations += more
        stored = np.zeros(e.size, dtype=wp.dtype_to_numpy(e.dtype))
        stored[self._rows] = self._system.e.numpy()
        e.assign(stored)
        return iterations, norm

    def _solve(self, right: np.ndarray, tolerance: float, max_iterations: int) -> tuple[int, float]:
        self._system.r.assign(right)
        self._start = self._system.norm()
        return self._system.solve(tolerance, max_iterations)


class _CompleteFactors(IncompleteFactors):
    """Complete factors of matrices that others fail on; of slightly raised diagonals, for a component may be singular."""

    def _factor(self, block: Any) -> Any:
        try:
            return scipy.sparse.linalg.splu((block + RAISED * scipy.sparse.diags_array(np.abs(block.diagonal()))).tocsc()).solve
        except RuntimeError:
            return super()._factor(block)


class _Factored(KrylovSystem):
    """GMRES with factors."""

    def __init__(self, factors: IncompleteFactors, *, weighted: bool) -> None:
        weight = factors.weight if weighted else None
        self.r = factors.r
        self._iterate_by(GMRES(factors.product, factors, weight=weight), weight)
