"""Projected multigrid cycles of a cold start of Newton's method.

On a grid, or on the aggregates of a sparse matrix.
"""

from __future__ import annotations

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.multigrid.aggregates import MonotoneAggregation
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.subproblems.active_set_kernels import projected_move
from warp_lcp.subproblems.grid_system import GridSystem, projected_cycle
from warp_lcp.subproblems.principal_system import PrincipalSystem

LARGE = 1000  # least number of unknowns of a sparse matrix for projected cycles at a cold start
# From this number of unknowns on, six cycles replace each cycle on a grid. One costs a fifth of a
# Newton step, which moves the set by one of many rows. With 4, 8, 16 and 32 cycles a membrane on
# 600,000 nodes takes 16, 15, 12 and 6 Newton steps, 7.0, 5.4, 4.8 and 4.4 s.
HUGE = 1 << 16
# Growth of the residual from which a projected cycle on an unsymmetric operator is undone: on a
# grid relative to the residual before the cycle, on a matrix to that at the start. Torsion with
# wind on 250^2 nodes raises it to 11 times that, and more with more nodes, which still helps.
RISEN, RISEN_ON_MATRIX = 10.0, 1000.0


class GridCycles:
    """Projected cycles of a grid's hierarchy.

    Args:
        problem: of a grid.
        system: its principal system, which has the hierarchy.
        sums: memory of passes.
        count: cycles of a cold start.
    """

    repairs = True  # whether a cycle helps where Newton's step has failed

    def __init__(self, problem: LCP, system: GridSystem, sums: RowReduction, count: int) -> None:
        self._problem, self._system, self._sums, self._count = problem, system, sums, count

    def begin(self) -> int:
        """Return the number of cycles of a cold start."""
        return self._count

    def run(
        self, x: DeviceArray, residual: NaturalResidual, free: DeviceArray, *, restrict: bool
    ) -> float:
        """Move x by a cycle on all unknowns; return the largest acceptable residual.

        Args:
            x: the iterate.
            residual: at x.
            free: becomes the set of all unknowns.
            restrict: whether the system must be restricted to all unknowns first.
        """
        p, system, sums, size = self._problem, self._system, self._sums, residual.norm
        projected_cycle(p, system, x, residual.y, size, free, sums, restrict=restrict)
        projected_move(sums.rows, p.bounds.operands, x, system.z, size, x, guarded=False)
        return RISEN * size


class AggregateColdStart:
    """Projected cycles on the aggregates of a large sparse matrix.

    The matrix must be nearly a diagonally dominant M-matrix.

    Args:
        problem: with a sparse matrix.
        A: its operator.
        count: cycles of a cold start, in units of those on a grid.
    """

    repairs = False

    def __init__(self, problem: LCP, A: SparseOperator, count: int) -> None:
        self._problem, self._count, self._aggregation, self._at_start = (
            problem,
            count,
            MonotoneAggregation(A),
            0.0,
        )

    def begin(self) -> int:
        """Return the number of cycles of a cold start, 0 if A is unsuitable."""
        self._at_start = 0.0
        if not (self._count > 0 and self._aggregation.refresh()):
            return 0
        return (2 if self._problem.A.shape[0] < HUGE else 6) * self._count

    def run(
        self, x: DeviceArray, residual: NaturalResidual, free: DeviceArray, *, restrict: bool
    ) -> float:
        """Move x by a cycle on all unknowns; return the largest acceptable residual."""
        p = self._problem
        self._at_start = self._at_start or residual.norm
        self._aggregation.cycle(x, p.b, p.lower, p.upper)
        return RISEN_ON_MATRIX * self._at_start


def cold_cycles(
    problem: LCP, system: PrincipalSystem, sums: RowReduction, count: int
) -> GridCycles | AggregateColdStart | None:
    """Return the cycles for a bounded problem, None for unsuitable operators."""
    if not problem.bounded:
        return None
    if isinstance(system, GridSystem):
        return GridCycles(problem, system, sums, count)
    A = problem.A
    if isinstance(A, SparseOperator) and A.unknowns >= LARGE:
        return AggregateColdStart(problem, A, count)
    return None
