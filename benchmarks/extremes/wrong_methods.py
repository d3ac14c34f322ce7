"""Solvers that are wrong on purpose; the checks must catch each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import ExpectedOutcome, ExtremeCase, OutcomeKind, SolveCase
from warp_lcp.benchmarks.extremes.shapes import grounded, pool
from warp_lcp.files import TableValue
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.method_protocol import Solver, Workspace

CAUGHT = ExpectedOutcome(OutcomeKind.CAUGHT)
RIGHT = (  # problems that the correct methods solve
    ("2-D", lambda: pool((24, 25)), "projected-multigrid"),
    ("1-D", lambda: grounded((1, 40)), "minimum-map-newton"),
)


class WrongSignMethod:
    """Method with the wrong sign of its step: x - dx in place of x + dx."""

    def __init__(self, right: Solver) -> None:
        self._right = right

    def init(self, problem: wl.LCP) -> Workspace:
        """Return the workspace of the correct method."""
        return self._right.init(problem)

    def step(self, problem: wl.LCP, work: Workspace, x: DeviceArray) -> wl.Step:
        """Take the negative of the correct step."""
        before = x.numpy().copy()
        done = self._right.step(problem, work, x)
        x.assign(2 * before - x.numpy())
        work.residual.current = False
        return done


def backwards(problem: wl.LCP, solver: Solver, **options: TableValue) -> wl.SolveResult:
    """Solve by steps of the wrong sign.

    The solve loop recomputes the residual and does not report convergence.
    """
    return wl.solve(problem, WrongSignMethod(solver), **options)


def flipped_and_sure(problem: wl.LCP, solver: Solver, **options: TableValue) -> wl.SolveResult:
    """Return -x with the status and residual of the correct result x.

    The result itself shows no fault.
    """
    result = wl.solve(problem, solver, **options)
    return replace(
        result, x=wp.array(-result.x.numpy(), dtype=result.x.dtype, device=result.x.device)
    )


def equations(
    problem: wl.LCP, solver: Solver, *, sign: float, **options: TableValue
) -> wl.SolveResult:
    """Solve y = A x + sign b without bounds.

    The result is correct for this problem, not for the given one.
    """
    b = wp.array(sign * problem.b.numpy(), dtype=wp.float64, device=problem.device)
    return wl.solve(wl.LCP(problem.A, problem.layout.unload(b), -np.inf, np.inf), solver, **options)


def sooner(
    problem: wl.LCP,
    solver: Solver,
    *,
    stopping: wl.StoppingCriteria,
    start: bool,
    **options: TableValue,
) -> wl.SolveResult:
    """Return an unconverged iterate and call it converged.

    The iterate is the start without a step, or the result for a tenth of the tolerance's digits.
    """
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


def wrong_solvers() -> Iterator[ExtremeCase]:
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
