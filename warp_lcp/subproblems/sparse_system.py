"""Principal systems of sparse matrices.

Systems whose preconditioner may fail are guarded: better factors then take over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

from warp_lcp.kernels.fields import zeros, zeros_like
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient, KrylovPreconditioner
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.multigrid.aggregates import suits_multigrid
from warp_lcp.multigrid.algebraic import AlgebraicHierarchy
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.operator_protocol import FLUID, HasStencil

# For symmetric matrices far from M-matrices: on plates of 60^2 and 120^2 0.55 times the iterations
# of the usual settings, .8 on elastic blocks.
FAR_FROM_M = partial(AlgebraicSettings, strength=0.08, interval=(0.05, 1.0))
# Share of a column below which entries of the factors are dropped, and the largest number of
# entries in units of A's.
DROP, FILL = 1e-4, 10.0
# Share of a row's largest entry; its multiples modulo 1 are all different.
NUDGE, GOLDEN = 1e-14, (math.sqrt(5) - 1) / 2
# Up to so many unknowns factors are complete: that costs less than the iterations it saves.
DIRECT = 2000
# Unknowns of a grid up to which factors are complete where cycles fail: a second or two.
FACTORED_IN_PLANE, FACTORED_IN_SPACE = 1 << 17, 1 << 14
RAISED = 1e-13  # relative increase of the diagonals of complete factors
# Of a right-hand side: any useful preconditioner reaches it, whatever rounding leaves.
REDUCED = 1e-2
ENOUGH = 60  # iterations within which it should reach that


class FallbackSystem(Protocol):
    """A system that takes over: the same matrix, with its own fields."""

    def restrict(self, free: DeviceArray, shift: DeviceArray | None) -> None:
        """Set another free set and shift."""

    def solve_for(
        self, r: DeviceArray, e: DeviceArray, tolerance: float, max_iterations: int
    ) -> tuple[int, float]:
        """Solve for e; return iterations and the norm reached."""


class GuardedSystem(KrylovSystem):
    """Krylov method whose preconditioner is replaced by another system if it fails.

    A preconditioner fails if its solve stalls, or is cut off after `ENOUGH` iterations, before the
    residual reaches the tolerance or `REDUCED`. The substitute stays until the operator changes.
    """

    _substitute: FallbackSystem | None = None
    _make_substitute: Callable[[], FallbackSystem] | None = None  # none: no substitute
    # The current free set and shift.
    _restriction: tuple[DeviceArray, DeviceArray | None] | None = None

    def _guard(self, substitute: Callable[[], FallbackSystem]) -> None:
        """Set the function that creates the substitute when it is needed."""
        self._saved, self._make_substitute = zeros_like(self.r), substitute

    def _note(self, free: DeviceArray, shift: DeviceArray | None) -> None:
        """Store the free set and the shift."""
        self._restriction = free, shift
        if self._substitute is not None:
            self._substitute.restrict(free, shift)

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from e = 0 until the norm is at most the tolerance.

        Returns the number of iterations and the norm reached.
        """
        if self._make_substitute is None or self._restriction is None:
            return super().solve(tolerance, max_iterations)
        done, start = 0, self.norm()
        if self._substitute is None:
            wp.copy(self._saved, self.r)
            done, norm = super().solve(tolerance, max_iterations)
            if norm <= max(tolerance, REDUCED * start) or ENOUGH > done >= max_iterations:
                return done, norm
            wp.copy(self.r, self._saved)
            self._substitute = self._make_substitute()
            self._substitute.restrict(*self._restriction)
        iterations, norm = self._substitute.solve_for(self.r, self.e, tolerance, max_iterations)
        return done + iterations, norm


class SparsePreconditioner(KrylovPreconditioner, Protocol):
    """An approximate inverse of M = P A P + P D P, and M itself."""

    weight: DeviceArray

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set a free set and a shift."""

    def product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        """Compute q = M p on the device."""


class SparseSystem(GuardedSystem):
    """Principal system (P A P + P D P) e = r of a sparse A.

    Symmetric matrices whose diagonal is not negative are solved by conjugate gradients with
    algebraic multigrid, which falls back on sweeps where nothing aggregates. Others are solved by
    GMRES. Its preconditioner is algebraic multigrid if most rows are diagonally dominant and nearly
    all off-diagonal entries are negative (convection-diffusion). Otherwise it is incomplete
    factors, which SciPy computes and applies on the host for each free set, for any device. On
    directed cycles, I - S with S nearly a permutation, multigrid fails, and factors take over.

    Args:
        A: the matrix.
        real: type of the corrections.
        shifted: as of `PrincipalSystem`.
        settings: of the hierarchy.
        substitute: creates the system that takes over where the hierarchy fails; None: factors, if
            A is not symmetric.

    Attributes:
        cycled: whether the preconditioner is algebraic multigrid: A is symmetric, or nearly an
            M-matrix.
    """

    def __init__(
        self,
        A: SparseOperator,
        real: DataType,
        *,
        shifted: bool = False,
        settings: AlgebraicSettings | None = None,
        substitute: Callable[[], FactoredSystem] | None = None,
    ) -> None:
        host = A.matrix()
        self._A, self._version, self._symmetric = A, A.version, A.symmetric
        positive = bool((host.diagonal() >= 0).all())
        self.preconditioner: SparsePreconditioner
        if (A.symmetric and positive) or suits_multigrid(host):
            usual = AlgebraicSettings if suits_multigrid(host) else FAR_FROM_M
            self.preconditioner = AlgebraicHierarchy(A, real, settings or usual())
        else:
            self.preconditioner = IncompleteFactors(A, real)
        M = self.preconditioner
        weight = M.weight if shifted else None
        method = ConjugateGradient if A.symmetric and positive else GMRES
        self.r = M.r
        self._iterate_by(method(M.product, M, weight=weight), weight)
        if substitute is None and not A.symmetric:
            substitute = partial(FactoredSystem.of, A, weighted=shifted)
        self.cycled = isinstance(M, AlgebraicHierarchy)
        if substitute is not None and self.cycled:
            self._guard(substitute)

    def refresh(self) -> None:
        """Reset the choice of the preconditioner if A has changed.

        `restrict` reads the entries.

        Raises:
            ValueError: A was symmetric and is not any more: this system's fields serve conjugate
                gradients.
        """
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None
            if self._symmetric and not self._A.symmetric:
                raise ValueError(
                    "A was updated from a symmetric to an unsymmetric matrix: make a new workspace"
                )

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set another free set and shift, and recompute the preconditioner."""
        if self._substitute is None:
            self.preconditioner.restrict(free, shift)
        self._note(free, shift)


class IncompleteFactors:
    """LU factors of the free block by SciPy, on the host.

    Incomplete factors for more than `DIRECT` unknowns.

    Args:
        A: the matrix.
        real: type of the corrections.
    """

    def __init__(self, A: SparseOperator, real: DataType) -> None:
        self._A = A
        self.r, self.z, self.weight = (zeros(A.unknowns, real, A.device) for _ in range(3))
        self._solve: Callable[[np.ndarray], np.ndarray] | None = None
        self._free = np.zeros(0, dtype=np.intp)

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Factor the free block, its diagonal nudged where a factor might be singular.

        With the diagonal 0-1 matrix F of the free set, M = F (A + diag(shift)) F. The weight is 1 /
        |m_ii| on free unknowns, 1 where m_ii = 0, and 0 on the others.
        """
        self._free = np.flatnonzero(free.numpy())
        matrix = self._A.matrix()
        if shift is not None:
            matrix = (matrix + scipy.sparse.diags_array(shift.numpy())).tocsr()
        mask = scipy.sparse.diags_array((free.numpy() != 0).astype(np.float64))
        self._M = (mask @ matrix @ mask).tocsr()
        diagonal = np.abs(self._M.diagonal())
        # A tiny entry in float32 overflows: the method detects that its iterate is not finite.
        with np.errstate(over="ignore"):
            self.weight.assign(
                np.where(free.numpy() != 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0)
            )
        self._solve = (
            self._factor(matrix[self._free][:, self._free].tocsc()) if self._free.size else None
        )

    def product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        """Compute q = M p on the host."""
        q.assign(self._M @ p.numpy())

    def apply(self) -> None:
        """Apply the preconditioner on the host: z = the factors' inverse times r."""
        z = np.zeros(self._A.unknowns)
        if self._solve is not None:
            z[self._free] = self._solve(self.r.numpy()[self._free].astype(np.float64))
        with np.errstate(over="ignore"):  # the method detects that its iterate is not finite
            self.z.assign(z)

    def _factor(self, block: scipy.sparse.csr_array) -> Callable[[np.ndarray], np.ndarray] | None:
        """Return a function that applies the factors' inverse.

        It is the identity where the factors are singular.
        """
        try:
            if block.shape[0] <= DIRECT:
                return scipy.sparse.linalg.splu(perturb_diagonal(block, NUDGE)).solve
            return scipy.sparse.linalg.spilu(
                perturb_diagonal(block, NUDGE, small=100 * DROP), drop_tol=DROP, fill_factor=FILL
            ).solve
        except RuntimeError:  # a factor is exactly singular after all
            return np.asarray


def perturb_diagonal(
    block: scipy.sparse.csr_array, share: float, *, small: float = 0.0
) -> scipy.sparse.csr_array:
    """Return a block without exactly singular factors.

    SuperLU, given those, writes to stderr, and may crash the process. A strictly diagonally
    dominant block is regular and stays unchanged. The diagonal of others grows by a share of each
    row's largest entry, a different one in each row, so that no two rows become equal.

    a_ii <- a_ii + sign(a_ii) share_i max_j |a_ij| with share_i = share (1 + (i GOLDEN mod 1)), for
    rows i = 0, 1, ...; the sign of 0 is 1.

    Args:
        block: square, in compressed columns.
        share: of a row's largest entry.
        small: the share where the diagonal entry itself is less than that: incomplete factors drop
            smaller ones.
    """
    magnitude, diagonal = abs(block), block.diagonal()
    off = np.asarray(magnitude.sum(axis=1)).ravel() - np.abs(diagonal)
    if (np.abs(diagonal) > (1 + 1e-12) * off).all():
        return block
    largest = magnitude.max(axis=1).toarray().ravel()
    largest = np.where(largest > 0, largest, 1.0)
    shares = np.where(np.abs(diagonal) <= small * largest, max(share, small), share) * (
        1 + np.arange(len(off)) * GOLDEN % 1
    )
    return (
        block + scipy.sparse.diags_array(np.where(diagonal < 0, -1.0, 1.0) * shares * largest)
    ).tocsc()


class CompleteFactors(IncompleteFactors):
    """Complete factors of matrices on which other preconditioners fail.

    Diagonals are slightly raised, because a component may be singular.
    """

    def _factor(self, block: scipy.sparse.csr_array) -> Callable[[np.ndarray], np.ndarray] | None:
        try:
            return scipy.sparse.linalg.splu(
                (block + RAISED * scipy.sparse.diags_array(np.abs(block.diagonal()))).tocsc()
            ).solve
        except RuntimeError:
            return super()._factor(block)


class FactoredSystem(KrylovSystem):
    """GMRES in double precision, preconditioned by factors.

    Args:
        factors: of the free block.
        weighted: whether residuals are measured in units of the shifted diagonal.
    """

    def __init__(self, factors: IncompleteFactors, *, weighted: bool) -> None:
        self._factors, self.r, weight = factors, factors.r, factors.weight if weighted else None
        self._iterate_by(GMRES(factors.product, factors, weight=weight), weight)

    @staticmethod
    def of(A: SparseOperator, *, weighted: bool, complete: int = 0) -> FactoredSystem:
        """Return the system of a matrix.

        Factors are complete for at most `complete` unknowns.
        """
        kind = CompleteFactors if A.unknowns <= complete else IncompleteFactors
        return FactoredSystem(kind(A, wp.float64), weighted=weighted)

    def restrict(self, free: DeviceArray, shift: DeviceArray | None) -> None:
        """Set another free set and shift, and factor."""
        self._factors.restrict(free, shift)

    def solve_for(
        self, r: DeviceArray, e: DeviceArray, tolerance: float, max_iterations: int
    ) -> tuple[int, float]:
        """Solve for e, a field like r of any precision."""
        self.r.assign(r.numpy().astype(np.float64))
        iterations, norm = self.solve(tolerance, max_iterations)
        e.assign(self.e.numpy().astype(wp.dtype_to_numpy(e.dtype)))
        return iterations, norm


class MatrixSystem:
    """Systems of a grid operator's matrix, in double precision.

    Solved by algebraic multigrid, then by factors.

    Args:
        A: the operator.
        shifted: as of `PrincipalSystem`.
    """

    def __init__(self, A: HasStencil, *, shifted: bool) -> None:
        self._rows = np.flatnonzero(A.cells.numpy().ravel() == FLUID)
        most = FACTORED_IN_SPACE if A.stencil.padding.counts[0] > 1 else FACTORED_IN_PLANE
        self._operator = SparseOperator(grid_matrix(A), device=A.device, dtype=wp.float64)
        factored = partial(FactoredSystem.of, self._operator, weighted=shifted, complete=most)
        self._system = SparseSystem(
            self._operator, wp.float64, shifted=shifted, substitute=factored
        )

    def restrict(self, free: DeviceArray, shift: DeviceArray | None) -> None:
        """Set another free set and shift, stored fields of the grid."""
        device = self._operator.device
        of_rows = (
            None
            if shift is None
            else wp.array(shift.numpy()[self._rows], dtype=wp.float64, device=device)
        )
        self._system.restrict(
            wp.array(free.numpy()[self._rows], dtype=wp.uint8, device=device), of_rows
        )

    def solve_for(
        self, r: DeviceArray, e: DeviceArray, tolerance: float, max_iterations: int
    ) -> tuple[int, float]:
        """Solve for e; r and e are fields of the grid."""
        self._system.r.assign(r.numpy()[self._rows].astype(np.float64))
        iterations, norm = self._system.solve(tolerance, max_iterations)
        stored = np.zeros(e.size, dtype=wp.dtype_to_numpy(e.dtype))
        stored[self._rows] = self._system.e.numpy()
        e.assign(stored)
        return iterations, norm
