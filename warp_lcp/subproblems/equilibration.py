"""Row and column scaling of dense and sparse problems.

For methods whose start depends on one size of all rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import rows_of
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.data_types import Matrix
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.method_protocol import Step, Workspace, WorkspaceBase
from warp_lcp.problem.operator_protocol import HasRows, HasScale, has, version_of
from warp_lcp.problem.residual_scaling import scaled
from warp_lcp.problem.result import SolveStatus
from warp_lcp.subproblems.dense_problem import (
    DenseProblem,
    power_of_two,
    proved_infeasible,
    unit_rows_and_columns,
    within_reach,
    without_contact,
)

KERNELS = KernelFile(Path(__file__).parent / "headers/reduced_systems.h")
UNITS = KERNELS["equilibrated.units"]
ALIKE = 4.0  # rows whose units differ by at most this factor are not scaled
# Steps without a residual below FALL times the smallest after which a proof of infeasibility is
# tried.
WAIT = 6
FALL = 0.9
# Share of the residual below which the solution of the equations on singular components is worth a
# new start.
HALF = 0.5
GROWN = 1e4  # growth of the residual after which the proof is tried too
EARLY = 10  # steps in which the residual may rise: a path is joined far from the start


class EquilibratedWorkspace(WorkspaceBase):
    """Workspace of a method for the scaled problem.

    The scaled problem is R A C x' + R b with bounds l / C and u / C; the problem's own iterate is x
    = C x'. R and C are powers of 2 with R_i C_i near 1 / d_i of the natural residual, equal where A
    is symmetric (for semi-definite matrices: Jacobi's scaling). A step with an x that is not finite
    is rejected and ends the solve, with INFEASIBLE if a linear program proves that there is no
    solution, else with STAGNATED.

    Args:
        problem: with a dense or sparse operator.
        precision: of the iterate.
        make: returns the method's own workspace for the scaled problem.

    Attributes:
        inner: that workspace.
    """

    def __init__(self, problem: LCP, precision: str, make: Callable[[LCP], Workspace]) -> None:
        super().__init__(problem, precision)
        layout, bounds = problem.layout, problem.bounds
        self._rows, self._units = layout.zeros(wp.float64), layout.zeros(wp.float64)
        sides = [
            layout.zeros(wp.float64)
            if bounds.varying[k] or bounds.values[k] not in (0.0, -np.inf, np.inf)
            else None
            for k in (0, 1)
        ]
        self._sides = sides
        operator = as_operator(self._scaled(), problem.device, problem.A.dtype)
        assert isinstance(operator, (DenseOperator, SparseOperator)), "`_scaled` is a matrix"
        self._operator = operator
        limits = [bounds.values[k] if side is None else side for k, side in enumerate(sides)]
        self._inner = LCP(self._operator, layout.zeros(wp.float64), *limits)
        self.inner = make(self._inner)
        self._version = version_of(problem.A)
        self._target = 0.0
        self._smallest, self._waited, self._steps, self._asked = math.inf, 0, 0, False
        self._tried = False

    @staticmethod
    def suits(problem: LCP) -> bool:
        """Return whether the problem's operator has rows and a scale."""
        return has(problem.A, HasRows) and has(problem.A, HasScale)

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the current A, b and bounds, and scale them."""
        inner, version = self._inner, version_of(self.problem.A)
        if version is None or version != self._version:
            self._version = version
            self._operator.update(self._scaled())
            if isinstance(self._operator, DenseOperator):
                self.inner.residual.rescale()
        UNITS.bind(
            rows_of(inner.b), x=self.problem.b, units=self._rows, inverse=False, scaled=inner.b
        ).launch()
        for k, side in enumerate(self._sides):
            if side is not None:
                self._multiply(self.problem.bounds.as_field(k), side, inverse=True)
        inner.bounds.refresh()
        self._multiply(self.x, self.inner.x, inverse=True)
        self.inner.residual.evaluate(self.inner.x)
        self._target = tolerance * float(self._rows.numpy().min())
        self.inner.start(warm=warm, tolerance=self._target)
        self._smallest, self._waited, self._steps, self._asked = math.inf, 0, 0, False
        self._tried = False

    def step(self, advance: Callable[[LCP, Any, DeviceArray], Step]) -> Step:
        """Take a step of the method on the scaled problem.

        x = C x' is evaluated in the problem's own units. Where the residual does not fall for some
        steps, a solution without contact is tried, then a proof of infeasibility.
        """
        inner = self.inner
        inner.residual.evaluate(inner.x)
        with np.errstate(over="ignore", invalid="ignore"):  # detected below
            step = advance(self._inner, inner, inner.x)
        alone = self.x.numpy()[self._alone] if self._alone.size else None
        self._multiply(inner.x, self.x)
        if alone is not None:  # x of an empty row and column with b = 0 is arbitrary
            x = self.x.numpy().copy()
            x[self._alone] = alone
            self.x.assign(x)
        self._round(self.x)
        norm = self.residual.evaluate(self.x)
        if not math.isfinite(norm):
            self.restore()
            self.residual.evaluate(self.x)
            return Step(step.name, step.linear_iterations, None, self._ended())
        self._steps += 1
        self._waited = 0 if norm <= FALL * self._smallest else self._waited + 1
        self._smallest = min(self._smallest, norm)
        if not self._asked and (self._waited >= WAIT or norm > GROWN * self._smallest):
            if not self._tried and self._take_without_contact():
                return Step("equations", 1, None)
            self._asked = True
            if self._ended() is SolveStatus.INFEASIBLE:
                return Step(step.name, step.linear_iterations, None, SolveStatus.INFEASIBLE)
        return replace(step, interim=True) if self._steps <= EARLY else step

    def _take_without_contact(self) -> bool:
        """Set x to the solution with y = 0 where A is singular.

        Only if the residual falls; returns whether it does.
        """
        self._tried = True
        if not within_reach(self.problem):
            return False
        data = DenseProblem.read(self.problem, keep_sparse=True)
        before, norm = self.x.numpy(), self.residual.norm
        self.x.assign(without_contact(data, before[data.rows]))
        if not self.residual.evaluate(self.x) <= HALF * norm:
            self.x.assign(before)
            self.residual.evaluate(self.x)
            return False
        self._multiply(self.x, self.inner.x, inverse=True)
        self.inner.residual.evaluate(self.inner.x)
        self.inner.start(warm=True, tolerance=self._target)
        self._smallest, self._waited = self.residual.norm, 0
        return True

    def _ended(self) -> SolveStatus:
        """Return the status of a solve that makes no progress."""
        return SolveStatus.INFEASIBLE if proved_infeasible(self.problem) else SolveStatus.STAGNATED

    def _scaled(self) -> Matrix:
        """Compute R and C, and return R A C on the host.

        R = C = 1 / sqrt(d), rounded to powers of 2, if A is symmetric and has a scale d, else those
        of `unit_rows_and_columns`. R = C = 1 if max / min of each is at most ALIKE.
        """
        A = self.problem.A
        assert has(A, HasRows), "`suits` has been asked"
        matrix = A.rows().matrix()
        scaling = self.problem.A
        d = scaling.scale() if has(scaling, HasScale) else None
        R, C = (
            (power_of_two(1 / np.sqrt(d)),) * 2
            if A.symmetric and d is not None
            else unit_rows_and_columns(matrix)
        )
        if max(R.max() / R.min(), C.max() / C.min()) <= ALIKE:
            R = C = np.ones(len(R))
        sizes = abs(matrix)
        sums = (np.asarray(sizes.sum(axis=k)).ravel() for k in (0, 1))
        self._alone = np.flatnonzero(np.add(*sums) == 0)
        self._rows.assign(R)
        self._units.assign(C)
        return scaled(matrix, R, C)

    def _multiply(self, field: DeviceArray, out: DeviceArray, *, inverse: bool = False) -> None:
        UNITS.bind(rows_of(field), x=field, units=self._units, inverse=inverse, scaled=out).launch()
