"""Run a method for sparse matrices on the assembled matrix of a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import (
    Solver,
    Step,
    WorkspaceBase,
    evaluate_unless_current,
    method_name,
    method_step,
)
from warp_lcp.problem.operator_protocol import HasStencil, check_taken, has
from warp_lcp.settings import Settings


@dataclass(frozen=True)
class AssembledMatrix(Settings):
    """Another method, on the assembled float64 matrix of a grid.

    For domains on which geometric aggregates of whole blocks fail. In channels and walls one cell
    wide, spirals and mazes, a block contains cells that are not connected within it. Coefficients
    that are random over many decades are another case. There the cycles of a geometric hierarchy
    converge slowly, even without bounds, while algebraic aggregates follow the coefficients (Vanek,
    Mandel and Brezina). The unknowns are the fluid cells, in their order. Steps are those of
    `inner`, with its cold start.

    Args:
        inner: a method that takes sparse matrices.
    """

    supports: ClassVar = (HasStencil,)
    needs: ClassVar[str] = "as the inner method"
    form: ClassVar[str] = " on the assembled matrix"

    inner: Solver

    @property
    def name(self) -> str:
        """Name of the inner method."""
        return method_name(self.inner)

    def init(self, problem: LCP) -> AssembledWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A has no stencil, or other processes have a part of it.
        """
        check_taken(self, problem.A)
        return AssembledWorkspace(problem, self.inner)

    def step(self, problem: LCP, work: AssembledWorkspace, x: DeviceArray) -> Step:
        """Take a step of the inner method."""
        return work.step(x)


class AssembledWorkspace(WorkspaceBase):
    """Workspace for one problem; each solve assembles the matrix at its start."""

    def __init__(self, problem: LCP, method: Solver) -> None:
        if not has(problem.A, HasStencil) or problem.A.stencil.ghosts is not None:
            raise ValueError("A: AssembledMatrix needs a grid that lies in one process")
        super().__init__(problem)
        self._method, self._A = method, problem.A

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Assemble the problem in its current state, and begin at x."""
        p = self.problem
        self._rows = np.flatnonzero(p.unknown.numpy() == 1)
        b, lower, upper, x = (
            field.numpy()[self._rows] for field in (p.b, p.lower, p.upper, self.x)
        )
        matrix = SparseOperator(grid_matrix(self._A), device=p.device, dtype=wp.float64)
        self._inner = LCP(matrix, b, lower, upper)
        work = self._work = self._method.init(self._inner)
        work.residual.start(work.x, keep=False)
        work.x.assign(x)
        self._least = work.residual.evaluate(work.x)
        work.keep()
        work.start(warm=False, tolerance=tolerance)

    def step(self, x: DeviceArray) -> Step:
        """Take a step, and write the iterate to x."""
        work = self._work
        done = method_step(self._method, self._inner, work)
        evaluate_unless_current(work)
        if work.residual.norm < self._least or not math.isfinite(self._least):
            self._least = work.residual.norm
            work.keep()
        stored = x.numpy().copy()
        stored[self._rows] = work.x.numpy()
        x.assign(stored)
        return done
