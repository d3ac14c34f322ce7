"""Workspaces of methods whose solve has begun, and the iterates of single steps."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl


def begun(problem: wl.LCP, work: Any, x0: np.ndarray | None = None) -> Any:
    """Begin a solve in a workspace, and return the workspace.

    The solve begins at x0, which is not projected; by default at clip(0, l, u).
    """
    problem.bounds.refresh()
    work.residual.start(work.x, keep=False)
    if x0 is not None:
        work.x.assign(problem.layout.load(x0, wp.float64))
    work.residual.evaluate(work.x)
    work.start(warm=x0 is not None, tolerance=0.0)
    return work


def steps_of(
    problem: wl.LCP, method: Any, count: int, x0: np.ndarray | None = None
) -> Iterator[tuple[Any, Any]]:
    """Yield the workspace and the report of each step."""
    work = begun(problem, method.init(problem), x0)
    for _ in range(count):
        step = method.step(problem, work, work.x)
        if not work.residual.current:
            work.residual.evaluate(work.x)
        yield work, step


def iterates(
    problem: wl.LCP, method: Any, count: int, x0: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Yield x after each step."""
    for work, _ in steps_of(problem, method, count, x0):
        yield work.x.numpy().copy()
