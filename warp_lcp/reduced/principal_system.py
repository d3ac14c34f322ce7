"""The system on the free unknowns that Newton-type methods share: (P A P + P D P) e = r with a free set P and a shift D >= 0.

Grids take multigrid-preconditioned conjugate gradients, dense and narrow matrices a factorization, other sparse ones algebraic multigrid
or incomplete factors, other operators Krylov methods preconditioned by the diagonal: conjugate gradients where A is symmetric, else GMRES.
Where a problem brings a preconditioner, that is taken instead. The passes that make free sets, right-hand sides on them and projected
steps stand here too.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.multigrid.line_hierarchy import BlackBoxMultigrid, needs_lines
from warp_lcp.multigrid.turning import make_hierarchy
from warp_lcp.operators.banded_matrix import NARROW, BandedMatrix, bands_of
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.sum import SumOperator, grid_and_low_rank
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.preconditioner import Preconditioner
from warp_lcp.problem.protocol import HasStencil, has
from warp_lcp.reduced.dense_problem import equilibration, factored
from warp_lcp.reduced.fused_conjugate_gradient import FusedConjugateGradient
from warp_lcp.reduced.grid_step_kernels import GAPS, SIZE
from warp_lcp.reduced.low_rank_correction import LowRankCorrection
from warp_lcp.reduced.sparse_system import GuardedSystem, MatrixSystem, SparseSystem
from warp_lcp.rows import KernelFile, Rows
from warp_lcp.rows.fields import zeros_like
from warp_lcp.rows.program import Launch, Program, launch_now
from warp_lcp.rows.vectors import Reduction, rows_of

NUDGES = (0.0, 1e-12, 1e-9, 1e-6)  # shifts of a singular banded block, in units of the matrix's largest column sum

KERNELS = KernelFile(Path(__file__).parent / "headers/active_set.h")
CLASSIFY = KERNELS["active_set.classify"]
ALL_FREE = KERNELS["active_set.all_free"]
ON_FREE = KERNELS["active_set.on_free"]
STEP = KERNELS["active_set.step"]
SHIFT = KERNELS["principal_system.shift"]
MASK = KERNELS["principal_system.mask"]
DIVIDE = KERNELS["principal_system.divide"]


def projected_move(
    rows: Rows, bounds: list[Any], x: Any, along: Any, length: float, to: Any, *, z: Any = None, beta: float = 0.0, kept: Any = None,
    guarded: bool = True,
) -> None:  # fmt: skip
    """Set `to` = clip(x + length along, l, u) where the direction is not 0; see `active_set.h`."""
    STEP.bind(rows, bounds=bounds, x=x, z=z, along=along, to=to, kept=kept, beta=beta, step=length, guarded=guarded).launch()


class PrincipalSystem(Protocol):
    """The system on a free set.

    A system made with `shifted=True` measures residuals as ||d^(-1/2) r||, d the diagonal of A + D, in `norm` and in `solve`: rows that
    a large D makes stiff would else decide when to stop. Without it they are ||r||. Dense systems, solved directly, always take ||r||.

    Attributes:
        r: stored field; the right-hand side, zero off the free set, overwritten by `solve`.
        e: stored field; the solution, zero off the free set.
    """

    r: wp.array[Any]
    e: wp.array[Any]

    def refresh(self) -> None:
        """Take A's entries again after they changed in place; `restrict` must follow."""

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set (stored uint8 field) and shift (stored float64 field, >= 0; needs `shifted=True`; None: 0)."""

    def norm(self) -> float:
        """Return the norm of r, as `solve` measures it."""

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Solve until the residual's norm is at most `tolerance`; return iterations and the norm reached."""


class GridSystem(GuardedSystem):
    """Conjugate gradients on a grid, preconditioned by a linear multigrid cycle on the free set; of `hierarchy` where there is one."""

    def __init__(
        self, A: HasStencil, real: Any, *, bounded: bool, settings: CycleSettings | None = None, shifted: bool = False,
        hierarchy: Hierarchy | None = None,
    ) -> None:  # fmt: skip
        self._A = A
        self._version = A.version
        self.hierarchy = hierarchy or make_hierarchy(A.stencil, real, bounded=bounded, settings=settings, shifted=shifted)
        self.r, self.z = self.hierarchy.finest.b, self.hierarchy.finest.x
        self._weight = zeros_like(self.r) if shifted else None
        # one CPU thread, no ghost cells to fill
        self.fused = self.hierarchy.ends_in_wave and A.symmetric and A.stencil.ghosts is None
        if self.fused:
            method: Any = FusedConjugateGradient(A.stencil, self.hierarchy, weighted=shifted)
        else:
            method = (ConjugateGradient if A.symmetric else GMRES)(self.hierarchy.finest.stencil.product, self, weight=self._weight)
        self._iterate_by(method, self._weight)
        if not A.symmetric and A.stencil.ghosts is None:
            self._guard(partial(MatrixSystem, A, shifted=shifted))

    def refresh(self) -> None:
        """Take the rows and the weights again if the operator has changed."""
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None
            self.hierarchy.refresh()
            if isinstance(self._krylov, FusedConjugateGradient):
                self._krylov.clear()

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Mask and shift the finest diagonal and coarsen.

        Raises:
            ValueError: a shift, but the system was not made for one.
        """
        self._note(free, shift)
        source, target = self._A.stencil, self.hierarchy.finest.stencil.d
        if self._weight is None:
            if shift is not None:
                raise ValueError("shift: construct the system with shifted=True")
            self.hierarchy.hold(source.d, free)
            self.hierarchy.rebuild_changed()
        else:
            rows, weight = rows_of(target), self._weight
            SHIFT.bind(rows, free=free, shift=shift, d=source.d, unit=source.unit, diagonal=target, weight=weight).launch()
            self.hierarchy.rebuild()

    @property
    def program(self) -> Program:
        """Precondition: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Precondition: run `program`."""
        self.program.run()

    def monotone_cycle(self) -> None:
        """One projected cycle on r within the finest level's bounds; the correction is `z`."""
        self.hierarchy.monotone_cycle.run()


class LineSystem(GuardedSystem):
    """Conjugate gradients on a compact stencil in 2-D, or GMRES if A is not symmetric, preconditioned by cycles over lines."""

    def __init__(self, A: HasStencil, real: Any, *, settings: CycleSettings | None = None, shifted: bool = False) -> None:
        self._A = A
        self.hierarchy = BlackBoxMultigrid(A.stencil, real, symmetric=A.symmetric, settings=settings)
        finest = self.hierarchy.finest
        self.r, self.z = finest.b, finest.x
        self._weight = zeros_like(self.r) if shifted else None
        method = ConjugateGradient if A.symmetric else GMRES
        self._iterate_by(method(finest.stencil.product, self, weight=self._weight), self._weight)
        if A.stencil.ghosts is None:  # else other processes have parts of the grid
            self._guard(partial(MatrixSystem, A, shifted=shifted))
        self._version = A.version

    def refresh(self) -> None:
        """Try cycles over lines again if the operator has changed; `restrict` takes A's entries."""
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set and shift, and coarsen."""
        self._note(free, shift)
        self.hierarchy.restrict(free, shift, self._weight)

    @property
    def program(self) -> Program:
        """Precondition: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Precondition: run `program`."""
        self.program.run()


class CoupledGridSystem(KrylovSystem):
    """Conjugate gradients on a grid operator plus one of low rank, preconditioned by the grid's multigrid, corrected for the columns."""

    def __init__(
        self, A: SumOperator, grid: HasStencil, low: LowRankOperator, real: Any, *, settings: CycleSettings | None, shifted: bool
    ) -> None:
        self._grid, self._low, self._A = GridSystem(grid, real, bounded=False, settings=settings, shifted=shifted), low, A
        self.r, self.z = self._grid.r, self._grid.z
        self._correction, self._begins = LowRankCorrection(low, self._grid.hierarchy), True
        self._extra = zeros_like(self.r)
        self._free: wp.array[Any] | None = None
        self._weight = zeros_like(self.r) if shifted else None
        across = A.layout.across
        rows = None if across is None else grid.stencil.rows  # without ghost cells, which others sum
        self._iterate_by(ConjugateGradient(self._product, self, weight=self._weight, rows=rows, across=across), self._weight, rows, across)
        self._take_diagonal()

    def refresh(self) -> None:
        """Take the grid's rows again if they changed."""
        self._grid.refresh()
        self._take_diagonal()
        self._begins = True

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set and shift."""
        self._free = free
        self._grid.restrict(free, shift)
        if self._weight is not None:
            rows, weight = rows_of(self.r), self._weight
            SHIFT.bind(rows, free=free, shift=shift, d=self._own, unit=1.0, diagonal=self._extra, weight=weight).launch()
        wp.copy(self._extra, self.r)
        self._correction.renew(begins=self._begins)
        wp.copy(self.r, self._extra)
        self._begins = False

    def apply(self) -> None:
        """Precondition: one cycle of the grid's multigrid, corrected."""
        self._correction.begin()
        self._grid.apply()
        self._correction.end()

    def _product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = launch_now) -> None:
        self._grid.hierarchy.finest.stencil.product(p, q)
        self._low.add(p, q, q, mask=self._free)

    def _take_diagonal(self) -> None:
        if self._weight is not None:
            self._own = self._A.layout.load(self._A.diagonal().numpy(), wp.float64)


class DenseSystem:
    """LU factors of the free block, on the host; the minimum-norm least-squares step where the block is singular."""

    def __init__(self, A: DenseOperator) -> None:
        self._A = A
        self.r, self.e = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
        self._shift: np.ndarray | None = None
        self.refresh()

    def refresh(self) -> None:
        """Copy the matrix to the host."""
        self._matrix = self._A.matrix.numpy().astype(np.float64)

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Remember the free set and the shift."""
        self._free = np.flatnonzero(free.numpy())
        self._shift = None if shift is None else shift.numpy()[self._free].astype(np.float64)

    def norm(self) -> float:
        """Return ||r||, plain for matrices solved directly."""
        return float(np.linalg.norm(self.r.numpy()))

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Factor the free block and solve, whatever the tolerance."""
        free, r, e = self._free, self.r.numpy(), np.zeros(self.e.size)
        norm = 0.0
        if free.size:
            block, scale = self._matrix[np.ix_(free, free)], np.ones(free.size)
            if self._shift is not None:
                block = block + np.diag(self._shift)
                scale = 1 / np.sqrt(1 + self._shift)  # rows with a large shift make no others look singular
            e[free] = scale * _solve_or_least_squares(block * np.outer(scale, scale), scale * r[free])
            norm = float(np.linalg.norm(block @ e[free] - r[free]))
        self.e.assign(e)
        return 1, norm


def _solve_or_least_squares(block: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return block^-1 r; where the block looks singular even in units in which its rows are alike, the least-squares solution there."""
    solution = factored(block, r)
    if solution is None:
        S = equilibration(block)
        block, r = S[:, None] * block * S, S * r
        solution = factored(block, r)
        solution = S * (scipy.linalg.lstsq(block, r, cond=1e-12, lapack_driver="gelsy")[0] if solution is None else solution)
    return solution


class BandedSystem:
    """Band LU factors of the free block of a narrow sparse matrix, on the host; slightly shifted where it is singular."""

    def __init__(self, A: SparseOperator) -> None:
        self._A, self._version = A, -1
        self.r, self.e = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
        self.refresh()

    def refresh(self) -> None:
        """Copy the entries to the host if they have changed."""
        if self._version != self._A.version:
            self._version, self._matrix = self._A.version, BandedMatrix(bands_of(self._A, self._A.bandwidth))

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set and shift."""
        self._free = free.numpy() != 0
        self._shift = 0.0 if shift is None else np.where(self._free, shift.numpy(), 0.0)

    def norm(self) -> float:
        """Return ||r||, plain for matrices solved directly."""
        return float(np.linalg.norm(self.r.numpy()))

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Factor the free block and solve, whatever the tolerance."""
        A, r, free = self._matrix, self.r.numpy(), self._free
        for nudge in NUDGES:
            e = A.solve(free, r, self._shift + nudge * A.size)
            if e is not None and np.isfinite(e).all():
                self.e.assign(e)
                return 1, float(np.linalg.norm(np.where(free, A.product(e) + self._shift * e - r, 0.0)))
        self.e.zero_()
        return 1, self.norm()


class DiagonalSystem(KrylovSystem):
    """A Krylov method preconditioned by the diagonal, for any operator, in float64: conjugate gradients if A is symmetric, else GMRES."""

    _definite = True  # whether conjugate gradients can take the preconditioner

    def __init__(self, problem: LCP, *, shifted: bool = False) -> None:
        self._A, self._layout = problem.A, problem.layout
        self.r, self.z = self._layout.zeros(wp.float64), self._layout.zeros(wp.float64)
        self._diagonal, self._inverse = self._layout.zeros(wp.float64), self._layout.zeros(wp.float64)
        weight = self._inverse if shifted else None
        self._shift: wp.array[Any] | None = None
        method = ConjugateGradient if self._A.symmetric and self._definite else GMRES
        self._iterate_by(method(self._product, self, weight=weight), weight)
        self.refresh()

    def refresh(self) -> None:
        """Take the diagonal of A again; entries may have changed."""
        self._own = self._layout.load(self._A.diagonal().numpy(), wp.float64)

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Remember the free set and the shift, and shift the diagonal."""
        self._free, self._shift = free, shift
        rows, weight = rows_of(self.r), self._inverse
        SHIFT.bind(rows, free=free, shift=shift, d=self._own, unit=1.0, diagonal=self._diagonal, weight=weight).launch()

    def apply(self) -> None:
        """Precondition: z = r / d."""
        DIVIDE.bind(rows_of(self.r), r=self.r, d=self._diagonal, z=self.z).launch()

    def _product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = launch_now) -> None:
        shape = self._layout.stored_shape
        self._A.apply(p.reshape(shape), q.reshape(shape))
        MASK.bind(rows_of(q), free=self._free, shift=self._shift, direction=p, q=q).launch()


class PreconditionedSystem(DiagonalSystem):
    """The same, preconditioned by P M P with the problem's own M, on the host; conjugate gradients if M seems definite, too."""

    def __init__(self, problem: LCP, M: Preconditioner) -> None:
        self._M, self._definite = M, M.definite
        super().__init__(problem)

    def apply(self) -> None:
        """Precondition: z = P M r; r is 0 off the free set."""
        self.z.assign(np.where(self._free.numpy() != 0, self._M(np.array(self.r.numpy())), 0.0))


def principal_system(
    problem: LCP, real: Any, *, bounded: bool, settings: CycleSettings | None = None, shifted: bool = False,
    hierarchy: Hierarchy | None = None,
) -> PrincipalSystem:  # fmt: skip
    """Return the system for a problem's operator.

    Args:
        problem: the problem.
        real: type of the corrections, where the operator leaves a choice.
        bounded: whether projected cycles are wanted on grids.
        settings: how a grid's cycles go.
        shifted: whether `restrict` gets a shift; see `PrincipalSystem` for what it does to norms.
        hierarchy: of a grid's stencil, where another method has made one.
    """
    A = problem.A
    if problem.preconditioner is not None and not shifted:
        return PreconditionedSystem(problem, problem.preconditioner)
    if has(A, HasStencil):
        if needs_lines(A):
            return LineSystem(A, real, settings=settings, shifted=shifted)
        return GridSystem(A, real, bounded=bounded, settings=settings, shifted=shifted, hierarchy=hierarchy)
    if isinstance(A, DenseOperator):
        return DenseSystem(A)
    if isinstance(A, SparseOperator):
        if A.bandwidth <= NARROW and A.unknowns > 2 * NARROW:
            return BandedSystem(A)
        return SparseSystem(A, real, shifted=shifted)
    terms = grid_and_low_rank(A)
    if terms is not None:
        return CoupledGridSystem(A, *terms, real, settings=settings, shifted=shifted)  # type: ignore[arg-type]
    return DiagonalSystem(problem, shifted=shifted)


def projected_cycle(
    problem: LCP, system: GridSystem, x: wp.array[Any], y: wp.array[Any], size: float, free: wp.array[Any], sums: Reduction, *,
    restrict: bool = True,
) -> None:  # fmt: skip
    """Run one from x: the correction is `system.z` times `size`.

    Args:
        problem: a grid's.
        system: of its corrections.
        x: where to begin, a stored field like y and free.
        y: A x + b.
        size: what the right-hand side is divided by.
        free: every unknown's, when this is done.
        sums: memory; `SIZE` of its scalars is written.
        restrict: whether the system does not have all unknowns yet.
    """
    rows, finest = Rows.flat(problem.layout.size, problem.device), system.hierarchy.finest
    ALL_FREE.bind(rows, unknown=problem.unknown, free=free).launch()
    if restrict:
        system.restrict(free)
    ON_FREE.bind(rows, y=y, free=free, g=system.r, scale=1 / size, out=sums.partials).launch()
    sums.scalars[int(SIZE) : int(SIZE) + 1].fill_(size)
    bounds, lo, hi = problem.bounds.operands, finest.lower, finest.upper
    GAPS.bind(rows, bounds=bounds, x=x, unknown=problem.unknown, lo=lo, hi=hi, scalars=sums.scalars).launch()
    system.monotone_cycle()
