"""Linear system on the free unknowns: (P A P + P D P) e = r.

Newton-type methods share it; P is the free set and D >= 0 a shift. Grids take
multigrid-preconditioned conjugate gradients, dense and narrow matrices a factorization, other
sparse ones algebraic multigrid or incomplete factors, other operators Krylov methods preconditioned
by the diagonal: conjugate gradients where A is symmetric, else GMRES. A preconditioner of the
problem replaces these. Each kind of system is a file.
"""

from __future__ import annotations

from typing import Protocol

from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.multigrid.black_box_multigrid import needs_lines
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.banded_matrix import NARROW
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.sum import grid_and_low_rank
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasStencil, has
from warp_lcp.subproblems.banded_system import BandedSystem
from warp_lcp.subproblems.dense_system import DenseSystem
from warp_lcp.subproblems.diagonal_system import DiagonalSystem, PreconditionedSystem
from warp_lcp.subproblems.grid_system import GridSystem
from warp_lcp.subproblems.line_system import LineSystem
from warp_lcp.subproblems.low_rank_system import CoupledGridSystem
from warp_lcp.subproblems.sparse_system import SparseSystem


class PrincipalSystem(Protocol):
    """Linear system on a free set.

    A system created with `shifted=True` measures residuals as ||d^(-1/2) r||, d the diagonal of A +
    D, in `norm` and in `solve`: otherwise rows that a large D makes stiff would decide when to
    stop. Without it they are ||r||. Dense systems, solved directly, always use ||r||.

    Attributes:
        r: stored field; the right-hand side, zero off the free set, overwritten by `solve`.
        e: stored field; the solution, zero off the free set.
    """

    r: DeviceArray
    e: DeviceArray

    def refresh(self) -> None:
        """Read A's entries after they changed in place; `restrict` must follow."""

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set another free set and shift.

        Args:
            free: stored uint8 field.
            shift: stored float64 field, >= 0; needs `shifted=True`; None: 0.
        """

    def norm(self) -> float:
        """Return the norm of r, as `solve` measures it."""

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Solve until the residual's norm is at most `tolerance`.

        Returns the number of iterations and the norm reached.
        """


def principal_system(
    problem: LCP,
    real: DataType,
    *,
    bounded: bool,
    settings: CycleSettings | None = None,
    shifted: bool = False,
    hierarchy: Hierarchy | None = None,
) -> PrincipalSystem:
    """Return the system for a problem's operator.

    Args:
        problem: the problem.
        real: type of the corrections, where the operator leaves a choice.
        bounded: whether projected cycles are needed on grids.
        settings: how a grid's cycles go.
        shifted: whether `restrict` gets a shift; it changes norms, see `PrincipalSystem`.
        hierarchy: of a grid's stencil, where another method has made one.
    """
    A = problem.A
    if problem.preconditioner is not None and not shifted:
        return PreconditionedSystem(problem, problem.preconditioner)
    if has(A, HasStencil):
        if needs_lines(A):
            return LineSystem(A, real, settings=settings, shifted=shifted)
        return GridSystem(
            A, real, bounded=bounded, settings=settings, shifted=shifted, hierarchy=hierarchy
        )
    if isinstance(A, DenseOperator):
        return DenseSystem(A)
    if isinstance(A, SparseOperator):
        if A.bandwidth <= NARROW and A.unknowns > 2 * NARROW:
            return BandedSystem(A)
        return SparseSystem(A, real, shifted=shifted)
    terms = grid_and_low_rank(A)
    if terms is not None:
        return CoupledGridSystem(
            A,  # type: ignore[arg-type]
            *terms,
            real,
            settings=settings,
            shifted=shifted,
        )
    return DiagonalSystem(problem, shifted=shifted)
