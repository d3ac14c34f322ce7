"""Coarse problems that move the active set of Newton's method.

For the minimum map, on coarse points or grids. Full approximation corrections (Brandt and Cryer
1983): the bounds of the coarse problem are the distances of x to its bounds at the coarse points.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.aggregates import coarse_points, suits_multigrid
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.stencil import AROUND, StoredStencil
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import AIR, FLUID, HasStencil
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.subproblems.line_system import LineSystem

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

# Accuracy of a correction; interpolation blurs it by one or two layers anyway.
ROUGH = partial(StoppingCriteria, rtol=1e-2, max_iterations=30)
# The active set creeps while a step moves more than this share of the unknowns that the last step
# moved. At that rate a dozen steps or more are still to come, and a first correction costs as much
# as those.
CREEP = 0.92
STEPS = 3  # creeping steps before the correction


class FullApproximationCorrection:
    """Solve for a correction P e of x on coarse points: P'A P e + P'(A x + b).

    The bounds of e are those that x leaves at the coarse points. These are unknowns of the fine
    problem, so that an obstacle's corners stay where they are, and unknowns at their bounds stay
    there unless the correction moves them. The boundary of the contact moves as far as it must at
    once, where Newton's own step moves it by one layer of unknowns. The coarse problem is solved by
    Newton's method too, which begins with a coarse problem of its own.

    Args:
        A: the matrix.
        settings: of Newton's method, a `MinimumMapNewton`.
        coarse: whether A is a coarse problem's.
    """

    def __init__(self, A: Any, settings: MinimumMapNewton, *, coarse: bool = False) -> None:
        self._A, self._coarse, self._version = A, coarse, -1
        self._settings = replace(settings, monotone_cycles=0, direct=False)
        self._work: Any = None  # a NewtonWorkspace, with a coarse problem
        self.start()

    def start(self) -> None:
        """Reset the record of the set's movement."""
        self._moved, self._crept, self._wait = 0.0, STEPS if self._coarse else 0, STEPS

    def is_due(self, moved: float) -> bool:
        """Return whether a correction should come now.

        `moved` is the number of unknowns that entered or left the active set. A correction comes
        after several steps in which the set creeps; the wait doubles after each.
        """
        creeps = self._coarse or moved > CREEP * self._moved > 0
        self._moved, self._crept = moved, self._crept + 1 if creeps else 0
        if self._crept < self._wait or not self._refresh():
            return False
        self._moved, self._crept, self._wait = 0.0, 0, 2 * self._wait
        return True

    def correction(self, problem: LCP, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return P e for the problem at x, where A x + b = y."""
        points = self._points
        return (
            self._P
            @ self._solved(
                self._R @ y,
                (problem.lower.numpy() - x)[points],
                (problem.upper.numpy() - x)[points],
            ).numpy()
        )

    def _solved(self, *fields: np.ndarray) -> DeviceArray:
        """Return a rough solution of the coarse problem for this b, lower and upper."""
        work = self._work
        for field, values in zip(
            (work.problem.b, work.problem.lower, work.problem.upper), fields, strict=True
        ):
            field.assign(values)
        return solve(work.problem, self._settings, stopping=ROUGH(), workspace=work).x

    def _refresh(self) -> bool:
        """Choose coarse points if A has changed; return whether there are any."""
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
            if self._work.system.coarse is not None:
                self._work.system.coarse = FullApproximationCorrection(
                    A, self._settings, coarse=True
                )
        return self._work is not None


class CoarseStencilProblem(FullApproximationCorrection):
    """Coarse problem on every second cell of a compact stencil's grid.

    It uses the transfers of the stencil's hierarchy; each solve begins with a correction. With
    coarse problems on all levels the method is a nested iteration. Newton's steps then start with a
    contact that is right except for one or two layers of cells, also from a cold start or from
    another time step's solution. They need no more steps than a linear solve.

    Args:
        A: the operator.
        system: of the fine problem.
        settings: of Newton's method.
    """

    def __init__(self, A: HasStencil, system: LineSystem, settings: MinimumMapNewton) -> None:
        self._system, self._hierarchy = system, system.hierarchy
        super().__init__(A, settings)

    def start(self) -> None:
        """Reset: a correction is due at once, others where the set creeps."""
        self._moved, self._crept, self._wait, self._begins = 0.0, 0, STEPS, True

    def is_due(self, moved: float) -> bool:
        """Return whether a correction should come now."""
        if not self._begins:
            return super().is_due(moved)
        self._begins = False
        return self._refresh()

    def correction(self, problem: LCP, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return P e for the problem at x, where A x + b = y.

        The residual is restricted to the coarse grid in units of its largest entry, which float32
        can hold; the solution is interpolated back.
        """
        hierarchy, kind = self._hierarchy, self._hierarchy.finest.t.dtype
        hierarchy.take_all(self._free)
        fine, coarse, size = hierarchy.finest, hierarchy.levels[1], float(np.abs(y).max()) or 1.0
        fine.t.assign((y / size).astype(wp.dtype_to_numpy(kind)))
        fine.restrict_to_coarse_kernel(coarse).launch()
        held = (
            self._points((bound.numpy() - x) / size) for bound in (problem.lower, problem.upper)
        )
        coarse.x.assign(
            self._solved(coarse.b.numpy().astype(np.float64), *held)
            .numpy()
            .astype(wp.dtype_to_numpy(kind))
        )
        fine.correct_kernel(coarse, add=False).launch()
        return size * fine.x.numpy().astype(np.float64)

    def _points(self, field: np.ndarray) -> np.ndarray:  # type: ignore[override]
        """Return the values of a stored field at the coarse cells, as a stored field."""
        fine, coarse = self._hierarchy.levels[:2]
        values, (fx, fy) = np.zeros(coarse.padding.shape), fine.factors
        values[1:-1, 1:-1, 1:-1] = field.reshape(fine.padding.shape)[1:-1, 1:-1:fy, 1:-1:fx]
        return values.ravel()

    def _refresh(self) -> bool:
        """Create the coarse problem if A has changed; return whether there is one.

        Its matrix has the diagonal and the 8 weights of the hierarchy's level 1. A coarse cell is
        an unknown if its diagonal is not 0 and the fine cell at its point is FLUID; all others are
        AIR.
        """
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
            self._work.problem.A.set_fields(cells, d, coarse.weights)
            return True
        copied, n = wp.clone(coarse.weights), coarse.padding.size
        weights = tuple(copied[i * n : (i + 1) * n] for i in range(8))
        stored = wp.array(d, dtype=coarse.d.dtype, device=hierarchy.device)
        A = StoredStencil(cells, stored, weights, AROUND, symmetric=self._A.symmetric)
        b, lower, upper = (A.layout.zeros(wp.float64) for _ in range(3))
        self._work = self._settings.init(LCP(A, b.reshape(A.layout.stored_shape), lower, upper))
        return True
