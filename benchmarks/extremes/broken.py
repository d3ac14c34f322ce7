"""Solvers that are wrong on purpose. If the checks let one of them pass, the checks are worth nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import Case, Expected, Promise, SolveCase
from warp_lcp.benchmarks.extremes.shapes import grounded, pool

CAUGHT = Promise(Expected.CAUGHT)
RIGHT = (  # problems that the right methods solve
    ("2-D", lambda: pool((24, 25)), "projected-multigrid"),
    ("1-D", lambda: grounded((1, 40)), "minimum-map-newton"),
)


class SignFlipped:
    """A method whose step goes the wrong way: x - dx in the place of x + dx."""

    def __init__(self, right: Any) -> None:
        self._right = right

    def init(self, problem: wl.LCP) -> Any:
        """Return the workspace of the right method."""
        return self._right.init(problem)

    def step(self, problem: wl.LCP, work: Any, x: wp.array[Any]) -> wl.Step:
        """Take the right step, backwards."""
        before = x.numpy().copy()
        done = self._right.step(problem, work, x)
        x.assign(2 * before - x.numpy())
        work.residual.current = False
        return done


def backwards(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Solve by steps that go the wrong way; the loop recomputes the residual and does not call it a solution."""
    return wl.solve(problem, SignFlipped(solver), **options)


def flipped_and_sure(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Return -x of the right result x with its status and its residual: the result itself shows nothing."""
    result = wl.solve(problem, solver, **options)
    return replace(
        result, x=wp.array(-result.x.numpy(), dtype=result.x.dtype, device=result.x.device)
    )


def equations(problem: wl.LCP, solver: Any, *, sign: float, **options: Any) -> wl.SolveResult:
    """Return the solution of y = A x + sign b without bounds: right for what it solves."""
    b = wp.array(sign * problem.b.numpy(), dtype=wp.float64, device=problem.device)
    return wl.solve(wl.LCP(problem.A, problem.layout.unload(b), -np.inf, np.inf), solver, **options)


def sooner(
    problem: wl.LCP, solver: Any, *, stopping: wl.StoppingCriteria, start: bool, **options: Any
) -> wl.SolveResult:
    """Return the start without a step, or what a tenth of the tolerance's digits gives, and call it converged."""
    weak = (
        replace(stopping, max_iterations=0) if start else replace(stopping, rtol=stopping.rtol**0.1)
    )
    result = wl.solve(problem, solver, stopping=weak, **options)
    return replace(result, status=wl.SolveStatus.CONVERGED, residual=result.residual * 1e-9)


SOLVERS: dict[str, Callable[..., wl.SolveResult]] = {
    "steps backwards": backwards,
    "x flipped": flipped_and_sure,
    "b flipped": partial(equations, sign=-1.0),
    "bounds ignored": partial(equations, sign=1.0),
    "start returned": partial(sooner, start=True),
    "claims too much": partial(sooner, start=False),
}


def wrong_solvers() -> Iterator[Case]:
    """Yield each wrong solver on two ordinary problems."""
    for name, solve in SOLVERS.items():
        for dimensions, make, method in RIGHT:
            yield SolveCase(
                "wrong on purpose",
                f"{name}, {dimensions}",
                make,
                method,
                expected=CAUGHT,
                solve=solve,
            )
