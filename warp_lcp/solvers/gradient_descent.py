"""Nonsmooth gradient descent, a start for Newton methods.

It is slow, but needs only products with A and A'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step, WorkspaceBase
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, NonNegative, Settings, ShareOrAll, renamed
from warp_lcp.subproblems.energy_monitor import NonmonotoneSearch
from warp_lcp.subproblems.nonsmooth_map import MapForm, MapName, NonsmoothMap

LEAST = 1e-12  # a smaller relative decrease of the merit counts as no step
LONGEST = 1e6  # longest length that is tried


@renamed(share="fischer_weight")
@dataclass(frozen=True, kw_only=True)
class GradientDescent(Settings):
    """Gradient descent on the merit function f.f / 2 of a reformulation.

    [Book] 2.4.4, eq. 2.199, algorithm 13.

    x <- clip(x - t d^-2 J'f, l, u) with an element J = diag(p d) + diag(q) A of the generalized
    Jacobian and the natural residual's d, which makes the direction independent of x's units. t
    comes from a backtracking search along the projected path that starts at Barzilai and Borwein's
    length; the merit may not exceed the largest of the last ones. The method needs only products
    with A and with A'. It is slow: its rate depends on the square of A's condition number.

    It ends by the book's tests. The absolute test is the criteria of every method (CONVERGED). The
    relative test (eq. 2.202), a merit that changes by less than `relative` of itself, and the
    stagnation test (eq. 2.203), an x that changes by less than `stagnation` of its largest entry,
    give STAGNATED. A gradient below `gradient` ||f|| gives LOCAL_MINIMUM, and a search without
    success NON_DESCENT.

    Args:
        map: "natural", "fischer" or "penalized".
        fischer_weight: lambda of the penalized map, the weight of the Fischer-Burmeister function,
            in (0, 1].
        relative: of the relative test, >= 0.
        stagnation: of the stagnation test, >= 0.
        gradient: of the test for a local minimum, >= 0.
        memory: number of stored merits of the search, >= 1; 1 is the book's monotone search.
        precision: "mixed" and "double" are the same here; "single" rounds x to float32.
        scaled: False: d = 1 in the map and in the step, as in the book.
    """

    needs: ClassVar[str] = "products with A'"

    map: MapName = "fischer"
    fischer_weight: ShareOrAll = 0.95
    relative: NonNegative = 1e-12
    stagnation: NonNegative = 1e-14
    gradient: NonNegative = 1e-10
    memory: Count = 10
    precision: PrecisionName = "double"
    scaled: bool = True

    def init(self, problem: LCP) -> DescentWorkspace:
        """Return a workspace, for any operator."""
        return DescentWorkspace(problem, self)

    def step(self, problem: LCP, work: DescentWorkspace, x: DeviceArray) -> Step:
        """Take one gradient step along the projected path."""
        return work.descend(x)


class DescentWorkspace(WorkspaceBase):
    """Workspace of the method for one problem.

    It belongs to another method if it shares that method's residual.

    Args:
        problem: the problem.
        settings: the method.
        residual: of the method that uses this one; its own if None.
    """

    def __init__(
        self, problem: LCP, settings: GradientDescent, residual: NaturalResidual | None = None
    ) -> None:
        x = None if residual is None else wp.empty(0, dtype=wp.float64, device=problem.device)
        super().__init__(problem, settings.precision, x=x, residual=residual)
        self.settings = settings
        self._from = problem.layout.zeros(wp.float64)
        self._map = NonsmoothMap(
            problem,
            self.residual,
            MapForm(settings.map),
            settings.fischer_weight,
            scaled=settings.scaled,
        )
        self._search = NonmonotoneSearch(memory=settings.memory, least=1e-18)
        self.length, self._square = 1.0, 0.0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Reset the last length and merits; b may have changed."""
        self.length, self._square = 1.0, 0.0
        self._search.forget()
        self._map.begin()

    def descend(self, x: DeviceArray) -> Step:
        """Take one step; `residual.y` is current at x before and after.

        The direction is d^-2 J'f. The first length is Barzilai and Borwein's: with the inner
        product of the last direction and this one over the square of the last one, t / (1 - inner /
        square).
        """
        s, map_ = self.settings, self._map
        merit = map_.merit(x)
        square, inner = map_.descend(x)
        if math.sqrt(square) <= s.gradient * math.sqrt(2 * merit):
            return Step("gradient", 1, None, SolveStatus.LOCAL_MINIMUM)
        if self._square > 0:  # Barzilai and Borwein's length of a step without bounds
            change = 1 - inner / self._square
            self.length = self.length / change if change > 1e-6 else 10 * self.length
        self._square = square
        wp.copy(self._from, x)
        # A projected step decreases the merit less than Armijo's condition for a free one requires.
        self._search.store_merit(merit * (1 - LEAST))
        length, reached = self._search.search(
            lambda t: self._trial(x, t), 0.0, first=min(self.length, LONGEST)
        )
        if length == 0.0:
            wp.copy(x, self._from)
            self.residual.evaluate(x)
            return Step("gradient", 1, None, SolveStatus.NON_DESCENT)
        self.length = length
        return Step("gradient", 2, None, self._tested(x, merit, reached))

    def _trial(self, x: DeviceArray, length: float) -> float:
        """Move along the projected path; return the merit."""
        self._map.advance(self._from, self._map.direction, -length, x, projected=True)
        self._round(x)
        self.residual.evaluate(x)
        return self._map.merit(x)

    def _tested(self, x: DeviceArray, before: float, after: float) -> SolveStatus | None:
        """Return STAGNATED if the relative or the stagnation test ends the solve.

        Returns None if neither does.
        """
        s = self.settings
        if abs(before - after) <= s.relative * before:
            return SolveStatus.STAGNATED
        moved = float(np.abs(x.numpy() - self._from.numpy()).max())
        return (
            SolveStatus.STAGNATED
            if moved <= s.stagnation * float(np.abs(x.numpy()).max())
            else None
        )
