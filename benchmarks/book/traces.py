"""One solve seen step by step, and how the book's tests would have ended it."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

import warp_lcp as wl
from warp_lcp.gallery import Problem

RTOL = 1e-6  # of the natural residual: what this library calls solved
# steps that are not the book's: what the library does where the book's method has ended
FALLBACKS = frozenset({"proximal point", "regularized"})


class Merit(Enum):
    """What Num4LCP tests: half the squared norm of the Fischer-Burmeister map or of the minimum map, or the product x'|y|."""

    FISCHER = "Fischer"
    MINIMUM = "minimum map"
    PRODUCT = "x'|y|"

    def of(self, x: np.ndarray, y: np.ndarray) -> float:
        """Return it for an iterate, shape (n,) each."""
        if self is Merit.PRODUCT:
            return float(x @ np.abs(y))
        f = np.hypot(x, y) - x - y if self is Merit.FISCHER else np.minimum(x, y)
        return 0.5 * float(f @ f)


@dataclass(frozen=True)
class Trace:
    """A solve.

    Args:
        merits: the merit of each iterate, the start's first.
        residuals: the natural residual's norm of each.
        steps: what led to each.
        status: how the solve ended.
    """

    merits: Sequence[float]
    residuals: Sequence[float]
    steps: Sequence[str]
    status: wl.SolveStatus

    @property
    def solved(self) -> int | None:
        """Return the steps after which the natural residual was RTOL times the first one, None if never."""
        return next((k for k, r in enumerate(self.residuals) if r <= RTOL * self.residuals[0]), None)


@dataclass(frozen=True)
class Verdict:
    """How the book's tests end a solve.

    Args:
        state: "relative", "absolute", "non-descent", "local minimum", "stagnation" or "max iterations".
        iterations: counted as Num4LCP does.
        residual: the natural residual there over the first one.
    """

    state: str
    iterations: int
    residual: float


STATES = {
    wl.SolveStatus.NON_DESCENT: "non-descent",
    wl.SolveStatus.LOCAL_MINIMUM: "local minimum",
    wl.SolveStatus.STAGNATED: "stagnation",
    wl.SolveStatus.FLOOR: "stagnation",
    wl.SolveStatus.MAX_ITERATIONS: "max iterations",
}


def follow(
    problem: Problem, solver: Any, merit: Merit, *, device: str, max_iterations: int = 100, rtol: float = 1e-8, x0: Any = None
) -> Trace:
    """Solve and keep the merit of each iterate.

    Args:
        problem: dense or sparse.
        solver: the method.
        merit: what to keep.
        device: Warp device.
        max_iterations: the most steps.
        rtol: of the natural residual, below what the book asks for.
        x0: a start, shape (n,).
    """
    lcp = problem.lcp(device=device)
    work = solver.init(lcp)
    merits: list[float] = []

    def look(record: wl.Record) -> None:
        x = lcp.layout.unload(work.x).numpy().ravel()
        merits.append(merit.of(x, problem.A @ x + problem.b))

    stopping = wl.StoppingCriteria(rtol=rtol, max_iterations=max_iterations, patience=max(1, max_iterations))
    result = wl.solve(lcp, solver, stopping=stopping, workspace=work, callback=look, x0=x0)
    return Trace(merits, [r.residual for r in result.history], [r.step for r in result.history], result.status)


def judge(trace: Trace, merit: Merit, *, rtol: float = 1e-6, atol: float = 1e-3, most: int = 100) -> Verdict:
    """Return how Num4LCP would have ended the solve: its tests of the merit's change and size, in its order, at each iterate.

    Sweeps are tested after each one; Newton methods before each step, the first test is iteration 1 there. A fallback of this library
    counts as the end of the book's method, which has none.
    """
    first = 1 if merit is Merit.PRODUCT else 0
    before = np.inf
    for k in range(first, len(trace.merits)):
        iteration, now = k + 1 - first, trace.merits[k]
        relative = trace.residuals[k] / trace.residuals[0]
        if trace.steps[k] in FALLBACKS:
            return Verdict("non-descent", iteration, relative)
        if np.isfinite(before) and abs(now - before) < rtol * abs(before):
            return Verdict("relative", iteration, relative)
        if now < atol:
            return Verdict("absolute", iteration, relative)
        if iteration >= most:
            return Verdict("max iterations", iteration, relative)
        before = now
    relative = trace.residuals[-1] / trace.residuals[0]
    return Verdict(STATES.get(trace.status, trace.status.name.lower()), max(1, len(trace.merits) - first), relative)


def spread(values: Sequence[float]) -> str:
    """Return mean (smallest to largest, standard deviation)."""
    if not values:
        return ""
    return f"{statistics.fmean(values):.2f} ({min(values):g} to {max(values):g}, {statistics.pstdev(values):.2f})"


def counted(states: Sequence[str]) -> str:
    """Return how often each came, the most frequent first."""
    return ", ".join(f"{n} {state}" for state, n in Counter(states).most_common())
