"""Solvers that are wrong on purpose. If the checks let one of them pass, the checks are worth nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import Case, Expected, Promise, SolveCase
from warp_lcp.benchmarks.extremes.shapes import grounded, pool, same

CAUGHT = same(Promise(Expected.CAUGHT))


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
    return replace(result, x=wp.array(-result.x.numpy(), dtype=result.x.dtype, device=result.x.device))


def equations(problem: wl.LCP, sign: float) -> wl.LCP:
    """Return y = A x + sign b without bounds."""
    b = wp.array(sign * problem.b.numpy(), dtype=wp.float64, device=problem.device)
    return wl.LCP(problem.A, problem.layout.unload(b), -np.inf, np.inf)


def wrong_sign_of_b(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Return the solution of y = A x - b: right for what it solves."""
    return wl.solve(equations(problem, -1.0), solver, **options)


def ignores_bounds(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Return the solution of the equations: right for what it solves."""
    return wl.solve(equations(problem, 1.0), solver, **options)


def stays_at_start(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Return the start without a step, and call it converged."""
    criteria = options.pop("stopping")
    result = wl.solve(problem, solver, stopping=replace(criteria, max_iterations=0), **options)
    return replace(result, status=wl.SolveStatus.CONVERGED, residual=result.residual * 1e-9)


def claims_too_much(problem: wl.LCP, solver: Any, **options: Any) -> wl.SolveResult:
    """Return what a tenth of the tolerance's digits gives, and call it converged."""
    criteria = options.pop("stopping")
    result = wl.solve(problem, solver, stopping=replace(criteria, rtol=criteria.rtol**0.1), **options)
    return replace(result, residual=result.residual * 1e-9)


SOLVERS = {
    "steps backwards": backwards,
    "x flipped": flipped_and_sure,
    "b flipped": wrong_sign_of_b,
    "bounds ignored": ignores_bounds,
    "start returned": stays_at_start,
    "claims too much": claims_too_much,
}


def wrong_solvers() -> Iterator[Case]:
    """Yield each wrong solver on two ordinary problems."""
    for name, solve in SOLVERS.items():
        yield SolveCase("wrong on purpose", f"{name}, 2-D", lambda: pool((24, 25)), promises=CAUGHT, solve=solve)
        yield SolveCase("wrong on purpose", f"{name}, 1-D", lambda: grounded((1, 40)), "minimum-map-newton", promises=CAUGHT, solve=solve)
