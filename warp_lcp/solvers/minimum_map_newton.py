"""Newton's method on the minimum map.

A step finds the active set, solves a linear system on the free unknowns, and is safeguarded.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import ClassVar

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step, WorkspaceDefaults
from warp_lcp.settings import Count, CountOrZero
from warp_lcp.subproblems.reduced_system import NewtonSettings, ReducedSystem, reduced_system

DECREASE = 1e-4  # share of a step by which the residual must fall


@dataclass(frozen=True, kw_only=True)
class MinimumMapNewton(NewtonSettings):
    """Nonsmooth Newton method on the minimum map, reduced to the free unknowns.

    It solves the linear system on the unknowns that the minimum map calls free and holds the others
    at their bounds ([Book] 2.4.1).

    Unknown i is held where x_i - y_i / d_i, with the natural residual's d, is outside [l_i, u_i].
    After a cold start on a grid, the first steps are projected multigrid cycles, which find the
    active set to within a few cells; a Newton step alone moves its boundary by about one layer.
    Each Newton correction is solved inexactly in the corrections' precision, and the step is
    shortened along its projection onto the bounds if the residual would exceed the largest of the
    last `memory` ones (Grippo, Lampariello, Lucidi 1986). If the active set of a large sparse
    matrix still moves slowly and A is nearly a diagonally dominant M-matrix, a problem on coarse
    points moves it (Brandt and Cryer 1983).

    On a grid the method converges in a few steps; on other matrices A should be a P-matrix. Where
    it is not, free blocks may be singular and steps may fail. Dense problems then try
    Levenberg-Marquardt steps of the minimum map and end with STAGNATED after 10 steps without
    progress. Others end with NON_DESCENT, or with STAGNATED where steps repeat themselves. The
    status is INFEASIBLE if equations have no solution. `wl.solve` without a method continues with
    other methods (`wl.default_chain`).

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate
            rounded to float32 as well.
        monotone_cycles: projected cycles of a cold start on a grid; twice as many, on aggregates,
            where a large sparse matrix is nearly a diagonally dominant M-matrix, six times from
            65,536 unknowns on.
        eta: each linear solve reduces its residual by this factor, or to the accuracy still needed.
            On a grid it ends earlier if the free set of an iterate changes; elsewhere it continues
            to the factor's square once the active set has settled.
        max_linear_iterations: maximum number of conjugate-gradient iterations of one step.
        backtracks: maximum number of halvings of a step.
        memory: number of last residuals whose maximum a step may not exceed (nonmonotone search).
        cycle: settings of multigrid cycles.
        direct: begin with whole steps that LAPACK solves on the host, for matrices of at most 200
            unknowns or a bandwidth up to 3: chosen by `default_method` there. The steps above
            take over where these fail.
        safeguard: True: as described above. False: the book's method alone, its Newton steps with
            Armijo's monotone search from the first to the last, and NON_DESCENT where no share of a
            step lowers the residual, as on some contacts ([Book] fig. C.2b).
    """

    needs: ClassVar[str] = "positive definite or P-matrix"
    definite: ClassVar[bool] = True
    distributed: ClassVar[bool] = True
    preconditioned: ClassVar[bool] = True
    any_numbering: ClassVar[bool] = True

    backtracks: CountOrZero = 6
    memory: Count = 4
    direct: bool = False
    safeguard: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direct and not self.safeguard:
            raise ValueError(
                "direct = True: needs safeguarded steps and cannot be combined with safeguard = "
                "False"
            )

    def init(self, problem: LCP) -> NewtonWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is neither a grid operator, dense nor symmetric; or `direct`, and A is
                neither small nor narrow.
        """
        return NewtonWorkspace(problem, self, reduced_system(problem, self))

    def step(self, problem: LCP, work: NewtonWorkspace, x: DeviceArray) -> Step:
        """Take a monotone cycle after a cold start, then Newton steps."""
        return work.step()


class NewtonWorkspace(WorkspaceDefaults):
    """Workspace of the method for one problem.

    It holds the reduced system, and the residuals of the last steps.

    Args:
        problem: the problem.
        settings: the method.
        system: Newton's equations on the free unknowns.

    Attributes:
        system: the current reduced system; another one takes over where it fails.
        iterate: x, its residual, and the best x so far, shared by all systems.
        norms: residual norms at the start of the last steps; no step may exceed the largest.
    """

    def __init__(self, problem: LCP, settings: MinimumMapNewton, system: ReducedSystem) -> None:
        self.problem, self.settings, self._first, self.system = problem, settings, system, system
        self.iterate = iterate = system.iterate
        self.x, self.residual, self.precision = iterate.x, iterate.residual, iterate.precision
        self.scratch = iterate.scratch
        self.keep, self.restore = iterate.keep, iterate.restore
        self.round_iterate = iterate.round_iterate
        # A memory of 1 is Armijo's monotone search.
        self.norms = deque[float](maxlen=settings.memory if settings.safeguard else 1)

    def solution(self) -> DeviceArray:
        """Return x in its precision and stored shape: the same array after each solve."""
        return self.iterate.solution()

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the state of the last solve; the operator may have changed."""
        self.system = self._first
        self.norms.clear()
        self.system.start(warm=warm, tolerance=tolerance, floating=floating)

    def step(self) -> Step:
        """Take a monotone cycle after a cold start, then Newton steps."""
        cycle = self.system.monotone_cycle()
        return self.newton_step() if cycle is None else cycle

    def newton_step(self) -> Step:
        """Take a Newton step: classify, restrict, solve on the free set, move.

        With F the free set, it solves A_FF e_F = -y_F after the held unknowns have moved onto their
        bounds.
        """
        system = self.system
        self.norms.append(self.residual.norm)
        # Unknown i is held where x_i - y_i / d_i is outside [l_i, u_i]; F is the set of the others.
        other = system.classify()
        if other is not None:
            self.norms.clear()
            return other
        if not system.restrict():  # held unknowns on their bounds; A_FF e_F = -y_F
            return system.accept(0)
        iterations = system.solve()
        return self.fall_back(0, math.inf, 1.0) if iterations is None else self.move(iterations)

    def move(self, iterations: int) -> Step:
        """Move to clip(x + t e, l, u) with t = 1, 1/2, ... until the residual falls.

        It must fall below the largest of the last norms, by DECREASE t of it.
        """
        system, limit = self.system, max(self.norms)
        length, best, best_length = 1.0, math.inf, 1.0
        for _ in range(self.settings.backtracks + 1):
            norm = system.move(length)
            if system.whole or norm <= (1 - DECREASE * length) * limit:
                return system.accept(iterations)
            if norm < best:
                best, best_length = norm, length
            length *= 0.5
        return self.fall_back(iterations, best, best_length)

    def fall_back(self, iterations: int, best: float, best_length: float) -> Step:
        """Continue where there is no direction, or no length of it is accepted.

        By a step of another kind, or by another system.
        """
        found = self.system.fall_back(iterations, self.norms, best, best_length)
        if isinstance(found, Step):
            return found
        self.system = found
        self.norms.clear()
        return self.step()
