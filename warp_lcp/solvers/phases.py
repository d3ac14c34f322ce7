"""Phases of a solve in which another method is at work: cold starts, and what goes on where a method's own steps lead nowhere."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.multigrid.aggregates import coarse_points, suits_multigrid
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.stencil import AROUND, StoredStencil
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.protocol import AIR, FLUID, HasRows, HasScale, HasStencil, has
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve import EPS, FLOOR_MARGIN, Step, solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.reduced.dense_problem import proved_infeasible
from warp_lcp.reduced.grid_step_kernels import GAPS, SIZE
from warp_lcp.reduced.principal_system import ALL_FREE, ON_FREE, GridSystem, LineSystem
from warp_lcp.rows import Rows
from warp_lcp.rows.vectors import Reduction
from warp_lcp.solvers.method_table import METHODS

if TYPE_CHECKING:
    from warp_lcp.reduced.sparse_system import SparseSystem
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

# of steps on a grid's matrix
WINDOW = 10  # steps over which the residual's fall is measured
FIRST = 20  # steps before which nothing is concluded: residuals of conjugate gradients rise and fall
MOST = 30  # steps that a solve may still need at that pace: assembly and set-up cost about as much
# of the proximal-point iteration
CENTER, FACTOR, LEAST = 1e-4, 0.1, 1e-10  # eps of the first center, its factor from center to center, and the smallest
RAISED, LARGEST = 100.0, 1.0  # factor of eps where a regularized problem is not solved, and the largest eps: larger ones are easier
NEAR = 1e-3  # of a center's residual: what the regularized problem's may be when the next center is taken
TRIED, FEWER = 30, 15  # steps for one center, before and after eps had to be raised
SMALL = 1000  # unknowns up to which a sparse matrix is taken as a dense one, for which least-index pivoting is there
FALL = 0.9  # a center, or a step of another method, whose residual is above this part of the smallest so far is no progress
IDLE = 4  # centers without progress before the end
PATIENCE = StoppingCriteria.patience  # gradient steps that neither lower the energy nor the residual before the end
# of interior-point steps
PATH_IDLE = 10  # steps without progress before the proximal-point iteration: a path is joined far from the start
CREEPS = 0.97  # of the residual that many steps ago: above it, a path that was joined far from the start leads nowhere
# of problems on coarse points
ROUGH = partial(StoppingCriteria, rtol=1e-2, max_iterations=30)  # of a correction that interpolation blurs by a layer or two anyway
# a set creeps while more than this share of what the last step moved moves again: at that rate a dozen steps or more are still to
# come, and a first correction costs as much as those
CREEP = 0.92
STEPS = 3  # of creeping before the correction


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


class Inner:
    """Another method at work inside one, on a problem of its own or the same.

    Args:
        method: it.
        problem: what it is to solve.
        work: its memory; None: made by the method.
    """

    def __init__(self, method: Any, problem: LCP, work: Any = None) -> None:
        self.method, self.problem, self.work = method, problem, method.init(problem) if work is None else work

    def begin(self, x: Any, tolerance: float, *, warm: bool = True, floating: FloatingComponents | None = None) -> None:
        """Start from a stored field; arguments as of a workspace's `start`."""
        work = self.work
        work.x.assign(x)
        work.residual.evaluate(work.x)
        work.start(warm=warm, tolerance=tolerance, **({} if floating is None else {"floating": floating}))

    def step(self, x: wp.array[Any] | None = None) -> Step:
        """Take a step, from another iterate than the last one if x is given; the residual is that of its end."""
        work = self.work
        work.residual.current = False
        done = self.method.step(self.problem, work, work.x if x is None else x)
        if not work.residual.current:
            work.residual.evaluate(work.x if x is None else x)
        return done


class Pace:
    """How fast the least residual of a solve falls.

    Args:
        tolerance: the residual norm that is asked for.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance, self._least = tolerance, list[float]()

    def record(self, norm: float) -> None:
        """Take note of the residual before a step."""
        self._least.append(min(self._least[-1], norm) if self._least else norm)

    @property
    def taken(self) -> int:
        """How many residuals have been noted."""
        return len(self._least)

    @property
    def crawls(self) -> bool:
        """Whether the tolerance, or what float64 can tell from 0, is more than MOST steps away at the pace of the last ones."""
        if len(self._least) <= FIRST:
            return False
        least, target = self._least[-1], max(self._tolerance, EPS * self._least[0])
        return least > target and math.log(least / target) > MOST / WINDOW * math.log(self._least[-1 - WINDOW] / least)


class AlgebraicSteps:
    """Steps of MinimumMapNewton on the matrix of a grid, in double precision: its aggregates follow the grid's coefficients.

    For domains on which aggregates of whole blocks fail. Channels and walls a cell wide, spirals and mazes, share blocks that are not
    joined inside; so do cells whose coefficients are random over many decades. Cycles of a geometric hierarchy are slow there, without
    bounds too.

    Args:
        problem: a grid's, in one process.
        A: its operator.
        x: the iterate, stored, to begin with.
        tolerance: the residual norm that is asked for.
    """

    def __init__(self, problem: LCP, A: HasStencil, x: wp.array[Any], tolerance: float) -> None:
        self._rows = np.flatnonzero(problem.unknown.numpy() == 1)
        b, lower, upper, start = (field.numpy()[self._rows] for field in (problem.b, problem.lower, problem.upper, x))
        matrix = SparseOperator(grid_matrix(A), device=problem.device, dtype=wp.float64)
        self._inner = Inner(METHODS["minimum-map-newton"](precision="double"), LCP(matrix, b, lower, upper))
        self._inner.begin(start, tolerance, warm=False)

    @staticmethod
    def suits(problem: LCP) -> bool:
        """Return whether A is a grid's, all of it in this process."""
        return has(problem.A, HasStencil) and problem.A.stencil.ghosts is None

    def step(self, x: wp.array[Any]) -> Step:
        """Take a step, and write the iterate to x."""
        done, stored = self._inner.step(), x.numpy()
        stored[self._rows] = self._inner.work.x.numpy()
        x.assign(stored)
        return done


class GradientPhase:
    """Minimizes the energy by conjugate gradients that know the bounds, a batch a step.

    Newton's method solves a linear system for each set that it tries, and its safeguard is a residual that says little where A is badly
    conditioned: a plate's rises by a factor of 1000 on the way. MPRGP as a whole costs about as much as one or two such linear solves.

    Args:
        problem: with a symmetric sparse operator whose diagonal is not negative.
        system: the preconditioner's.
        precision: as MPRGP takes it.
    """

    def __init__(self, problem: LCP, system: SparseSystem, precision: str) -> None:
        method = METHODS["mprgp"](precision=precision)
        self._inner = Inner(method, problem, method.init(problem, system))

    def start(self, x: wp.array[Any], floating: Any, tolerance: float) -> None:
        """Begin at x; `floating` are the operator's floating components."""
        work, self._tolerance = self._inner.work, tolerance
        work.residual.start(work.x, keep=False)
        self._inner.begin(x, tolerance, floating=floating)

    def step(self, x: wp.array[Any], factor: float, most: int) -> Step | None:
        """Iterate until the residual is `factor` times what it was, at most so often; move x there.

        Returns:
            None: the energy has no minimum, or neither it nor the residual falls any more.
        """
        inner, residual, linear, idle, sank = self._inner, self._inner.work.residual, 0, 0, False
        least, target = residual.norm, max(self._tolerance, factor * residual.norm)
        while linear < most and idle < PATIENCE and residual.norm > target:
            step = inner.step()
            if step.failure is not None:
                return None
            linear += step.linear_iterations
            idle = 0 if step.interim or residual.norm < least else idle + 1
            least, sank = min(least, residual.norm), sank or step.interim
        wp.copy(x, inner.work.x)
        if idle == PATIENCE:
            return None
        return Step("conjugate gradients", linear, residual.active, interim=sank)


class ProximalPoint:
    """Solve A x + b + eps D (x - c) = y with the same bounds, take x for the center c, lower eps, repeat (Martinet 1970, Rockafellar 1976).

    D is the natural residual's d. A + eps D is a P-matrix wherever A is a
    P0-matrix (positive semi-definite ones, skew ones), so that free blocks are regular and least-index pivoting is finite. Its solutions
    tend to one of the problem's own if A is monotone and there is one. The regularized problems are solved by PrimalDualActiveSet; where
    it fails, eps is raised, and does not fall again. Failure with eps = 1 ends the iteration with NON_DESCENT.

    Made for a singular block here and there. Linear programs (A skew) of more than some dozens of unknowns come to residuals of 1e-2 or end
    with NON_DESCENT: they are InteriorPoint's.

    Args:
        problem: with a dense or sparse operator.
        residual: the problem's own.
        tolerance: the norm of it that is asked for.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, tolerance: float) -> None:
        self._problem, self._residual, self._tolerance = problem, residual, tolerance
        A: Any = problem.A
        self._matrix, self._D = A.rows().matrix(), A.scale()
        self._b, self._eps = problem.b.numpy(), CENTER
        if scipy.sparse.issparse(self._matrix) and len(self._D) <= SMALL:
            self._matrix = self._matrix.toarray()
        self._operator: Any = as_operator(self._regularized(), problem.device)
        regularized = LCP(self._operator, self._b, problem.lower.numpy(), problem.upper.numpy())
        self._inner = Inner(METHODS["primal-dual-active-set"](precision="double"), regularized)
        self._inner.work.last_resort = False
        self._smallest, self._idle, self._steps, self._near, self._least = residual.norm, 0, 0, 0.0, LEAST

    @staticmethod
    def suits(problem: LCP) -> bool:
        """Return whether the iteration can be had: A + eps D must be assembled."""
        return has(problem.A, HasRows) and has(problem.A, HasScale)

    def step(self, x: wp.array[Any]) -> Step:
        """Take one step for the regularized problem, from a new center if the last one's has been solved."""
        if self._steps == 0:
            self._take_center(x)
        residual, self._steps = self._inner.work.residual, self._steps + 1
        residual.evaluate(x)
        step, failure = self._inner.step(x), None
        if residual.norm <= self._near or step.failure is not None or self._steps >= (TRIED if self._least == LEAST else FEWER):
            failure = self._assess(x)
        self._residual.current = False
        return Step("proximal point", step.linear_iterations, step.active, failure, interim=failure is None)

    def _take_center(self, x: wp.array[Any]) -> None:
        """Write the regularized problem around clip(x, l, u)."""
        inner = self._inner.problem
        center = np.clip(x.numpy(), inner.lower.numpy(), inner.upper.numpy())
        x.assign(center)
        self._operator.update(self._regularized())
        inner.b.assign(self._b - self._eps * self._D * center)
        self._center = center
        size = self._residual.evaluate(x)
        self._near = max(NEAR * size, 0.3 * self._tolerance)
        self._inner.work.start(warm=True, tolerance=self._near)

    def _assess(self, x: wp.array[Any]) -> SolveStatus | None:
        """Prepare for the next center; return how the iteration ends if it has come no nearer to a solution for some."""
        solved, self._steps = self._inner.work.residual.norm <= self._near, 0
        x.assign(np.clip(x.numpy(), self._inner.problem.lower.numpy(), self._inner.problem.upper.numpy()))
        norm = self._residual.evaluate(x)
        if norm <= FALL * self._smallest:
            self._smallest, self._idle, self._eps = norm, 0, max(self._least, FACTOR * self._eps)
            return None
        if not solved and self._eps < LARGEST:
            if self._least == LEAST and proved_infeasible(self._problem):
                return SolveStatus.INFEASIBLE
            self._eps = self._least = min(LARGEST, RAISED * self._eps)
            x.assign(self._center)
            return None
        self._eps, self._idle = max(self._least, FACTOR * self._eps), self._idle + 1
        if solved and self._idle < IDLE:
            return None
        floor = FLOOR_MARGIN * self._residual.rounding_floor(x, EPS)
        if norm > floor and proved_infeasible(self._problem):
            return SolveStatus.INFEASIBLE
        return SolveStatus.STAGNATED if solved else SolveStatus.NON_DESCENT

    def _regularized(self) -> Any:
        """Return A + eps D."""
        if not scipy.sparse.issparse(self._matrix):
            return self._matrix + np.diag(self._eps * self._D)
        entries, i = self._matrix.tocoo(), np.arange(len(self._D))
        places = np.r_[entries.row, i], np.r_[entries.col, i]
        # duplicates are summed and sums of 0 stay entries: the pattern is the same for all eps
        return scipy.sparse.csr_array((np.r_[entries.data, self._eps * self._D], places), shape=self._matrix.shape)


class InteriorSteps:
    """Follow the central path from its own start; where that leads nowhere, iterate by ProximalPoint from where the method was.

    Linear programs and other saddle points, A skew but for a block or a small shift, have free blocks that are singular or nearly so
    on the way to the solution's own; so have matrices of low rank, and Laplacians that nothing holds, whose active set creeps by a layer
    of unknowns a step. The central path exists for every positive semi-definite A, and asks for none.

    Args:
        problem: with a dense or sparse operator.
        residual: the problem's own.
        tolerance: the norm of it that is asked for.
        patience: steps without progress before the proximal-point iteration.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, tolerance: float, *, patience: int = PATH_IDLE) -> None:
        self._problem, self._residual, self._tolerance = problem, residual, tolerance
        self._inner = Inner(METHODS["interior-point"](precision="double"), problem)
        self._inner.work.residual.start(self._inner.work.x, keep=False)
        self._inner.begin(self._inner.work.x, tolerance, warm=False)
        self._smallest, self._idle, self._patience, self._norms = math.inf, 0, patience, list[float]()
        self._begun: wp.array[Any] | None = None
        self._next: ProximalPoint | None = None

    def step(self, x: wp.array[Any]) -> Step:
        """Take one step, and write the iterate to x."""
        if self._next is not None:
            return self._next.step(x)
        if self._begun is None:
            self._begun = wp.clone(x)
        step = self._inner.step()
        if step.failure is SolveStatus.INFEASIBLE:
            return step
        norm = self._inner.work.residual.norm
        self._idle = 0 if norm <= FALL * self._smallest else self._idle + 1
        self._smallest = min(norm, self._smallest)
        self._norms = [*self._norms, norm][-1 - PATH_IDLE :]
        creeps = len(self._norms) > PATH_IDLE and norm > CREEPS * self._norms[0]
        over = step.failure is not None or (self._idle >= self._patience and creeps)
        wp.copy(x, self._begun if over else self._inner.work.x)
        if over:
            self._residual.evaluate(x)
            self._next = ProximalPoint(self._problem, self._residual, self._tolerance)
        self._residual.current = False
        return Step("interior point", step.linear_iterations, interim=True)


class CoarseProblem:
    """Solves for the correction P e of an x: P'A P e + P'(A x + b), with the bounds that x leaves to the coarse points.

    Those are unknowns of the fine problem, so that an obstacle's corners stay where they are, and unknowns at their bounds stay there until
    the correction says otherwise: the contact's boundary moves as far as it must at once, where Newton's own step moves it by a layer of
    unknowns. The coarse problem is solved by Newton's method too, which begins with a coarse problem of its own.

    Args:
        A: the matrix.
        coarse: whether A is a coarse problem's.
    """

    def __init__(self, A: Any, settings: MinimumMapNewton, *, coarse: bool = False) -> None:
        self._A, self._coarse, self._version = A, coarse, -1
        self._settings = replace(settings, monotone_cycles=0, direct=False)
        self._work: Any = None
        self.start()

    def start(self) -> None:
        """Forget how the set has moved."""
        self._moved, self._crept, self._wait = 0.0, STEPS if self._coarse else 0, STEPS

    def is_due(self, moved: float) -> bool:
        """Return whether a correction should come now that another part of the unknowns has moved on or off the active set."""
        creeps = self._coarse or moved > CREEP * self._moved > 0
        self._moved, self._crept = moved, self._crept + 1 if creeps else 0
        if self._crept < self._wait or not self._refresh():
            return False
        self._moved, self._crept, self._wait = 0.0, 0, 2 * self._wait
        return True

    def correction(self, problem: LCP, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return P e for the problem at x, where A x + b = y."""
        points = self._points
        return self._P @ self._solved(self._R @ y, (problem.lower.numpy() - x)[points], (problem.upper.numpy() - x)[points]).numpy()

    def _solved(self, *fields: np.ndarray) -> wp.array[Any]:
        """Return the coarse problem's rough solution for this b, lower and upper."""
        work = self._work
        for field, values in zip((work.problem.b, work.problem.lower, work.problem.upper), fields, strict=True):
            field.assign(values)
        return solve(work.problem, self._settings, stopping=ROUGH(), workspace=work).x

    def _refresh(self) -> bool:
        """Choose points of A as it is now, if it has changed since; return whether there are any."""
        if self._version == self._A.version:
            return self._work is not None
        self._version, self._work, host = self._A.version, None, self._A.matrix()
        found = coarse_points(host) if self._coarse or suits_multigrid(host) else None
        if found is not None:
            self._P, matrix, self._points = found
            self._R = self._P.T.tocsr()
            A = SparseOperator(matrix, device=self._A.device, dtype=wp.float64)
            b, lower, upper = (A.layout.zeros(wp.float64) for _ in range(3))
            self._work = self._settings.init(LCP(A, b, lower, upper))
            if self._work.coarse is not None:
                self._work.coarse = CoarseProblem(A, self._settings, coarse=True)
        return self._work is not None


class CoarseStencilProblem(CoarseProblem):
    """The same on every second cell of a compact stencil's grid, with the transfers of its hierarchy; each solve begins with a correction.

    With coarse problems on all levels that is nested iteration: Newton's steps then start with a contact that is right but for a layer or
    two of cells, cold or from another time step's solution, and come to the end in as many as a linear solve takes.

    Args:
        A: the operator.
        system: of the fine problem.
        settings: of Newton's method.
    """

    def __init__(self, A: HasStencil, system: LineSystem, settings: MinimumMapNewton) -> None:
        self._system, self._hierarchy = system, system.hierarchy
        super().__init__(A, settings)

    def start(self) -> None:
        """A correction is due at once, others where the set creeps."""
        self._moved, self._crept, self._wait, self._begins = 0.0, 0, STEPS, True

    def is_due(self, moved: float) -> bool:
        """Return whether a correction should come now."""
        if not self._begins:
            return super().is_due(moved)
        self._begins = False
        return self._refresh()

    def correction(self, problem: LCP, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return P e for the problem at x, where A x + b = y."""
        hierarchy, kind = self._hierarchy, self._hierarchy.finest.t.dtype
        hierarchy.take_all(self._free)
        fine, coarse, size = hierarchy.finest, hierarchy.levels[1], float(np.abs(y).max()) or 1.0
        fine.t.assign((y / size).astype(wp.dtype_to_numpy(kind)))
        fine.handing_down(coarse).launch()
        held = (self._points((bound.numpy() - x) / size) for bound in (problem.lower, problem.upper))
        coarse.x.assign(self._solved(coarse.b.numpy().astype(np.float64), *held).numpy().astype(wp.dtype_to_numpy(kind)))
        fine.correcting(coarse, add=False).launch()
        return size * fine.x.numpy().astype(np.float64)

    def _points(self, field: np.ndarray) -> np.ndarray:  # type: ignore[override]
        """Return the coarse cells' values of a stored field, as a stored field."""
        fine, coarse = self._hierarchy.levels[:2]
        values, (fx, fy) = np.zeros(coarse.padding.shape), fine.factors
        values[1:-1, 1:-1, 1:-1] = field.reshape(fine.padding.shape)[1:-1, 1:-1:fy, 1:-1:fx]
        return values.ravel()

    def _refresh(self) -> bool:
        """Make the coarse problem of A as it is now, if it has changed since; return whether there is one."""
        if self._version == self._A.version or len(self._hierarchy.levels) < 2:
            return self._work is not None
        self._version, hierarchy = self._A.version, self._hierarchy
        fluid = self._A.cells.numpy().ravel() == FLUID
        self._free = wp.array(fluid.astype(np.uint8), device=hierarchy.device)
        hierarchy.restrict(self._free)
        coarse = hierarchy.levels[1]
        inside = (coarse.d.numpy() != 0) & (self._points(fluid.astype(np.float64)) != 0)
        if not inside.any():
            return False
        cells = np.where(inside.reshape(coarse.padding.shape)[1, 1:-1, 1:-1], FLUID, AIR)
        d = np.where(inside, coarse.d.numpy(), 0)
        if self._work is not None:
            self._work.problem.A.take(cells, d, coarse.weights)
            return True
        copied, n = wp.clone(coarse.weights), coarse.padding.size
        weights = tuple(copied[i * n : (i + 1) * n] for i in range(8))
        stored = wp.array(d, dtype=coarse.d.dtype, device=hierarchy.device)
        A = StoredStencil(cells, stored, weights, AROUND, symmetric=self._A.symmetric)
        b, lower, upper = (A.layout.zeros(wp.float64) for _ in range(3))
        self._work = self._settings.init(LCP(A, b.reshape(A.layout.stored_shape), lower, upper))
        self._work.last_resort = False  # a rough correction is not worth it
        return True
