"""The problem of a correction on the coarse points of a sparse matrix: what an active set that creeps is cured by."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.aggregates import suits_multigrid
from warp_lcp.multigrid.coarse_points import coarse_points
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem import LCP
from warp_lcp.solve import solve
from warp_lcp.stopping import StoppingCriteria

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

ROUGH = partial(StoppingCriteria, rtol=1e-2, max_iterations=30)  # of a correction that interpolation blurs by a layer or two anyway
# a set creeps while more than this share of what the last step moved moves again: at that rate a dozen steps or more are still to
# come, and a first correction costs as much as those
CREEP = 0.92
STEPS = 3  # of creeping before the correction


class CoarseProblem:
    """Solves for the correction P e of an x: P'A P e + P'(A x + b), with the bounds that x leaves to the coarse points.

    Those are unknowns of the fine problem, so that an obstacle's corners stay where they are, and unknowns at their bounds stay there until
    the correction says otherwise: the contact's boundary moves as far as it must at once, where Newton's own step moves it by a layer of
    unknowns. The coarse problem is solved by Newton's method too, which begins with a coarse problem of its own.

    Args:
        A: the matrix.
        coarse: whether A is a coarse problem's.
    """

    def __init__(self, A: SparseOperator, settings: MinimumMapNewton, *, coarse: bool = False) -> None:
        self._A, self._settings, self._coarse, self._version = A, replace(settings, monotone_cycles=0), coarse, -1
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
        work, fields = self._work, (self._R @ y, (problem.lower.numpy() - x)[self._points], (problem.upper.numpy() - x)[self._points])
        for field, values in zip((work.problem.b, work.problem.lower, work.problem.upper), fields, strict=True):
            field.assign(values)
        e = solve(work.problem, self._settings, stopping=ROUGH(), workspace=work).x.numpy()
        return self._P @ e

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
